"""Matching of one tile: pixels of all its images, level after level, to a surface.

The order of docs/explanation/method.md: the coarsest level searches the whole height range; every finer level searches
around the heights of the coarser one; the heights of the finest level are refined and checked. `match_level` names the
stages of one level, `match_tile` those of a tile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, large_window_side
from zlocus.core.options.option_fields import value_of
from zlocus.matching.break_lines import constrain
from zlocus.matching.cost_volume import CountedPairs, cost_volume
from zlocus.matching.edge_penalties import penalties_at_edges
from zlocus.matching.evidence import MIN_CELLS_OF_TILE, TaughtHeights, heights_to_learn_from
from zlocus.matching.expected_heights import expected_of_searched
from zlocus.matching.fill import filled
from zlocus.matching.finest_level import ortho_of_surface, refined_surface, with_planes_of_segments
from zlocus.matching.free_rays import add_costs_of_rays
from zlocus.matching.height_lattice import search_lattice
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.level_records import (
    ERODE_OWN_SURFACE,
    LevelResult,
    LevelSearch,
    PyramidLevel,
    SearchPrior,
    TileInputs,
    count_evaluations,
)
from zlocus.matching.local_contrast import agreement
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.occlusion import (
    MANY_VIEWS,
    PAIR,
    covered_heights,
    covers,
    exclude_views_of_one_direction,
    in_level_indices,
    keep_enough_views,
    mark_occlusions,
    usual_number,
)
from zlocus.matching.overlap import CoarsestHeights, ExpectedBounds, OverlapGround, find_overlap_window, overlap_ground
from zlocus.matching.pair_labels import PairLabels, TileLabels, label_pairs_at_ties
from zlocus.matching.prior_costs import (
    add_costs_beyond_expected,
    add_costs_far_from_surface,
    costs_of_coarser,
    misfit,
    penalties_after_misfit,
    penalty_factor,
    smaller_penalties,
)
from zlocus.matching.search_range import coarsest_prior, prior_from_coarser, reachable_range, table_range
from zlocus.matching.semiglobal import (
    SemiGlobalHeights,
    aggregate,
    least_jump_penalty,
    level_indices,
    winner_takes_all_heights,
    winner_takes_all_indices,
)
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.subpixel import smoothed
from zlocus.matching.surface import Surface, max_sigma_m
from zlocus.matching.tile_candidates import candidates_of_tile, windows_of
from zlocus.matching.tile_views import TileGrid, TileViews, tile_views
from zlocus.matching.view_selection import ChosenViews, choose_views

# Matches a level from a tile, the level, its search prior, the labels of pairs and the result of an earlier pass.
MatchLevel = Callable[[TileInputs, PyramidLevel, SearchPrior, PairLabels | None, LevelResult | None], LevelResult]


@dataclass(frozen=True)
class TileResult:
    """The result of a tile.

    surface : of the tile's core; evaluations : correlations that were computed (cells x heights x images, at all
    levels, with those of the choice of images; the refinement is not counted); all_images : the same if every image
    that covers a cell had been used; tile_labels : labels of all pairs of images, None where no images were chosen.
    """

    surface: Surface
    evaluations: int = 0
    all_images: int = 0
    tile_labels: TileLabels | None = None


@dataclass(frozen=True)
class CoarsestMatch:
    """The coarsest level, the search prior of its last pass, and the labels by which all levels choose images (None:
    all images are used)."""

    result: LevelResult
    prior: SearchPrior
    pair_labels: PairLabels | None


def match_tile(
    match_scene: MatchScene,
    core_window: CellWindow,
    config: RunConfig,
    method: str = "mvll-sgm",
    choose_images: bool = False,
    fill: str = "none",
    preselect: bool = True,
) -> TileResult:
    """Match one tile.

    core_window : finest cells whose surface is wanted; every level adds a halo around them. method : mvll-sgm, mvll
    without the semi-global constraint, or gc3-sgm in image space. choose_images : match each block with a few
    images, chosen by labels; False: with all. fill : none, or interpolate to fill gaps that images cover. preselect :
    see `tile_inputs`. Occlusions are found wherever three images or more see the tile.
    """
    if not (core_window.rows and core_window.cols):
        return TileResult(Surface.nothing(core_window))
    tile = tile_inputs(match_scene, core_window, config, method, choose_images, preselect)
    if len(tile.view_numbers) < PAIR:
        return TileResult(Surface.nothing(core_window))
    levels = match_all_levels(tile)
    results, ground = levels.results, levels.ground
    if not levels.has_overlap:
        return TileResult(Surface.nothing(core_window), results[0].evaluations, results[0].all_images)
    if method != "mvll":
        results[-1] = with_planes_of_segments(results[-1], config)
    refined = refined_surface(tile, results[-1], ground)
    surface = refined.surface.precise(max_sigma_m(config.checks, method, match_scene.cell_size))
    if fill == "interpolate":
        surface = filled(surface, config.pyramid.halo // 2)
    surface = replace(surface, ortho=ortho_of_surface(tile, results, surface, refined.lattice_index))
    return _tile_result(tile, results, surface, levels.pair_labels)


@dataclass(frozen=True)
class TileLevels:
    """The matched levels of a tile.

    has_overlap : whether the coarsest level finds ground in the tile's core that two views see; results : the coarsest
    level first, and no other without such ground; ground : see `ground_of_overlap`; pair_labels : see `CoarsestMatch`.
    """

    has_overlap: bool
    results: list[LevelResult]
    ground: OverlapGround
    pair_labels: PairLabels | None


def match_all_levels(tile: TileInputs, match: MatchLevel | None = None) -> TileLevels:
    """Match all levels of a tile that two views see. match : matches a finer level, None: `match_level`."""
    coarsest_match = match_coarsest_level(tile)
    ground = ground_of_overlap(tile, coarsest_match)
    result, pair_labels = coarsest_match.result, coarsest_match.pair_labels
    overlap_window = find_overlap_window(result.visible, result.heights.vertex, ground.covered, result.level.window)
    if not tile.core_window.at_level(result.level.number, 0).meets(overlap_window):
        return TileLevels(False, [result], ground, pair_labels)
    return TileLevels(True, match_finer_levels(tile, coarsest_match, overlap_window, match), ground, pair_labels)


def _tile_result(
    tile: TileInputs, results: list[LevelResult], surface: Surface, pair_labels: PairLabels | None
) -> TileResult:
    """The result of a tile from those of its levels. surface : of the finest level's window."""
    labels = None if pair_labels is None else TileLabels(pair_labels, tile.view_numbers)
    return TileResult(
        surface=surface.part(tile.core_window, results[-1].level.window),
        evaluations=sum(r.evaluations for r in results) + (0 if pair_labels is None else pair_labels.evaluations),
        all_images=sum(r.all_images for r in results),
        tile_labels=labels,
    )


