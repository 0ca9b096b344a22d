"""How well many views agree: the sum of NCC over all their pairs.

The moments of a window are computed once per view, so that a pair costs one box sum of products. (The square of the
sum of normalised windows gives the same figure without forming pairs, but costs more up to six views and beyond.)

Planes are flat: a block of rows x cols cells with a border of `half` cells each side is stored row after row with the
stride `width` = cols + 2 half, and a result for cell (r, c) stands at r width + c (what stands in the last 2 half
columns is meaningless). Long loops over one index vectorise; loops over the rows of a small block do not pay.
Windows are given by their half widths, ascending: sums down the columns of one go on from those of the one before it.
"""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel

TINY = np.float32(1e-9)
# A window is even when its variance is this share of its mean square: below it, float32 sums leave nothing but rounding
# (up to 8e-7 of it for exactly equal values).
EVEN = np.float32(2e-6)
# Floats beyond a flat plane: n may then be whole rows, sums read on beyond the last cell.
SLACK = 32


# (p,) f4, i8, i8, (p,) f4 -> None
@kernel
def row_sums(a, half, n, out):
    """Horizontal sums over 2 half + 1 values, at the first n places."""
    if half == 1:
        for j in range(n):
            out[j] = a[j] + a[j + 1] + a[j + 2]
    elif half == 2:
        for j in range(n):
            out[j] = a[j] + a[j + 1] + a[j + 2] + a[j + 3] + a[j + 4]
    elif half == 3:
        for j in range(n):
            out[j] = a[j] + a[j + 1] + a[j + 2] + a[j + 3] + a[j + 4] + a[j + 5] + a[j + 6]
    elif half == 4:
        for j in range(n):
            first = a[j] + a[j + 1] + a[j + 2] + a[j + 3] + a[j + 4]
            out[j] = first + a[j + 5] + a[j + 6] + a[j + 7] + a[j + 8]
    else:
        for j in range(n):
            out[j] = a[j]
        for k in range(1, 2 * half + 1):
            x = a[k : k + n]
            for j in range(n):
                out[j] += x[j]


# (p,) f4, i8, i8, i8, i8, i8, (p,) f4, (p,) f4 -> None
@kernel
def column_moments(plane, half, done, window, width, n, sums, squares):
    """Vertical sums of values and squares over 2 window + 1 rows around row `half` below each of the first n places.

    done : `sums` and `squares` hold those over 2 done + 1 rows already; 0 if they hold nothing. A slice a row leaves no
    index to be checked.
    """
    if done == 0:
        a, b, c = plane[(half - 1) * width :], plane[half * width :], plane[(half + 1) * width :]
        for j in range(n):
            sums[j] = a[j] + b[j] + c[j]
            squares[j] = a[j] * a[j] + b[j] * b[j] + c[j] * c[j]
    for k in range(max(done, 1) + 1, window + 1):
        a, b = plane[(half - k) * width :], plane[(half + k) * width :]
        for j in range(n):
            sums[j] += a[j] + b[j]
            squares[j] += a[j] * a[j] + b[j] * b[j]


# (p,) f4, (p,) f4, i8, i8, i8, i8, i8, (p,) f4 -> None
@kernel
def column_products(x, y, half, done, window, width, n, sums):
    """As `column_moments`, of the products of two planes."""
    if done == 0:
        a, b, c = x[(half - 1) * width :], x[half * width :], x[(half + 1) * width :]
        d, e, f = y[(half - 1) * width :], y[half * width :], y[(half + 1) * width :]
        for j in range(n):
            sums[j] = a[j] * d[j] + b[j] * e[j] + c[j] * f[j]
    for k in range(max(done, 1) + 1, window + 1):
        a, b = x[(half - k) * width :], x[(half + k) * width :]
        d, e = y[(half - k) * width :], y[(half + k) * width :]
        for j in range(n):
            sums[j] += a[j] * d[j] + b[j] * e[j]


