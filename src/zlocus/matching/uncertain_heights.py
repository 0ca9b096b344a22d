"""Uncertain heights take the weighted median of the heights around them.

A height whose standard deviation is several steps is mostly that of a single cell that matched by chance: among crowns
and beside edges, where the images look different. Its neighbours err too, but not all of them, and not all to one side.
Their median is therefore a better guess than the height itself. Precise heights count more, and so do cells of the same
grey value, so that a roof does not take the height of the street beside it (Ma, He, Wei, Sun and Wu 2013, "Constant
time weighted median filtering for stereo matching and beyond").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.weighted_median import medians_around

FloatGrid = NDArray[np.float32]
# A height counts by its standard deviation to the power of -WEIGHT_POWER, which counts as at least MIN_SIGMA_STEPS.
WEIGHT_POWER, MIN_SIGMA_STEPS = 0.5, 0.3
# Grey differences that make a cell count little, in units of the texture.
GREY_SPREAD_TEXTURES = 3.0


def with_medians(
    height: FloatGrid, sigma: FloatGrid, grey: FloatGrid, is_known: NDArray[np.bool_], min_sigma: float, texture: float
) -> FloatGrid:
    """Heights (r, c) float32, those with a standard deviation above `min_sigma` as weighted medians around them.

    height, sigma : (r, c) float32, steps; grey : (r, c) float32, an ortho-image, NaN where not known; is_known : (r, c)
    bool, cells that have a height; texture : the unit of grey differences.
    """
    weight = np.maximum(sigma, np.float32(MIN_SIGMA_STEPS)) ** np.float32(-WEIGHT_POWER)
    out = np.empty_like(height)
    spread = np.float32(GREY_SPREAD_TEXTURES * texture) if texture > 0 else np.float32(np.inf)
    is_wanted = is_known & (sigma > np.float32(min_sigma))
    medians_around(height, weight, grey, is_known, is_wanted, spread, out)
    return out
