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
# Weighted sums over the cells of a window, by what is summed; those before COL are sums over a column of cells, too.
WEIGHT, ROW, ROW_ROW, HEIGHT, ROW_HEIGHT, HEIGHT_HEIGHT, N_KNOWN, COL, ROW_COL, COL_COL, COL_HEIGHT = range(11)
N_COLUMN_SUMS, N_WINDOW_SUMS = COL, COL_HEIGHT + 1
# What is summed of the planes: their weight, and by weight the constant, the rise by row and the rise by column.
OF_WEIGHT, OF_CONSTANT, OF_ROW, OF_COL = range(4)
N_PLANE_SUMS = OF_COL + 1


# (c,) f4, (c,) f8, f8, f8, f8, (k,c) f8 -> None
@kernel
def add_row_of_heights(height, weight, origin, row, sign, columns):
    """Add a row of cells to the sums of the columns, or take it away (sign -1). columns : from the first cell on."""
    for c in range(height.shape[0]):
        z = np.float64(height[c]) - origin if weight[c] > 0.0 else 0.0
        w = sign * weight[c]
        columns[WEIGHT, c] += w
        columns[ROW, c] += w * row
        columns[ROW_ROW, c] += w * row * row
        columns[HEIGHT, c] += w * z
        columns[ROW_HEIGHT, c] += w * row * z
        columns[HEIGHT_HEIGHT, c] += w * z * z
        columns[N_KNOWN, c] += sign if weight[c] > 0.0 else 0.0


# (k,c) f8, i8, (k,c) f8 -> None
@kernel
def window_sums(columns, side, windows):
    """Write the sums of the windows around the cells of a row. columns : with side // 2 + 1 zeros before the first
    cell, and side // 2 behind the last; see WEIGHT."""
    half, before = side // 2, side // 2 + 1
    weight, row, row_row, z, row_z, z_z, known = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    col, row_col, col_col, col_z = 0.0, 0.0, 0.0, 0.0
    for j in range(before, columns.shape[1]):
        i = max(j - side, 0)
        entering, leaving = np.float64(j - before), np.float64(j - before - side)
        weight += columns[WEIGHT, j] - columns[WEIGHT, i]
        row += columns[ROW, j] - columns[ROW, i]
        row_row += columns[ROW_ROW, j] - columns[ROW_ROW, i]
        z += columns[HEIGHT, j] - columns[HEIGHT, i]
        row_z += columns[ROW_HEIGHT, j] - columns[ROW_HEIGHT, i]
        z_z += columns[HEIGHT_HEIGHT, j] - columns[HEIGHT_HEIGHT, i]
        known += columns[N_KNOWN, j] - columns[N_KNOWN, i]
        col += entering * columns[WEIGHT, j] - leaving * columns[WEIGHT, i]
        row_col += entering * columns[ROW, j] - leaving * columns[ROW, i]
        col_col += entering * entering * columns[WEIGHT, j] - leaving * leaving * columns[WEIGHT, i]
        col_z += entering * columns[HEIGHT, j] - leaving * columns[HEIGHT, i]
        c = j - before - half
        if c >= 0:
            windows[WEIGHT, c], windows[ROW, c], windows[ROW_ROW, c], windows[HEIGHT, c] = weight, row, row_row, z
            windows[ROW_HEIGHT, c], windows[HEIGHT_HEIGHT, c], windows[N_KNOWN, c] = row_z, z_z, known
            windows[COL, c], windows[ROW_COL, c], windows[COL_COL, c], windows[COL_HEIGHT, c] = (
                col, row_col, col_col, col_z,
            )  # fmt: skip


# (k,c) f8, f8, i8, (k,c) f8 -> None
@kernel
def planes_of_sums(windows, origin, side, planes):
    """Write the weight of the planes of a row of windows, and the weighted planes, see OF_WEIGHT; 0 where a plane is
    not kept. Planes that fit well count more."""
    least_known = MIN_KNOWN_SHARE * side * side
    for c in range(planes.shape[1]):
        total = max(windows[WEIGHT, c], MIN_TOTAL_WEIGHT)
        share, known = 1.0 / total, windows[N_KNOWN, c]
        mean_row, mean_col, mean_z = windows[ROW, c] * share, windows[COL, c] * share, windows[HEIGHT, c] * share
        row_row = windows[ROW_ROW, c] * share - mean_row * mean_row
        col_col = windows[COL_COL, c] * share - mean_col * mean_col
        row_col = windows[ROW_COL, c] * share - mean_row * mean_col
        row_z = windows[ROW_HEIGHT, c] * share - mean_row * mean_z
        col_z = windows[COL_HEIGHT, c] * share - mean_col * mean_z
        z_z = windows[HEIGHT_HEIGHT, c] * share - mean_z * mean_z
        of_determinant = 1.0 / max(row_row * col_col - row_col * row_col, MIN_DETERMINANT)
        by_row = (row_z * col_col - col_z * row_col) * of_determinant
        by_col = (col_z * row_row - row_z * row_col) * of_determinant
        misfit = max(z_z - by_row * row_z - by_col * col_z, 0.0) * total / max(known, 1.0)
        is_kept = misfit < MAX_MISFIT and known >= least_known
        # Sums go on from window to window, so that a plane of any size that is not kept must be left out of them.
        weight = 1.0 / (1.0 + misfit)
        constant = origin + mean_z - by_row * mean_row - by_col * mean_col
        planes[OF_WEIGHT, c] = weight if is_kept else 0.0
        planes[OF_CONSTANT, c] = weight * constant if is_kept else 0.0
        planes[OF_ROW, c] = weight * by_row if is_kept else 0.0
        planes[OF_COL, c] = weight * by_col if is_kept else 0.0


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
        weight += columns[OF_WEIGHT, j] - columns[OF_WEIGHT, i]
        constant += columns[OF_CONSTANT, j] - columns[OF_CONSTANT, i]
        by_row += columns[OF_ROW, j] - columns[OF_ROW, i]
        by_col += columns[OF_COL, j] - columns[OF_COL, i]
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
        entering, leaving = r + half, r - half - 1
        if entering < n_rows:
            add_row_of_heights(height[entering], weight[entering], origin, np.float64(entering), 1.0, inner)
        if leaving >= 0:
            add_row_of_heights(height[leaving], weight[leaving], origin, np.float64(leaving), -1.0, inner)
        if r >= 0:
            window_sums(columns, side, windows)
            planes_of_sums(windows, origin, side, planes[:, r])
    columns[:] = 0.0
    for r in range(-half, n_rows):
        entering, leaving = r + half, r - half - 1
        if entering < n_rows:
            add_row_of_planes(planes[:, entering], 1.0, inner)
        if leaving >= 0:
            add_row_of_planes(planes[:, leaving], -1.0, inner)
        if r >= 0:
            heights_of_planes(columns[:N_PLANE_SUMS], side, np.float64(r), found[r])
