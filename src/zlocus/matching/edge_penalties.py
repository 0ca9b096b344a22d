"""Which edges of the ortho-image may make height jumps cheaper: those that lie across the parallax.

When the height of a cell changes, the images move against each other along one direction, that of the parallax. An edge
across this direction shows where a height ends. An edge along it looks the same at all heights: the images say nothing
about the height of its cells, and what they seem to say is noise. If jumps were cheap there, the heights beside a road
that runs along the base line would be those of noise. The share of the grey gradient that lies along the parallax is
therefore measured around every cell, in the structure tensor of its surroundings (Foerstner and Guelch 1987).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SemiGlobalOptions
from zlocus.matching.level_records import PyramidLevel
from zlocus.matching.local_contrast import edge_image
from zlocus.matching.occlusion import PAIR
from zlocus.matching.semiglobal import jump_penalties
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_directions import directions_of_blocks

# The window whose gradients are taken together, cells.
TENSOR_WINDOW = (5, 5)
# Edges count in full from this share on; it is one half where the grey values have no direction, as in noise.
FULL_SHARE = 0.05
# Squared gradients below this share of their mean are those of rounding, where nothing has an edge.
PLAIN_SHARE = 1e-6
# Parallaxes, in cells per height step and squared, below this have no direction.
LEAST_PARALLAX = 1e-12


def penalties_at_edges(
    tile_views: TileViews,
    surface: NDArray[np.float32] | None,
    covered: NDArray[np.bool_],
    alike: NDArray[np.float64] | None,
    level: PyramidLevel,
    options: SemiGlobalOptions,
) -> NDArray[np.uint16]:
    """Penalties of height jumps, lower across the edges of the ortho-image that lie across the parallax, (4, r, c).

    surface : (r, c) float32 level indices, the surface known before, None without one; covered : (i, r, c), cells that
    each view covers; alike : (i,), how well each view agrees with the others, not None where a surface is known. See
    `jump_penalties`.
    """
    ortho, weight = None, None
    if surface is not None:
        assert alike is not None, "wherever a surface is known"
        ortho = edge_image(tile_views, surface, covered, level.core, alike)
        weight = weights_of_edges(ortho, tile_views)
    has_two_views = covered.sum(axis=0) <= PAIR
    return jump_penalties(ortho, level.shape, level.number, options, has_two_views, level.core, weight)


def weights_of_edges(ortho: NDArray[np.float32], tile_views: TileViews) -> NDArray[np.float32]:
    """How much an edge at each cell says about heights, (r, c) float32 from 0 to 1. ortho : (r, c), NaN where not
    known."""
    share = share_along_parallax(ortho, by_cell(parallax_tensors(tile_views), tile_views.block, ortho.shape))
    return np.asarray(np.clip(share / np.float32(FULL_SHARE), 0.0, 1.0), np.float32)


def parallax_tensors(tile_views: TileViews) -> NDArray[np.float32]:
    """Directions along which the views of each block move against each other, (b, d, 3) float32.

    For the pairs of views with the directions p (column, row) of their parallax: the sums of p p^T, divided by their
    trace, as column-column, row-row and column-row. No direction is preferred where no two views show a block.
    """
    direction = directions_of_blocks(tile_views)
    n = tile_views.is_projected.sum(axis=0)[..., None]
    total = direction.sum(axis=0)
    squares = n * (direction**2).sum(axis=0) - total**2
    product = n[..., 0] * direction.prod(axis=-1).sum(axis=0) - total.prod(axis=-1)
    trace = squares.sum(axis=-1)
    is_known = trace > LEAST_PARALLAX
    trace = np.where(is_known, trace, 1.0)
    parts = (squares[..., 0], squares[..., 1], product)
    return np.stack(
        [np.where(is_known, part / trace, even) for part, even in zip(parts, (0.5, 0.5, 0.0), strict=True)], axis=-1
    ).astype(np.float32)


def by_cell(of_block: NDArray[np.float32], block: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Values (r, c, k) of the cells of a shape from those of their blocks, (b, d, k)."""
    rows, cols = (np.arange(n) // block for n in shape)
    return of_block[np.ix_(rows, cols)]


def share_along_parallax(ortho: NDArray[np.float32], tensor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Share of the squared grey gradients around each cell that lies along the parallax, (r, c) float32.

    ortho : (r, c), NaN where not known; tensor : (r, c, 3), see `parallax_tensors`. 1 where there is no gradient.
    """
    is_known = np.isfinite(ortho)
    usual = np.float32(ortho[is_known].mean()) if is_known.any() else np.float32(0.0)
    grey = np.where(is_known, ortho, usual)
    by_col, by_row = (cv2.Sobel(grey, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    cols, rows, both = (
        cv2.blur(product, TENSOR_WINDOW) for product in (by_col * by_col, by_row * by_row, by_col * by_row)
    )
    along = tensor[..., 0] * cols + tensor[..., 1] * rows + np.float32(2.0) * tensor[..., 2] * both
    total = cols + rows
    is_plain = total <= np.float32(PLAIN_SHARE) * total.mean()
    return np.where(is_plain, np.float32(1.0), along / np.where(is_plain, np.float32(1.0), total)).astype(np.float32)
