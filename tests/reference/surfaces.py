"""Twins of `lowest_visible`, `block_coverage` and `smooth_surface`."""

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


def slope(surface, reach, axis):
    """The smaller of the slopes before and after each cell where they have one sign, else 0; at the border that of the
    nearest cell with so many cells on both sides, 0 where there is none."""
    out, n = np.zeros(surface.shape), surface.shape[axis]
    for at in np.ndindex(surface.shape):
        if n <= 2 * reach:
            continue
        step = np.array([reach if k == axis else 0 for k in (0, 1)])
        middle = np.array(at)
        middle[axis] = min(max(at[axis], reach), n - 1 - reach)
        before = surface[tuple(middle)] - surface[tuple(middle - step)]
        after = surface[tuple(middle + step)] - surface[tuple(middle)]
        if before * after > 0:
            out[at] = (before if abs(before) < abs(after) else after) / reach
    return out


def smoothed(surface, by_row, by_col, spacing, jump):
    """Binomial mean over 5 x 5 cells around each cell's own plane, with Tukey's weight in the distance from it."""
    out, taps = np.empty(surface.shape), np.array([1, 4, 6, 4, 1]) / 16
    for r, c in np.ndindex(surface.shape):
        total = weight = 0.0
        for i, j in np.ndindex(5, 5):
            dr, dc = (i - 2) * spacing, (j - 2) * spacing
            if 0 <= r + dr < surface.shape[0] and 0 <= c + dc < surface.shape[1]:
                away = surface[r + dr, c + dc] - surface[r, c] - dr * by_row[r, c] - dc * by_col[r, c]
                w = taps[i] * taps[j] * max(1 - (away / jump) ** 2, 0.0) ** 2
                total, weight = total + w * away, weight + w
        out[r, c] = surface[r, c] + total / weight
    return out
