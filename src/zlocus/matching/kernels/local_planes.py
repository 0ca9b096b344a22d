"""Planes fitted to the heights in the windows around every cell, and the mean of the planes that hold a cell.

All sums over windows go on from one row, or column, to the next: what comes in is added, what goes out is taken away. A
window of any size costs the same.
"""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# A plane is kept where the mean squared difference of the heights from it, in units of their variances, is below this
# (below 1 on a plane, because heights of neighbouring cells err alike), and where at least this share of the cells
# of its window has heights.
MAX_MISFIT, MIN_KNOWN_SHARE = 0.8, 0.7
# Where no cell of a window has a height, its weights are this, so that nothing is divided by zero.
MIN_TOTAL_WEIGHT = 1e-9
# Windows whose cells lie nearly on a line have no less than this determinant; they have too few cells to be kept.
MIN_DETERMINANT = 1e-6
# Sums of weights that are all zero may differ from it by rounding.
MIN_WEIGHT_OF_PLANES = 0.25
# Weighted sums of the cells of a column: of 1, row, row^2, height, row height, height^2, and the number of cells.
N_COLUMN_SUMS = 7
# The same of a window, and the weighted sums of column, row column, column^2 and column height.
N_WINDOW_SUMS = 11
# What is summed of the planes: weight, and weight times constant, rise by row and rise by column.
N_PLANE_SUMS = 4


# (c,) f4, (c,) f8, f8, f8, f8, (k,c) f8 -> None
@kernel
def add_row_of_heights(height, weight, origin, row, sign, columns):
    """Add a row of cells to the sums of the columns, or take it away (sign -1). columns : from the first cell on."""
    for c in range(height.shape[0]):
        z = np.float64(height[c]) - origin if weight[c] > 0.0 else 0.0
        w = sign * weight[c]
        columns[0, c] += w
        columns[1, c] += w * row
        columns[2, c] += w * row * row
        columns[3, c] += w * z
        columns[4, c] += w * row * z
        columns[5, c] += w * z * z
        columns[6, c] += sign if weight[c] > 0.0 else 0.0


# (k,c) f8, i8, (k,c) f8 -> None
@kernel
def window_sums(columns, side, windows):
    """Write the sums of the windows around the cells of a row. columns : with side // 2 + 1 zeros before the first
    cell, and side // 2 behind the last; see N_WINDOW_SUMS."""
    half, before = side // 2, side // 2 + 1
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(before, columns.shape[1]):
        i = max(j - side, 0)
        come, go = np.float64(j - before), np.float64(j - before - side)
        s0 += columns[0, j] - columns[0, i]
        s1 += columns[1, j] - columns[1, i]
        s2 += columns[2, j] - columns[2, i]
        s3 += columns[3, j] - columns[3, i]
        s4 += columns[4, j] - columns[4, i]
        s5 += columns[5, j] - columns[5, i]
        s6 += columns[6, j] - columns[6, i]
        s7 += come * columns[0, j] - go * columns[0, i]
        s8 += come * columns[1, j] - go * columns[1, i]
        s9 += come * come * columns[0, j] - go * go * columns[0, i]
        s10 += come * columns[3, j] - go * columns[3, i]
        c = j - before - half
        if c >= 0:
            windows[0, c], windows[1, c], windows[2, c], windows[3, c] = s0, s1, s2, s3
            windows[4, c], windows[5, c], windows[6, c], windows[7, c] = s4, s5, s6, s7
            windows[8, c], windows[9, c], windows[10, c] = s8, s9, s10


