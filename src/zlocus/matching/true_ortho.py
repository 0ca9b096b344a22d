"""Ortho-images: the image values that views show on a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.scene import ColourSource
from zlocus.matching.height_lattice import by_block
from zlocus.matching.kernels.occlusion import finest_view
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.kernels.subpixel import tile_ortho
from zlocus.matching.occlusion import mark_occlusions
from zlocus.matching.radiometry import GreyScale
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_directions import cells_per_step

# Steps by which a surface must stand above a ray to occlude the cells behind it: less is noise of the surface.
MIN_OCCLUDER_STEPS = 1.0
# The reference image is shown unless another view shows the cell on so many times its pixels.
MIN_PIXEL_RATIO_OF_FINER_VIEW = 1.2
# Surfaces are widened by this shape before views that see past them are preferred.
WIDENED_SHAPE = np.ones((3, 3), np.uint8)
# Coarser heights are freed of false heights of a cell or two by a median over so many cells.
MEDIAN_CELLS = 3


def ortho_image(
    tile_views: TileViews,
    surface: NDArray[np.float32],
    view: int = 0,
    where: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Grey values of one view on a surface, (r, c) float32, as `tile_views` has its pixels.

    surface : (r, c) float32 level indices; view : by default the reference image; where : (r, c), cells whose values
    are wanted, None: all. The values of other cells may be anything, and are 0 in blocks that the view does not show.
    """
    out, is_wanted = np.empty(surface.shape, np.float32), tile_views.is_projected[view]
    if where is not None:
        is_wanted = is_wanted & by_block(where, tile_views.block, np.logical_or)
    tile_ortho(tile_views.arrays, surface, view, is_wanted, out)
    return out


@dataclass(frozen=True)
class Surroundings:
    """The surface around a tile.

    surface : (r, c) float32 height indices of the tile's level, on the cells of the tile (whose values are not used)
    and around it; row, col : the tile's first cell in it.
    """

    surface: NDArray[np.float32]
    row: int
    col: int

    def with_inside(self, surface: NDArray[np.float32]) -> NDArray[np.float32]:
        """The surface around a tile with the tile's own surface in its middle."""
        whole = self.surface.copy()
        whole[self.row : self.row + surface.shape[0], self.col : self.col + surface.shape[1]] = surface
        return whole


@dataclass(frozen=True)
class CoarserHeights:
    """Heights of a coarser level on the cells `window`: (r, c) float32, level indices of that level."""

    level: int
    window: CellWindow
    surface: NDArray[np.float32]


