"""Plain twins of `zlocus.matching.kernels.rasterise`."""

from __future__ import annotations

import numpy as np


def agreed_heights_reference(heights, tolerance):
    """See `zlocus.matching.kernels.rasterise.agreed_heights`: (r, c) heights and (i, r, c) who agrees."""
    out = np.full(heights.shape[1:], np.nan, np.float32)
    agrees = np.zeros(heights.shape, bool)
    for cell in np.ndindex(out.shape):
        z = heights[(slice(None), *cell)]
        groups = [(z <= top) & (z >= top - np.float32(tolerance)) for top in z]
        ranked = sorted(
            (group.sum(), top, k) for k, (group, top) in enumerate(zip(groups, z, strict=True)) if group.any()
        )
        if ranked:
            chosen = groups[ranked[-1][2]]
            out[cell], agrees[(slice(None), *cell)] = np.median(z[chosen]), chosen
    return out, agrees
