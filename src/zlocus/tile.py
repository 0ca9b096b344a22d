"""One tile: windows of all images, level after level, to a surface."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.refine import tile_ortho
from zlocus.kernels.spline import spline_coefficients
from zlocus.matching.base import BaseSurface
from zlocus.matching.cells import CellWindow
from zlocus.matching.lattice import HeightLattice
from zlocus.matching.measure import cost_volume
from zlocus.matching.ranges import UNKNOWN, by_block, ranges_nearby
from zlocus.matching.refine import refine, smoothed
from zlocus.matching.semiglobal import SemiGlobalHeights, aggregate, penalties, pick
from zlocus.matching.setup import MatchScene
from zlocus.matching.views import TileViews, ViewPixels, pixel_window, read_pixels, tile_views
from zlocus.matching.visibility import above_base, coverage, covers, hide, sees
from zlocus.options import RunConfig
from zlocus.surface.checks import judge
from zlocus.surface.fill import filled
from zlocus.surface.reasons import is_empty
from zlocus.surface.surface import Surface

RIVALS_KEPT = 128
SEEN_MARGIN = 4
# What hides a cell is taken this much narrower than the guide shows it, for its edges are a coarser level's.
OBSTACLE = np.ones((5, 5), np.uint8)
SPIKE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class LevelResult:
    """What one level hands to the next: its window, heights, and between which heights views cover and see each cell.

    seen and heights are in height indices of the level's lattice, whatever base surface they were found along.
    """

    window: CellWindow
    views: TileViews
    lattice: HeightLattice
    seen: NDArray[np.int32]
    heights: SemiGlobalHeights


@dataclass(frozen=True)
class TileResult:
    """surface : of the tile's core; evaluations : NCC evaluated (cell x step x image, all levels); all_images : the
    same if every image that covers a cell had been used."""

    surface: Surface
    evaluations: int = 0
    all_images: int = 0


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
    the coarser level's surface stands in their way; fill : none, or interpolate gaps that images cover.
    """
    if not (core.rows and core.cols):
        return TileResult(Surface.nothing(core))
    pixels = _read(scene, core, config)
    if len(pixels) < 2:
        return TileResult(Surface.nothing(core))
    evaluations = 0
    coarsest = scene.levels - 1
    window = _level_window(scene, core, coarsest, config)
    result = _match_level(
        scene, pixels, window, coarsest, _coarsest_guide(scene, window, None), config, method, use_visibility
    )
    evaluations += _evaluations(result)
    if BaseSurface.along(smoothed(result.heights.vertex, config.refine.jump_steps), config.pyramid.block).is_steep:
        guide = _coarsest_guide(scene, window, result.heights.vertex)
        result = _match_level(scene, pixels, window, coarsest, guide, config, method, use_visibility)
        evaluations += _evaluations(result)
    worth = _worth_matching(result)
    for level in range(coarsest - 1, -1, -1):
        window = _level_window(scene, core, level, config).within(worth.finer(coarsest - level))
        if not (window.rows and window.cols):
            return TileResult(Surface.nothing(core), evaluations, evaluations)
        guide = Guide(_finer(result, window), *_candidates(scene, result, window, level))
        result = _match_level(scene, pixels, window, level, guide, config, method, use_visibility)
        evaluations += _evaluations(result)
    surface = _finish(scene, pixels, result, config)
    if fill == "interpolate":
        surface = filled(surface, config.pyramid.halo // 2)
    return TileResult(surface.part(core, result.window), evaluations, evaluations)


def _worth_matching(coarsest: LevelResult) -> CellWindow:
    """The cells, with a margin, whose ground two views see as far as the coarsest level can tell."""
    seeing = sees(coarsest.seen, coarsest.heights.vertex[None]).sum(axis=0) >= 2
    rows, cols = np.flatnonzero(seeing.any(axis=1)), np.flatnonzero(seeing.any(axis=0))
    window = coarsest.window
    if not len(rows):
        return CellWindow(window.row, window.col, 0, 0)
    row, col = window.row + int(rows[0]) - SEEN_MARGIN, window.col + int(cols[0]) - SEEN_MARGIN
    size = (int(rows[-1] - rows[0]) + 1 + 2 * SEEN_MARGIN, int(cols[-1] - cols[0]) + 1 + 2 * SEEN_MARGIN)
    return CellWindow(row, col, *size)


def _evaluations(result: LevelResult) -> int:
    """Cells x steps x images that were compared."""
    covering = covers(result.seen).sum(axis=0, dtype=np.int32)
    return int((by_block(covering, result.lattice.block, np.add) * result.lattice.count).sum())


def _level_window(scene: MatchScene, core: CellWindow, level: int, config: RunConfig) -> CellWindow:
    return core.at_level(level, config.pyramid.halo).within(scene.seen.at_level(level, 0))


def _read(scene: MatchScene, core: CellWindow, config: RunConfig) -> list[ViewPixels]:
    """Pixels of all views that may see the tile, the leading one first."""
    coarsest = scene.levels - 1
    window = _level_window(scene, core, coarsest, config)
    z = (scene.origin_m, scene.origin_m + scene.n_steps * scene.step_m)
    transform = scene.transform(window, coarsest)
    across, down = np.linspace(0, window.cols, 5), np.linspace(0, window.rows, 5)
    corners = np.array([transform * (c, r) for c in across for r in down])
    found = []
    for view, grey in zip(scene.views, scene.grey, strict=True):
        part = pixel_window(view, corners, z, 2**coarsest)
        if part is not None:
            found.append(read_pixels(view, part, scene.levels, *grey))
    return found


@dataclass(frozen=True)
class Guide:
    """What is known of a level's heights before it is matched, in its own height indices, all (r, c) float32.

    surface : the coarser level's; low, high : lowest and highest index worth a look, NaN where nothing is known.
    """

    surface: NDArray[np.float32] | None
    low: NDArray[np.float32]
    high: NDArray[np.float32]


def _coarsest_guide(scene: MatchScene, window: CellWindow, surface: NDArray[np.float32] | None) -> Guide:
    """The whole range, or what a DEM leaves of it."""
    n_steps = -(-scene.n_steps // 2 ** (scene.levels - 1))
    low = np.zeros((window.rows, window.cols), np.float32)
    high = np.full((window.rows, window.cols), n_steps - 1, np.float32)
    if scene.prior is not None:
        part = scene.prior[(slice(None), *window.slices_in(scene.seen.at_level(scene.levels - 1, 0)))]
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
    window: CellWindow,
    level: int,
    guide: Guide,
    config: RunConfig,
    method: str,
    use_visibility: bool,
) -> LevelResult:
    """One level: base surface, ranges, visibility, costs, semi-global constraint."""
    shape, block = (window.rows, window.cols), config.pyramid.block
    step = scene.step_m * 2**level
    n_steps = -(-scene.n_steps // 2**level)
    z = (scene.origin_m - 2 * step, scene.origin_m + (n_steps + 18) * step)
    half = config.measure.large_window // 2
    views = tile_views(pixels, level, scene.transform(window, level), shape, block, (scene.origin_m, step), z, half)
    smooth = None if guide.surface is None else smoothed(guide.surface, config.refine.jump_steps)
    base = BaseSurface.level(shape, block) if smooth is None else BaseSurface.along(smooth, block)
    low, high = guide.low - base.cells, guide.high - base.cells
    lattice = ranges_nearby(low, high, scene.origin_m, step, shape, config.pyramid)
    along_base = base.shear(views)
    seen = coverage(along_base, base, lattice)
    if guide.surface is not None and use_visibility:
        obstacle = cv2.erode(guide.surface, OBSTACLE)
        hide(seen, views, obstacle, base.cells, block, config.measure.hidden_margin_steps)
    ortho = None if smooth is None else _ortho(views, smooth, block)
    cost = cost_volume(along_base, base, lattice, seen, config.measure)
    if method == "mvll":
        heights = pick(cost.astype(np.uint16), lattice)
    else:
        heights = aggregate(cost, lattice, penalties(ortho, shape, level, config.semiglobal), config.semiglobal)
    return LevelResult(window, views, lattice, above_base(seen, base.cells), heights.above(base.cells))


def _ortho(views: TileViews, surface: NDArray[np.float32], block: int, view: int = 0) -> NDArray[np.float32]:
    """One view, by default the leading one, on a surface of height indices."""
    out = np.empty(surface.shape, np.float32)
    tile_ortho(views.pixels, views.layout, views.nodes, views.heights, surface, view, block, out)
    return out


def _true_ortho(
    pixels: list[ViewPixels], result: LevelResult, surface: NDArray[np.float32], block: int
) -> NDArray[np.float32]:
    """Grey values of the first view that sees each cell of a surface; NaN where none does."""
    out = np.full(surface.shape, np.nan, np.float32)
    for i, view in enumerate(pixels):
        shown = np.isnan(out) & sees(result.seen[:, i], surface)
        if shown.any():
            grey = _ortho(result.views, surface, block, i)[shown]
            out[shown] = grey * np.float32(view.contrast) + np.float32(view.mean)
    return out


def _finer(coarser: LevelResult, window: CellWindow) -> NDArray[np.float32]:
    """Height indices of the coarser level on the cells, and in the steps, of the finer."""
    return 2 * _doubled(coarser.heights.vertex, coarser.window, window)


def _doubled(values: NDArray[np.float32], source: CellWindow, target: CellWindow) -> NDArray[np.float32]:
    """Values of a level on the cells of the next finer one, each coarse cell four times."""
    rows = np.clip((np.arange(target.rows) + target.row) // 2 - source.row, 0, source.rows - 1)
    cols = np.clip((np.arange(target.cols) + target.col) // 2 - source.col, 0, source.cols - 1)
    return np.ascontiguousarray(values[np.ix_(rows, cols)])


def _candidates(
    scene: MatchScene, coarser: LevelResult, window: CellWindow, level: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest height index worth a look in every cell: best, near rivals and tie points."""
    heights = coarser.heights
    known = covers(coarser.seen).sum(axis=0) >= 2
    rival = np.where(heights.margin < RIVALS_KEPT, heights.second, heights.best)
    low = np.minimum(heights.best, rival).astype(np.float32)
    high = np.maximum(heights.best, rival).astype(np.float32)
    low, high = _without_spikes(low, high, known)
    low, high = (2 * _doubled(v, coarser.window, window) for v in (low, high))
    if len(scene.ties):
        side = scene.cell_m * 2**level
        col = np.floor((scene.ties[:, 0] - scene.anchor[0]) / side).astype(int) - window.col
        row = np.floor((scene.anchor[1] - scene.ties[:, 1]) / side).astype(int) - window.row
        inside = (row >= 0) & (row < window.rows) & (col >= 0) & (col < window.cols)
        index = ((scene.ties[inside, 2] - scene.origin_m) / (scene.step_m * 2**level)).astype(np.float32)
        np.fmin.at(low, (row[inside], col[inside]), index)
        np.fmax.at(high, (row[inside], col[inside]), index)
    return low, high


def _without_spikes(
    low: NDArray[np.float32], high: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest candidates that 3 x 3 cells share (a closing and an opening), NaN where not `known`.

    A false height of a cell or two would widen the range of a whole block; a tower has more cells, and tie points are
    added later.
    """
    far = UNKNOWN
    top = cv2.erode(np.where(known, high, far), SPIKE)
    top = cv2.dilate(np.where(known, top, -far), SPIKE)
    floor = cv2.dilate(np.where(known, low, -far), SPIKE)
    floor = cv2.erode(np.where(known, floor, far), SPIKE)
    nothing = np.float32(np.nan)
    return np.where(known, np.minimum(floor, top), nothing), np.where(known, np.maximum(floor, top), nothing)


def _finish(scene: MatchScene, pixels: list[ViewPixels], result: LevelResult, config: RunConfig) -> Surface:
    """Refine the finest level and judge it, halo included."""
    block = config.pyramid.block
    coefficients = TileViews(
        pixels=np.concatenate([spline_coefficients(view.pixels[0]).ravel() for view in pixels]),
        blocked=result.views.blocked,
        has_blocked=result.views.has_blocked,
        layout=result.views.layout,
        nodes=result.views.nodes,
        heights=result.views.heights,
    )
    refined = refine(
        coefficients, result.heights.vertex, result.seen, block, scene.step_m / scene.cell_m, config.refine
    )
    at = refined.height[None]
    covering = covers(result.seen).sum(axis=0)
    seeing = sees(result.seen, at).sum(axis=0)
    last = scene.n_steps - 1
    quality = judge(result.heights, refined, covering, seeing, last, config.checks)
    height = result.lattice.metres(refined.height)
    height[is_empty(quality)] = np.nan
    ortho = _true_ortho(pixels, result, refined.height, block)
    ortho[np.isnan(height)] = np.nan
    used = np.where(np.isnan(height), 0, seeing).astype(np.uint8)
    return Surface(height, quality, used, ortho)
