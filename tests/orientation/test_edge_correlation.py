"""Displacements of windows by their edges, whatever the contrast."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as shifted

from zlocus.orientation.edge_correlation import correlation, peak_of

SIDE, SEARCH = 84, 10
FOUND_CELLS = 0.1


def texture(seed=1):
    return gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), 1.5).astype(np.float32)


@pytest.mark.parametrize("contrast", [1.0, -0.4])
def test_a_displacement_is_found_whatever_the_contrast(contrast):
    first = texture()
    second = (contrast * shifted(first, (2.3, -4.6), order=3, mode="reflect") + 7).astype(np.float32)
    peak = peak_of(correlation(first, second, SEARCH))
    assert (peak.row, peak.col) == pytest.approx((2.3, -4.6), abs=FOUND_CELLS)
    assert peak.height > 8


def test_other_windows_do_not_stand_out():
    heights = [
        peak.height
        for seed in range(2, 12)
        if (peak := peak_of(correlation(texture(1), texture(seed), SEARCH))) is not None
    ]
    assert np.median(heights) < 5


def test_windows_without_edges_or_values_are_not_compared():
    flat = np.zeros((SIDE, SIDE), np.float32)
    assert correlation(flat, texture(), SEARCH) is None
    gap = texture()
    gap[:, : SIDE // 2 + 5] = np.nan
    assert correlation(gap, texture(), SEARCH) is None


def test_missing_values_are_no_edges():
    first = texture()
    second = shifted(first, (1.0, 2.0), order=3, mode="reflect").astype(np.float32)
    second[20:40, 30:50] = np.nan
    peak = peak_of(correlation(first, second, SEARCH))
    assert (peak.row, peak.col) == pytest.approx((1.0, 2.0), abs=FOUND_CELLS)