def tile_inputs(
    match_scene: MatchScene,
    core_window: CellWindow,
    config: RunConfig,
    method: str = "mvll-sgm",
    choose_images: bool = False,
    preselect: bool = True,
) -> TileInputs:
    """The views that may see a tile; with `preselect`, of many views only the best candidates."""
    numbers = list(windows_of(match_scene, core_window, config))
    if preselect:
        numbers = candidates_of_tile(match_scene, core_window, numbers, config)
    return TileInputs(match_scene, core_window, config, numbers, method, choose_images)


def rank_tile(match_scene: MatchScene, core_window: CellWindow, config: RunConfig) -> TileLabels | None:
    """Labels of all pairs of views at the tie points of a tile, before anything is matched.

    Of scenes with few views too, where a match uses all of them; None where fewer than two views see the tile.
    """
    if not (core_window.rows and core_window.cols):
        return None
    tile = tile_inputs(match_scene, core_window, config)
    if len(tile.view_numbers) < PAIR:
        return None
    return TileLabels(label_pairs_at_ties(tile, None), tile.view_numbers)


def match_coarsest_level(tile: TileInputs) -> CoarsestMatch:
    """Match the coarsest level, and a second time where the first pass taught the evidence of the images, or found
    slopes along which to search."""
    level = tile.level(tile.match_scene.levels - 1)
    prior = coarsest_prior(tile.match_scene, level, None)
    pair_labels = pair_labels_for_choice(tile, None)
    result = match_level(tile, level, prior, pair_labels)
    slope_surface = _slope_of_heights(tile, result)
    is_steep = slope_surface.is_steep(level.core)
    teaches = learns_evidence(tile) and heights_to_learn_from(result, level, slope_surface) is not None
    if is_steep:
        prior = coarsest_prior(tile.match_scene, level, result.heights.vertex)
        pair_labels = pair_labels_for_choice(tile, result)
    if is_steep or teaches:
        result = match_level(tile, level, prior, pair_labels, result).with_evaluations_of(result)
    return CoarsestMatch(replace(result, slope_surface=_slope_of_heights(tile, result)), prior, pair_labels)


