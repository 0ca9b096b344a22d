"""Ortho-images: what views show on a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.refine import tile_ortho
from zlocus.matching.views import TileViews, ViewPixels
from zlocus.matching.visibility import hide, sees
from zlocus.scene import ColourSource

# Steps by which a surface must stand above a ray to hide what lies behind: less is its noise.
STANDS_ABOVE_STEPS = 1.0
# A view that shows a cell on so many times the pixels of the leading one is better.
FINER = 1.2
EDGE = np.ones((3, 3), np.uint8)


def ortho_image(views: TileViews, surface: NDArray[np.float32], view: int = 0) -> NDArray[np.float32]:
    """One view, by default the leading one, on a surface of height indices (r, c), as `views` has its pixels."""
    out = np.empty(surface.shape, np.float32)
    tile_ortho(views.pixels, views.layout, views.nodes, views.heights, surface, view, views.block, out)
    return out


def true_ortho(
    pixels: Sequence[ViewPixels], views: TileViews, seen: NDArray[np.int32], surface: NDArray[np.float32],
    coloured: Sequence[ColourSource] = (),
) -> NDArray[np.float32]:  # fmt: skip
    """Grey values (r, c), or colours (r, c, 3), of the best view that sees each cell of a surface; NaN where none does.

    surface : (r, c) float32 height indices, no NaN, which also is what hides one cell from a view behind another;
    pixels, views : the finest level's; seen : (3, i, r, c), see `coverage`; coloured : their images, where all have
    colours.
    """
    best = best_view(views, seen, surface)
    out = np.full(surface.shape + ((3,) if coloured else ()), np.nan, np.float32)
    for i, view in enumerate(pixels):
        shown = best == i
        if not shown.any():
            continue
        if coloured:
            (row, col), (rows, cols) = view.origin, view.shape
            for k, channel in enumerate(coloured[i].colours(row, col, rows, cols)):
                out[shown, k] = _of_one(views, i, channel, surface)[shown]
            continue
        out[shown] = ortho_image(views, surface, i)[shown] * np.float32(view.contrast) + np.float32(view.mean)
        if view.trend is not None:
            out[shown] += _of_one(views, i, view.trend, surface)[shown]
    return out


def best_view(views: TileViews, seen: NDArray[np.int32], surface: NDArray[np.float32]) -> NDArray[np.int64]:
    """The view that shows each cell of a surface on most pixels, of those from which the surface itself does not hide
    it; the leading one unless another is clearly finer; -1 where none sees it. (r, c)

    Edges lie within a cell or so of where they should: views that see past them by more are asked first.
    """
    size = pixels_per_cell(views)
    size[0] *= FINER
    best = np.full(surface.shape, -1)
    for obstacle in (cv2.dilate(surface, EDGE), surface):
        free = seen.copy()
        hide(free, views, obstacle, np.zeros_like(surface), STANDS_ABOVE_STEPS)
        found = _on_most_pixels(size, free, views.block, surface)
        best = np.where(best < 0, found, best)
        if (best >= 0).all():
            break
    return best


def _on_most_pixels(
    size: NDArray[np.float64], seen: NDArray[np.int32], block: int, surface: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Of the views that see each cell that with the largest size (i, b, d), -1 where none does. (r, c)"""
    rows, cols = surface.shape
    best, most = np.full(surface.shape, -1), np.zeros(surface.shape)
    for i in range(len(size)):
        of_cell = size[i].repeat(block, axis=0).repeat(block, axis=1)[:rows, :cols]
        better = sees(seen[:, i], surface) & (of_cell > most)
        best[better], most[better] = i, of_cell[better]
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
