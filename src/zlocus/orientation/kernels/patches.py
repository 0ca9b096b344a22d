"""Least-squares matching: the position of a small patch of one image in another, to a fraction of a pixel."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# The search by whole pixels compares every second pixel of a patch.
STRIDE = 2
MAX_ROUNDS = 10
CONVERGED_PX = 0.005
# Largest distance of the result from the whole pixel that correlates best.
MAX_FRACTIONAL_SHIFT_PX = 1.5
# Smallest determinant of a normal matrix or of a warp that counts as not singular.
MIN_DETERMINANT = 1e-6


# (k) f8, (k) f8 -> f8
@kernel
def covariance(a, b):
    """Sum of the products of the deviations of two samples from their means."""
    sum_a, sum_b, sum_ab = 0.0, 0.0, 0.0
    for k in range(len(a)):
        sum_a += a[k]
        sum_b += b[k]
        sum_ab += a[k] * b[k]
    return sum_ab - sum_a * sum_b / len(a)


# (k) f8, (k) f8 -> f8
@kernel
def correlation(a, b):
    """Normalised cross-correlation of two samples; 0 where one is constant."""
    product = covariance(a, a) * covariance(b, b)
    return covariance(a, b) / np.sqrt(product) if product > 0.0 else 0.0


# (s,s) f4, (k) f8, (k) f8, (2) f8, (k) f8 -> None
@kernel
def sample_linear(square, x, y, shift, out):
    """Interpolate a square bilinearly at positions (x, y) moved by a shift, into `out`."""
    for k in range(len(x)):
        at_x, at_y = x[k] + shift[0], y[k] + shift[1]
        col, row = int(np.floor(at_x)), int(np.floor(at_y))
        u, v = at_x - col, at_y - row
        upper = (1.0 - u) * square[row, col] + u * square[row, col + 1]
        lower = (1.0 - u) * square[row + 1, col] + u * square[row + 1, col + 1]
        out[k] = (1.0 - v) * upper + v * lower


# (s,s) f4, (k) f8, (k) f8, (2) f8, (k) f8 -> None
@kernel
def sample_cubic(square, x, y, shift, out):
    """Interpolate a square at positions (x, y) moved by a shift, into `out`, by cubic convolution.

    Source: Keys (1981), equation 15, with a = -1/2.
    """
    for k in range(len(x)):
        at_x, at_y = x[k] + shift[0], y[k] + shift[1]
        col, row = int(np.floor(at_x)), int(np.floor(at_y))
        u, v = at_x - col, at_y - row
        u0, u3 = ((-0.5 * u + 1.0) * u - 0.5) * u, (0.5 * u - 0.5) * u * u
        u1, u2 = (1.5 * u - 2.5) * u * u + 1.0, ((-1.5 * u + 2.0) * u + 0.5) * u
        v0, v3 = ((-0.5 * v + 1.0) * v - 0.5) * v, (0.5 * v - 0.5) * v * v
        v1, v2 = (1.5 * v - 2.5) * v * v + 1.0, ((-1.5 * v + 2.0) * v + 0.5) * v
        total = 0.0
        for i in range(4):
            line = square[row - 1 + i]
            weight = v0 if i == 0 else v1 if i == 1 else v2 if i == 2 else v3
            total += weight * (u0 * line[col - 1] + u1 * line[col] + u2 * line[col + 1] + u3 * line[col + 2])
        out[k] = total


# (s,s) f4, (k) f8, (k) f8, (k) f8, i8, (2) f8 -> None
@kernel
def whole_shift(square, values, x, y, max_shift, shift):
    """Find the shift by whole pixels, at most `max_shift`, at which a square correlates best with values, into
    `shift`."""
    best, found, at = -2.0, np.empty(len(values)), np.empty(2)
    shift[:] = 0.0
    for row in range(-max_shift, max_shift + 1):
        for col in range(-max_shift, max_shift + 1):
            at[0], at[1] = col, row
            sample_linear(square, x, y, at, found)
            ncc = correlation(values, found)
            if ncc > best:
                best = ncc
                shift[:] = at


# (s,s) f4, (k) f8, (k,2) f8, (k) f8, (k) f8, (2) f8 -> f8
@kernel
def fine_shift(square, values, slopes, x, y, shift):
    """Refine a shift by least-squares matching, and return the NCC at the result, 0 where none is found near the start.

    Solves values = offset + gain * square(x + shift) by Gauss-Newton, with the slopes of the values (per px of the
    square) instead of those of the square. Source: Grün (1985), with shifts as the only parameters.
    """
    across, down = np.ascontiguousarray(slopes[:, 0]), np.ascontiguousarray(slopes[:, 1])
    xx, xy, yy = covariance(across, across), covariance(across, down), covariance(down, down)
    determinant = xx * yy - xy * xy
    if not determinant > MIN_DETERMINANT * (xx + yy) ** 2:
        return 0.0
    start_x, start_y = shift[0], shift[1]
    found, spread = np.empty(len(values)), covariance(values, values)
    for _ in range(MAX_ROUNDS):
        sample_cubic(square, x, y, shift, found)
        common = covariance(values, found)
        if not common > 0.0:
            return 0.0
        gain = spread / common
        by_x = covariance(across, values) - gain * covariance(across, found)
        by_y = covariance(down, values) - gain * covariance(down, found)
        step_x, step_y = (yy * by_x - xy * by_y) / determinant, (xx * by_y - xy * by_x) / determinant
        shift[0] += step_x
        shift[1] += step_y
        if not max(abs(shift[0] - start_x), abs(shift[1] - start_y)) <= MAX_FRACTIONAL_SHIFT_PX:
            return 0.0
        if max(abs(step_x), abs(step_y)) < CONVERGED_PX:
            return correlation(values, found)
    return 0.0


# (n,p,p) f4, (n,s,s) f4, (n,2,2) f8, (n,2) f8, i8, (n,3) f8 -> None
@kernel
def patch_shifts(patches, squares, warps, centres, max_shift, out):
    """Find the shifts of patches from their expected positions in squares of another image.

    patches : (n, p, p), p odd, whose outermost pixels serve for slopes only; squares : (n, s, s); warps : (n, 2, 2) px
    of the square per px of the patch; centres : (n, 2) px, expected position of the patch's middle in the square;
    max_shift : whole pixels that are searched to either side; out : (n, 3) receives column (px), row (px) and NCC,
    which is 0 where no position is found or the square is too small.
    """
    half = patches.shape[1] // 2 - 1
    side, last = 2 * half + 1, squares.shape[1] - 1
    count, margin = side * side, max_shift + MAX_FRACTIONAL_SHIFT_PX + 2.0
    values, slopes, x, y = np.empty(count), np.empty((count, 2)), np.empty(count), np.empty(count)
    few = np.array([r * side + c for r in range(0, side, STRIDE) for c in range(0, side, STRIDE)])
    shift = np.empty(2)
    out[:] = 0.0
    for n in range(len(patches)):
        patch, warp = patches[n], warps[n]
        determinant = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
        if not abs(determinant) > MIN_DETERMINANT:
            continue
        for k in range(count):
            row, col = k // side + 1, k % side + 1
            values[k] = patch[row, col]
            across, down = (
                0.5 * (patch[row, col + 1] - patch[row, col - 1]),
                0.5 * (patch[row + 1, col] - patch[row - 1, col]),
            )
            slopes[k, 0] = (warp[1, 1] * across - warp[1, 0] * down) / determinant
            slopes[k, 1] = (warp[0, 0] * down - warp[0, 1] * across) / determinant
            by_col, by_row = col - 1 - half, row - 1 - half
            x[k] = centres[n, 0] + warp[0, 0] * by_col + warp[0, 1] * by_row
            y[k] = centres[n, 1] + warp[1, 0] * by_col + warp[1, 1] * by_row
        if not (min(x.min(), y.min()) >= margin and max(x.max(), y.max()) <= last - margin):
            continue
        whole_shift(squares[n], values[few], x[few], y[few], max_shift, shift)
        out[n, 2] = fine_shift(squares[n], values, slopes, x, y, shift)
        out[n, 0], out[n, 1] = shift[0], shift[1]
