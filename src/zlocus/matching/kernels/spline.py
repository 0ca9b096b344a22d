"""Cubic B-spline coefficients of an image."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

POLE = np.sqrt(3.0) - 2.0
# Number of pixels after which the powers of the pole are below the rounding of float32.
BOUNDARY_PIXELS = 16


# (r,c) f4 -> None
@kernel
def filter_columns(image):
    """Replace every column by its cubic B-spline coefficients, whole rows at a time so that it vectorises.

    image : (r, c) float32, in place; mirrored at the first and last row. Source: Unser (1999), box 2: a causal and an
    anticausal recursion with the pole sqrt(3) - 2.
    """
    n_rows, n_cols = image.shape
    if n_rows < 2:
        return
    pole = np.float32(POLE)
    first = np.zeros(n_cols, np.float32)
    power = np.float32(1.0)
    for k in range(BOUNDARY_PIXELS):
        at = k % (2 * n_rows - 2)
        row = image[at if at < n_rows else 2 * n_rows - 2 - at]
        for c in range(n_cols):
            first[c] += power * row[c]
        power *= pole
    image[0] = first
    for r in range(1, n_rows):
        for c in range(n_cols):
            image[r, c] += pole * image[r - 1, c]
    gain = pole / (pole * pole - np.float32(1.0))
    for c in range(n_cols):
        image[n_rows - 1, c] = gain * (image[n_rows - 1, c] + pole * image[n_rows - 2, c])
    for r in range(n_rows - 2, -1, -1):
        for c in range(n_cols):
            image[r, c] = pole * (image[r + 1, c] - image[r, c])
    for r in range(n_rows):
        for c in range(n_cols):
            image[r, c] *= np.float32(6.0)


# (r,c) f4 -> (c,r) f4
@kernel
def transposed(image):
    """The image with rows and columns exchanged, in pieces of 16 x 16 pixels that stay in the cache."""
    n_rows, n_cols = image.shape
    out = np.empty((n_cols, n_rows), np.float32)
    for r0 in range(0, n_rows, 16):
        for c0 in range(0, n_cols, 16):
            for c in range(c0, min(c0 + 16, n_cols)):
                for r in range(r0, min(r0 + 16, n_rows)):
                    out[c, r] = image[r, c]
    return out


# (r,c) f4 -> (r,c) f4
@kernel
def spline_coefficients(image):
    """Cubic B-spline coefficients (r, c) of an image, (r, c) float32; their B-splines pass through its pixels."""
    turned = transposed(image)
    filter_columns(turned)
    out = transposed(turned)
    filter_columns(out)
    return out
