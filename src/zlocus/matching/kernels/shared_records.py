"""Records that several kernels take: Numba reads their fields without cost.

The comment of a field begins with its shape and type, as the comments above kernels do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class ViewArrays(NamedTuple):
    """All views of a tile at one level; see `zlocus.matching.tile_views.TileViews`, which makes it."""

    pixels: np.ndarray  # (p,) f4: grey values (or spline coefficients) of one view after the other
    layout: np.ndarray  # (i,k) i8: offset of a view in `pixels`, its rows and its columns
    nodes: np.ndarray  # (i,b,d,a,n) f8: polynomial of each image coordinate (column, row) at the corners of the blocks
    heights: np.ndarray  # (k,) f8: argument of the polynomials at height index 0, and its change per index
    block: int  # i8: cells along the side of a block


class VolumeLayout(NamedTuple):
    """Where a ragged volume keeps each cell; see `zlocus.matching.height_lattice.HeightLattice`, which makes it.

    Cell (r, c) of block (b, d) starts at
    block_row_start[b, d] + (r - b block) row_length[b, d] + block_start[b, d] + (c - d block) count[b, d].
    """

    first: np.ndarray  # (b,d) i8: first height index that the cells of a block search
    count: np.ndarray  # (b,d) i8: number of heights that they search
    block_row_start: np.ndarray  # (b,d) i8: where the first row of cells of a block row starts
    row_length: np.ndarray  # (b,d) i8: length of a row of cells
    block_start: np.ndarray  # (b,d) i8: where a block starts within a row of cells
    block: int  # i8: cells along the side of a block
