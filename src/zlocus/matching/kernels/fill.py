"""Interpolation of the gaps of a surface."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

DIRECTIONS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))


# (r,c) f4, (r,c) b1, i8, (r,c) f4 -> None
@kernel
def interpolate_gaps(surface, is_excluded, max_distance, out):
    """Fill gaps with the mean of the nearest heights in eight directions, weighted by the inverse of their distance.

    surface : (r, c) float32, NaN in gaps; is_excluded : (r, c) bool, cells that stay as they are; max_distance : cells;
    out : (r, c) float32, written; a gap without a height within that distance stays NaN.
    """
    n_rows, n_cols = surface.shape
    for r in range(n_rows):
        for c in range(n_cols):
            out[r, c] = surface[r, c]
            if is_excluded[r, c] or not np.isnan(surface[r, c]):
                continue
            total, weight = 0.0, 0.0
            for by_row, by_col in DIRECTIONS:
                for step in range(1, max_distance + 1):
                    row, col = r + by_row * step, c + by_col * step
                    if row < 0 or row >= n_rows or col < 0 or col >= n_cols:
                        break
                    if not np.isnan(surface[row, col]):
                        w = 1.0 / (step * np.sqrt(float(by_row * by_row + by_col * by_col)))
                        total += w * surface[row, col]
                        weight += w
                        break
            if weight > 0.0:
                out[r, c] = np.float32(total / weight)