def surroundings_of_tile(
    coarser: Sequence[CoarserHeights],
    tile_views: TileViews,
    window: CellWindow,
    surface: NDArray[np.float32],
    halo: int,
) -> Surroundings | None:
    """The surface around a tile, from coarser levels, as far as it can occlude cells of the tile from a view.

    None where the tile's own window already extends that far. coarser : the next coarser level first; tile_views,
    window, surface : of the finest level, with a halo of so many cells.
    """
    if not coarser:
        return None
    speed = max(float(np.hypot(*cells_per_step(tile_views, i))) for i in range(len(tile_views.layout)))
    ground = float(surface.min())
    for known in coarser:
        size = 2**known.level
        top = size * float(cv2.medianBlur(known.surface, MEDIAN_CELLS).max())
        # Distance from the cells that matter, those of the core.
        distance = max(int(np.ceil((top - ground) * speed)) - halo, 0)
        whole = known.window.finer(known.level)
        wide = CellWindow(
            window.row - distance, window.col - distance, window.rows + 2 * distance, window.cols + 2 * distance
        ).within(whole.around(window))
        # Halos double from level to level.
        if halo * (size - 1) >= distance:
            break
    if wide == window:
        return None
    rows = np.clip((np.arange(wide.rows) + wide.row) // size - known.window.row, 0, known.window.rows - 1)
    cols = np.clip((np.arange(wide.cols) + wide.col) // size - known.window.col, 0, known.window.cols - 1)
    doubled = np.ascontiguousarray(known.surface[np.ix_(rows, cols)]) * np.float32(size)
    return Surroundings(doubled, window.row - wide.row, window.col - wide.col)


def true_ortho(
    tile_views: TileViews, visible: VisibleHeights, surface: NDArray[np.float32],
    coloured: Sequence[ColourSource] = (), surroundings: Surroundings | None = None, scale: GreyScale | None = None,
) -> NDArray[np.float32]:  # fmt: skip
    """Grey values (r, c), or colours (r, c, 3), of the best view that sees each cell of a surface, float32.

    NaN where no view sees the cell. surface : (r, c) float32 height indices without NaN, which also decides which cells
    are occluded; tile_views, visible : of the finest level; coloured : the images, where all have colours;
    surroundings : surface around the tile that may occlude cells, None where nothing there is tall enough; scale : of
    the image to whose grey values all are adjusted, without trends; None: each keeps its own grey values.
    """
    best = best_view(tile_views, visible, surface, surroundings)
    out = np.full(surface.shape + ((3,) if coloured else ()), np.nan, np.float32)
    for i, view in enumerate(tile_views.view_pixels):
        shown = best == i
        if not shown.any():
            continue
        gain, offset = 1.0, 0.0
        if scale is not None:
            gain = scale.contrast / view.scale.contrast
            offset = scale.mean - gain * view.scale.mean
        if coloured:
            trend = None if scale is None else view.trend
            for k, channel in enumerate(coloured[i].colours(*view.window)):
                plain = channel if trend is None else channel - trend
                values = _ortho_of(tile_views, i, plain, surface, shown)[shown]
                out[shown, k] = values * np.float32(gain) + np.float32(offset)
            continue
        own = view.scale
        grey = ortho_image(tile_views, surface, i, shown)[shown] * np.float32(own.contrast) + np.float32(own.mean)
        trend = view.trend if scale is None else None
        if trend is not None:
            grey += _ortho_of(tile_views, i, trend, surface, shown)[shown]
        out[shown] = grey if scale is None else grey * np.float32(gain) + np.float32(offset)
    return out


def best_view(
    tile_views: TileViews,
    visible: VisibleHeights,
    surface: NDArray[np.float32],
    surroundings: Surroundings | None = None,
) -> NDArray[np.int32]:
    """Number of the view that shows each cell of a surface best, (r, c) int32; -1 where no view sees it.

    That is the view that sees the cell on most pixels; the reference image unless another is clearly finer. Edges of a
    surface are uncertain by about a cell, so views that see past them by more are preferred. Where the surface occludes
    a cell from all views, those with which it was matched are taken, by `visible`: rough ground occludes itself.
    """
    size = pixels_per_cell(tile_views)
    size[0] *= MIN_PIXEL_RATIO_OF_FINER_VIEW
    best = np.full(surface.shape, -1, np.int32)
    first = (0, 0) if surroundings is None else (surroundings.row, surroundings.col)
    whole = surface if surroundings is None else surroundings.with_inside(surface)
    seeing, level_ground = visible.copy(), np.zeros_like(surface)
    for occluder in (cv2.dilate(whole, WIDENED_SHAPE), whole):
        mark_occlusions(seeing, tile_views, occluder, level_ground, MIN_OCCLUDER_STEPS, first)
        finest_view(size, seeing, surface, tile_views.block, best)
        if (best >= 0).all():
            return best
    finest_view(size, visible, surface, tile_views.block, best)
    return best


def pixels_per_cell(tile_views: TileViews) -> NDArray[np.float64]:
    """Number of pixels on which each view shows a level cell, by blocks, (i, b, d) float64.

    It is small where the view is far away or looks obliquely.
    """
    # At height index 0 or as near to it as the polynomials of the block hold.
    index = np.clip(0.0, tile_views.index_range[..., 0], tile_views.index_range[..., 1])
    t = tile_views.t_of_index[0] + np.where(tile_views.is_projected, index, 0.0) * tile_views.t_of_index[1]
    nodes, block = tile_views.nodes, tile_views.block
    powers = t[..., None] ** np.arange(nodes.shape[-1])
    corners = (nodes[:, :-1, :-1], nodes[:, :-1, 1:], nodes[:, 1:, :-1])
    here, right, below = ((part * powers[..., None, :]).sum(axis=-1) for part in corners)
    across, down = (right - here) / block, (below - here) / block
    return np.asarray(np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]))


def _ortho_of(
    tile_views: TileViews,
    view: int,
    pixels: NDArray[np.float32],
    surface: NDArray[np.float32],
    where: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Ortho-image of other pixels (r, c) in place of those of a view. where : see `ortho_image`."""
    layout = tile_views.layout.copy()
    layout[view, 0] = 0
    of_view = replace(tile_views, pixels=np.ascontiguousarray(pixels).ravel(), layout=layout)
    return ortho_image(of_view, surface, view, where)
