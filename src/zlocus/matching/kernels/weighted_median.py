"""Weighted medians of heights in the window around a cell."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

RADIUS = 3
# Weights of heights decrease with the distance by a normal distribution of this standard deviation, cells.
SPREAD_CELLS = 2.0


# (n,) f4, (n,) f4, i8, f4 -> f4
@kernel
def weighted_median(values, weights, n, total):
    """The least of the first n values up to which half the weight lies; orders `values` and `weights` in place."""
    for i in range(1, n):
        value, weight, k = values[i], weights[i], i - 1
        while k >= 0 and values[k] > value:
            values[k + 1], weights[k + 1] = values[k], weights[k]
            k -= 1
        values[k + 1], weights[k + 1] = value, weight
    below = np.float32(0.0)
    for i in range(n):
        below += weights[i]
        if below >= np.float32(0.5) * total:
            return values[i]
    return values[n - 1]


# (r,c) f4, (r,c) f4, (r,c) f4, (r,c) b1, (r,c) b1, f4, (r,c) f4 -> None
@kernel
def medians_around(height, weight, grey, is_known, is_wanted, grey_spread, out):
    """Write the weighted median of the known heights around each cell that is wanted, and the height of all others.

    A height counts by its weight, by its distance, and by how little its grey value differs from that of the cell;
    where one of the two grey values is NaN, by the others alone.
    """
    rows, cols = height.shape
    near = np.empty((2 * RADIUS + 1, 2 * RADIUS + 1), np.float32)
    for i in range(2 * RADIUS + 1):
        for j in range(2 * RADIUS + 1):
            squared = (i - RADIUS) ** 2 + (j - RADIUS) ** 2
            near[i, j] = np.exp(-squared / (2.0 * SPREAD_CELLS**2))
    values = np.empty(near.size, np.float32)
    weights = np.empty(near.size, np.float32)
    for row in range(rows):
        for col in range(cols):
            out[row, col] = height[row, col]
            if not is_wanted[row, col]:
                continue
            n, total, own = 0, np.float32(0.0), grey[row, col]
            for r in range(max(row - RADIUS, 0), min(row + RADIUS + 1, rows)):
                for c in range(max(col - RADIUS, 0), min(col + RADIUS + 1, cols)):
                    if not is_known[r, c]:
                        continue
                    counts = weight[r, c] * near[r - row + RADIUS, c - col + RADIUS]
                    differs = abs(grey[r, c] - own)
                    if differs == differs:
                        counts *= np.exp(-differs / grey_spread)
                    values[n], weights[n] = height[r, c], counts
                    total += counts
                    n += 1
            if total > 0.0:
                out[row, col] = weighted_median(values, weights, n, total)