def learns_evidence(tile: TileInputs) -> bool:
    """Whether costs are evidence: not in image space, not for single cells, where they are those of the papers, and not
    in small tiles."""
    n_cells = tile.core_window.rows * tile.core_window.cols
    return tile.method == "mvll-sgm" and n_cells >= MIN_CELLS_OF_TILE


def _slope_of_heights(tile: TileInputs, result: LevelResult) -> SlopeSurface:
    """The slanted support surface that follows from the heights of the coarsest level."""
    smooth = smoothed(result.heights.vertex, tile.config.refine.jump_steps)
    return SlopeSurface.from_surface(smooth, tile.config.pyramid.block)


def pair_labels_for_choice(tile: TileInputs, coarsest_result: LevelResult | None) -> PairLabels | None:
    """Labels by which images are chosen; None where no choice is wanted, or too few images see the tile for one."""
    if not tile.choose_images or len(tile.view_numbers) - 1 <= tile.config.selection.min_images:
        return None
    return label_pairs_at_ties(tile, coarsest_result)


def ground_of_overlap(tile: TileInputs, coarsest_match: CoarsestMatch) -> OverlapGround:
    """What the coarsest level says about the ground at the borders of the images' overlap."""
    result, level, prior = coarsest_match.result, coarsest_match.result.level, coarsest_match.prior
    heights = CoarsestHeights(
        result.tile_views, result.lattice, result.visible, level.window, level.number, result.heights.vertex,
        ExpectedBounds(*expected_of_searched(tile.match_scene, level, prior)),
    )  # fmt: skip
    return overlap_ground(heights, level.n_steps, level.cell_size)


def match_finer_levels(
    tile: TileInputs, coarsest_match: CoarsestMatch, overlap_window: CellWindow, match: MatchLevel | None = None
) -> list[LevelResult]:
    """Match all finer levels inside a window of coarsest cells; results of all levels, the coarsest first.

    match : matches a level, None: `match_level`.
    """
    match, results, pair_labels = match or match_level, [coarsest_match.result], coarsest_match.pair_labels
    level, prior = coarsest_match.result.level, coarsest_match.prior
    coarsest_number = level.number
    for number in range(coarsest_number - 1, -1, -1):
        level = tile.level(number, overlap_window.finer(coarsest_number - number))
        prior = prior_from_coarser(tile, level, results[-1])
        results.append(match(tile, level, prior, pair_labels, results[-1]))
    for _ in range(1, tile.config.pyramid.finest_level_rounds if tile.handles_occlusion else 1):
        prior = replace(prior, surface=results[-1].heights.vertex, erosion=ERODE_OWN_SURFACE)
        results[-1] = match(tile, level, prior, pair_labels, results[-1]).with_evaluations_of(results[-1])
    return results


@dataclass(frozen=True)
class LevelCosts:
    """The matching costs of one level, and what they were computed from.

    visible : visible height ranges of all views, slope indices; chosen_views : those that are compared;
    taught_heights : the evidence was learned from them, None: costs are those of correlation; has_known_costs : whether
    they contain those of the coarser level's candidates; cost : (v,) uint8, see `HeightLattice.layout`; alike : (i,)
    see `view_agreement`.
    """

    search: LevelSearch
    visible: VisibleHeights
    chosen_views: ChosenViews
    taught_heights: TaughtHeights | None
    has_known_costs: bool
    cost: NDArray[np.uint8]
    alike: NDArray[np.float64] | None


def match_level(
    tile: TileInputs,
    level: PyramidLevel,
    prior: SearchPrior,
    pair_labels: PairLabels | None,
    earlier_result: LevelResult | None = None,
) -> LevelResult:
    """Match one pyramid level of a tile.

    The steps are those of docs/explanation/method.md: slanted support surface and search range, visibility, choice of
    images, cost volume, semi-global heights. pair_labels : None uses all images; earlier_result : of an earlier pass
    over this level, or of the coarser one, from which the evidence is learned. None: costs are those of correlation.
    """
    return result_of_costs(tile, level, level_costs(tile, level, prior, pair_labels, earlier_result))


