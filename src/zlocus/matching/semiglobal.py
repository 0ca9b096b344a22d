"""The semi-global constraint on a cost volume, and the heights that it prefers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SemiGlobalOptions
from zlocus.core.options.option_fields import value_of
from zlocus.matching.height_lattice import NARROW_BASE_STEP_CELLS, HeightLattice
from zlocus.matching.kernels.mgm import sweep_quarter
from zlocus.matching.kernels.penalties import PenaltyOptions, image_penalties
from zlocus.matching.kernels.sgm import sweep
from zlocus.matching.kernels.winners import winner_takes_all, winners
from zlocus.matching.local_contrast import ALL, Part, edge_unit
from zlocus.matching.occlusion import PAIR

PATHS = 4  # from W, NW, N and NE; as many come from the other side
# P1 is divided by the number of images less one, but is not below this: many images err together.
LEAST_P1 = 45
# The default of P1 for two images is that of height steps of so many cells, or more: those of satellite images. The
# least P1 of many images holds for steps of a cell or more.
USUAL_STEP_CELLS, LEAST_STEP_CELLS = 1.35, 1.0
# The uniqueness of a height without another minimum, as the kernel `winners` writes it.
NO_OTHER_HEIGHT = 65535
# Cells that only two images cover ask for so many times the contrast of an edge that opens a jump.
PAIR_CONTRAST = np.float32(4.0)


@dataclass(frozen=True)
class SemiGlobalHeights:
    """Height indices after aggregation, all (r, c).

    best : int32, minimum of the sums of path costs; second : int32, the secondary minimum, that is the least local
    minimum at least three steps away, = best where there is none; uniqueness : uint16, by how much the sum at `second`
    is larger, 65535 where there is none, see `with_full_penalties`; vertex : float32, minimum of the parabola through
    the sums around `best`.
    """

    best: NDArray[np.int32]
    second: NDArray[np.int32]
    uniqueness: NDArray[np.uint16]
    vertex: NDArray[np.float32]

    def on_lattice(self, slope_cells: NDArray[np.float32]) -> SemiGlobalHeights:
        """The same heights as indices of the lattice, from indices counted from a slanted support surface.

        slope_cells : (r, c), lattice index of that surface at each cell.
        """
        best, second = (level_indices(index, slope_cells) for index in (self.best, self.second))
        return SemiGlobalHeights(best, second, self.uniqueness, self.vertex + slope_cells)

    def with_full_penalties(self, factor: float) -> SemiGlobalHeights:
        """The same heights with the uniqueness as it would be with penalties that were not made smaller by a factor.

        Limits of the uniqueness, and the precision model, count it in units of the full penalties.
        """
        if factor == 1.0:
            return self
        in_full = np.minimum(self.uniqueness / np.float32(factor), np.float32(NO_OTHER_HEIGHT - 1))
        is_only = self.uniqueness == NO_OTHER_HEIGHT
        return replace(self, uniqueness=np.where(is_only, NO_OTHER_HEIGHT, in_full).astype(np.uint16))


def level_indices(index: NDArray[np.int32], slope_cells: NDArray[np.float32]) -> NDArray[np.int32]:
    """Level indices of slope indices, both (r, c)."""
    return np.asarray(np.rint(index + slope_cells), np.int32)


def jump_penalties(
    ortho: NDArray[np.float32] | None,
    shape: tuple[int, int],
    level: int,
    options: SemiGlobalOptions,
    has_two_views: NDArray[np.bool_] | None = None,
    core: Part = ALL,
    edge_weight: NDArray[np.float32] | None = None,
) -> NDArray[np.uint16]:
    """Penalty P2 of the steps from W, NW, N and NE into each cell, (4, r, c) uint16.

    P2 decreases with the grey difference g of the two cells in the ortho-image, p2 / (1 + g / (edge_contrast median
    g)), but not below p2_edge (Hirschmueller 2008, section 2.3, with the contrast of the cells of `core` as the unit).
    Both are lower at coarser levels: there the same roof has half as many cells to pay for its jumps, and a roof that
    is lost there stays lost.

    ortho : (r, c), NaN where the grey value is not known; has_two_views : (r, c), cells that only two views cover,
    where PAIR_CONTRAST times as much contrast is asked for; edge_weight : (r, c) from 0 to 1, how much of the decrease
    an edge at each cell is worth, None for all of it.
    """
    factor = options.penalty_factor_per_level**level
    p2 = value_of(options, "p2") * factor
    p2_edge = least_jump_penalty(level, options)
    if ortho is None:
        return np.full((PATHS, *shape), p2, np.uint16)
    penalties = np.empty((PATHS, *shape), np.uint16)
    unit = np.float32(max(edge_unit(ortho, core), 1e-6))
    unit *= np.float32(value_of(options, "edge_contrast"))
    has_two_views = np.zeros(shape, np.bool_) if has_two_views is None else has_two_views
    edge_weight = np.ones(shape, np.float32) if edge_weight is None else edge_weight
    constants = PenaltyOptions(np.float32(p2), np.float32(p2_edge), unit, PAIR_CONTRAST * unit)
    image_penalties(ortho, has_two_views, edge_weight, constants, penalties)
    return penalties


def least_jump_penalty(level: int, options: SemiGlobalOptions) -> float:
    """Penalty P2 of a level across a strong edge of the ortho-image."""
    factor = options.penalty_factor_per_level**level
    return float(min(value_of(options, "p2_edge"), value_of(options, "p2")) * factor)


def aggregate(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    p2: NDArray[np.uint16],
    step_cells: float,
    options: SemiGlobalOptions,
    n_images: float = PAIR,
) -> SemiGlobalHeights:
    """Heights with the least sum of the path costs over 8 paths.

    cost : (v,) uint8, see `HeightLattice.layout`; p2 : see `jump_penalties`; step_cells : height step divided by the
    side of a cell, from which P1 follows if it is not set; n_images : that see a cell; see `penalty_of_one_step` for
    both. Two predecessors find more roofs and take up to twice the time; with a narrow base, where a step is as high as
    a storey, they find few more.
    """
    p1 = penalty_of_one_step(value_of(options, "p1"), n_images, step_cells if options.p1 is None else USUAL_STEP_CELLS)
    if (options.predecessors or (1 if step_cells > NARROW_BASE_STEP_CELLS else 2)) == 2:
        return heights_of_sums(more_global_path_sums(cost, lattice, p2, p1), lattice)
    total = np.empty(lattice.size, np.uint16)
    for sign in (1, -1):
        sweep(cost, lattice.layout, p2, np.uint16(p1), sign, total)
    return heights_of_sums(total, lattice)


def penalty_of_one_step(p1: int, n_images: float, step_cells: float = USUAL_STEP_CELLS) -> int:
    """P1 where so many images see a cell, and a height step is so many cells high.

    p1 : where two images see it, for height steps of USUAL_STEP_CELLS or more. n images compare a height n - 1 times
    without repeating what was compared already, so that the noise of their mean cost is smaller, and the constraint has
    to smooth less.

    Where the base is wide, a step is lower than a cell: the same slope takes more steps, and each of them says less.
    P1 decreases with the square of the height of a step, as the logarithm of a normal distribution of slopes does, and
    its least value with that height, below LEAST_STEP_CELLS.
    """
    of_two = round(p1 * min(step_cells / USUAL_STEP_CELLS, 1.0) ** 2)
    least = round(LEAST_P1 * min(step_cells / LEAST_STEP_CELLS, 1.0))
    return min(max(round(of_two / max(n_images - 1.0, 1.0)), least), of_two)


def winner_takes_all_heights(cost: NDArray[np.uint8], lattice: HeightLattice) -> SemiGlobalHeights:
    """Heights of the least costs of each cell, without regard to its neighbours: `aggregate` without penalties.

    `aggregate` counts the cost of a cell once per path. So does this, and the uniqueness means the same.
    """
    return heights_of_sums(np.multiply(cost, np.uint16(2 * PATHS), dtype=np.uint16), lattice)


def winner_takes_all_indices(
    cost: NDArray[np.uint8], lattice: HeightLattice, preferred: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Height indices (r, c) of the least costs of each cell; of equal costs that of `preferred`, (r, c)."""
    best = np.empty(lattice.shape, np.int32)
    winner_takes_all(cost, lattice.layout, preferred, best)
    return best


def more_global_path_sums(
    cost: NDArray[np.uint8], lattice: HeightLattice, p2: NDArray[np.uint16], p1: int
) -> NDArray[np.uint16]:
    """Sum over 8 directions of path costs with two predecessors, (v,) uint16.

    The second predecessor lies a quarter turn clockwise from the first (Facciolo, de Franchis, Meinhardt 2015). The
    sums are as large as those with one predecessor, so that limits of the uniqueness mean the same.
    """
    total = np.zeros(lattice.size, np.uint16)
    for turn in range(4):
        sweep_quarter(cost, lattice.layout, p2, np.uint16(p1), turn, total)
    return total


def heights_of_sums(total: NDArray[np.uint16], lattice: HeightLattice) -> SemiGlobalHeights:
    """Heights of the least sums of a volume, (v,) uint16, see `HeightLattice.layout`."""
    best, second = np.empty(lattice.shape, np.int32), np.empty(lattice.shape, np.int32)
    uniqueness, vertex = np.empty(lattice.shape, np.uint16), np.empty(lattice.shape, np.float32)
    winners(total, lattice.layout, best, second, uniqueness, vertex)
    return SemiGlobalHeights(best, second, uniqueness, vertex)
