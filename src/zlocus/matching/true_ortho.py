"""Ortho-images: what views show on a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.scene import ColourSource
from zlocus.matching.kernels.occlusion import finest_view
from zlocus.matching.kernels.subpixel import tile_ortho
from zlocus.matching.occlusion import hide
from zlocus.matching.radiometry import GreyScale
from zlocus.matching.tile_views import TileViews, ViewPixels
from zlocus.matching.view_directions import cells_per_step

# Steps by which a surface must stand above a ray to hide what lies behind: less is its noise.
STANDS_ABOVE_STEPS = 1.0
# A view that shows a cell on so many times the pixels of the leading one is better.
FINER = 1.2
EDGE = np.ones((3, 3), np.uint8)


def ortho_image(views: TileViews, surface: NDArray[np.float32], view: int = 0) -> NDArray[np.float32]:
    """One view, by default the leading one, on a surface of height indices (r, c), as `views` has its pixels."""
    out = np.empty(surface.shape, np.float32)
    tile_ortho(views.arrays, surface, view, out)
    return out


@dataclass(frozen=True)
class Around:
    """What stands around a tile. surface : (r, c) float32 height indices of the tile's level, of the tile's cells (not
    looked at) and of others; row, col : the tile's first cell in it."""

    surface: NDArray[np.float32]
    row: int
    col: int

    def with_inside(self, surface: NDArray[np.float32]) -> NDArray[np.float32]:
        """The surface around a tile with the tile's own in its middle."""
        whole = self.surface.copy()
        whole[self.row : self.row + surface.shape[0], self.col : self.col + surface.shape[1]] = surface
        return whole


@dataclass(frozen=True)
class CoarserHeights:
    """Height indices (r, c) float32 of a level, in its own steps, on the cells `window`."""

    level: int
    window: CellWindow
    surface: NDArray[np.float32]


def what_stands_around(
    coarser: Sequence[CoarserHeights], views: TileViews, window: CellWindow, surface: NDArray[np.float32], halo: int
) -> Around | None:
    """What coarser levels know of the ground around a tile, as far as it can stand between the tile and a view; None
    where the tile's own cells reach that far already.

    coarser : of the next level first; views, window, surface : the finest level's, with a halo of so many cells.
    """
    if not coarser:
        return None
    speed = max(float(np.hypot(*cells_per_step(views, i))) for i in range(len(views.layout)))
    ground = float(surface.min())
    for known in coarser:
        size = 2**known.level
        # A false height of a cell or two is no tower.
        top = size * float(cv2.medianBlur(known.surface, 3).max())
        # From the cells that matter, those of the core.
        reach = max(int(np.ceil((top - ground) * speed)) - halo, 0)
        whole = known.window.finer(known.level)
        wide = CellWindow(
            window.row - reach, window.col - reach, window.rows + 2 * reach, window.cols + 2 * reach
        ).within(whole.around(window))
        # Halos double from level to level.
        if halo * (size - 1) >= reach:
            break
    if wide == window:
        return None
    rows = np.clip((np.arange(wide.rows) + wide.row) // size - known.window.row, 0, known.window.rows - 1)
    cols = np.clip((np.arange(wide.cols) + wide.col) // size - known.window.col, 0, known.window.cols - 1)
    doubled = np.ascontiguousarray(known.surface[np.ix_(rows, cols)]) * np.float32(size)
    return Around(doubled, window.row - wide.row, window.col - wide.col)


def true_ortho(
    pixels: Sequence[ViewPixels], views: TileViews, seen: NDArray[np.int32], surface: NDArray[np.float32],
    coloured: Sequence[ColourSource] = (), around: Around | None = None, scale: GreyScale | None = None,
) -> NDArray[np.float32]:  # fmt: skip
    """Grey values (r, c), or colours (r, c, 3), of the best view that sees each cell of a surface; NaN where none does.

    surface : (r, c) float32 height indices, no NaN, which also is what hides one cell from a view behind another;
    pixels, views : the finest level's; seen : (3, i, r, c), see `coverage`; coloured : their images, where all have
    colours; around : what may hide cells too, None where nothing beyond the tile is tall enough; scale : of the image
    to which all are levelled, trends taken off; None: each keeps its own grey values.
    """
    best = best_view(views, seen, surface, around)
    out = np.full(surface.shape + ((3,) if coloured else ()), np.nan, np.float32)
    for i, view in enumerate(pixels):
        shown = best == i
        if not shown.any():
            continue
        gain, offset = 1.0, 0.0
        if scale is not None:
            gain = scale.contrast / view.contrast
            offset = scale.mean - gain * view.mean
        if coloured:
            (row, col), (rows, cols) = view.origin, view.shape
            for k, channel in enumerate(coloured[i].colours(row, col, rows, cols)):
                plain = channel if scale is None or view.trend is None else channel - view.trend
                out[shown, k] = _of_one(views, i, plain, surface)[shown] * np.float32(gain) + np.float32(offset)
            continue
        grey = ortho_image(views, surface, i)[shown] * np.float32(view.contrast) + np.float32(view.mean)
        if scale is None and view.trend is not None:
            grey += _of_one(views, i, view.trend, surface)[shown]
        out[shown] = grey if scale is None else grey * np.float32(gain) + np.float32(offset)
    return out


def best_view(
    views: TileViews, seen: NDArray[np.int32], surface: NDArray[np.float32], around: Around | None = None
) -> NDArray[np.int32]:
    """The view that shows each cell of a surface on most pixels, of those from which the surface itself, or what stands
    around it, does not hide it; the leading one unless another is clearly finer; -1 where none sees it. (r, c)

    Edges lie within a cell or so of where they should: views that see past them by more are asked first. Where the
    surface hides a cell from all, those with which it was matched are taken, by `seen`: rough ground hides itself.
    """
    size = pixels_per_cell(views)
    size[0] *= FINER
    best = np.full(surface.shape, -1, np.int32)
    first = (0, 0) if around is None else (around.row, around.col)
    whole = surface if around is None else around.with_inside(surface)
    free, level = seen.copy(), np.zeros_like(surface)
    for obstacle in (cv2.dilate(whole, EDGE), whole):
        hide(free, views, obstacle, level, STANDS_ABOVE_STEPS, first)
        finest_view(size, free, surface, views.block, best)
        if (best >= 0).all():
            return best
    finest_view(size, seen, surface, views.block, best)
    return best


def pixels_per_cell(views: TileViews) -> NDArray[np.float64]:
    """Pixels that each view shows a level cell on, by blocks, (i, b, d): few where it is far away or looks aside."""
    # At height index 0 or as near to it as the block's polynomials hold.
    index = np.clip(0.0, views.ends[..., 0], views.ends[..., 1])
    t = views.heights[0] + np.where(views.holds, index, 0.0) * views.heights[1]
    powers = t[..., None] ** np.arange(views.nodes.shape[-1])
    corners = (views.nodes[:, :-1, :-1], views.nodes[:, :-1, 1:], views.nodes[:, 1:, :-1])
    here, right, below = ((part * powers[..., None, :]).sum(axis=-1) for part in corners)
    across, down = (right - here) / views.block, (below - here) / views.block
    return np.asarray(np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]))


def _of_one(
    views: TileViews, view: int, pixels: NDArray[np.float32], surface: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Other pixels (r, c) of a view, in place of its own, on a surface."""
    layout = views.layout.copy()
    layout[view, 0] = 0
    return ortho_image(replace(views, pixels=np.ascontiguousarray(pixels).ravel(), layout=layout), surface, view)
