"""How well many views agree: the mean NCC over all their pairs, at the cost of one pass per view.

With n_i the window of view i, its mean removed and divided by its norm, the sum of NCC over all pairs is
(|sum_i n_i|^2 - sum_i |n_i|^2) / 2, so no pair is ever formed. For two views it is their NCC.

Planes are flat: a block of rows x cols cells with a border of `half` cells each side is stored row after row with the
stride `width` = cols + 2 half, and a result for cell (r, c) stands at r width + c (what stands in the last 2 half
columns is meaningless). Long flat loops vectorise; loops over one row of a small block do not pay.
"""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel

TINY = np.float32(1e-9)
CHUNK = 512


# (p,) f4, i8, i8, (p,) f4, (p,) f4 -> None
@kernel
def row_sums(plane, half, n, sums, squares):
    """Horizontal sums over 2 half + 1 values of a flat plane, and of its squares, at the first n places."""
    if half == 1:
        for j in range(n):
            a, b, c = plane[j], plane[j + 1], plane[j + 2]
            sums[j] = a + b + c
            squares[j] = a * a + b * b + c * c
    elif half == 2:
        for j in range(n):
            a, b, c, d, e = plane[j], plane[j + 1], plane[j + 2], plane[j + 3], plane[j + 4]
            sums[j] = a + b + c + d + e
            squares[j] = a * a + b * b + c * c + d * d + e * e
    else:
        for j in range(n):
            sums[j] = plane[j]
            squares[j] = plane[j] * plane[j]
        for k in range(1, 2 * half + 1):
            for j in range(n):
                sums[j] += plane[j + k]
                squares[j] += plane[j + k] * plane[j + k]


# (p,) f4, i8, i8, i8, (p,) f4 -> None
@kernel
def column_sums(sums, half, width, n, out):
    """Vertical sums over 2 half + 1 values of a flat plane at the first n places."""
    if half == 1:
        for j in range(n):
            out[j] = sums[j] + sums[j + width] + sums[j + 2 * width]
    elif half == 2:
        for j in range(n):
            out[j] = sums[j] + sums[j + width] + sums[j + 2 * width] + sums[j + 3 * width] + sums[j + 4 * width]
    else:
        for j in range(n):
            out[j] = sums[j]
        for k in range(1, 2 * half + 1):
            for j in range(n):
                out[j] += sums[j + k * width]


# (p,) f4, i8, i8, i8, f4, (2,p) f4, (p,) f4, (p,) f4 -> None
@kernel
def window_moments(plane, half, width, n, floor, scratch, mean, scale):
    """Mean and 1 / norm of every window of a flat plane, at the first n places.

    plane : (p,) float32, centred near zero so that float32 sums are exact enough; floor : variance added, grey values
    squared; scale = 1 / sqrt(sum (x - mean)^2 + m floor) with m = (2 half + 1)^2.
    """
    m = np.float32((2 * half + 1) ** 2)
    row_sums(plane, half, n + 2 * half * width, scratch[0], scratch[1])
    column_sums(scratch[0], half, width, n, mean)
    column_sums(scratch[1], half, width, n, scale)
    inverse = np.float32(1.0) / m
    for j in range(n):
        value = mean[j] * inverse
        mean[j] = value
        square = max(scale[j] - m * value * value, np.float32(0.0))
        scale[j] = np.float32(1.0) / np.sqrt(square + m * floor + TINY)


# (i,p) f4, (i,p) f4, (i,p) f4, i8, i8, i8, (2,d) f4, (p,) f4 -> None
@kernel
def squared_sum(planes, mean, scale, half, width, n, scratch, out):
    """|sum_i n_i|^2 of every window, at the first n places; a view takes part where its `scale` is not zero.

    planes, mean, scale : (i, p); the number of views must be a multiple of three (fill up with zeros): three at a
    time keep the products in registers; scratch : (2, CHUNK).
    """
    n_views = planes.shape[0]
    offset, total = scratch[0], scratch[1]
    for j0 in range(0, n, CHUNK):
        m = min(CHUNK, n - j0)
        acc = out[j0 : j0 + m]
        offset[:] = 0.0
        acc[:] = 0.0
        for i in range(n_views):
            s, x = scale[i, j0 : j0 + m], mean[i, j0 : j0 + m]
            for j in range(m):
                offset[j] -= s[j] * x[j]
        for window in range((2 * half + 1) ** 2):
            shift = j0 + window // (2 * half + 1) * width + window % (2 * half + 1)
            for i in range(0, n_views, 3):
                s0, s1, s2 = scale[i, j0 : j0 + m], scale[i + 1, j0 : j0 + m], scale[i + 2, j0 : j0 + m]
                x0, x1 = planes[i, shift : shift + m], planes[i + 1, shift : shift + m]
                x2 = planes[i + 2, shift : shift + m]
                if n_views == 3:
                    for j in range(m):
                        value = offset[j] + s0[j] * x0[j] + s1[j] * x1[j] + s2[j] * x2[j]
                        acc[j] += value * value
                elif i == 0:
                    for j in range(m):
                        total[j] = offset[j] + s0[j] * x0[j] + s1[j] * x1[j] + s2[j] * x2[j]
                elif i + 3 < n_views:
                    for j in range(m):
                        total[j] += s0[j] * x0[j] + s1[j] * x1[j] + s2[j] * x2[j]
                else:
                    for j in range(m):
                        value = total[j] + s0[j] * x0[j] + s1[j] * x1[j] + s2[j] * x2[j]
                        acc[j] += value * value
