"""Twins of `lowest_visible`, `block_reach` and `smooth_surface`."""

from __future__ import annotations

import numpy as np


def marched(surface, by_col, by_row):
    """Lowest visible height of every cell: rays marched a cell at a time along the longer component of the direction.

    The surface is interpolated between the two cells that the ray passes between; -1e30 where nothing is in the way.
    """
    rows, cols = surface.shape
    longest = max(abs(by_col), abs(by_row))
    out = np.full(surface.shape, -1e30)
    for r, c in np.ndindex(surface.shape):
        for n in range(1, max(rows, cols)):
            y, x = r + n * by_row / longest, c + n * by_col / longest
            if not (0 <= y <= rows - 1 and 0 <= x <= cols - 1):
                break
            out[r, c] = max(out[r, c], between(surface, y, x) - n / longest)
    return out


def between(surface, y, x):
    """Linear interpolation where one of y and x is whole (within rounding)."""
    r0, c0 = int(np.floor(y + 1e-9)), int(np.floor(x + 1e-9))
    r1, c1 = min(r0 + 1, surface.shape[0] - 1), min(c0 + 1, surface.shape[1] - 1)
    fy, fx = max(y - r0, 0.0), max(x - c0, 0.0)
    top = (1 - fx) * surface[r0, c0] + fx * surface[r0, c1]
    low = (1 - fx) * surface[r1, c0] + fx * surface[r1, c1]
    return (1 - fy) * top + fy * low


def longest_run(is_good):
    """First and last index of the first longest run of True in (h,); None where there is none."""
    best, start = None, None
    for k, good in enumerate([*is_good, False]):
        if good and start is None:
            start = k
        if not good and start is not None:
            if best is None or k - start > best[1] - best[0] + 1:
                best = (start, k - 1)
            start = None
    return best


def smoothed(surface, radius, spread, jump):
    """Weighted mean over a square of cells, Gauss in distance and Tukey in height."""
    out = np.empty(surface.shape)
    rows, cols = surface.shape
    for r, c in np.ndindex(surface.shape):
        total = weight = 0.0
        for i in range(max(r - radius, 0), min(r + radius + 1, rows)):
            for j in range(max(c - radius, 0), min(c + radius + 1, cols)):
                away = (surface[i, j] - surface[r, c]) / jump
                w = max(1 - away**2, 0.0) ** 2 * np.exp(-((i - r) ** 2 + (j - c) ** 2) / (2 * spread**2))
                total, weight = total + w * surface[i, j], weight + w
        out[r, c] = total / weight
    return out
