"""Directions of views over a tile: how many cells the point seen by a fixed pixel moves per height step."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.tile_views import TileViews

# Directions may differ by so many cells per height step within a part of a tile.
MAX_TURN_CELLS_PER_STEP = 0.2
MAX_PARTS_PER_SIDE = 8


def parts_of_one_direction(tile_views: TileViews, view: int) -> list[tuple[slice, slice]]:
    """Parts of a tile, whole blocks each, over which a view looks in nearly the same direction.

    For a view from far away that is the tile itself.
    """
    n, ends = tile_views.is_projected.shape[1:], []
    for b in (0, n[0] - 1):
        ends += [cells_per_step(tile_views, view, _block_cells(tile_views, b, d)) for d in (0, n[1] - 1)]
    apart = float(np.abs(np.diff(np.array(ends), axis=0)).max())
    n_parts = min(max(math.ceil(apart / MAX_TURN_CELLS_PER_STEP), 1), MAX_PARTS_PER_SIDE)
    edges = [np.unique(np.linspace(0, count, n_parts + 1).astype(int)) * tile_views.block for count in n]
    rows, cols = ([slice(int(a), int(b)) for a, b in pairwise(edge)] for edge in edges)
    return [(row, col) for row in rows for col in cols]


def _block_cells(tile_views: TileViews, b: int, d: int) -> tuple[slice, slice]:
    """Rows and columns of the cells of a block."""
    block = tile_views.block
    return slice(b * block, (b + 1) * block), slice(d * block, (d + 1) * block)


def directions_of_blocks(tile_views: TileViews) -> NDArray[np.float64]:
    """Cells (columns, rows) that the ground point seen by a fixed pixel moves per height step, of every view and block.

    (i, b, d, 2) float64; see `cells_per_step`. 0 where a view does not show a block.
    """
    found = _directions(tile_views, tile_views.nodes, tile_views.index_range)
    is_shown = tile_views.is_projected & np.isfinite(found).all(axis=-1)
    return np.where(is_shown[..., None], found, 0.0)


def _directions(
    tile_views: TileViews, nodes: NDArray[np.float64], index_range: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Directions (i, b, d, 2) of some views in some blocks, see `directions_of_blocks`, from the nodes at the blocks'
    corners and the ranges of height indices over which these hold, as in `TileViews`.

    Taken at height index 0, or as near to it as the polynomials of a block hold.
    """
    t_0, t_step = tile_views.t_of_index
    low, high = np.moveaxis(t_0 + index_range * t_step, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        powers = np.clip(0.0, low, high)[..., None] ** np.arange(nodes.shape[-1])
        here, right, below = (
            np.einsum("ibdxk,ibdk->ibdx", at, powers)
            for at in (nodes[:, :-1, :-1], nodes[:, :-1, 1:], nodes[:, 1:, :-1])
        )
        slopes = np.arange(1, nodes.shape[-1]) * powers[..., :-1]
        by_step = np.einsum("ibdxk,ibdk->ibdx", nodes[:, :-1, :-1, :, 1:], slopes) * t_step
        by_col, by_row = (right - here) / tile_views.block, (below - here) / tile_views.block
        determinant = by_col[..., 0] * by_row[..., 1] - by_col[..., 1] * by_row[..., 0]
        col = (by_row[..., 0] * by_step[..., 1] - by_row[..., 1] * by_step[..., 0]) / determinant
        row = (by_col[..., 1] * by_step[..., 0] - by_col[..., 0] * by_step[..., 1]) / determinant
    return np.stack([col, row], axis=-1)


def cells_per_step(tile_views: TileViews, view: int, part: tuple[slice, slice] | None = None) -> tuple[float, float]:
    """Cells (columns, rows) that the ground point seen by a fixed pixel of a view moves per height step.

    Taken at the centre of a part of the tile (None: of the whole tile), or at the block nearest to it that the view can
    show; 0 where it shows no block of the tile.
    """
    nodes = tile_views.nodes[view]
    b, d = (nodes.shape[0] - 1) // 2, (nodes.shape[1] - 1) // 2
    if part is not None:
        b, d = ((span.start + span.stop) // 2 // tile_views.block for span in part)
        b, d = min(b, nodes.shape[0] - 2), min(d, nodes.shape[1] - 2)
    if not tile_views.is_projected[view, b, d]:
        shown = np.argwhere(tile_views.is_projected[view])
        if not len(shown):
            return 0.0, 0.0
        b, d = (int(n) for n in shown[((shown - (b, d)) ** 2).sum(axis=1).argmin()])
    of_block = nodes[None, b : b + 2, d : d + 2], tile_views.index_range[view : view + 1, b : b + 1, d : d + 1]
    col, row = _directions(tile_views, *of_block)[0, 0, 0]
    return float(col), float(row)


def cells_along_rays(
    part: tuple[slice, slice], by_cell: tuple[float, float], span: float, shape: tuple[int, int]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Rows and columns of the cells from which rays reach a part of a tile, and where the part lies in them.

    by_cell : cells (columns, rows) that the rays move for each height step; span : height steps over which they are
    followed; shape : rows and columns of the tile.
    """
    around, inside = [], []
    for cells, speed, size in zip(part, by_cell[::-1], shape, strict=True):
        start, stop, _ = cells.indices(size)
        distance = math.ceil(abs(speed) * span) + 1
        first, end = max(start - (distance if speed > 0 else 1), 0), min(stop + (distance if speed < 0 else 1), size)
        around.append(slice(first, end))
        inside.append(slice(start - first, stop - first))
    return (around[0], around[1]), (inside[0], inside[1])
