"""How well many views agree: the sum of NCC over all their pairs.

The moments of a window are computed once per view, so that a pair costs one box sum of products. (The square of the
sum of normalised windows gives the same figure without forming pairs, but costs more up to six views and beyond.)

Planes are flat: a block of rows x cols cells with a border of `half` cells each side is stored row after row with the
stride `width` = cols + 2 half, and a result for cell (r, c) stands at r width + c (what stands in the last 2 half
columns is meaningless). Long loops over one index vectorise; loops over the rows of a small block do not pay.
"""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel

TINY = np.float32(1e-9)
# A window is even when its variance is this share of its mean square: below it, float32 sums leave nothing but rounding
# (up to 8e-7 of it for exactly equal values).
EVEN = np.float32(2e-6)


# (p,) f4, (p,) f4, i8, i8, (p,) f4 -> None
@kernel
def product_rows(a, b, half, n, out):
    """Horizontal sums over 2 half + 1 products a b, at the first n places."""
    if half == 1:
        for j in range(n):
            out[j] = a[j] * b[j] + a[j + 1] * b[j + 1] + a[j + 2] * b[j + 2]
    elif half == 2:
        for j in range(n):
            first = a[j] * b[j] + a[j + 1] * b[j + 1] + a[j + 2] * b[j + 2]
            out[j] = first + a[j + 3] * b[j + 3] + a[j + 4] * b[j + 4]
    elif half == 3:
        for j in range(n):
            first = a[j] * b[j] + a[j + 1] * b[j + 1] + a[j + 2] * b[j + 2] + a[j + 3] * b[j + 3]
            out[j] = first + a[j + 4] * b[j + 4] + a[j + 5] * b[j + 5] + a[j + 6] * b[j + 6]
    elif half == 4:
        for j in range(n):
            first = a[j] * b[j] + a[j + 1] * b[j + 1] + a[j + 2] * b[j + 2] + a[j + 3] * b[j + 3]
            first += a[j + 4] * b[j + 4] + a[j + 5] * b[j + 5] + a[j + 6] * b[j + 6]
            out[j] = first + a[j + 7] * b[j + 7] + a[j + 8] * b[j + 8]
    else:
        for j in range(n):
            out[j] = a[j] * b[j]
        for k in range(1, 2 * half + 1):
            x, y = a[k : k + n], b[k : k + n]
            for j in range(n):
                out[j] += x[j] * y[j]


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


# (p,) f4, i8, i8, i8, (p,) f4 -> None
@kernel
def column_sums(sums, half, width, n, out):
    """Vertical sums over 2 half + 1 values, at the first n places; a slice a row leaves no index to be checked."""
    a, b, c = sums[:n], sums[width : width + n], sums[2 * width : 2 * width + n]
    for j in range(n):
        out[j] = a[j] + b[j] + c[j]
    for k in range(3, 2 * half, 2):
        a, b = sums[k * width : k * width + n], sums[(k + 1) * width : (k + 1) * width + n]
        for j in range(n):
            out[j] += a[j] + b[j]


# (p,) f4, i8, i8, i8, i8, f4, (p,) f4, (p,) f4, (p,) f4 -> None
@kernel
def window_moments(plane, start, half, width, n, floor, scratch, mean, scale):
    """Mean and 1 / norm of every window of a flat plane, at the first n places.

    plane : (p,) float32, centred near zero so that float32 sums are exact enough; start : place of the first window's
    first cell (not 0 where a larger window set the border); floor : variance added, grey values squared; scale =
    1 / sqrt(sum (x - mean)^2 + m floor) with m = (2 half + 1)^2, and 0 where the window is even (it agrees with none).
    """
    m = np.float32((2 * half + 1) ** 2)
    inverse = np.float32(1.0) / m
    values = plane[start:]
    row_sums(values, half, n + 2 * half * width, scratch)
    column_sums(scratch, half, width, n, mean)
    product_rows(values, values, half, n + 2 * half * width, scratch)
    column_sums(scratch, half, width, n, scale)
    for j in range(n):
        value = mean[j] * inverse
        square = scale[j] - mean[j] * value
        is_even = square <= EVEN * scale[j]
        mean[j] = value
        norm = np.float32(1.0) / np.sqrt(max(square, np.float32(0.0)) + m * floor + TINY)
        scale[j] = np.float32(0.0) if is_even else norm


# (i,p) f4, i8, (i,p) f4, (i,p) f4, i8, i8, i8, (2,p) f4, (p,) f4 -> None
@kernel
def pair_sum(planes, start, mean, scale, half, width, n, work, out):
    """Sum of NCC over all pairs of views, each counted twice, at the first n places.

    planes, mean, scale : (i, p), a view takes part where its scale is not zero; start : see `window_moments`;
    work : (2, p), scratch; out : (p,). Plain formula: 2 sum_{a<b} scale_a scale_b (sum x_a x_b - m mean_a mean_b).
    """
    m = np.float32((2 * half + 1) ** 2)
    out[:n] = 0.0
    for a in range(planes.shape[0]):
        xa, ma, sa = planes[a][start:], mean[a], scale[a]
        for b in range(a + 1, planes.shape[0]):
            mb, sb = mean[b], scale[b]
            product_rows(xa, planes[b][start:], half, n + 2 * half * width, work[0])
            column_sums(work[0], half, width, n, work[1])
            cross = work[1]
            for j in range(n):
                out[j] += np.float32(2.0) * sa[j] * sb[j] * (cross[j] - m * ma[j] * mb[j])
