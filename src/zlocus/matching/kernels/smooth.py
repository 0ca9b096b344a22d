"""Smoothing of a surface that preserves jumps and slopes."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# Binomial weights of five taps, as the a-trous scheme uses them.
TAPS = (1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0)


# f4, f4 -> f4
@kernel
def smaller_slope(before, after):
    """The smaller of two slopes of equal sign, else 0 (minmod): a jump on one side only is not a slope."""
    if before * after <= 0.0:
        return np.float32(0.0)
    return before if abs(before) < abs(after) else after


# (n,) f4, (n,) f4, (n,) f4, f4, (n,) f4 -> None
@kernel
def slopes_between(before, here, after, inverse, out):
    """Write the slopes of cells from cells at an equal distance on both sides; inverse : of that distance, per cell."""
    for j in range(here.shape[0]):
        out[j] = smaller_slope(here[j] - before[j], after[j] - here[j]) * inverse


# (r,c) f4, i8, (r,c) f4, (r,c) f4 -> None
@kernel
def slopes(surface, distance, by_row, by_col):
    """Write the slopes per cell along rows and columns, over `distance` cells to both sides.

    They are 0 beside jumps. At the edges of the surface they are those of the nearest cell with enough cells on both
    sides.
    """
    n_rows, n_cols = surface.shape
    by_row[:] = 0.0
    by_col[:] = 0.0
    inverse = np.float32(1.0 / distance)
    for r in range(n_rows):
        here = surface[r]
        if distance <= r < n_rows - distance:
            slopes_between(surface[r - distance], here, surface[r + distance], inverse, by_row[r])
        if n_cols > 2 * distance:
            n = n_cols - distance
            slopes_between(here[: n - distance], here[distance:n], here[2 * distance :], inverse, by_col[r, distance:n])
    if n_rows > 2 * distance:
        for r in range(distance):
            by_row[r], by_row[n_rows - 1 - r] = by_row[distance], by_row[n_rows - 1 - distance]
    if n_cols > 2 * distance:
        for r in range(n_rows):
            by_col[r, :distance], by_col[r, n_cols - distance :] = by_col[r, distance], by_col[r, n_cols - 1 - distance]


# (c,) f4, (c,) f4, (c,) f4, (c,) f4, (3,) f4, f4, (c,) f4, (c,) f4 -> None
@kernel
def add_tap(centre, other, by_row, by_col, tap, inverse, total, weight):
    """Add one neighbour of every cell of a row, minus the slope to it, with the weight (1 - (dz / jump)^2)^2; 0 beyond.

    tap : weight of the tap and its distance in rows and in columns.
    """
    near, rows, cols = tap[0], tap[1], tap[2]
    for c in range(centre.shape[0]):
        step = other[c] - centre[c] - rows * by_row[c] - cols * by_col[c]
        away = step * inverse
        kept = max(np.float32(1.0) - away * away, np.float32(0.0))
        w = near * kept * kept
        total[c] += w * step
        weight[c] += w


# (r,c) f4, (r,c) f4, (r,c) f4, i8, f4, (r,c) f4 -> None
@kernel
def smooth_surface(surface, by_row, by_col, spacing, jump, out):
    """Write the weighted mean over 5 x 5 cells `spacing` apart, around the plane of each cell and not across jumps.

    surface : (r, c) float32, any unit of height; by_row, by_col : (r, c), its slopes per cell; jump : distance from
    the plane beyond which a cell has no weight; out : (r, c), written. Passes with growing spacings smooth widely with
    few taps. Source: Tomasi and Manduchi (1998), with Tukey's weight in height and the taps of Starck et
    al. (2007).
    """
    n_rows, n_cols = surface.shape
    inverse = np.float32(1.0) / jump
    total, weight, tap = np.empty(n_cols, np.float32), np.empty(n_cols, np.float32), np.empty(3, np.float32)
    for r in range(n_rows):
        total[:] = 0.0
        weight[:] = 0.0
        for i in range(5):
            row = r + (i - 2) * spacing
            if row < 0 or row >= n_rows:
                continue
            for j in range(5):
                shift = (j - 2) * spacing
                c0, c1 = max(-shift, 0), min(n_cols - shift, n_cols)
                tap[0], tap[1], tap[2] = TAPS[i] * TAPS[j], (i - 2) * spacing, shift
                if c1 > c0:
                    add_tap(
                        surface[r, c0:c1], surface[row, c0 + shift : c1 + shift], by_row[r, c0:c1], by_col[r, c0:c1],
                        tap, inverse, total[c0:c1], weight[c0:c1],
                    )  # fmt: skip
        for c in range(n_cols):
            out[r, c] = surface[r, c] + total[c] / weight[c]
