"""What is known of the surface as a part of the costs, and penalties of jumps that follow from how well it fits.

Costs of unexpected heights
    At the coarsest level, heights far from what the tie points around a place suggest cost more, see
    `zlocus.matching.expected_heights`.
Costs of candidates
    The search range of a block is wide wherever one of its cells needs it, and noise finds false heights in it. Heights
    far from everything that the coarser level considers around a cell, with its wider windows, therefore cost more.
Misfit
    After a first aggregation, the costs of most cells are least at, or near, the height found. Where a whole patch of
    cells has much lower costs at other heights, the smooth surface contradicts the images: a crown or a roof was
    smoothed away. There jumps become cheaper, and the costs are aggregated once more. Noise alone makes small misfits,
    and a plain road has none, because all heights cost the same there.
Agreement of the costs with the surface
    Good images need less smoothing. The larger the share of cells is whose least cost lies at the height found, the
    lower are all penalties of jumps when the costs are aggregated once more.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import PyramidOptions, SemiGlobalOptions
from zlocus.matching.expected_heights import expected_heights
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.prior_costs import (
    CoarserCells,
    DistanceCost,
    add_costs_beyond,
    add_costs_of_candidates,
    write_misfit,
)
from zlocus.matching.level_records import LevelResult, PyramidLevel
from zlocus.matching.local_contrast import Part
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.search_range import candidates
from zlocus.matching.semiglobal import SemiGlobalHeights, winner_takes_all_indices
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.unsupported_patches import heights_of_surroundings

# Coarser cells on each side whose candidates are known to a cell, and the cost of heights far from all of them.
CANDIDATE_REACH = 2
COST_OF_CANDIDATES = DistanceCost(np.float32(3.0), np.float32(5.0), np.float32(30.0))
# The cost of heights far from what the tie points suggest, at the coarsest level.
COST_BEYOND_EXPECTED = DistanceCost(np.float32(0.0), np.float32(5.0), np.float32(20.0))
# And of all heights below or above the tie points, objects or not: where no two images see a cell all heights cost the
# same, so that a surface at its rim would lie anywhere.
COST_BEYOND_TIES = DistanceCost(np.float32(0.0), np.float32(0.25), np.float32(8.0))
# Where jumps become cheaper, heights far from the surface of the first aggregation become more expensive: so many steps
# of the finest level are free, below and above the heights of NEARBY_CELLS. A tree is as high for images with a narrow
# base, whose steps are large: no more than so many sides of a finest cell are free, and the cost of a step grows as the
# free steps become fewer.
NEARBY_CELLS = np.ones((5, 5), np.uint8)
FREE_STEPS, FREE_SIDES = 12.0, 21.0
COST_BEYOND, MAX_COST_BEYOND = 3.0, 30.0
# The same for patches that stand off their surroundings without evidence, and the heights of the surroundings.
COST_OFF_SURROUNDINGS, MAX_COST_OFF_SURROUNDINGS = 6.0, 90.0
# A height that no cell has.
FAR = np.float32(1e6)
# The misfit is averaged over windows of this side, so that it is that of a patch. The penalty of a jump is halved where
# it is HALVING_MISFIT; one cell counts with MAX_MISFIT at most.
MISFIT_WINDOW, HALVING_MISFIT, MISFIT_POWER, MAX_MISFIT = (9, 9), 15.0, 3, 40.0
LEAST_PENALTY = 10
# Penalties of jumps decrease from the first share of cells whose least cost lies within a step of the height found, to
# LEAST_FACTOR at the second.
SHARES, LEAST_FACTOR = (0.7, 0.95), 0.5


def costs_of_coarser(
    lattice: HeightLattice,
    slope_surface: SlopeSurface,
    level: PyramidLevel,
    coarser_result: LevelResult,
    options: PyramidOptions,
) -> NDArray[np.uint8]:
    """The costs of heights far from the candidates of the coarser level, (v,) uint8, see `HeightLattice.layout`."""
    window, coarser_window = level.window, coarser_result.level.window
    cells = CoarserCells(window.row - 2 * coarser_window.row, window.col - 2 * coarser_window.col, CANDIDATE_REACH)
    found = np.ascontiguousarray(candidates(coarser_result, options), np.int32)
    cost = np.zeros(lattice.size, np.uint8)
    add_costs_of_candidates(cost, lattice.layout, slope_surface.cells, found, cells, COST_OF_CANDIDATES)
    return cost


def add_costs_beyond_expected(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    slope_surface: SlopeSurface,
    match_scene: MatchScene,
    level: PyramidLevel,
) -> None:
    """Add the costs of heights below or above those that tie points suggest; changes `cost`, (v,) uint8."""
    for has_margins, cost_of_distance in ((True, COST_BEYOND_EXPECTED), (False, COST_BEYOND_TIES)):
        expected = expected_heights(match_scene, level, has_margins)
        if expected is not None:
            add_costs_beyond(cost, lattice.layout, slope_surface.cells, *expected, cost_of_distance)


def misfit(cost: NDArray[np.uint8], lattice: HeightLattice, heights: SemiGlobalHeights) -> NDArray[np.float32]:
    """Mean over a window of how much the cost of the heights found is above the least cost, (r, c) float32."""
    of_cells = np.empty(lattice.shape, np.float32)
    write_misfit(cost, lattice.layout, heights.best, np.ones(lattice.shape, np.bool_), of_cells)
    return np.asarray(cv2.blur(np.minimum(of_cells, np.float32(MAX_MISFIT)), MISFIT_WINDOW))


def share_at_least_cost(
    cost: NDArray[np.uint8], lattice: HeightLattice, heights: SemiGlobalHeights, core: Part
) -> float:
    """Share of the cells of `core` whose least cost lies within a step of the height found, from 0 to 1; 0
    without such cells.

    cost : (v,), see `HeightLattice.layout`, the one that was aggregated; of equal costs the one at the height counts.
    """
    at_least_cost = winner_takes_all_indices(cost, lattice, heights.best)
    is_near = np.abs(at_least_cost[core] - heights.best[core]) <= 1
    return float(is_near.mean()) if is_near.size else 0.0


def penalty_factor(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    heights: SemiGlobalHeights,
    core: Part,
    options: SemiGlobalOptions,
) -> float:
    """Factor of the penalties of jumps, from LEAST_FACTOR to 1: the smaller, the more cells of `core` have their least
    cost at the heights found. 1 where the options set P2. cost : (v,), see `share_at_least_cost`."""
    if options.p2 is not None:
        return 1.0
    return float(np.interp(share_at_least_cost(cost, lattice, heights, core), SHARES, (1.0, LEAST_FACTOR)))


def smaller_penalties(penalties: NDArray[np.uint16], factor: float, least_penalty: float) -> NDArray[np.uint16]:
    """Penalties of jumps (4, r, c) times a factor; those above `least_penalty`, that of a strong edge of the
    ortho-image, do not fall below it."""
    least = np.minimum(penalties, np.uint16(least_penalty))
    return np.maximum((penalties * np.float32(factor)).astype(np.uint16), least)


def penalties_after_misfit(penalties: NDArray[np.uint16], of_patch: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Penalties (4, r, c) of jumps from W, NW, N and NE, made smaller where the surface fits badly.

    of_patch : (r, c), see `misfit`.
    """
    factor = 1.0 / (1.0 + (of_patch / np.float32(HALVING_MISFIT)) ** MISFIT_POWER)
    wide = np.pad(factor, 1, mode="edge")
    rows, cols = factor.shape
    smaller = np.empty_like(penalties)
    for path, (row, col) in enumerate(((1, 0), (0, 0), (0, 1), (0, 2))):
        other = wide[row : row + rows, col : col + cols]
        smaller[path] = np.maximum(penalties[path] * (factor + other) / 2, LEAST_PENALTY)
    return smaller