def level_costs(
    tile: TileInputs,
    level: PyramidLevel,
    prior: SearchPrior,
    pair_labels: PairLabels | None,
    earlier_result: LevelResult | None = None,
) -> LevelCosts:
    """The matching costs of one level; see `match_level`."""
    config = tile.config
    search = search_along_slope(tile, level, prior, earlier_result)
    visible = visible_heights(tile, level, search, prior)
    chosen = _chosen_views(tile, level, search, visible, prior, pair_labels)
    taught_heights, known_costs = None, None
    if earlier_result is not None and learns_evidence(tile):
        taught_heights = heights_to_learn_from(earlier_result, level, search.slope_surface)
    if taught_heights is not None and prior.coarser_result is not None:
        known_costs = costs_of_coarser(
            search.lattice, search.slope_surface, level, prior.coarser_result, config.pyramid
        )  # fmt: skip
    cost = cost_volume(
        search.slope_views, search.slope_surface, search.lattice, chosen.matched, config.cost, CountedPairs.of(tile),
        taught_heights, known_costs,
    )  # fmt: skip
    if tile.method != "mvll" and prior.coarser_result is None:
        add_costs_beyond_expected(cost, search.lattice, search.slope_surface, tile.match_scene, level)
    alike = view_agreement(tile, level, search, covers(visible), prior)
    return LevelCosts(search, visible, chosen, taught_heights, known_costs is not None, cost, alike)


def result_of_costs(tile: TileInputs, level: PyramidLevel, costs: LevelCosts) -> LevelResult:
    """The result of a level from its costs, which the semi-global constraint changes."""
    search, visible, chosen, cost, alike = (
        costs.search, costs.visible, costs.chosen_views, costs.cost, costs.alike
    )  # fmt: skip
    if tile.method == "mvll":
        heights = winner_takes_all_heights(cost, search.lattice)
    else:
        penalties = penalties_at_edges(
            search.tile_views, search.smooth, covers(visible), alike, level, tile.config.semiglobal
        )  # fmt: skip
        # In image space P1 is that of close objects, however many images there are.
        n_images = PAIR if tile.method == "gc3-sgm" else chosen.usual_number(level.core)
        heights = semiglobal_heights(tile, level, search, cost, penalties, visible, n_images, costs.has_known_costs)
    return _level_result(level, search, visible, chosen, cost, heights, alike)


def search_along_slope(
    tile: TileInputs, level: PyramidLevel, prior: SearchPrior, earlier_result: LevelResult | None = None
) -> LevelSearch:
    """Slanted support surface, search range and projections of a level; those of an earlier pass over it are kept."""
    earlier_pass = earlier_result if earlier_result is not None and earlier_result.level is level else None
    views = _project(tile, level, prior) if earlier_pass is None else earlier_pass.tile_views
    smooth = None if prior.surface is None else smoothed(prior.surface, tile.config.refine.jump_steps)
    if smooth is None:
        slope_surface = SlopeSurface.flat(level.shape, views.block)
    else:
        slope_surface = SlopeSurface.from_surface(smooth, views.block, prior.coarser_slope(level.window))
    low, high = slope_surface.slope_index(prior.low), slope_surface.slope_index(prior.high)
    lattice = search_lattice(low, high, level.height_origin, level.height_step, tile.config.pyramid, views.block)
    return LevelSearch(views, smooth, slope_surface, slope_surface.along(views), lattice)