# (p,) f4, (w,) i8, i8, i8, f4, (4,p) f4, (w,p) f4, (w,p) f4 -> None
@kernel
def window_moments(plane, windows, width, n, floor, work, mean, scale):
    """Scaled mean and 1 / norm of the windows around every cell of a flat plane, at the first n places.

    plane : (p,) float32 and SLACK more, centred near zero so that float32 sums are exact enough; windows : (w,) half
    widths, ascending, the last that of the plane's border; floor : variance added, grey values squared; mean : (w, p),
    times sqrt(m), m = (2 window + 1)^2; scale : (w, p), 1 / sqrt(sum (x - mean)^2 + m floor), and 0 where the window is
    even (it agrees with none); work : (4, p), scratch.
    """
    half, done = windows[-1], 0
    sums, squares, total, square = work[0], work[1], work[2], work[3]
    for w in range(windows.shape[0]):
        window = windows[w]
        side = np.float32(2 * window + 1)
        inverse, added = np.float32(1.0) / side, side * side * floor + TINY
        column_moments(plane, half, done, window, width, n + SLACK, sums, squares)
        row_sums(sums[half - window :], window, n, total)
        row_sums(squares[half - window :], window, n, square)
        level, norm = mean[w], scale[w]
        for j in range(n):
            value = total[j] * inverse
            spread = square[j] - value * value
            is_even = spread <= EVEN * square[j]
            level[j] = value
            unit = np.float32(1.0) / np.sqrt(max(spread, np.float32(0.0)) + added)
            norm[j] = np.float32(0.0) if is_even else unit
        done = window


# (p,) f4, i8, i8, (p,) f4, (p,) f4, (p,) f4, (p,) f4, (p,) f4, (p,) f4 -> None
@kernel
def add_correlation(columns, window, n, scale_a, scale_b, mean_a, mean_b, work, total):
    """Add the NCC of a pair of views at the first n places.

    columns : sums of their products down the columns of the windows, from the first of each on; work : (p,), scratch.
    """
    x = columns
    if window == 1:
        for j in range(n):
            cross = x[j] + x[j + 1] + x[j + 2]
            total[j] += scale_a[j] * scale_b[j] * (cross - mean_a[j] * mean_b[j])
    elif window == 2:
        for j in range(n):
            cross = (x[j] + x[j + 1]) + (x[j + 2] + x[j + 3]) + x[j + 4]
            total[j] += scale_a[j] * scale_b[j] * (cross - mean_a[j] * mean_b[j])
    elif window == 3:
        for j in range(n):
            cross = ((x[j] + x[j + 1]) + (x[j + 2] + x[j + 3])) + ((x[j + 4] + x[j + 5]) + x[j + 6])
            total[j] += scale_a[j] * scale_b[j] * (cross - mean_a[j] * mean_b[j])
    else:
        row_sums(columns, window, n, work)
        for j in range(n):
            total[j] += scale_a[j] * scale_b[j] * (work[j] - mean_a[j] * mean_b[j])


# (i,p) f4, (w,) i8, (i,w,p) f4, (i,w,p) f4, i8, i8, (2,p) f4, (g,p) f4 -> None
@kernel
def add_pairs(planes, windows, mean, scale, width, n, work, total):
    """Add the NCC of all pairs of views, for every window, at the first n places.

    planes : (i, p); windows, mean, scale : see `window_moments`, a view takes part where its scale is not zero; work :
    (2, p), scratch; total : (g, p), the pair of views a and b adds to row (a + b) % g. Plain formula: sum_{a<b} scale_a
    scale_b (sum x_a x_b - mean_a mean_b).
    """
    half, columns, n_groups = windows[-1], work[0], total.shape[0]
    for a in range(planes.shape[0]):
        for b in range(a + 1, planes.shape[0]):
            done, into = 0, total[(a + b) % n_groups]
            for w in range(windows.shape[0]):
                window = windows[w]
                column_products(planes[a], planes[b], half, done, window, width, n + SLACK, columns)
                add_correlation(
                    columns[half - window :], window, n, scale[a, w], scale[b, w], mean[a, w], mean[b, w], work[1], into
                )
                done = window


# (i,p) f4, f4, i8, (p,) f4 -> None
@kernel
def add_closeness(greys, weight, n, total):
    """Add max(0, weight - |x_a - x_b|) of all pairs of views, at the first n places.

    greys : (i, p) float32, grey values times weight / reach, reach being the grey difference from which on two views
    are strangers; total : (p,).
    """
    for a in range(greys.shape[0]):
        x = greys[a]
        for b in range(a + 1, greys.shape[0]):
            y = greys[b]
            for j in range(n):
                total[j] += max(weight - abs(x[j] - y[j]), np.float32(0.0))
