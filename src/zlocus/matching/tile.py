"""One tile: windows of all images, level after level, to a surface."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow, on_cells
from zlocus.core.options import PyramidOptions, RunConfig, large_window_side
from zlocus.matching.cost_volume import cost_volume
from zlocus.matching.fill import filled
from zlocus.matching.free_rays import add_costs_of_rays
from zlocus.matching.height_checks import judge
from zlocus.matching.height_lattice import LANES, HeightLattice, by_block, ranges_nearby, shared_heights, without_spikes
from zlocus.matching.kernels.spline import spline_coefficients
from zlocus.matching.local_contrast import agreement, edge_image, texture_unit
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.occlusion import PAIR, above_base, coverage, covers, hide, left_out, n_seeing, sees, spare_pairs
from zlocus.matching.overlap import BorderGround, border_ground, unsupported, worth_matching
from zlocus.matching.plane_fitting import PlanarHeights, with_planes
from zlocus.matching.precision import sigma_steps, signs_of_precision, spread_around
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.semiglobal import SemiGlobalHeights, aggregate, alone, counted_above, lone_heights, penalties
from zlocus.matching.slope_surface import SlopeSurface, CoarserSlope
from zlocus.matching.subpixel import refine, smoothed
from zlocus.matching.surface import Surface
from zlocus.matching.tile_views import TileViews, ViewPixels, pixel_window, read_pixels, tile_views
from zlocus.matching.true_ortho import CoarserHeights, ortho_image, true_ortho, what_stands_around
from zlocus.matching.view_ranking import KnownGround, PairLabels, label_pairs_at_ties
from zlocus.matching.view_selection import (
    Coarser,
    block_middles,
    block_of_cells,
    block_shares,
    chosen_views,
    images_needed,
    only_chosen,
    order_views,
    preselected,
    sampled_cells,
)

RIVALS_KEPT = 128
PLAIN_IN = 2  # views in which plain segments are looked for, one after the other
# Texture of the second sharpest view (the sharpest may be noise) over that of one that is sharp, at most.
SHARP = 1.5
STRIDE = 2  # cells between those that are looked at for the views that cover them
FEWEST_STEPS = 4  # to both sides of a surface, over which a match curve is looked at
# What hides a cell is taken this much narrower than the guide shows it, for its edges are a coarser level's; less where
# they are the level's own.
OBSTACLE, OWN_OBSTACLE = np.ones((5, 5), np.uint8), np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class LevelResult:
    """What one level hands to the next: its window, heights, and between which heights views cover and see each cell.

    base : what heights were searched along; of the coarsest level, what its heights give. seen, heights and lone are in
    height indices of the level's lattice, whatever base they were found along.
    lone : (r, c) int32, see `lone_heights`; None at the finest level.
    evaluations : cell x step x view that were compared; all_views : if every view that covers a cell had been.
    agrees : (i,) how alike each view is to the others, see `agreement`; None where no surface was known yet.
    is_planar : (r, c) cells whose heights are those of planes through plain segments.
    """

    level: int
    window: CellWindow
    views: TileViews
    base: SlopeSurface
    lattice: HeightLattice
    seen: NDArray[np.int32]
    heights: SemiGlobalHeights
    lone: NDArray[np.int32] | None
    evaluations: int
    all_views: int
    agrees: NDArray[np.float64] | None
    is_planar: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class TileResult:
    """surface : of the tile's core; evaluations : NCC evaluated (cell x step x image, all levels, with what it took to
    choose images; the refinement counts on neither side); all_images : the same if every image that covers a cell had
    been used; ranking : of the images, and which of the scene's they are, None where there was nothing to choose."""

    surface: Surface
    evaluations: int = 0
    all_images: int = 0
    ranking: tuple[PairLabels, list[int]] | None = None