# (k,c) f8, f8, i8, (k,c) f8 -> None
@kernel
def planes_of_sums(windows, origin, side, planes):
    """Write the weight of the planes of a row of windows, and the weighted planes, see N_PLANE_SUMS; 0 where a plane is
    not kept. Planes that fit well count more."""
    least_known = MIN_KNOWN_SHARE * side * side
    for c in range(planes.shape[1]):
        total = max(windows[0, c], MIN_TOTAL_WEIGHT)
        share, known = 1.0 / total, windows[6, c]
        mean_row, mean_col, mean_z = windows[1, c] * share, windows[7, c] * share, windows[3, c] * share
        row_row, col_col = windows[2, c] * share - mean_row * mean_row, windows[9, c] * share - mean_col * mean_col
        row_col = windows[8, c] * share - mean_row * mean_col
        row_z, col_z = windows[4, c] * share - mean_row * mean_z, windows[10, c] * share - mean_col * mean_z
        z_z = windows[5, c] * share - mean_z * mean_z
        of_determinant = 1.0 / max(row_row * col_col - row_col * row_col, MIN_DETERMINANT)
        by_row = (row_z * col_col - col_z * row_col) * of_determinant
        by_col = (col_z * row_row - row_z * row_col) * of_determinant
        misfit = max(z_z - by_row * row_z - by_col * col_z, 0.0) * total / max(known, 1.0)
        is_kept = misfit < MAX_MISFIT and known >= least_known
        # Sums go on from window to window, so that a plane of any size that is not kept must be left out of them.
        planes[0, c] = 1.0 / (1.0 + misfit) if is_kept else 0.0
        planes[1, c] = planes[0, c] * (origin + mean_z - by_row * mean_row - by_col * mean_col) if is_kept else 0.0
        planes[2, c] = planes[0, c] * by_row if is_kept else 0.0
        planes[3, c] = planes[0, c] * by_col if is_kept else 0.0


# (k,c) f8, f8, (k,c) f8 -> None
@kernel
def add_row_of_planes(planes, sign, columns):
    """Add a row of weighted planes to the sums of the columns, or take it away (sign -1)."""
    for k in range(N_PLANE_SUMS):
        for c in range(planes.shape[1]):
            columns[k, c] += sign * planes[k, c]


# (k,c) f8, i8, f8, (c,) f4 -> None
@kernel
def heights_of_planes(columns, side, row, found):
    """Write the mean height of the planes that hold each cell of a row, NaN without one; columns : as for
    `window_sums`."""
    half, before = side // 2, side // 2 + 1
    weight, constant, by_row, by_col = 0.0, 0.0, 0.0, 0.0
    for j in range(before, columns.shape[1]):
        i = max(j - side, 0)
        weight += columns[0, j] - columns[0, i]
        constant += columns[1, j] - columns[1, i]
        by_row += columns[2, j] - columns[2, i]
        by_col += columns[3, j] - columns[3, i]
        c = j - before - half
        if c >= 0:
            height = (constant + by_row * row + by_col * np.float64(c)) / max(weight, MIN_WEIGHT_OF_PLANES)
            found[c] = np.float32(height) if weight > MIN_WEIGHT_OF_PLANES else np.float32(np.nan)


# (r,c) f4, (r,c) f8, f8, i8, (k,r,c) f8, (r,c) f4 -> None
@kernel
def mean_heights_of_planes(height, weight, origin, side, planes, found):
    """Write the mean height of the planes of all windows that hold a cell and whose plane is kept, NaN without one.

    height : (r, c); weight : (r, c), 1 / variance of each height, 0 where it is not known; origin : a height near those
    that are known; side : of the windows, cells, odd; planes : (4, r, c), scratch; found : (r, c). Source: He, Sun,
    Tang (2013), section 3, the mean of the linear models of all windows that hold a cell.
    """
    n_rows, n_cols = height.shape
    half, before = side // 2, side // 2 + 1
    columns = np.zeros((N_COLUMN_SUMS, n_cols + side), np.float64)
    windows = np.empty((N_WINDOW_SUMS, n_cols), np.float64)
    inner = columns[:, before : before + n_cols]
    for r in range(-half, n_rows):
        come, go = r + half, r - half - 1
        if come < n_rows:
            add_row_of_heights(height[come], weight[come], origin, np.float64(come), 1.0, inner)
        if go >= 0:
            add_row_of_heights(height[go], weight[go], origin, np.float64(go), -1.0, inner)
        if r >= 0:
            window_sums(columns, side, windows)
            planes_of_sums(windows, origin, side, planes[:, r])
    columns[:] = 0.0
    for r in range(-half, n_rows):
        come, go = r + half, r - half - 1
        if come < n_rows:
            add_row_of_planes(planes[:, come], 1.0, inner)
        if go >= 0:
            add_row_of_planes(planes[:, go], -1.0, inner)
        if r >= 0:
            heights_of_planes(columns[:N_PLANE_SUMS], side, np.float64(r), found[r])
