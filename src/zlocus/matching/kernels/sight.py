"""Which cells of a surface another part of it hides from a sensor, along rays whose direction changes from cell to
cell."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# A ray that moves by fewer cells than this per metre is vertical, and nothing hides its cell.
MIN_SPEED = 1e-6


# (s,t) f4, (2,) i8, (r,c,2) f4, f4, f4, f4, (r,c) b1 -> None
@kernel
def mark_hidden(surface, first, by_height, top, margin, stride, out):
    """Mark the cells whose ray to the sensor passes below the surface.

    surface : (s, t) float32 heights, m, NaN where there is none; first : row and column in it of the first cell of
    `out`; by_height : (r, c, 2) float32, columns and rows that the ray moves per metre that it rises; top : height
    above which nothing stands; margin : m by which the surface must stand above the ray; stride : cells of a step
    along a ray; out : (r, c) bool.

    Each ray is followed in steps, and the surface is interpolated between four cells. Where one of them has
    no height, nothing is known to stand there.
    """
    n_rows, n_cols = surface.shape
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] = False
            by_col, by_row = float(by_height[r, c, 0]), float(by_height[r, c, 1])
            speed = np.sqrt(by_col * by_col + by_row * by_row)
            row, col, height = float(first[0] + r), float(first[1] + c), float(surface[first[0] + r, first[1] + c])
            if not speed > MIN_SPEED or np.isnan(height):
                continue
            step_col, step_row, gain = stride * by_col / speed, stride * by_row / speed, stride / speed
            while True:
                col, row, height = col + step_col, row + step_row, height + gain
                if height > top or not (0.0 <= row < n_rows - 1 and 0.0 <= col < n_cols - 1):
                    break
                i, j = int(row), int(col)
                down, right = row - i, col - j
                upper = surface[i, j] * (1.0 - right) + surface[i, j + 1] * right
                lower = surface[i + 1, j] * (1.0 - right) + surface[i + 1, j + 1] * right
                if upper * (1.0 - down) + lower * down > height + margin:
                    out[r, c] = True
                    break
