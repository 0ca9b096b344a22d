"""Image values at the projections of ground cells."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import as_strided

from zlocus.core.jit import kernel

# Cells at a time of a surface: what stands between its passes stays in the first level of the cache.
RUN = 512


# (3,) i8, (8,) f8, (2,p) f4, (p,) f4, (2,) f4, i8, i8, (n,) u4, (2,n) f4 -> None
@kernel
def pixel_positions(layout, grid, cells, relief, velocity, first, end, index, fraction):
    """Index of the upper left of the four pixels around each of a run of cells, and how far it is from there (x, y).

    See `resample_plane`; float32 positions are from a whole-pixel origin near the grid. Vectorises (int32 becomes
    float32 in vector lanes, int64 does not).
    """
    n_rows, n_cols = layout[1], layout[2]
    origin_x = min(max(int(grid[0]), 0), n_cols - 2)
    origin_y = min(max(int(grid[1]), 0), n_rows - 2)
    x_low, x_high = np.float32(-origin_x), np.float32(n_cols - 1.01 - origin_x)
    y_low, y_high = np.float32(-origin_y), np.float32(n_rows - 1.01 - origin_y)
    stride, origin = np.int32(n_cols), np.int32(origin_y * n_cols + origin_x)
    x0, y0 = np.float32(grid[0] - origin_x), np.float32(grid[1] - origin_y)
    x_col, y_col, x_row, y_row = np.float32(grid[2]), np.float32(grid[3]), np.float32(grid[4]), np.float32(grid[5])
    x_mixed, y_mixed = np.float32(grid[6]), np.float32(grid[7])
    vx, vy = velocity[0], velocity[1]
    rows, cols, steps, fx, fy = cells[0][first:end], cells[1][first:end], relief[first:end], fraction[0], fraction[1]
    for j in range(end - first):
        r, c, z = rows[j], cols[j], steps[j]
        x = min(max(x0 + c * (x_col + r * x_mixed) + r * x_row + z * vx, x_low), x_high)
        y = min(max(y0 + c * (y_col + r * y_mixed) + r * y_row + z * vy, y_low), y_high)
        left, top = np.floor(x), np.floor(y)
        fx[j] = x - left
        fy[j] = y - top
        index[j] = np.uint32(np.int32(np.int32(top) * stride) + np.int32(left) + origin)


# (p,) f4, (3,) i8, (n,) u4, (2,n) f4, (2,n) c8, (n,) f4 -> None
@kernel
def gather(pixels, layout, index, fraction, pairs, out):
    """Bilinear values between the four pixels from each index on.

    pairs : (2, n) complex64, scratch: a pixel as real part, the one right of it as imaginary part, so that one load
    reads both. Loads from an index are scalar code; once they are apart, the interpolation vectorises.
    """
    image = pixels[layout[0] : layout[0] + layout[1] * layout[2]]
    beside = as_strided(image[: image.shape[0] // 2 * 2].view(np.complex64), (image.shape[0] - 1,), (4,))
    below, upper, lower = np.uint64(layout[2]), pairs[0], pairs[1]
    for j in range(out.shape[0]):
        p = np.uint64(index[j])
        upper[j] = beside[p]
        lower[j] = beside[p + below]
    fx, fy = fraction[0], fraction[1]
    for j in range(out.shape[0]):
        top = upper[j].real + fx[j] * (upper[j].imag - upper[j].real)
        low = lower[j].real + fx[j] * (lower[j].imag - lower[j].real)
        out[j] = top + fy[j] * (low - top)


# (p,) f4, (3,) i8, (8,) f8, (2,c) f4, (c,) f4, (2,) f4, (n,) u4, (2,n) f4, (2,n) c8, (c,) f4 -> None
@kernel
def resample_plane(pixels, layout, grid, cells, relief, velocity, index, fraction, pairs, out):
    """Bilinear image values at positions that are bilinear in row and column of the ground grid, moved by its relief.

    pixels : (p,) float32, all images one after the other; layout : (3,) int64, offset, rows and columns of this image
    in `pixels`; grid : (8,) float64, px: (x, y) at the first cell, step per column, step per row, mixed step per row
    and column; cells : (2, c) float32, rows and columns from the first cell; relief : (c,) float32 steps above those
    positions' heights; velocity : (2,) float32, px per step (x, y); index : (n,) uint32, fraction : (2, n) float32 and
    pairs : (2, n) complex64, scratch for n cells at a time; out : (c,) float32 or longer, written.
    Positions outside the image are clamped to its border (the caller masks them).
    """
    run = index.shape[0]
    for first in range(0, relief.shape[0], run):
        end = min(first + run, relief.shape[0])
        pixel_positions(layout, grid, cells, relief, velocity, first, end, index, fraction)
        gather(pixels, layout, index, fraction, pairs, out[first:end])
