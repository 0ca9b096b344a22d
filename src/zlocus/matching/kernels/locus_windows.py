"""Windows of single cells along their vertical lines: match curves are made of them."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.cost_volume import views_of_block
from zlocus.matching.kernels.ncc import MAX_VARIANCE_SHARE_WITHOUT_TEXTURE, TINY
from zlocus.matching.kernels.resample import block_grid, block_velocity, coordinate, image_of


# ViewImage, BlockGrid, PixelVelocity, f8, f8, i8, (k,) f4, (k,) f4 -> b1
@kernel
def sample_window(image, grid, velocity, row, col, half, relief, out):
    """Write the bilinear values of one view in the window around a cell; False where the window leaves the image.

    grid : positions of the cells of a block at the height of the window's middle; velocity : px per step; row, col :
    the cell, from the first of the block; half : half width of the window; relief : (k,) float32, steps of the window's
    cells above its middle; out : (k,) float32.
    """
    pixels, n_rows, n_cols, gx, gy = image.pixels, image.n_rows, image.n_cols, grid.x, grid.y
    right, below, diagonal = np.uint64(1), np.uint64(n_cols), np.uint64(n_cols + 1)
    at = 0
    for i in range(-half, half + 1):
        r = row + i
        x0, y0 = gx.origin + r * (gx.by_row + r * gx.bend_row), gy.origin + r * (gy.by_row + r * gy.bend_row)
        dx, dy = gx.by_col + r * gx.mixed, gy.by_col + r * gy.mixed
        for j in range(-half, half + 1):
            c = col + j
            x = x0 + c * (dx + c * gx.bend_col) + relief[at] * velocity.x
            y = y0 + c * (dy + c * gy.bend_col) + relief[at] * velocity.y
            if not (0.0 <= x < n_cols - 1 and 0.0 <= y < n_rows - 1):
                return False
            left, top = int(x), int(y)
            fx, fy = np.float32(x - left), np.float32(y - top)
            p = np.uint64(top * n_cols + left)
            high = pixels[p] + fx * (pixels[p + right] - pixels[p])
            low = pixels[p + below] + fx * (pixels[p + diagonal] - pixels[p + below])
            out[at] = high + fy * (low - high)
            at += 1
    return True


# (k,) f4 -> None
@kernel
def normalise(window):
    """Subtract the mean from a window and divide it by its norm; all zero where it has no texture."""
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
    is_plain = spread <= MAX_VARIANCE_SHARE_WITHOUT_TEXTURE * square
    scale = np.float32(0.0) if is_plain else np.float32(1.0) / np.sqrt(spread + TINY)
    for k in range(n):
        window[k] *= scale


# ViewArrays, (p,) b1, i8, (n,2) i8, (n,) f8, i8, (n,k) f4, (n,h,k) f4 -> None
@kernel
def line_windows(views, blocked, view, cells, first, half, relief, out):
    """Write the normalised windows of one view around cells, at every height of their vertical lines.

    blocked : (p,) bool, pixels that the middle of a window may not be on; cells : (n, 2) int64, row and column; first :
    (n,) float64, lowest height index of each cell (fractions too); half, relief : see `sample_window`, relief (n, k);
    out : (n, h, k) float32, at the indices first, first + 1, ...; NaN where the view does not show the whole window.
    The product of two views' windows is their NCC.
    """
    middle, block, heights, image = out.shape[2] // 2, views.block, views.heights, image_of(views, view)
    offset = views.layout[view, 0]
    for n in range(out.shape[0]):
        b, d = cells[n, 0] // block, cells[n, 1] // block
        row, col = float(cells[n, 0] - b * block), float(cells[n, 1] - d * block)
        of_block = views_of_block(views, b, d)
        for k in range(out.shape[1]):
            t = heights[0] + (first[n] + k) * heights[1]
            grid, velocity = block_grid(of_block, view, t, 0), block_velocity(of_block, view, t)
            window = out[n, k]
            is_shown = sample_window(image, grid, velocity, row, col, half, relief[n], window)
            if is_shown:
                x = coordinate(grid.x, row, col) + relief[n, middle] * velocity.x
                y = coordinate(grid.y, row, col) + relief[n, middle] * velocity.y
                is_shown = not blocked[offset + int(y + 0.5) * image.n_cols + int(x + 0.5)]
            if is_shown:
                normalise(window)
            else:
                window[:] = np.nan
