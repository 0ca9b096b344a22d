"""Records that several kernels take: Numba reads their fields without cost.

The comment of a field begins with its shape and type, as the comments above kernels do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class ViewArrays(NamedTuple):
    """All views of a tile at one level; see `zlocus.matching.tile_views.TileViews`, which makes it."""

    pixels: np.ndarray  # (p,) f4: grey values (or spline coefficients) of one view after the other
    layout: np.ndarray  # (i,k) i8: offset of a view in `pixels`, its rows and its columns
    nodes: np.ndarray  # (i,b,d,a,n) f8: polynomial of each image coordinate (column, row) at the corners of the blocks
    bends: np.ndarray  # (i,b,d,e,a,n) f8: polynomials of the bends (along rows, along columns), see `AxisGrid`
    heights: np.ndarray  # (k,) f8: argument of the polynomials at height index 0, and its change per index
    block: int  # i8: cells along the side of a block


class VolumeLayout(NamedTuple):
    """Where a ragged volume keeps each cell; see `zlocus.matching.height_lattice.HeightLattice`, which makes it.

    Cell (r, c) of block (b, d) starts at
    block_row_start[b, d] + (r - b block) row_length[b, d] + block_start[b, d] + (c - d block) n_heights[b, d].
    """

    first: np.ndarray  # (b,d) i8: first height index that the cells of a block search
    n_heights: np.ndarray  # (b,d) i8: number of heights that they search
    block_row_start: np.ndarray  # (b,d) i8: where the first row of cells of a block row starts
    row_length: np.ndarray  # (b,d) i8: length of a row of cells
    block_start: np.ndarray  # (b,d) i8: where a block starts within a row of cells
    block: int  # i8: cells along the side of a block


class VisibleHeights(NamedTuple):
    """Visible height range of every view in every cell, as height indices; see `zlocus.matching.occlusion`.

    A view covers a cell from lowest_covered to highest_covered, and sees it there from lowest_unoccluded on. A view
    that never covers the cell has lowest_covered > highest_covered.
    """

    lowest_covered: np.ndarray  # (i,r,c) i4: lowest index at which the window of the cell lies inside the image
    highest_covered: np.ndarray  # (i,r,c) i4: highest index at which it does
    lowest_unoccluded: np.ndarray  # (i,r,c) i4: lowest index at which no surface occludes the cell

    def at(self, index: Any) -> VisibleHeights:
        """The ranges of some views and cells. index : any NumPy index of an array (i, r, c)."""
        return VisibleHeights(*(bound[index] for bound in self))

    def copy(self) -> VisibleHeights:
        """The same ranges in arrays of their own."""
        return VisibleHeights(*(bound.copy() for bound in self))


class HeightSpan(NamedTuple):
    """The height indices that a block of cells searches."""

    first: int  # i8: first height index
    n_heights: int  # i8: number of heights


class CellBox(NamedTuple):
    """A rectangle of cells."""

    first_row: int  # i8: first row
    end_row: int  # i8: the row after the last
    first_col: int  # i8: first column
    end_col: int  # i8: the column after the last


class ViewImage(NamedTuple):
    """The pixels of one view, row by row."""

    pixels: np.ndarray  # (p,) f4: grey values (or spline coefficients)
    n_rows: int  # i8: rows of the image
    n_cols: int  # i8: columns of the image


class AxisGrid(NamedTuple):
    """One image coordinate (px) of the cells of a block, as a function of the row r and the column c of the cell:
    origin + c by_col + r by_row + r c mixed + r^2 bend_row + c^2 bend_col.

    It is bilinear between the corners of the block where the bends are 0. The bends are those of close cameras.
    """

    origin: float  # f8: at the first cell
    by_col: float  # f8: change per column of cells
    by_row: float  # f8: change per row of cells
    mixed: float  # f8: change per row and column of cells
    bend_row: float  # f8: factor of the square of the row
    bend_col: float  # f8: factor of the square of the column


class BlockGrid(NamedTuple):
    """Image positions of the cells of a block in one view at one height."""

    x: AxisGrid  # AxisGrid: column in the image
    y: AxisGrid  # AxisGrid: row in the image


class PixelVelocity(NamedTuple):
    """Pixels that the image position of a cell moves per height index."""

    x: np.float32  # f4: columns
    y: np.float32  # f4: rows


class FlatCells(NamedTuple):
    """Rows and columns of the cells of a block, one row of cells after the other, from the first cell."""

    rows: np.ndarray  # (p,) f4: rows
    cols: np.ndarray  # (p,) f4: columns


class ResampleScratch(NamedTuple):
    """Arrays that are reused from call to call, for n cells at a time."""

    pixel_index: np.ndarray  # (n,) u4: index of the upper left of the four pixels around each cell
    fraction: np.ndarray  # (2,n) f4: distance (x, y) of the cell from that pixel, px
    pairs: np.ndarray  # (2,n) c8: upper and lower pixels; the left one is the real, the right one the imaginary part


# Height indices beyond all others: lowest_covered of a view that never covers a cell, and lowest_unoccluded where no
# surface occludes it.
NEVER_COVERED = np.int32(2**30)
NEVER_OCCLUDED = np.int32(-(2**29))