def add_costs_far_from_surface(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    slope_surface: SlopeSurface,
    heights: SemiGlobalHeights,
    level: int,
    step_cells: float,
) -> None:
    """Add the costs of heights far below or above the surface found around a cell; changes `cost`, (v,) uint8.

    Where a patch of the surface stands off its surroundings without evidence, their heights take its place. step_cells
    : finest height step divided by the side of a finest cell.
    """
    surface = np.asarray(heights.vertex + slope_surface.cells, np.float32)
    surroundings = heights_of_surroundings(cost, lattice, slope_surface, surface, level, step_cells)
    is_replaced = np.isfinite(surroundings)
    if is_replaced.any():
        surface = np.where(is_replaced, surroundings, surface)
        off = cost_beyond(COST_OFF_SURROUNDINGS, MAX_COST_OFF_SURROUNDINGS, level, step_cells)
        low, high = np.where(is_replaced, surface, -FAR), np.where(is_replaced, surface, FAR)
        add_costs_beyond(cost, lattice.layout, slope_surface.cells, low, high, off)
    low, high = cv2.erode(surface, NEARBY_CELLS), cv2.dilate(surface, NEARBY_CELLS)
    by_distance = cost_beyond(COST_BEYOND, MAX_COST_BEYOND, level, step_cells)
    add_costs_beyond(cost, lattice.layout, slope_surface.cells, low, high, by_distance)


def cost_beyond(cost_per_step: float, max_cost: float, level: int, step_cells: float) -> DistanceCost:
    """Cost of the steps of a level beyond those that are free, see FREE_STEPS. step_cells : finest height step divided
    by the side of a finest cell."""
    free_steps = min(FREE_STEPS, FREE_SIDES / step_cells)
    cost = cost_per_step * FREE_STEPS / free_steps
    return DistanceCost(np.float32(free_steps / 2**level), np.float32(cost), np.float32(max_cost))
