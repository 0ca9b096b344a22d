"""Image values at the projections of ground cells."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel


# (p,) f4, (3,) i8, (8,) f8, (c,) u4, (2,c) f4, (r,c) f4 -> None
@kernel
def resample_plane(pixels, layout, grid, index, fraction, out):
    """Bilinear image values at positions that are bilinear in row and column of the ground grid.

    pixels : (p,) float32, all images one after the other; layout : (3,) int64, offset, rows and columns of this image
    in `pixels`; grid : (8,) float64, px: (x, y) at the first cell, step per column, step per row, mixed step per row
    and column; index : (c,) uint32 and fraction : (2, c) float32, scratch; out : (r, c) float32, written.
    Positions outside the image are clamped to its border (the caller masks them). Two passes per row, positions and
    gathers, so that the first vectorises (int32 becomes float32 in vector lanes, int64 does not); positions are float32
    from a whole-pixel origin near the grid.
    """
    base, n_rows, n_cols = layout[0], layout[1], layout[2]
    origin_x = min(max(int(grid[0]), 0), n_cols - 2)
    origin_y = min(max(int(grid[1]), 0), n_rows - 2)
    x_low, x_high = np.float32(-origin_x), np.float32(n_cols - 1.01 - origin_x)
    y_low, y_high = np.float32(-origin_y), np.float32(n_rows - 1.01 - origin_y)
    stride = np.int32(n_cols)
    right, below, diagonal = np.uint32(1), np.uint32(n_cols), np.uint32(n_cols + 1)
    origin = np.int32(origin_y * n_cols + origin_x)
    image = pixels[base : base + n_rows * n_cols]
    for r in range(out.shape[0]):
        x0 = np.float32(grid[0] + r * grid[4] - origin_x)
        y0 = np.float32(grid[1] + r * grid[5] - origin_y)
        dx = np.float32(grid[2] + r * grid[6])
        dy = np.float32(grid[3] + r * grid[7])
        for c in range(out.shape[1]):
            x = min(max(x0 + np.float32(np.int32(c)) * dx, x_low), x_high)
            y = min(max(y0 + np.float32(np.int32(c)) * dy, y_low), y_high)
            col = np.int32(np.floor(x))
            row = np.int32(np.floor(y))
            fraction[0, c] = x - np.float32(col)
            fraction[1, c] = y - np.float32(row)
            index[c] = np.uint32(np.int32(row * stride) + col + origin)
        for c in range(out.shape[1]):
            p = index[c]
            fx = fraction[0, c]
            top = image[p] + fx * (image[p + right] - image[p])
            low = image[p + below] + fx * (image[p + diagonal] - image[p + below])
            out[r, c] = top + fraction[1, c] * (low - top)
