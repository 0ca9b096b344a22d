"""Directions of views over a tile: how many cells an image point moves for a step of height."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from zlocus.matching.tile_views import TileViews

# Cells per height step by which directions differ within a part of a tile, and parts along a side at most.
TURN, MOST_PARTS = 0.2, 8


def parts_of_one_direction(views: TileViews, i: int) -> list[tuple[slice, slice]]:
    """Parts of a tile, whole blocks each, over which a view looks about the same way: the tile itself from afar."""
    n = views.holds.shape[1:]
    by_step = np.array([cells_per_step(views, i, _block_cells(views, b, d)) for b in _ends(n[0]) for d in _ends(n[1])])
    apart = float(np.abs(np.diff(by_step, axis=0)).max())
    n_parts = min(max(math.ceil(apart / TURN), 1), MOST_PARTS)
    edges = [np.unique(np.linspace(0, count, n_parts + 1).astype(int)) * views.block for count in n]
    rows, cols = ([slice(int(a), int(b)) for a, b in pairwise(edge)] for edge in edges)
    return [(row, col) for row in rows for col in cols]


def _ends(count: int) -> tuple[int, int]:
    return 0, count - 1


def _block_cells(views: TileViews, b: int, d: int) -> tuple[slice, slice]:
    """Cells of a block."""
    return slice(b * views.block, (b + 1) * views.block), slice(d * views.block, (d + 1) * views.block)


def cells_per_step(views: TileViews, i: int, part: tuple[slice, slice] | None = None) -> tuple[float, float]:
    """Cells (columns, rows) that the ground point seen by a fixed pixel moves per height step, at the centre of a part
    of the tile, by default of all, or as near to it as the view can show; 0 where it shows none of the tile."""
    nodes = views.nodes[i]
    b, d = (nodes.shape[0] - 1) // 2, (nodes.shape[1] - 1) // 2
    if part is not None:
        b, d = ((span.start + span.stop) // 2 // views.block for span in part)
        b, d = min(b, nodes.shape[0] - 2), min(d, nodes.shape[1] - 2)
    if not views.holds[i, b, d]:
        shown = np.argwhere(views.holds[i])
        if not len(shown):
            return 0.0, 0.0
        b, d = shown[((shown - (b, d)) ** 2).sum(axis=1).argmin()]
    # At a height where the block is seen: 0, or as near to it as may be.
    low, high = views.heights[0] + views.ends[i, b, d] * views.heights[1]
    t = float(min(max(0.0, low), high))
    powers = t ** np.arange(nodes.shape[-1])
    slopes = np.arange(1, nodes.shape[-1]) * powers[:-1]
    here, right, below = (nodes[at] @ powers for at in ((b, d), (b, d + 1), (b + 1, d)))
    by_cell = np.column_stack([right - here, below - here]) / views.block
    by_step = nodes[b, d][:, 1:] @ slopes * views.heights[1]
    col, row = -np.linalg.solve(by_cell, by_step)
    return float(col), float(row)
