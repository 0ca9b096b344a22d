"""Normalised cross-correlation (NCC), summed over all pairs of views.

The moments of a window are computed once per view, so that a pair costs one box sum of products. (The square of the
sum of normalised windows gives the same figure without forming pairs, but costs more up to six views and beyond.)

Planes are flat: see README.md, "Flat planes". Windows are given by their half widths, in ascending order: the sums down
the columns of a window start from those of the next smaller one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

TINY = np.float32(1e-9)
# A window has no texture when its variance is at most this share of its mean square. Below it, float32 sums contain
# only rounding errors (up to 8e-7 of the mean square for exactly equal values).
MAX_VARIANCE_SHARE_WITHOUT_TEXTURE = np.float32(2e-6)
# Unused floats behind every flat plane: sums may read beyond the last cell.
SLACK = 32


class WindowMoments(NamedTuple):
    """Moments of the windows around the cells of flat planes, see `window_moments`."""

    mean: np.ndarray  # (i,w,p) f4: mean, times the root of the number of cells in the window
    scale: np.ndarray  # (i,w,p) f4: 1 / norm of the window less its mean; 0 where the view takes no part


class ColumnSums(NamedTuple):
    """Which vertical sums are made on a flat plane: over 2 window + 1 rows around each of the first n places."""

    half: int  # i8: cells around the block, the largest half width of a window
    done: int  # i8: half width of the window whose sums are there already; 0: none
    window: int  # i8: half width of the window
    width: int  # i8: floats from a row to the next
    n: int  # i8: places


class ViewPair(NamedTuple):
    """Numbers of two views. Unsigned, which leaves no negative index to be checked in the loops."""

    a: np.uint64  # u8: first view
    b: np.uint64  # u8: second view


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


# (p,) f4, ColumnSums, (p,) f4, (p,) f4 -> None
@kernel
def column_moments(plane, span, sums, squares):
    """Make the vertical sums of the values and of their squares on a flat plane.

    The sums of the window `span.done` are in `sums` and `squares` already. Unsigned indices leave no negative index to
    be checked; a slice per row would do the same, but counts the references to its array.
    """
    half, done, window, width, n = span.half, span.done, span.window, span.width, span.n
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


# (i,p) f4, ViewPair, ColumnSums, (p,) f4 -> None
@kernel
def column_products(planes, pair, span, sums):
    """Make the vertical sums of the products of two views' planes, as `column_moments` does for one."""
    a, b, half, done, window, width, n = pair.a, pair.b, span.half, span.done, span.window, span.width, span.n
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
    """1 / sqrt(square - value^2 + added), and 0 for a window without texture."""
    spread = square - value * value
    unit = np.float32(1.0) / np.sqrt(max(spread, np.float32(0.0)) + added)
    return np.float32(0.0) if spread <= MAX_VARIANCE_SHARE_WITHOUT_TEXTURE * square else unit


# (p,) f4, (w,) i8, i8, i8, f4, (4,p) f4, (w,p) f4, (w,p) f4 -> None
@kernel
def window_moments(plane, windows, width, n, variance, work, mean, scale):
    """Write the scaled mean and 1 / norm of the windows around every cell of one view, at the first n places.

    plane : (p,) float32 and SLACK more, centred near zero so that float32 sums are exact enough; windows : (w,) half
    widths in ascending order, the last is the number of cells around the block; variance : added to that of every
    window, grey values squared; mean : (w, p), times sqrt(m), m = (2 window + 1)^2; scale : (w, p), 1 / sqrt(sum (x -
    mean)^2 + m variance), and 0 where the window has no texture (its correlation is 0); work : (4, p), scratch.
    """
    half, done, sums, squares, total, square = windows[-1], 0, work[0], work[1], work[2], work[3]
    for w in range(windows.shape[0]):
        window, level, norm = windows[w], mean[w], scale[w]
        side = np.float32(2 * window + 1)
        inverse, added = np.float32(1.0) / side, side * side * variance + TINY
        column_moments(plane, ColumnSums(half, done, window, width, n + SLACK), sums, squares)
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