def match_tile(
    scene: MatchScene,
    core: CellWindow,
    config: RunConfig,
    method: str = "mvll-sgm",
    use_visibility: bool = True,
    fill: str = "none",
) -> TileResult:
    """The surface of a tile's core (finest cells), computed with a halo at every level.

    method : mvll-sgm, or mvll without the semi-global constraint; use_visibility : whether views count as hidden where
    the coarser level's surface stands in their way, which takes three views or more; fill : none, or interpolate gaps
    that images cover.
    """
    if not (core.rows and core.cols):
        return TileResult(Surface.nothing(core))
    pixels, which = _read(scene, core, config, use_visibility)
    if len(pixels) < 2:
        return TileResult(Surface.nothing(core))
    # Of two views none can be spared: where one counts as hidden, by a false height as likely as by a true one, nothing
    # is left that could tell.
    use_visibility = use_visibility and len(pixels) > 2
    coarsest = scene.levels - 1
    result, guide, ranking = _match_coarsest(scene, pixels, core, config, method, use_visibility)
    done, every = result.evaluations, result.all_views
    border = border_ground(
        pixels, result.views, result.lattice, result.seen, result.heights.vertex, (guide.low, guide.high),
        result.window, coarsest, -(-scene.n_steps // 2**coarsest), scene.cell_m * 2**coarsest,
    )  # fmt: skip
    worth, levels = worth_matching(result.seen, result.heights.vertex, border.covered, result.window), [result]
    if not core.at_level(coarsest, 0).meets(worth):
        return TileResult(Surface.nothing(core), done, every)
    for level in range(coarsest - 1, -1, -1):
        window = _level_window(scene, core, level, config, worth.finer(coarsest - level))
        above = 2 * on_cells(result.heights.vertex, result.window, window)
        guide = Guide(above, *_candidates(scene, result, window, level, config.pyramid), result)
        result = _match_level(scene, pixels, core, window, level, guide, config, method, use_visibility, ranking)
        levels.append(result)
        done, every = done + result.evaluations, every + result.all_views
    for _ in range(1, config.pyramid.finest_rounds if use_visibility else 1):
        guide = replace(guide, surface=result.heights.vertex, obstacle=OWN_OBSTACLE)
        result = _match_level(scene, pixels, core, result.window, 0, guide, config, method, use_visibility, ranking)
        done, every = done + result.evaluations, every + result.all_views
    levels[-1] = result = result if method == "mvll" else _with_planes(result, core, config)
    judged, refined = _finish(scene, pixels, result, border, config)
    surface = judged.precise(config.checks.most_sigma_m)
    if fill == "interpolate":
        surface = filled(surface, config.pyramid.halo // 2)
    surface = replace(surface, ortho=_ortho(scene, pixels, which, levels, surface, refined, config))
    done += 0 if ranking is None else ranking.evaluations
    return TileResult(surface.part(core, result.window), done, every, None if ranking is None else (ranking, which))


def _match_coarsest(
    scene: MatchScene, pixels: list[ViewPixels], core: CellWindow, config: RunConfig, method: str, use_visibility: bool
) -> tuple[LevelResult, Guide, PairLabels | None]:
    """The coarsest level, a second time along what it found where that is steep; what guided it, and the ranking."""
    level = scene.levels - 1
    window = _level_window(scene, core, level, config)
    done = every = 0
    known: LevelResult | None = None
    while True:
        guide = _coarsest_guide(scene, window, None if known is None else known.heights.vertex)
        ranking = _ranking(scene, pixels, core, known, config) if use_visibility else None
        result = _match_level(scene, pixels, core, window, level, guide, config, method, use_visibility, ranking)
        done, every = done + result.evaluations, every + result.all_views
        smooth = smoothed(result.heights.vertex, config.refine.jump_steps)
        base = SlopeSurface.along(smooth, config.pyramid.block)
        if known is not None or not base.is_steep(_own_cells(core, window, level)):
            return replace(result, base=base, evaluations=done, all_views=every), guide, ranking
        known = result


def _evaluations(seen: NDArray[np.int32], lattice: HeightLattice) -> int:
    """Cells x steps x views that are compared."""
    covering = covers(seen).sum(axis=0, dtype=np.int32)
    return int((by_block(covering, lattice.block, np.add) * lattice.count).sum())


def _ranking(
    scene: MatchScene, pixels: list[ViewPixels], core: CellWindow, coarsest: LevelResult | None, config: RunConfig
) -> PairLabels | None:
    """Labels of the views at the tie points in and around the tile; None where there are too few views to choose."""
    if len(pixels) < config.selection.fewest_views or len(pixels) - 1 <= config.selection.least_images:
        return None
    if coarsest is None:
        return label_pairs_at_ties(scene, pixels, core, None, config)
    known = KnownGround(coarsest.heights.vertex, coarsest.level, coarsest.window)
    return label_pairs_at_ties(scene, pixels, core, known, config)


def rank_tile(scene: MatchScene, core: CellWindow, config: RunConfig) -> tuple[PairLabels, list[int]] | None:
    """The ranking of the views that may see a tile's core, however few, and which of the scene's they are, before
    anything is matched; None where fewer than two see it."""
    if not (core.rows and core.cols):
        return None
    pixels, which = _read(scene, core, config, True)
    return (label_pairs_at_ties(scene, pixels, core, None, config), which) if len(pixels) > 1 else None


def _level_window(
    scene: MatchScene, core: CellWindow, level: int, config: RunConfig, seen: CellWindow | None = None
) -> CellWindow:
    """A tile's cells at a level with their halo, where the scene or the part `seen` of it lies; from the same blocks on
    whatever the halo, so that it may begin before that part."""
    window = core.at_level(level, config.pyramid.halo).within(scene.seen.at_level(level, 0) if seen is None else seen)
    row, col = (
        first - (first - own) % config.pyramid.block
        for first, own in ((window.row, core.row >> level), (window.col, core.col >> level))
    )
    return CellWindow(row, col, window.rows + window.row - row, window.cols + window.col - col)


def _own_cells(core: CellWindow, window: CellWindow, level: int) -> tuple[slice, slice]:
    """Rows and columns of a window that are the core's. What decides for a whole tile is asked of them alone: it does
    not change with the halo then."""
    return core.at_level(level, 0).within(window).slices_in(window)


def _read(scene: MatchScene, core: CellWindow, config: RunConfig, choose: bool) -> tuple[list[ViewPixels], list[int]]:
    """Pixels of the views that may see the tile, the leading one first, and their numbers in the scene.

    choose : whether those beyond the most promising ones are left out.
    """
    corners, windows = windows_of(scene, core, config)
    which = list(windows)
    if choose and len(which) > config.selection.candidates + 1:
        middle = sum(scene.z_range) / 2
        which = [which[row] for row in preselected([scene.views[n] for n in which], corners, middle, config.selection)]
    return [read_pixels(scene.views[n], windows[n], scene.levels, scene.grey[n]) for n in which], which


def windows_of(
    scene: MatchScene, core: CellWindow, config: RunConfig
) -> tuple[NDArray[np.float64], dict[int, tuple[int, int, int, int]]]:
    """Points (n, 2) m all over a tile with its halo, and the window (row, col, rows, cols) px of each view that may see
    it, by its number in the scene."""
    coarsest = scene.levels - 1
    window = _level_window(scene, core, coarsest, config)
    transform = scene.transform(window, coarsest)
    across, down = np.linspace(0, window.cols, 5), np.linspace(0, window.rows, 5)
    corners = np.array([transform * (c, r) for c in across for r in down])
    found = {n: pixel_window(scene.views[n], corners, scene.z_range, 2**coarsest) for n in scene.views_near(corners)}
    return corners, {number: part for number, part in found.items() if part is not None}


@dataclass(frozen=True)
class Guide:
    """What is known of a level's heights before it is matched, in its own height indices, all (r, c) float32.

    surface : the coarser level's, or an earlier round's; low, high : lowest and highest index worth a look, NaN where
    nothing is known; coarser : that level, None at the coarsest; obstacle : cells by which what hides others is
    narrowed.
    """

    surface: NDArray[np.float32] | None
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    coarser: LevelResult | None = None
    obstacle: NDArray[np.uint8] = field(default_factory=lambda: OBSTACLE)

    def base(self, window: CellWindow) -> CoarserSlope | None:
        """The base surface of the coarser level, beneath the cells of a window."""
        if self.coarser is None:
            return None
        above = self.coarser.window
        return CoarserSlope(self.coarser.base, above.row - window.row / 2, above.col - window.col / 2)


def _coarsest_guide(scene: MatchScene, window: CellWindow, surface: NDArray[np.float32] | None) -> Guide:
    """The whole range, or what a DEM leaves of it."""
    n_steps = -(-scene.n_steps // 2 ** (scene.levels - 1))
    low = np.zeros((window.rows, window.cols), np.float32)
    high = np.full((window.rows, window.cols), n_steps - 1, np.float32)
    if scene.prior is not None:
        seen = scene.seen.at_level(scene.levels - 1, 0)
        part = np.stack([on_cells(bound, seen, window, 0) for bound in scene.prior])
        step = np.float32(scene.step_m * 2 ** (scene.levels - 1))
        from_dem = (part - np.float32(scene.origin_m)) / step
        low, high = (
            np.where(np.isnan(from_dem[0]), low, from_dem[0]),
            np.where(np.isnan(from_dem[1]), high, from_dem[1]),
        )
    return Guide(surface, low, high)


def _match_level(
    scene: MatchScene,
    pixels: list[ViewPixels],
    core: CellWindow,
    window: CellWindow,
    level: int,
    guide: Guide,
    config: RunConfig,
    method: str,
    use_visibility: bool,
    ranking: PairLabels | None,
) -> LevelResult:
    """One level: base surface, ranges, visibility, choice of views, costs, semi-global constraint."""
    shape = (window.rows, window.cols)
    step = scene.step_m * 2**level
    n_steps = -(-scene.n_steps // 2**level)
    z = (scene.origin_m - 2 * step, scene.origin_m + (n_steps + 18) * step)
    views = tile_views(
        pixels, level, scene.transform(window, level), shape, config.pyramid.block, (scene.origin_m, step), z,
        large_window_side(config.cost) // 2, _needed_heights(scene, guide, z, level, config),
    )  # fmt: skip
    block = views.block
    smooth = None if guide.surface is None else smoothed(guide.surface, config.refine.jump_steps)
    base = SlopeSurface.level(shape, block) if smooth is None else SlopeSurface.along(smooth, block, guide.base(window))
    low, high = guide.low - base.cells, guide.high - base.cells
    lattice = ranges_nearby(low, high, scene.origin_m, step, shape, config.pyramid, block)
    along_base = base.shear(views)
    seen = coverage(along_base, base, lattice)
    covered = covers(seen)
    if guide.surface is not None and use_visibility:
        obstacle = cv2.erode(guide.surface, guide.obstacle)
        hide(seen, views, obstacle, base.cells, config.cost.occlusion_margin_steps)
        spare_pairs(seen)
    used, worth, added, all_views = seen, seen, 0, _evaluations(seen, lattice)
    if ranking is not None:
        ground = None if guide.surface is None else guide.surface - base.cells
        used, worth, added = _choose(seen, ranking, lattice, window, level, ground, guide.coarser, config)
    done = _evaluations(used, lattice) + added
    is_pair = len(scene.views) == PAIR
    cost = cost_volume(along_base, base, lattice, used, config.cost, is_pair)
    agrees = None if guide.coarser is None else guide.coarser.agrees
    if method == "mvll":
        heights = alone(cost, lattice)
    else:
        own, ortho = _own_cells(core, window, level), None
        if smooth is not None:
            agrees = agreement(views, smooth, covered, own) if agrees is None else agrees
            ortho = edge_image(views, smooth, covered, own, agrees)
        p2 = penalties(ortho, shape, level, config.semiglobal, covered.sum(axis=0) <= PAIR, own)
        step_cells = scene.step_m / scene.cell_m
        heights = aggregate(cost, lattice, p2, step_cells, config.semiglobal, is_pair)
        if smooth is not None and add_costs_of_rays(cost, views, base, lattice, seen, heights.vertex, level):
            heights = aggregate(cost, lattice, p2, step_cells, config.semiglobal, is_pair)
    lone = counted_above(lone_heights(cost, lattice, heights.best), base.cells) if level else None
    worth = above_base(worth, base.cells)
    return LevelResult(
        level, window, views, base, lattice, worth, heights.above(base.cells), lone, done, all_views, agrees
    )


def _needed_heights(
    scene: MatchScene, guide: Guide, z: tuple[float, float], level: int, config: RunConfig
) -> tuple[float, float]:
    """The part of the heights z (m) of a level that its candidates, and what is done around them, can reach."""
    step = scene.step_m * 2**level
    known = np.isfinite(guide.low) & np.isfinite(guide.high)
    if not known.any():
        return z
    around = config.pyramid.margin_steps + LANES + max(config.selection.reach_steps >> level, FEWEST_STEPS)
    low, high = float(guide.low[known].min()) - around, float(guide.high[known].max()) + around
    return max(z[0], scene.origin_m + low * step), min(z[1], scene.origin_m + high * step)


def _choose(
    seen: NDArray[np.int32],
    ranking: PairLabels,
    lattice: HeightLattice,
    window: CellWindow,
    level: int,
    ground: NDArray[np.float32] | None,
    coarser: LevelResult | None,
    config: RunConfig,
) -> tuple[NDArray[np.int32], NDArray[np.int32], int]:
    """`seen` of the views that each block needs to be matched, and of all that help; and what it took to find out, cell
    x step x view.

    A finer block takes as many as the match curves of the coarser level ask for.
    """
    options = config.selection
    order = order_views(ranking, block_shares(seen, lattice), block_middles(window, level, lattice), options)
    every, evaluations = np.full(len(order.reference), order.search.shape[1]), 0
    needed = np.minimum(every, options.most_images)
    if coarser is not None:
        cells, of_block = sampled_cells(lattice)
        covering = covers(seen[:, :, cells[:, 0], cells[:, 1]]).T
        offset = np.array([window.row, window.col]), np.array([coarser.window.row, coarser.window.col])
        last = np.array([coarser.window.rows - 1, coarser.window.cols - 1])
        below = np.clip((cells + offset[0]) // 2 - offset[1], 0, last)
        reach = max(options.reach_steps >> coarser.level, FEWEST_STEPS)
        surface = smoothed(coarser.heights.vertex, config.refine.jump_steps)
        above = Coarser(coarser.views, coarser.seen, surface, large_window_side(config.cost), reach)
        match = images_needed(above, below, of_block, covering, order, options)
        needed = np.where(match.n_added > 0, np.minimum(match.n_added, options.most_images), every)
        evaluations = match.evaluations + len(cells) * (2 * reach + 1)
    few = seen[:, :, ::STRIDE, ::STRIDE]
    covered = covers(few) if ground is None else sees(few, ground[::STRIDE, ::STRIDE])
    covered = covered.reshape(seen.shape[1], -1)
    of_cell = block_of_cells(lattice, STRIDE).ravel()
    used = only_chosen(seen, chosen_views(order, needed, covered, of_cell, options), lattice)
    return used, only_chosen(seen, chosen_views(order, every, covered, of_cell, options), lattice), evaluations


def _candidates(
    scene: MatchScene, coarser: LevelResult, window: CellWindow, level: int, options: PyramidOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest height index worth a look in every cell: best, near rivals, tie points, and what cells would
    choose if the others had no say (see `shared_heights`).

    The last is what keeps a tower of few coarse cells, or a crown, which the semi-global constraint levels there.
    """
    heights = coarser.heights
    assert coarser.lone is not None
    known = covers(coarser.seen).sum(axis=0) >= PAIR
    rival = np.where(heights.margin < RIVALS_KEPT, heights.second, heights.best)
    found = np.stack([heights.best, rival, shared_heights(coarser.lone, heights.best, coarser.base.cells, options)])
    low, high = without_spikes(found.min(axis=0).astype(np.float32), found.max(axis=0).astype(np.float32), known)
    low, high = (2 * on_cells(v, coarser.window, window) for v in (low, high))
    if len(scene.ties):
        side = scene.cell_m * 2**level
        col = np.floor((scene.ties[:, 0] - scene.anchor[0]) / side).astype(int) - window.col
        row = np.floor((scene.anchor[1] - scene.ties[:, 1]) / side).astype(int) - window.row
        inside = (row >= 0) & (row < window.rows) & (col >= 0) & (col < window.cols)
        index = ((scene.ties[inside, 2] - scene.origin_m) / (scene.step_m * 2**level)).astype(np.float32)
        np.fmin.at(low, (row[inside], col[inside]), index)
        np.fmax.at(high, (row[inside], col[inside]), index)
    return low, high


def _with_planes(result: LevelResult, core: CellWindow, config: RunConfig) -> LevelResult:
    """The finest level with planes where the leading views show plain segments, of those that are sharp enough to
    tell a plain roof from a blurred one."""
    heights = result.heights
    planar = PlanarHeights(heights.vertex, np.zeros(heights.vertex.shape, np.bool_))
    own, n_views = _own_cells(core, result.window, 0), len(result.views.layout)
    shown = [ortho_image(result.views, planar.height, view) for view in range(n_views)]
    units = [texture_unit(ortho, own) for ortho in shown]
    sharp = [view for view, unit in enumerate(units) if unit * SHARP > sorted(units)[-2]]
    for number, view in enumerate(sharp[:PLAIN_IN]):
        ortho = shown[view] if number == 0 else ortho_image(result.views, planar.height, view)
        planar = with_planes(result.views, ortho, planar, result.seen, config.planes, own)
    return replace(result, heights=replace(heights, vertex=planar.height), is_planar=planar.is_planar)


def _finish(
    scene: MatchScene, pixels: list[ViewPixels], result: LevelResult, border: BorderGround, config: RunConfig
) -> tuple[Surface, NDArray[np.float32]]:
    """Refine the finest level and judge it, halo included: the surface without its ortho-image, and height indices of
    all cells, (r, c)."""
    splines = np.concatenate([spline_coefficients(view.pixels[0]).ravel() for view in pixels])
    refined = refine(
        result.views, splines, result.heights.vertex, result.seen, scene.step_m / scene.cell_m, config.refine,
        result.is_planar,
    )  # fmt: skip
    covering = covers(result.seen).sum(axis=0)
    seeing = n_seeing(result.seen, refined.height)
    last = scene.n_steps - 1
    signs = signs_of_precision(result.heights, refined, seeing)
    quality = judge(result.heights, refined, covering, seeing, np.exp(signs["apart"]), last, config.checks)
    quality[left_out(result.views, quality.shape)] |= np.uint16(Quality.LEFT_OUT)
    quality[border.is_beyond(result.window)] |= np.uint16(Quality.UNSEEN)
    quality[unsupported(border, result.window, result.views, result.seen, refined.height)] |= np.uint16(Quality.UNSEEN)
    if result.is_planar is not None:
        quality[result.is_planar] |= np.uint16(Quality.PLANE)
    height = result.lattice.metres(refined.height)
    sigma = sigma_steps(signs, refined)
    is_noise = border.is_near(result.window) & (spread_around(sigma) > config.checks.most_spread_steps)
    quality[is_noise] |= np.uint16(Quality.NO_MATCH)
    sigma *= np.float32(scene.step_m)
    height[is_empty(quality)] = np.nan
    sigma[is_empty(quality)] = np.nan
    used = np.where(np.isnan(height), 0, seeing).astype(np.uint8)
    return Surface(height, sigma, quality, used, np.full_like(height, np.nan)), refined.height


def _ortho(
    scene: MatchScene,
    pixels: list[ViewPixels],
    which: list[int],
    levels: list[LevelResult],
    surface: Surface,
    index: NDArray[np.float32],
    config: RunConfig,
) -> NDArray[np.float32]:
    """What the views show of a surface, of its filled cells too; NaN where there is no height. which : of the scene's
    views `pixels` are; levels : the coarsest first; index : (r, c) height indices of all cells as matched, which hide
    others whether they were kept or not."""
    *coarser, finest = levels
    lattice, is_filled = finest.lattice, (surface.quality & np.uint16(Quality.FILLED)) != 0
    index = np.where(is_filled, (surface.height - np.float32(lattice.origin_m)) / np.float32(lattice.step_m), index)
    known = [CoarserHeights(each.level, each.window, each.heights.vertex) for each in reversed(coarser)]
    around = what_stands_around(known, finest.views, finest.window, index, config.pyramid.halo)
    scale = scene.grey[0] if config.products.ortho_levels == "common" else None
    ortho = true_ortho(pixels, finest.views, finest.seen, index, scene.coloured(which), around, scale)
    ortho[np.isnan(surface.height)] = np.nan
    return ortho
