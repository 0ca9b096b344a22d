"""Where the cells of a block project to in an image, and the image values there.

Source of the speed: loads from an index are scalar code, so they are kept apart from the arithmetic, which vectorises.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import as_strided

from zlocus.core.jit import kernel
from zlocus.matching.kernels.shared_records import (
    AxisGrid,
    BlockGrid,
    FlatCells,
    PixelVelocity,
    ResampleScratch,
    ViewImage,
)

# Cells of a surface that are resampled at a time: the arrays between the passes stay in the first level of the cache.
RUN = 512


# as ViewArrays.pixels, sliced: ViewArrays, i8 -> ViewImage
@kernel
def image_of(views, view):
    """The image of one view."""
    offset, n_rows, n_cols = views.layout[view, 0], views.layout[view, 1], views.layout[view, 2]
    return ViewImage(views.pixels[offset : offset + n_rows * n_cols], n_rows, n_cols)


# (n,) f8, f8 -> f8
@kernel
def polynomial(coefficients, t):
    """Value of a polynomial at t; coefficients of 1, t, t^2, ..."""
    value = 0.0
    for power in range(coefficients.shape[0] - 1, -1, -1):
        value = value * t + coefficients[power]
    return value


# (2,2,2,4) f8, (2,2,4) f8, i8, f8, i8, i8 -> AxisGrid
@kernel
def axis_grid(corners, bends, axis, t, block, half):
    """One image coordinate of the cells of a block and of `half` cells around it. See `block_grid`."""
    origin, right = polynomial(corners[0, 0, axis], t), polynomial(corners[0, 1, axis], t)
    below, diagonal = polynomial(corners[1, 0, axis], t), polynomial(corners[1, 1, axis], t)
    by_col = (right - origin) / block
    by_row = (below - origin) / block
    mixed = (diagonal - below - right + origin) / (block * block)
    bend_row, bend_col = polynomial(bends[0, axis], t), polynomial(bends[1, axis], t)
    # A bend is zero at both ends of the block.
    by_row -= block * bend_row
    by_col -= block * bend_col
    origin += half * (half * (mixed + bend_row + bend_col) - by_col - by_row)
    by_row -= half * (mixed + 2.0 * bend_row)
    by_col -= half * (mixed + 2.0 * bend_col)
    return AxisGrid(origin, by_col, by_row, mixed, bend_row, bend_col)


# ViewArrays, i8, f8, i8 -> BlockGrid
@kernel
def block_grid(views, view, t, half):
    """Image positions, in one view, of the cells of a block and of `half` cells around it at one height.

    views : of one block, see `views_of_block`; t : height in the normalised unit of the projection table.
    """
    corners, bends, block = views.nodes[view], views.bends[view, 0, 0], views.block
    return BlockGrid(axis_grid(corners, bends, 0, t, block, half), axis_grid(corners, bends, 1, t, block, half))


# AxisGrid, f8, f8 -> f8
@kernel
def coordinate(grid, row, col):
    """Image coordinate (px) of the cell at (row, col)."""
    by_col = grid.by_col + row * grid.mixed + col * grid.bend_col
    return grid.origin + row * (grid.by_row + row * grid.bend_row) + col * by_col


# AxisGrid, i8 -> f8
@kernel
def largest_bend(grid, block):
    """By how much, at most, the positions within a block deviate from the bilinear ones between its corners, px."""
    return 0.25 * block * block * (abs(grid.bend_row) + abs(grid.bend_col))


# (2,2,2,4) f8, i8, f8 -> f8
@kernel
def axis_velocity(corners, axis, t):
    """Pixels per unit of t that one image coordinate of the middle of a block moves."""
    total = 0.0
    for corner in range(4):
        k = corners[corner // 2, corner % 2, axis]
        slope = 0.0
        for power in range(k.shape[0] - 1, 0, -1):
            slope = slope * t + power * k[power]
        total += slope
    return 0.25 * total


# ViewArrays, i8, f8 -> PixelVelocity
@kernel
def block_velocity(views, view, t):
    """Pixels that the middle of a block moves per height index. views, t : see `block_grid`."""
    corners, t_per_index = views.nodes[view], views.heights[1]
    x, y = axis_velocity(corners, 0, t) * t_per_index, axis_velocity(corners, 1, t) * t_per_index
    return PixelVelocity(np.float32(x), np.float32(y))


# i8, i8 -> FlatCells
@kernel
def flat_cells(n_rows, n_cols):
    """Rows and columns of the cells of a block, one row of cells after the other."""
    cells = FlatCells(np.empty(n_rows * n_cols, np.float32), np.empty(n_rows * n_cols, np.float32))
    for r in range(n_rows):
        for c in range(n_cols):
            cells.rows[r * n_cols + c], cells.cols[r * n_cols + c] = r, c
    return cells


# i8 -> ResampleScratch
@kernel
def resample_scratch(n):
    """New scratch arrays for n cells at a time."""
    return ResampleScratch(np.empty(n, np.uint32), np.empty((2, n), np.float32), np.empty((2, n), np.complex64))


# ViewImage, BlockGrid, PixelVelocity, FlatCells, (p,) f4, i8, i8, ResampleScratch -> None
@kernel
def pixel_positions(image, grid, velocity, cells, relief, first, end, scratch):
    """Find the four pixels around each of the cells `first` to `end`, and the position of the cell between them.

    See `resample_plane`. The index of the upper left pixel and the distance from it are written to the scratch arrays.
    Float32 positions are from a whole-pixel origin near the grid. Vectorises (int32 becomes float32 in vector lanes,
    int64 does not).
    """
    n_rows, n_cols = image.n_rows, image.n_cols
    origin_x = min(max(int(grid.x.origin), 0), n_cols - 2)
    origin_y = min(max(int(grid.y.origin), 0), n_rows - 2)
    x_low, x_high = np.float32(-origin_x), np.float32(n_cols - 1.01 - origin_x)
    y_low, y_high = np.float32(-origin_y), np.float32(n_rows - 1.01 - origin_y)
    stride, origin = np.int32(n_cols), np.int32(origin_y * n_cols + origin_x)
    x0, y0 = np.float32(grid.x.origin - origin_x), np.float32(grid.y.origin - origin_y)
    x_col, y_col = np.float32(grid.x.by_col), np.float32(grid.y.by_col)
    x_row, y_row = np.float32(grid.x.by_row), np.float32(grid.y.by_row)
    x_mixed, y_mixed = np.float32(grid.x.mixed), np.float32(grid.y.mixed)
    x_bend_row, y_bend_row = np.float32(grid.x.bend_row), np.float32(grid.y.bend_row)
    x_bend_col, y_bend_col = np.float32(grid.x.bend_col), np.float32(grid.y.bend_col)
    vx, vy = velocity.x, velocity.y
    rows, cols, steps = cells.rows[first:end], cells.cols[first:end], relief[first:end]
    index, fx, fy = scratch.pixel_index, scratch.fraction[0], scratch.fraction[1]
    for j in range(end - first):
        r, c, z = rows[j], cols[j], steps[j]
        x_of_col, x_of_row = c * (x_col + r * x_mixed + c * x_bend_col), r * (x_row + r * x_bend_row)
        y_of_col, y_of_row = c * (y_col + r * y_mixed + c * y_bend_col), r * (y_row + r * y_bend_row)
        x = min(max(x0 + x_of_col + x_of_row + z * vx, x_low), x_high)
        y = min(max(y0 + y_of_col + y_of_row + z * vy, y_low), y_high)
        left, top = np.floor(x), np.floor(y)
        fx[j] = x - left
        fy[j] = y - top
        index[j] = np.uint32(np.int32(np.int32(top) * stride) + np.int32(left) + origin)


# ViewImage, ResampleScratch, (n,) f4 -> None
@kernel
def gather(image, scratch, out):
    """Write the bilinear values between the four pixels that the scratch arrays name, one per element of `out`.

    A pixel and the one to the right of it are read together, as a complex number, so that one load reads both. Loads
    from an index are scalar code; once they are apart, the interpolation vectorises.
    """
    pixels, index = image.pixels, scratch.pixel_index
    beside = as_strided(pixels[: pixels.shape[0] // 2 * 2].view(np.complex64), (pixels.shape[0] - 1,), (4,))
    below, upper, lower = np.uint64(image.n_cols), scratch.pairs[0], scratch.pairs[1]
    for j in range(out.shape[0]):
        p = np.uint64(index[j])
        upper[j] = beside[p]
        lower[j] = beside[p + below]
    fx, fy = scratch.fraction[0], scratch.fraction[1]
    for j in range(out.shape[0]):
        top = upper[j].real + fx[j] * (upper[j].imag - upper[j].real)
        low = lower[j].real + fx[j] * (lower[j].imag - lower[j].real)
        out[j] = top + fy[j] * (low - top)


# ViewImage, BlockGrid, PixelVelocity, FlatCells, (c,) f4, ResampleScratch, (c,) f4 -> None
@kernel
def resample_plane(image, grid, velocity, cells, relief, scratch, out):
    """Write the bilinear image values at the positions of a block's cells, which are moved by the relief of the ground.

    grid, velocity : positions of the cells at the height of the plane, and pixels that they move per step; cells :
    c of them; relief : (c,) float32, steps by which each cell stands above the plane; out : (c,) float32 or longer.
    Positions outside the image are clamped to its edge (the caller masks them).
    """
    run = scratch.pixel_index.shape[0]
    for first in range(0, relief.shape[0], run):
        end = min(first + run, relief.shape[0])
        pixel_positions(image, grid, velocity, cells, relief, first, end, scratch)
        gather(image, scratch, out[first:end])
