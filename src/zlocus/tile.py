"""One tile: windows of all images, level after level, to a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter, spline_filter

from zlocus.kernels.refine import tile_ortho
from zlocus.matching.lattice import HeightLattice
from zlocus.matching.measure import cost_volume
from zlocus.matching.ranges import ranges_nearby, whole_range
from zlocus.matching.refine import refine, smoothed
from zlocus.matching.semiglobal import SemiGlobalHeights, aggregate, penalties
from zlocus.matching.views import ViewPixels, TileViews, pixel_window, read_pixels, tile_views
from zlocus.matching.visibility import coverage, hide
from zlocus.options import RunConfig
from zlocus.scene import View
from zlocus.surface.checks import judge
from zlocus.surface.reasons import is_empty
from zlocus.surface.surface import Surface

RIVALS_KEPT = 128


@dataclass(frozen=True)
class CellWindow:
    """Rows and columns of the scene's lattice of cells at one level; row and column may be negative."""

    row: int
    col: int
    rows: int
    cols: int

    def at_level(self, level: int, halo: int) -> CellWindow:
        """The same ground at a coarser level, with a halo of that level's cells."""
        size = 2**level
        row, col = self.row // size - halo, self.col // size - halo
        row1, col1 = -(-(self.row + self.rows) // size) + halo, -(-(self.col + self.cols) // size) + halo
        return CellWindow(row, col, row1 - row, col1 - col)

    def within(self, other: CellWindow) -> CellWindow:
        """The part inside another window of the same level (may be empty)."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        row1 = min(self.row + self.rows, other.row + other.rows)
        col1 = min(self.col + self.cols, other.col + other.cols)
        return CellWindow(row, col, max(row1 - row, 0), max(col1 - col, 0))

    def slices_in(self, other: CellWindow) -> tuple[slice, slice]:
        """Where this window lies in an array of another one of the same level."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.rows), slice(col, col + self.cols)


@dataclass(frozen=True)
class MatchScene:
    """All that is settled before tiling, the same for every tile.

    views : oriented, the leading (most nadir) one first; anchor : ground position of cell (0, 0)'s corner; cell_m :
    side of a finest cell; origin_m, step_m, n_steps : lattice of heights at the finest level; levels : of the pyramid;
    seen : cells (finest level) that two views may cover; contrast : standard deviation of each image; ties : (n, 3)
    ground points that widen the ranges of their blocks.
    """

    views: tuple[View, ...]
    anchor: tuple[float, float]
    cell_m: float
    origin_m: float
    step_m: float
    n_steps: int
    levels: int
    seen: CellWindow
    contrast: tuple[float, ...]
    ties: NDArray[np.float64]

    def transform(self, window: CellWindow, level: int) -> Affine:
        """Cell corners to ground of a window of a level."""
        side = self.cell_m * 2**level
        return Affine(side, 0.0, self.anchor[0] + window.col * side, 0.0, -side, self.anchor[1] - window.row * side)


@dataclass(frozen=True)
class LevelResult:
    """What one level hands to the next: its window, heights, and how many views cover and see each cell."""

    window: CellWindow
    views: TileViews
    lattice: HeightLattice
    seen: NDArray[np.int32]
    heights: SemiGlobalHeights


def match_tile(scene: MatchScene, core: CellWindow, config: RunConfig) -> Surface:
    """The surface of a tile's core (finest cells), computed with a halo at every level."""
    coarsest = scene.levels - 1
    pixels = _read(scene, core, config)
    if len(pixels) < 2:
        return _nothing(core)
    result: LevelResult | None = None
    for level in range(coarsest, -1, -1):
        window = _level_window(scene, core, level, config)
        result = _match_level(scene, pixels, window, level, result, config)
    assert result is not None
    return _finish(scene, pixels, core, result, config)


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
    for view, contrast in zip(scene.views, scene.contrast, strict=True):
        part = pixel_window(view, corners, z, 2**coarsest)
        if part is not None:
            found.append(read_pixels(view, part, scene.levels, contrast))
    return found


def _match_level(
    scene: MatchScene,
    pixels: list[ViewPixels],
    window: CellWindow,
    level: int,
    coarser: LevelResult | None,
    config: RunConfig,
) -> LevelResult:
    """One level: ranges, visibility, costs, semi-global constraint."""
    shape = (window.rows, window.cols)
    step = scene.step_m * 2**level
    n_steps = -(-scene.n_steps // 2**level)
    block = config.pyramid.block
    z = (scene.origin_m - 2 * step, scene.origin_m + (n_steps + 18) * step)
    half = config.measure.large_window // 2
    views = tile_views(pixels, level, scene.transform(window, level), shape, block, (scene.origin_m, step), z, half)
    above = None if coarser is None else _finer(coarser, window, level)
    if above is None:
        lattice = whole_range(scene.origin_m, step, n_steps, shape, block)
    else:
        low, high = _candidates(scene, coarser, window, level)
        lattice = ranges_nearby(low, high, scene.origin_m, step, shape, n_steps, config.pyramid)
    seen = coverage(views, lattice)
    ortho = None
    if above is not None:
        hide(seen, views, minimum_filter(above, 3), block, config.measure.hidden_margin_steps)
        ortho = _ortho(views, smoothed(above, config.refine.jump_steps), block)
    cost = cost_volume(views, lattice, seen, config.measure)
    heights = aggregate(cost, lattice, penalties(ortho, shape, config.semiglobal), config.semiglobal)
    return LevelResult(window, views, lattice, seen, heights)


def _ortho(views: TileViews, surface: NDArray[np.float32], block: int) -> NDArray[np.float32]:
    """The leading view on a surface of height indices."""
    out = np.empty(surface.shape, np.float32)
    tile_ortho(views.pixels, views.layout, views.nodes, views.heights, surface, 0, block, out)
    return out


def _finer(coarser: LevelResult, window: CellWindow, level: int) -> NDArray[np.float32]:
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
    known = (coarser.seen[0] <= coarser.seen[1]).sum(axis=0) >= 2
    rival = np.where(heights.margin < RIVALS_KEPT, heights.second, heights.best)
    low = np.where(known, np.minimum(heights.best, rival), np.nan).astype(np.float32)
    high = np.where(known, np.maximum(heights.best, rival), np.nan).astype(np.float32)
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


def _finish(
    scene: MatchScene, pixels: list[ViewPixels], core: CellWindow, result: LevelResult, config: RunConfig
) -> Surface:
    """Refine the finest level, judge it, and cut the core out."""
    block = config.pyramid.block
    coefficients = TileViews(
        pixels=np.concatenate(
            [spline_filter(view.pixels[0], 3, output=np.float32, mode="mirror").ravel() for view in pixels]
        ),
        blocked=result.views.blocked,
        has_blocked=result.views.has_blocked,
        layout=result.views.layout,
        nodes=result.views.nodes,
        heights=result.views.heights,
    )
    refined = refine(coefficients, result.heights.vertex, result.seen, block, config.refine)
    at = refined.height[None]
    covering = (result.seen[1] >= 0).sum(axis=0)
    seeing = ((result.seen[0] <= at) & (at <= result.seen[1])).sum(axis=0)
    last = scene.n_steps - 1
    quality = judge(result.heights, refined, covering, seeing, last, config.checks)
    height = result.lattice.metres(refined.height)
    height[is_empty(quality)] = np.nan
    ortho = _ortho(result.views, refined.height, block) * np.float32(scene.contrast[0])
    ortho[np.isnan(height)] = np.nan
    used = np.where(np.isnan(height), 0, seeing).astype(np.uint8)
    return _place(core, result.window, Surface(height, quality, used, ortho))


def _nothing(core: CellWindow) -> Surface:
    """A tile that no two views cover."""
    from zlocus.surface.reasons import Quality

    shape = (core.rows, core.cols)
    empty = np.full(shape, np.nan, np.float32)
    return Surface(empty, np.full(shape, Quality.UNSEEN, np.uint16), np.zeros(shape, np.uint8), empty)


def _place(core: CellWindow, window: CellWindow, surface: Surface) -> Surface:
    """The core of a tile, from what was computed with halos and inside the ground seen."""
    out = _nothing(core)
    shared = core.within(window)
    here, there = shared.slices_in(core), shared.slices_in(window)
    result = {}
    for name in ("height", "quality", "views", "ortho"):
        array = getattr(out, name).copy()
        array[here] = getattr(surface, name)[there]
        result[name] = array
    return Surface(**result)
