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

from zlocus.core.jit import kernel

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

    done : `sums` and `squares` hold those over 2 done + 1 rows already; 0 if they hold nothing. Places beyond an offset
    are counted without sign, which leaves no index to be checked; a slice a row would too, but is counted by its owner.
    """
    if done == 0:
        p, q, r = np.uint64((half - 1) * width), np.uint64(half * width), np.uint64((half + 1) * width)
        for j in range(np.uint64(n)):
            a, b, c = plane[p + j], plane[q + j], plane[r + j]
            sums[j] = a + b + c
            squares[j] = a * a + b * b + c * c
    for k in range(max(done, 1) + 1, window + 1):
        above, below = plane[(half - k) * width :], plane[(half + k) * width :]
        for j in range(n):
            sums[j] += above[j] + below[j]
            squares[j] += above[j] * above[j] + below[j] * below[j]


# (i,p) f4, u8, u8, i8, i8, i8, i8, i8, (p,) f4 -> None
@kernel
def column_products(planes, a, b, half, done, window, width, n, sums):
    """As `column_moments`, of the products of planes a and b."""
    if done == 0:
        p, q, r = np.uint64((half - 1) * width), np.uint64(half * width), np.uint64((half + 1) * width)
        for j in range(np.uint64(n)):
            first, second = planes[a, p + j] * planes[b, p + j], planes[a, q + j] * planes[b, q + j]
            sums[j] = first + second + planes[a, r + j] * planes[b, r + j]
    x, y = planes[a], planes[b]
    for k in range(max(done, 1) + 1, window + 1):
        c, d, e, f = x[(half - k) * width :], x[(half + k) * width :], y[(half - k) * width :], y[(half + k) * width :]
        for j in range(n):
            sums[j] += c[j] * e[j] + d[j] * f[j]


# f4, f4, f4 -> f4
@kernel
def inverse_norm(value, square, added):
    """1 / sqrt(square - value^2 + added), and 0 of an even window."""
    spread = square - value * value
    unit = np.float32(1.0) / np.sqrt(max(spread, np.float32(0.0)) + added)
    return np.float32(0.0) if spread <= EVEN * square else unit


# (p,) f4, (w,) i8, i8, i8, f4, (4,p) f4, (w,p) f4, (w,p) f4 -> None
@kernel
def window_moments(plane, windows, width, n, floor, work, mean, scale):
    """Scaled mean and 1 / norm of the windows around every cell of a flat plane, at the first n places.

    plane : (p,) float32 and SLACK more, centred near zero so that float32 sums are exact enough; windows : (w,) half
    widths, ascending, the last that of the plane's border; floor : variance added, grey values squared; mean : (w, p),
    times sqrt(m), m = (2 window + 1)^2; scale : (w, p), 1 / sqrt(sum (x - mean)^2 + m floor), and 0 where the window is
    even (it agrees with none); work : (4, p), scratch.
    """
    half, done, sums, squares, total, square = windows[-1], 0, work[0], work[1], work[2], work[3]
    for w in range(windows.shape[0]):
        window, level, norm = windows[w], mean[w], scale[w]
        side = np.float32(2 * window + 1)
        inverse, added = np.float32(1.0) / side, side * side * floor + TINY
        column_moments(plane, half, done, window, width, n + SLACK, sums, squares)
        x, y = sums[half - window :], squares[half - window :]
        if window == 1:
            for j in range(n):
                level[j] = (x[j] + x[j + 1] + x[j + 2]) * inverse
                norm[j] = inverse_norm(level[j], y[j] + y[j + 1] + y[j + 2], added)
        elif window == 2:
            for j in range(n):
                level[j] = (x[j] + x[j + 1] + x[j + 2] + x[j + 3] + x[j + 4]) * inverse
                norm[j] = inverse_norm(level[j], y[j] + y[j + 1] + y[j + 2] + y[j + 3] + y[j + 4], added)
        else:
            row_sums(x, window, n, total)
            row_sums(y, window, n, square)
            for j in range(n):
                level[j] = total[j] * inverse
                norm[j] = inverse_norm(level[j], square[j], added)
        done = window


# (p,) f4, i8, i8, u8, u8, i8, (i,w,p) f4, (i,w,p) f4, (p,) f4, (p,) f4 -> None
@kernel
def add_correlation(columns, window, n, a, b, w, mean, scale, work, total):
    """Add the NCC of views a and b in windows w at the first n places.

    columns : sums of their products down the columns of the windows, from the first of each on; mean, scale : see
    `window_moments`; work : (p,), scratch.
    """
    x, v = columns, np.uint64(w)
    if window == 1:
        for j in range(n):
            cross = x[j] + x[j + 1] + x[j + 2]
            total[j] += scale[a, v, j] * scale[b, v, j] * (cross - mean[a, v, j] * mean[b, v, j])
    elif window == 2:
        for j in range(n):
            cross = (x[j] + x[j + 1]) + (x[j + 2] + x[j + 3]) + x[j + 4]
            total[j] += scale[a, v, j] * scale[b, v, j] * (cross - mean[a, v, j] * mean[b, v, j])
    elif window == 3:
        for j in range(n):
            cross = ((x[j] + x[j + 1]) + (x[j + 2] + x[j + 3])) + ((x[j + 4] + x[j + 5]) + x[j + 6])
            total[j] += scale[a, v, j] * scale[b, v, j] * (cross - mean[a, v, j] * mean[b, v, j])
    else:
        row_sums(columns, window, n, work)
        for j in range(n):
            total[j] += scale[a, v, j] * scale[b, v, j] * (work[j] - mean[a, v, j] * mean[b, v, j])


# (i,p) f4, i8, i8, i8, i8, (4,p) f4 -> None
@kernel
def couple_products(planes, first, second, width, n, sums):
    """`column_products` of the four pairs of view `first` or the next with view `second` or the next, three rows."""
    a, b, c, d = np.uint64(first), np.uint64(first + 1), np.uint64(second), np.uint64(second + 1)
    q, r, ac, ad, bc, bd = np.uint64(width), np.uint64(2 * width), sums[0], sums[1], sums[2], sums[3]
    for j in range(np.uint64(n)):
        a0, a1, a2 = planes[a, j], planes[a, q + j], planes[a, r + j]
        b0, b1, b2 = planes[b, j], planes[b, q + j], planes[b, r + j]
        c0, c1, c2 = planes[c, j], planes[c, q + j], planes[c, r + j]
        d0, d1, d2 = planes[d, j], planes[d, q + j], planes[d, r + j]
        ac[j], ad[j] = a0 * c0 + a1 * c1 + a2 * c2, a0 * d0 + a1 * d1 + a2 * d2
        bc[j], bd[j] = b0 * c0 + b1 * c1 + b2 * c2, b0 * d0 + b1 * d1 + b2 * d2


# (4,p) f4, i8, i8, i8, (i,w,p) f4, (i,w,p) f4, (p,) f4 -> None
@kernel
def add_couples(sums, n, first, second, mean, scale, total):
    """`add_correlation` of the four pairs of `couple_products`, windows of 3 x 3."""
    a, b, c, d, w = np.uint64(first), np.uint64(first + 1), np.uint64(second), np.uint64(second + 1), np.uint64(0)
    ac, ad, bc, bd = sums[0], sums[1], sums[2], sums[3]
    for j in range(n):
        mean_a, mean_b, mean_c, mean_d = mean[a, w, j], mean[b, w, j], mean[c, w, j], mean[d, w, j]
        with_a = scale[c, w, j] * (ac[j] + ac[j + 1] + ac[j + 2] - mean_a * mean_c)
        with_a += scale[d, w, j] * (ad[j] + ad[j + 1] + ad[j + 2] - mean_a * mean_d)
        with_b = scale[c, w, j] * (bc[j] + bc[j + 1] + bc[j + 2] - mean_b * mean_c)
        with_b += scale[d, w, j] * (bd[j] + bd[j + 1] + bd[j + 2] - mean_b * mean_d)
        total[j] += scale[a, w, j] * with_a + scale[b, w, j] * with_b


# (i,p) f4, (w,) i8, (i,w,p) f4, (i,w,p) f4, i8, i8, (4,p) f4, (v,g,p) f4 -> None
@kernel
def add_pairs(planes, windows, mean, scale, width, n, work, total):
    """Add the NCC of all pairs of views, for every window, at the first n places.

    planes : (i, p); windows, mean, scale : see `window_moments`, a view takes part where its scale is not zero; work :
    (4, p), scratch; total : (v, g, p), the pair of views a and b in window w adds to row (w % v, (a + b) % g): v is 1
    for the sum over the windows, or their number. Plain formula: sum_{a<b} scale_a scale_b (sum x_a x_b - mean_a
    mean_b). In windows of 3 x 3 alone, two views at a time meet two others: each value is read for two pairs.
    """
    half, columns, beyond, n_groups = windows[-1], work[0], work[1], total.shape[1]
    coupled = planes.shape[0] // 2 * 2 if half == 1 and n_groups == 1 else 0
    for a in range(0, coupled, 2):
        for b in range(a + 2, coupled, 2):
            couple_products(planes, a, b, width, n + SLACK, work)
            add_couples(work, n, a, b, mean, scale, total[0, 0])
    for a in range(planes.shape[0]):
        for b in range(a + 1, planes.shape[0]):
            if b < coupled and a // 2 < b // 2:
                continue
            done, x, y, group = 0, np.uint64(a), np.uint64(b), (a + b) % n_groups
            for w in range(windows.shape[0]):
                window = windows[w]
                column_products(planes, x, y, half, done, window, width, n + SLACK, columns)
                into = total[w % total.shape[0], group]
                add_correlation(columns[half - window :], window, n, x, y, w, mean, scale, beyond, into)
                done = window


# (i,p) f4, f4, i8, (p,) f4 -> None
@kernel
def add_closeness(greys, weight, n, total):
    """Add max(0, weight - |x_a - x_b|) of all pairs of views, at the first n places.

    greys : (i, p) float32, grey values times weight / reach, reach being the grey difference from which on two views
    are strangers; total : (p,).
    """
    n_views, one = np.uint64(greys.shape[0]), np.uint64(1)
    for a in range(n_views):
        for b in range(a + one, n_views):
            for j in range(n):
                total[j] += max(weight - abs(greys[a, j] - greys[b, j]), np.float32(0.0))
