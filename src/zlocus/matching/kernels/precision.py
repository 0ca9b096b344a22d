"""Additive model of piecewise linear curves, cell by cell."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel


# (n,) f4, f4, f4, (k,) f4, (n,) f4 -> None
@kernel
def add_curve(values, first, spacing, curve, out):
    """Add a curve through equally spaced knots, constant beyond both ends, to `out` at every value.

    values : (n,) float32, no NaN; first : position of the first knot; curve : (k,) float32, k >= 2; out : (n,) float32.
    """
    last = np.float32(curve.shape[0] - 1)
    inverse = np.float32(1.0) / spacing
    for j in range(values.shape[0]):
        x = min(max((values[j] - first) * inverse, np.float32(0.0)), last)
        k = min(np.int32(x), np.int32(curve.shape[0] - 2))
        f = x - np.float32(k)
        out[j] += curve[k] + f * (curve[k + 1] - curve[k])
