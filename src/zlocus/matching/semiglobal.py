"""The semi-global constraint on a cost volume, and the heights it prefers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SemiGlobalOptions
from zlocus.matching.height_lattice import NARROW_BASE_STEP_CELLS, HeightLattice
from zlocus.matching.kernels.mgm import sweep_quarter
from zlocus.matching.kernels.penalties import jump_penalties
from zlocus.matching.kernels.sgm import sweep, winner_takes_all, winners
from zlocus.matching.local_contrast import ALL, Part, edge_unit

PATHS = 4  # from W, NW, N and NE; as many come from the other side


@dataclass(frozen=True)
class SemiGlobalHeights:
    """Height indices after aggregation, all (r, c).

    best, second : int32, least sum and least other local minimum (= best where there is none); margin : uint16, by
    how much the sum at `second` is larger; vertex : float32, parabola through the sums around `best`.
    """

    best: NDArray[np.int32]
    second: NDArray[np.int32]
    margin: NDArray[np.uint16]
    vertex: NDArray[np.float32]

    def above(self, base: NDArray[np.float32]) -> SemiGlobalHeights:
        """The same heights counted from the lattice's origin, from indices counted from a base surface (r, c)."""
        best, second = (counted_above(found, base) for found in (self.best, self.second))
        return SemiGlobalHeights(best, second, self.margin, self.vertex + base)


def counted_above(found: NDArray[np.int32], base: NDArray[np.float32]) -> NDArray[np.int32]:
    """Height indices counted from the lattice's origin, from those counted from a base surface, all (r, c)."""
    return np.asarray(np.rint(found + base), np.int32)


def penalties(
    ortho: NDArray[np.float32] | None,
    shape: tuple[int, int],
    level: int,
    options: SemiGlobalOptions,
    by_two: NDArray[np.bool_] | None = None,
    core: Part = ALL,
) -> NDArray[np.uint16]:
    """P2 of the steps from W, NW, N and NE into each cell, (4, r, c) uint16.

    P2 shrinks with the grey difference g of the two cells in the ortho-image, p2 / (1 + g / (edge_contrast median g)),
    but not below p2_edge (Hirschmueller 2008, section 2.3, with the contrast of the cells of `core` as the unit). Both
    are eased at coarser levels: the same roof has half the cells to pay for its jumps, and a roof lost there stays
    lost. ortho : (r, c), NaN where nothing is known of edges; by_two : (r, c) cells that two views cover, no more, to
    which `edge_contrast_two` applies.
    """
    easing = options.level_easing**level
    p2, p2_edge = options.p2 * easing, min(options.p2_edge, options.p2) * easing
    if ortho is None:
        return np.full((PATHS, *shape), p2, np.uint16)
    steps = np.empty((PATHS, *shape), np.uint16)
    unit = np.float32(max(edge_unit(ortho, core), 1e-6))
    units = np.array([options.edge_contrast, options.edge_contrast_two], np.float32) * unit
    by_two = np.zeros(shape, np.bool_) if by_two is None else by_two
    jump_penalties(ortho, by_two, units, np.float32(p2), np.float32(p2_edge), steps)
    return steps


def aggregate(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    p2: NDArray[np.uint16],
    step_cells: float,
    options: SemiGlobalOptions,
    is_pair: bool = False,
) -> SemiGlobalHeights:
    """Sum of the path costs over 8 paths, and its minima.

    cost : (v,) uint8, see `HeightLattice.address`; step_cells : height of a step over the side of a cell; is_pair :
    there are two views and no more, so that `p1_two` applies. Two predecessors find more roofs and take up to
    twice the time; with a narrow base there is little to find (a step is as high as a storey).
    """
    p1 = options.p1_two if is_pair else options.p1
    if (options.predecessors or (1 if step_cells > NARROW_BASE_STEP_CELLS else 2)) == 2:
        return pick(more_global_sums(cost, lattice, p2, p1), lattice)
    total = np.empty(lattice.size, np.uint16)
    for sign in (1, -1):
        sweep(cost, lattice.layout, p2, np.uint16(p1), sign, total)
    return pick(total, lattice)


def alone(cost: NDArray[np.uint8], lattice: HeightLattice) -> SemiGlobalHeights:
    """Heights of the least costs, each cell by itself: what `aggregate` gives without penalties.

    Costs count once per path there, so they do here, and margins mean the same.
    """
    return pick(np.multiply(cost, np.uint16(2 * PATHS), dtype=np.uint16), lattice)


def lone_heights(cost: NDArray[np.uint8], lattice: HeightLattice, found: NDArray[np.int32]) -> NDArray[np.int32]:
    """Height indices (r, c) of the least costs, each cell by itself; of equals that of `found`, (r, c)."""
    lone = np.empty(lattice.shape, np.int32)
    winner_takes_all(cost, lattice.layout, found, lone)
    return lone


def more_global_sums(
    cost: NDArray[np.uint8], lattice: HeightLattice, p2: NDArray[np.uint16], p1: int
) -> NDArray[np.uint16]:
    """Sum over 8 directions of path costs with two predecessors, (v,) uint16.

    The second one lies a quarter turn clockwise from the first (Facciolo, de Franchis, Meinhardt 2015). Sums are of
    the size of those with one predecessor, so that limits on margins mean the same.
    """
    total = np.zeros(lattice.size, np.uint16)
    for turn in range(4):
        sweep_quarter(cost, lattice.layout, p2, np.uint16(p1), turn, total)
    return total


def pick(total: NDArray[np.uint16], lattice: HeightLattice) -> SemiGlobalHeights:
    """Heights of the least sums of a volume laid out as `HeightLattice.address` says."""
    best, second = np.empty(lattice.shape, np.int32), np.empty(lattice.shape, np.int32)
    margin, vertex = np.empty(lattice.shape, np.uint16), np.empty(lattice.shape, np.float32)
    winners(total, lattice.layout, best, second, margin, vertex)
    return SemiGlobalHeights(best, second, margin, vertex)
