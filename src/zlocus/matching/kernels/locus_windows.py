"""Windows of single cells along their vertical lines: what match curves are made of."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.cost_volume import plane_grid, plane_velocity
from zlocus.matching.kernels.ncc import EVEN, TINY


# (p,) f4, (3,) i8, (8,) f8, f8, f8, i8, (k,) f4, (2,) f4, (k,) f4 -> b1
@kernel
def sample_window(pixels, layout, grid, row, col, half, relief, velocity, out):
    """Bilinear values of one view in the window around a cell; False where the window leaves the image.

    grid : positions of a block at the middle's height, see `plane_grid`; row, col : the cell from the block's first;
    relief : (k,) float32, steps of the window's cells above its middle; velocity : (2,) float32, px per step; out :
    (k,) float32.
    """
    base, n_rows, n_cols = layout[0], layout[1], layout[2]
    image = pixels[base : base + n_rows * n_cols]
    right, below, diagonal = np.uint64(1), np.uint64(n_cols), np.uint64(n_cols + 1)
    at = 0
    for i in range(-half, half + 1):
        r = row + i
        x0, y0 = grid[0] + r * grid[4], grid[1] + r * grid[5]
        dx, dy = grid[2] + r * grid[6], grid[3] + r * grid[7]
        for j in range(-half, half + 1):
            x = x0 + (col + j) * dx + relief[at] * velocity[0]
            y = y0 + (col + j) * dy + relief[at] * velocity[1]
            if not (0.0 <= x < n_cols - 1 and 0.0 <= y < n_rows - 1):
                return False
            left, top = int(x), int(y)
            fx, fy = np.float32(x - left), np.float32(y - top)
            p = np.uint64(top * n_cols + left)
            high = image[p] + fx * (image[p + right] - image[p])
            low = image[p + below] + fx * (image[p + diagonal] - image[p + below])
            out[at] = high + fy * (low - high)
            at += 1
    return True


# (k,) f4 -> None
@kernel
def normalise(window):
    """Take the mean from a window and divide it by its norm; all zero where it is even (it agrees with none)."""
    n = window.shape[0]
    mean = np.float32(0.0)
    for k in range(n):
        mean += window[k]
    mean /= np.float32(n)
    spread, square = np.float32(0.0), np.float32(0.0)
    for k in range(n):
        square += window[k] * window[k]
        window[k] -= mean
        spread += window[k] * window[k]
    scale = np.float32(0.0) if spread <= EVEN * square else np.float32(1.0) / np.sqrt(spread + TINY)
    for k in range(n):
        window[k] *= scale


# (p,) f4, (p,) b1, (i,3) i8, (i,b,d,2,4) f8, (2,) f8, i8, i8, (n,2) i8, (n,) f8, i8, (n,k) f4, (n,h,k) f4 -> None
@kernel
def line_windows(pixels, blocked, layout, nodes, heights, block, view, cells, first, half, relief, out):
    """Normalised windows of one view around cells, at every height of their vertical lines.

    blocked : (p,) bool, pixels no window's middle may be on; cells : (n, 2) int64, row and column; first : (n,)
    float64, lowest height index of each cell (a fraction too); relief : (n, k) float32, see `sample_window`; out :
    (n, h, k) float32, written, at indices first, first + 1, ...: the product of two views' windows is their NCC. NaN
    where the view does not show the whole window.
    """
    grid, velocity = np.empty(8), np.empty(2, np.float32)
    middle = out.shape[2] // 2
    for n in range(out.shape[0]):
        b, d = cells[n, 0] // block, cells[n, 1] // block
        row, col = float(cells[n, 0] - b * block), float(cells[n, 1] - d * block)
        corners = nodes[:, b : b + 2, d : d + 2]
        for k in range(out.shape[1]):
            t = heights[0] + (first[n] + k) * heights[1]
            plane_grid(corners, view, t, block, 0, grid)
            plane_velocity(corners, view, t, heights[1], velocity)
            window = out[n, k]
            shown = sample_window(pixels, layout[view], grid, row, col, half, relief[n], velocity, window)
            if shown:
                x = grid[0] + row * grid[4] + col * (grid[2] + row * grid[6]) + relief[n, middle] * velocity[0]
                y = grid[1] + row * grid[5] + col * (grid[3] + row * grid[7]) + relief[n, middle] * velocity[1]
                shown = not blocked[layout[view, 0] + int(y + 0.5) * layout[view, 2] + int(x + 0.5)]
            if shown:
                normalise(window)
            else:
                window[:] = np.nan
