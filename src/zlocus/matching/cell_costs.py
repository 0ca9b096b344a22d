"""What decided the height of single cells: costs by height, the evidence of each pair of images, and what the coarser
level knew.

A run keeps none of this. `match_with_costs` therefore matches a tile again, as the run did, and keeps the costs of the
last pass over its finest level; `cell_costs` reads those of a cell. The evidence of a pair of images is computed by
the kernel of the run, from which all other images are withheld.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import CostOptions
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.cost_volume import CountedPairs, cost_parameters, half_widths
from zlocus.matching.evidence import MAX_LOG_RATIO, learned_evidence
from zlocus.matching.finest_level import refined_surface, with_planes_of_segments
from zlocus.matching.kernels.cost_volume import SlopeArrays, tile_costs
from zlocus.matching.kernels.evidence import NO_COST_IS_FAR, TableAndCounts
from zlocus.matching.kernels.pairs_of_block import pairs_of_block
from zlocus.matching.kernels.shared_records import NEVER_COVERED, NEVER_OCCLUDED, VisibleHeights, VolumeLayout
from zlocus.matching.level_records import LevelResult, PyramidLevel, SearchPrior, TileInputs
from zlocus.matching.occlusion import PAIR, covers, sees
from zlocus.matching.pair_labels import PairLabels
from zlocus.matching.prior_costs import costs_of_coarser
from zlocus.matching.search_range import candidates
from zlocus.matching.surface import max_sigma_m
from zlocus.matching.tile import LevelCosts, level_costs, match_all_levels, result_of_costs

# Costs of single pairs have this many steps for a natural unit of evidence: as fine as costs from 0 to 255 allow.
UNIT_OF_PAIR = np.float32(250.0 / (2 * MAX_LOG_RATIO))


@dataclass(frozen=True)
class MatchedCosts:
    """A tile that was matched again, with the costs of its finest level.

    tile : its inputs; level : the finest level, its window with halo; coarser_result : that of the next coarser level;
    result : of the finest level, before planes and refinement; costs : of its last pass, before the semi-global
    constraint; known_costs : (v,) uint8, those of the coarser level's candidates, which are a part of the costs, None
    without; table_and_counts : the evidence of the pass, None where costs are those of correlation; height_m : (r, c)
    float32, ellipsoidal, of the surface; NaN where it has none.
    """

    tile: TileInputs
    level: PyramidLevel
    coarser_result: LevelResult
    result: LevelResult
    costs: LevelCosts
    known_costs: NDArray[np.uint8] | None
    table_and_counts: TableAndCounts | None
    height_m: NDArray[np.float32]


@dataclass(frozen=True)
class PairEvidence:
    """The evidence of a pair of views at a cell.

    views : their numbers in the scene; log_ratio : (h,) float64, natural logarithm of how much more often windows that
    look like these occur at right heights than at wrong ones, 0 at wrong heights on average, NaN where a view does not
    see the cell; weight : how much the pair counts, 1 for the mean pair, 0 for a pair that is not compared; counts :
    (h,) bool, whether it is among the best pairs, of which the mean is the evidence.
    """

    views: tuple[int, int]
    log_ratio: FloatArray
    weight: float
    counts: NDArray[np.bool_]


@dataclass(frozen=True)
class CellCosts:
    """What decided the height of a cell, by height searched.

    heights_m : (h,) float64 ellipsoidal m; cost, known_cost : (h,) uint8, all costs and those of the coarser level's
    candidates, the latter 0 without them; chosen : which of the heights the semi-global constraint chose; second_m :
    height of the secondary minimum of the path costs, NaN without one; uniqueness : by how much its sum is larger;
    coarser_m : (3,) m, what the coarser level considers here: its height, the second one, that of the least cost on
    which neighbours agree; coarser_cell_m : side of its cells; height_m : of the surface, NaN without one;
    pair_evidence : of the pairs of views, none where costs are those of correlation; view_numbers : views of the tile;
    sees : (i,) bool, which of them take part at the chosen height.
    """

    heights_m: FloatArray
    cost: NDArray[np.uint8]
    known_cost: NDArray[np.uint8]
    chosen: int
    second_m: float
    uniqueness: int
    coarser_m: FloatArray
    coarser_cell_m: float
    height_m: float
    pair_evidence: tuple[PairEvidence, ...]
    view_numbers: tuple[int, ...]
    sees: NDArray[np.bool_]


def match_with_costs(tile: TileInputs) -> MatchedCosts | None:
    """Match a tile again and keep the costs of its finest level.

    None where no two views see its core, and where there is no coarser level from which the costs begin.
    """
    if len(tile.view_numbers) < PAIR:
        return None
    all_level_costs: list[LevelCosts] = []

    def match(
        tile: TileInputs, level: PyramidLevel, prior: SearchPrior, pair_labels: PairLabels | None,
        earlier_result: LevelResult | None,
    ) -> LevelResult:  # fmt: skip
        costs = level_costs(tile, level, prior, pair_labels, earlier_result)
        if level.number == 0:
            # Both are changed while the result is made.
            chosen_views = replace(costs.chosen_views, matched=costs.chosen_views.matched.copy())
            all_level_costs[:] = [replace(costs, cost=costs.cost.copy(), chosen_views=chosen_views)]
        return result_of_costs(tile, level, costs)

    levels = match_all_levels(tile, match)
    if len(levels.results) < 2:
        return None
    coarser, result = levels.results[-2:]
    (costs,) = all_level_costs
    known_costs = None
    if costs.has_known_costs:
        slope_surface = costs.search.slope_surface
        known_costs = costs_of_coarser(costs.search.lattice, slope_surface, result.level, coarser, tile.config.pyramid)
    with_planes = result if tile.method == "mvll" else with_planes_of_segments(result, tile.config)
    max_sigma = max_sigma_m(tile.config.checks, tile.method, tile.match_scene.cell_size)
    surface = refined_surface(tile, with_planes, levels.ground).surface.precise(max_sigma)
    evidence = _evidence_of(tile, costs)
    return MatchedCosts(tile, result.level, coarser, result, costs, known_costs, evidence, surface.height)


def _evidence_of(tile: TileInputs, costs: LevelCosts) -> TableAndCounts | None:
    """The table of evidence of a pass; None where its costs are those of correlation."""
    if costs.taught_heights is None:
        return None
    search, options, windows = costs.search, tile.config.cost, half_widths(tile.config.cost)
    slope = SlopeArrays(search.slope_surface.padded(int(windows.max())), search.slope_surface.nodes)
    parameters = cost_parameters(options, CountedPairs.of(tile))
    matched = costs.chosen_views.matched
    return learned_evidence(
        search.slope_views, slope, search.lattice, windows, matched, parameters, costs.taught_heights
    )  # fmt: skip


def cell_costs(matched_costs: MatchedCosts, row: int, col: int) -> CellCosts | None:
    """What decided the height of a cell; None where the matched window does not contain it.

    row, col : of the finest lattice.
    """
    level, result, costs = matched_costs.level, matched_costs.result, matched_costs.costs
    r, c = row - level.window.row, col - level.window.col
    if not (0 <= r < level.window.rows and 0 <= c < level.window.cols):
        return None
    lattice, slope = costs.search.lattice, float(costs.search.slope_surface.cells[r, c])
    first, count, start = _place_of(lattice.layout, r, c)
    index = first + np.arange(count)
    chosen = int(np.clip(np.rint(result.heights.best[r, c] - slope) - first, 0, count - 1))
    best, second = int(result.heights.best[r, c]), int(result.heights.second[r, c])
    known = matched_costs.known_costs
    matched = costs.chosen_views.matched.at(np.s_[:, r, c])
    return CellCosts(
        heights_m=np.asarray(lattice.height_origin + (index + slope) * lattice.height_step, np.float64),
        cost=costs.cost[start : start + count],
        known_cost=np.zeros(count, np.uint8) if known is None else known[start : start + count],
        chosen=chosen,
        second_m=np.nan if second == best else lattice.height_origin + second * lattice.height_step,
        uniqueness=int(result.heights.uniqueness[r, c]),
        coarser_m=_coarser_heights(matched_costs, row, col),
        coarser_cell_m=matched_costs.coarser_result.level.cell_size,
        height_m=float(matched_costs.height_m[r, c]),
        pair_evidence=_pairs_at(matched_costs, r, c),
        view_numbers=tuple(matched_costs.tile.view_numbers),
        sees=sees(matched, np.full(1, first + chosen, np.float32)),
    )


def _place_of(layout: VolumeLayout, r: int, c: int) -> tuple[int, int, int]:
    """First height index of a cell, number of heights, and where its costs begin in the volume."""
    b, d = r // layout.block, c // layout.block
    count = int(layout.n_heights[b, d])
    start = layout.block_row_start[b, d] + (r - b * layout.block) * layout.row_length[b, d]
    return int(layout.first[b, d]), count, int(start + layout.block_start[b, d] + (c - d * layout.block) * count)


def _coarser_heights(matched_costs: MatchedCosts, row: int, col: int) -> FloatArray:
    """Heights (3,) m that the coarser level considers at a finest cell, see `candidates`."""
    coarser = matched_costs.coarser_result
    window = coarser.level.window
    r, c = (row >> 1) - window.row, (col >> 1) - window.col
    r, c = min(max(r, 0), window.rows - 1), min(max(c, 0), window.cols - 1)
    found = candidates(coarser, matched_costs.tile.config.pyramid)[:, r, c]
    return np.asarray(coarser.level.height_origin + found * coarser.level.height_step, np.float64)


def _pairs_at(matched_costs: MatchedCosts, r: int, c: int) -> tuple[PairEvidence, ...]:
    """Evidence of the pairs of views that cover a cell of the window, those that count most first."""
    evidence, costs, numbers = matched_costs.table_and_counts, matched_costs.costs, matched_costs.tile.view_numbers
    if evidence is None:
        return ()
    visible = costs.chosen_views.matched
    b, d = r // costs.search.lattice.block, c // costs.search.lattice.block
    block = costs.search.lattice.block
    box = np.s_[:, b * block : (b + 1) * block, d * block : (d + 1) * block]
    of_block = visible.at(box)
    covering = np.flatnonzero(covers(of_block).any(axis=(1, 2)))
    if len(covering) < PAIR:
        return ()
    weights = pairs_of_block(evidence.table.worth, covering).weights
    n_first, n_heights, _ = _place_of(costs.search.lattice.layout, r, c)
    index = np.arange(n_first, n_first + n_heights, dtype=np.float32)
    place, found = (r - b * block, c - d * block), []
    for (k, one), (m, other) in combinations(enumerate(covering.tolist()), 2):
        if weights[k, m] == 0:
            continue
        see = sees(visible.at(np.s_[one, r, c]), index) & sees(visible.at(np.s_[other, r, c]), index)
        log_ratio = np.full(n_heights, np.nan)
        if see.any():
            alone = _only(of_block, (one, other))
            cost = _costs_of_block(matched_costs, evidence, alone, (b, d), len(covering))
            highest = min(float(evidence.table.highest), 255.0 / float(UNIT_OF_PAIR))
            log_ratio[see] = (highest - cost[place] / float(UNIT_OF_PAIR))[see]
        found.append(PairEvidence((numbers[one], numbers[other]), log_ratio, float(weights[k, m]), see))
    best = _best_pairs(np.array([pair.log_ratio for pair in found]), [pair.weight for pair in found],
                       float(evidence.table.best_share))  # fmt: skip
    return tuple(replace(pair, counts=counts) for pair, counts in zip(found, best, strict=True))


def _only(visible: VisibleHeights, views: tuple[int, int]) -> VisibleHeights:
    """The visible height ranges of a block without all views but some."""
    alone = visible.copy()
    others = np.ones(len(alone.lowest_covered), np.bool_)
    others[list(views)] = False
    alone.lowest_covered[others], alone.highest_covered[others] = NEVER_COVERED, NEVER_OCCLUDED
    return VisibleHeights(*(np.ascontiguousarray(bound) for bound in alone))


def _costs_of_block(
    matched_costs: MatchedCosts,
    table_and_counts: TableAndCounts,
    visible: VisibleHeights,
    place: tuple[int, int],
    n_covering: int,
) -> NDArray[np.uint8]:
    """Costs (r, c, h) of a block with some of its views, in units of `UNIT_OF_PAIR`.

    place : row and column of the block; n_covering : views that cover it, on which the windows depend.
    """
    costs, options = matched_costs.costs, matched_costs.tile.config.cost
    search, (b, d) = costs.search, place
    views, lattice, windows = search.slope_views.arrays, search.lattice, _windows_of(options, n_covering)
    half, (rows, cols), block = int(windows.max()), visible.lowest_covered.shape[1:], search.lattice.block
    of_block = views._replace(
        nodes=np.ascontiguousarray(views.nodes[:, b : b + 2, d : d + 2]),
        bends=np.ascontiguousarray(views.bends[:, b : b + 1, d : d + 1]),
    )
    around = search.slope_surface.padded(half)[b * block :, d * block :][: rows + 2 * half, : cols + 2 * half]
    slope = SlopeArrays(
        np.ascontiguousarray(around), np.ascontiguousarray(search.slope_surface.nodes[b : b + 2, d : d + 2])
    )
    n_heights = int(lattice.count[b, d])
    one = replace(lattice, shape=(rows, cols), first=lattice.first[b : b + 1, d : d + 1].copy(),
                  count=lattice.count[b : b + 1, d : d + 1].copy())  # fmt: skip
    table = table_and_counts.table._replace(
        unit=UNIT_OF_PAIR, small_window_unit=UNIT_OF_PAIR, max_cost=np.float32(255.0), best_share=np.float32(1.0)
    )
    volume = np.zeros(rows * cols * n_heights, np.uint8)
    parameters = cost_parameters(options, CountedPairs.of(matched_costs.tile))
    withheld = TableAndCounts(table, table_and_counts.learning, NO_COST_IS_FAR)
    tile_costs(of_block, slope, one.layout, windows, visible, parameters, withheld, volume)
    return volume.reshape(rows, cols, n_heights)


def _windows_of(options: CostOptions, n_covering: int) -> NDArray[np.int64]:
    """Half widths of the windows of a block that so many views cover, see `cost_volume`."""
    windows = half_widths(options)
    return windows if n_covering <= options.max_images_for_large_window else windows[:1]


def _best_pairs(log_ratio: FloatArray, weights: list[float], share: float) -> NDArray[np.bool_]:
    """Which pairs are among the best at each height, (p, h) bool; the last one of them may count in part.

    log_ratio : (p, h), NaN where a pair does not see the cell; share : of the weight of those that do.
    """
    best = np.zeros(log_ratio.shape, np.bool_)
    weight = np.where(np.isnan(log_ratio), 0.0, np.array(weights)[:, None])
    order = np.argsort(np.where(np.isnan(log_ratio), np.inf, -log_ratio), axis=0, kind="stable")
    sorted_weight = np.take_along_axis(weight, order, axis=0)
    before = np.cumsum(sorted_weight, axis=0) - sorted_weight
    is_best = (sorted_weight > 0) & (before < share * weight.sum(axis=0))
    np.put_along_axis(best, order, is_best, axis=0)
    return best


def tile_around(core_window: CellWindow, row: int, col: int, side: int) -> CellWindow:
    """The part of a tile's core, of about `side` cells along each side, that is matched again for a cell.

    The whole core where it has no more cells than `side`² times two. The parts overlap by half, so that a cell lies at
    least a quarter of a side from their border, unless it lies at that of the core.
    """
    if core_window.rows * core_window.cols <= 2 * side * side:
        return core_window
    firsts, sizes = [], []
    for at, first, length in ((row, core_window.row, core_window.rows), (col, core_window.col, core_window.cols)):
        size, half = min(side, length), side // 2
        start = (at - first - side // 4) // half * half
        firsts.append(first + min(max(start, 0), length - size))
        sizes.append(size)
    return CellWindow(*firsts, *sizes)