# (p,) f4, i8, i8, ViewPair, i8, WindowMoments, (p,) f4, (p,) f4 -> None
@kernel
def add_correlation(columns, window, n, pair, w, moments, work, total):
    """Add the NCC of a pair of views in the windows number `w`, of half width `window`, at the first n places.

    columns : sums of the products of the views down the columns of the windows, from the first column of each on;
    work : (p,), scratch.
    """
    x, v, a, b, mean, scale = columns, np.uint64(w), pair.a, pair.b, moments.mean, moments.scale
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
    """Make the sums of `column_products` over three rows for four pairs of views: `first` or the next view with
    `second` or the next view."""
    a, b, c, d = np.uint64(first), np.uint64(first + 1), np.uint64(second), np.uint64(second + 1)
    q, r, ac, ad, bc, bd = np.uint64(width), np.uint64(2 * width), sums[0], sums[1], sums[2], sums[3]
    for j in range(np.uint64(n)):
        a0, a1, a2 = planes[a, j], planes[a, q + j], planes[a, r + j]
        b0, b1, b2 = planes[b, j], planes[b, q + j], planes[b, r + j]
        c0, c1, c2 = planes[c, j], planes[c, q + j], planes[c, r + j]
        d0, d1, d2 = planes[d, j], planes[d, q + j], planes[d, r + j]
        ac[j], ad[j] = a0 * c0 + a1 * c1 + a2 * c2, a0 * d0 + a1 * d1 + a2 * d2
        bc[j], bd[j] = b0 * c0 + b1 * c1 + b2 * c2, b0 * d0 + b1 * d1 + b2 * d2


# (4,p) f4, i8, i8, i8, WindowMoments, (p,) f4 -> None
@kernel
def add_couples(sums, n, first, second, moments, total):
    """Add the NCC of the four pairs of `couple_products` in windows of 3 x 3 at the first n places."""
    mean, scale = moments.mean, moments.scale
    a, b, c, d, w = np.uint64(first), np.uint64(first + 1), np.uint64(second), np.uint64(second + 1), np.uint64(0)
    ac, ad, bc, bd = sums[0], sums[1], sums[2], sums[3]
    for j in range(n):
        mean_a, mean_b, mean_c, mean_d = mean[a, w, j], mean[b, w, j], mean[c, w, j], mean[d, w, j]
        with_a = scale[c, w, j] * (ac[j] + ac[j + 1] + ac[j + 2] - mean_a * mean_c)
        with_a += scale[d, w, j] * (ad[j] + ad[j + 1] + ad[j + 2] - mean_a * mean_d)
        with_b = scale[c, w, j] * (bc[j] + bc[j + 1] + bc[j + 2] - mean_b * mean_c)
        with_b += scale[d, w, j] * (bd[j] + bd[j + 1] + bd[j + 2] - mean_b * mean_d)
        total[j] += scale[a, w, j] * with_a + scale[b, w, j] * with_b


# (i,p) f4, (w,) i8, WindowMoments, i8, i8, (4,p) f4, (v,g,p) f4 -> None
@kernel
def add_pairs(planes, windows, moments, width, n, work, total):
    """Add the NCC of all pairs of views, for every window, at the first n places.

    planes : (i, p); windows : see `window_moments`; moments : a view takes part where its scale is not zero; work :
    (4, p), scratch; total : (v, g, p), the pair of views a and b in window w adds to row (w % v, (a + b) % g), where v
    is 1 for the sum over the windows, or their number. Plain formula: sum_{a<b} scale_a scale_b (sum x_a x_b - mean_a
    mean_b). With windows of 3 x 3 only, two views at a time are compared with two others, so that each value is read
    for two pairs.
    """
    half, columns, beyond, n_groups = windows[-1], work[0], work[1], total.shape[1]
    coupled = planes.shape[0] // 2 * 2 if half == 1 and n_groups == 1 else 0
    for a in range(0, coupled, 2):
        for b in range(a + 2, coupled, 2):
            couple_products(planes, a, b, width, n + SLACK, work)
            add_couples(work, n, a, b, moments, total[0, 0])
    for a in range(planes.shape[0]):
        for b in range(a + 1, planes.shape[0]):
            if b < coupled and a // 2 < b // 2:
                continue
            done, pair, group = 0, ViewPair(np.uint64(a), np.uint64(b)), (a + b) % n_groups
            for w in range(windows.shape[0]):
                window = windows[w]
                column_products(planes, pair, ColumnSums(half, done, window, width, n + SLACK), columns)
                into = total[w % total.shape[0], group]
                add_correlation(columns[half - window :], window, n, pair, w, moments, beyond, into)
                done = window


# (i,p) f4, f4, i8, (p,) f4 -> None
@kernel
def add_closeness(greys, weight, n, total):
    """Add max(0, weight - |x_a - x_b|) of all pairs of views, at the first n places.

    greys : (i, p) float32, grey values times weight / d, where d is the grey difference at which two views do not agree
    at all; total : (p,).
    """
    n_views, one = np.uint64(greys.shape[0]), np.uint64(1)
    for a in range(n_views):
        for b in range(a + one, n_views):
            for j in range(n):
                total[j] += max(weight - abs(greys[a, j] - greys[b, j]), np.float32(0.0))