def _project(tile: TileInputs, level: PyramidLevel, prior: SearchPrior) -> TileViews:
    """The views of a level, with their projections over the heights that the prior can reach."""
    config = tile.config
    cells = TileGrid(
        level.number, level.transform, level.shape, config.pyramid.block, level.height_origin, level.height_step
    )
    z_needed = reachable_range(level, prior, config)
    view_pixels = tile.read(level.window, level.number, z_needed)
    return tile_views(view_pixels, cells, table_range(level), large_window_side(config.cost) // 2, z_needed)


def visible_heights(tile: TileInputs, level: PyramidLevel, search: LevelSearch, prior: SearchPrior) -> VisibleHeights:
    """Visible height ranges of all views, slope indices.

    Where a surface is known and there are three views or more, but not many, heights at which it occludes a view are
    excluded, and where all views look along one line, none takes part.
    """
    visible = covered_heights(search.slope_views, search.slope_surface, search.lattice)
    exclude_views_of_one_direction(
        visible, search.tile_views, tile.match_scene.cell_size / tile.match_scene.height_step
    )
    are_few = usual_number(visible, level.core) < MANY_VIEWS
    if prior.surface is not None and tile.handles_occlusion and are_few:
        occluder = cv2.erode(prior.surface, prior.erosion)
        margin_steps = value_of(tile.config.cost, "occlusion_margin_steps")
        mark_occlusions(visible, search.tile_views, occluder, search.slope_surface.cells, margin_steps)
        keep_enough_views(visible)
    return visible


def _chosen_views(
    tile: TileInputs,
    level: PyramidLevel,
    search: LevelSearch,
    visible: VisibleHeights,
    prior: SearchPrior,
    pair_labels: PairLabels | None,
) -> ChosenViews:
    """The views that each block is matched with; all of them where no labels are given."""
    if pair_labels is None:
        return ChosenViews(visible, visible)
    surface = None if prior.surface is None else search.slope_surface.slope_index(prior.surface)
    return choose_views(level, search.lattice, visible, surface, prior.coarser_result, pair_labels, tile.config)


def view_agreement(
    tile: TileInputs, level: PyramidLevel, search: LevelSearch, covered: NDArray[np.bool_], prior: SearchPrior
) -> NDArray[np.float64] | None:
    """How well each view agrees with the others, (i,) see `agreement`: that of the coarser level where it is known,
    else on the surface known before; None without one. covered : (i, r, c), cells that each view covers."""
    of_coarser = None if prior.coarser_result is None else prior.coarser_result.agreement
    if of_coarser is not None or tile.method == "mvll" or search.smooth is None:
        return of_coarser
    return agreement(search.tile_views, search.smooth, covered, level.core)


def semiglobal_heights(
    tile: TileInputs,
    level: PyramidLevel,
    search: LevelSearch,
    cost: NDArray[np.uint8],
    penalties: NDArray[np.uint16],
    visible: VisibleHeights,
    n_images: float,
    is_evidence: bool = False,
) -> SemiGlobalHeights:
    """Heights of a level under the semi-global constraint, slope indices; this changes `cost`.

    Where a surface was known before, the constraint is applied a second time. Heights that stand in free rays of sight
    are more expensive then. n_images : that cells are matched with; is_evidence : whether jumps are cheaper the second
    time, everywhere as far as the costs alone find the surface of the first, and more so where that surface contradicts
    the images, see `zlocus.matching.prior_costs`. Break lines hold both times.
    """
    options, step_cells = tile.config.semiglobal, tile.match_scene.step_cells
    lines = tile.match_scene.break_lines
    penalties = constrain(lines, level, search.lattice, search.slope_surface, cost, penalties)
    heights = aggregate(cost, search.lattice, penalties, step_cells, options, n_images)
    if search.smooth is None:
        return heights
    factor = penalty_factor(cost, search.lattice, heights, level.core, options) if is_evidence else 1.0
    has_rays = add_costs_of_rays(
        cost, search.tile_views, search.slope_surface, search.lattice, visible, heights.vertex, level.number, step_cells
    )
    if is_evidence:
        penalties = smaller_penalties(penalties, factor, least_jump_penalty(level.number, options))
        penalties = penalties_after_misfit(penalties, misfit(cost, search.lattice, heights))
        add_costs_far_from_surface(cost, search.lattice, search.slope_surface, heights, level.number, step_cells)
    elif not has_rays:
        return heights
    penalties = constrain(lines, level, search.lattice, search.slope_surface, cost, penalties)
    return aggregate(cost, search.lattice, penalties, step_cells, options, n_images).with_full_penalties(factor)


def _level_result(
    level: PyramidLevel,
    search: LevelSearch,
    visible: VisibleHeights,
    chosen_views: ChosenViews,
    cost: NDArray[np.uint8],
    heights: SemiGlobalHeights,
    alike: NDArray[np.float64] | None,
) -> LevelResult:
    """The result of a level, with heights and visible height ranges converted from slope indices to level indices."""
    slope_cells = search.slope_surface.cells
    all_images = count_evaluations(visible, search.lattice)
    evaluations = count_evaluations(chosen_views.matched, search.lattice) + chosen_views.evaluations
    winner_takes_all = None
    if level.number:
        winner_takes_all = level_indices(winner_takes_all_indices(cost, search.lattice, heights.best), slope_cells)
    return LevelResult(
        level=level,
        tile_views=search.tile_views,
        slope_surface=search.slope_surface,
        lattice=search.lattice,
        visible=in_level_indices(chosen_views.helpful, slope_cells),
        heights=heights.on_lattice(slope_cells),
        winner_takes_all=winner_takes_all,
        evaluations=evaluations,
        all_images=all_images,
        agreement=alike,
    )
