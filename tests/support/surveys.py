"""Surveys of small rasters, as the report makes them."""

from __future__ import annotations

import numpy as np
from affine import Affine

from zlocus.products.report.sampling import Survey


def small(quality: np.ndarray, height=None, sigma=None) -> Survey:
    """A survey of small rasters, every cell kept."""
    height = np.ones(quality.shape, np.float32) if height is None else height
    sigma = np.ones(quality.shape, np.float32) if sigma is None else sigma
    codes, n_heights = np.bincount(quality.ravel(), minlength=1 << 16), int(np.isfinite(height).sum())
    return Survey(
        quality.shape, Affine(2.0, 0.0, 100.0, 0.0, -2.0, 50.0), "height", codes, n_heights, np.zeros(256, np.int64),
        1.0, 1.0, 1, height, sigma, quality.astype(np.uint16), np.ones(quality.shape, np.uint8),
    )  # fmt: skip
