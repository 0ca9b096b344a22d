"""Weighted medians of uncertain heights: analytic cases, a slow twin, and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zlocus.matching.kernels.weighted_median import RADIUS, SPREAD_CELLS
from zlocus.matching.uncertain_heights import (
    GREY_SPREAD_TEXTURES,
    MIN_SIGMA_STEPS,
    WEIGHT_POWER,
    with_medians,
)

MIN_SIGMA, TEXTURE = 2.0, 1.0
UNCERTAIN, CERTAIN = 6.0, 0.5
STEP_CELLS = slice(None, 20), slice(20, None)


def medians(height, sigma=UNCERTAIN, grey=0.0, is_known=None, texture=TEXTURE):
    sigma, grey = (np.broadcast_to(np.float32(each), height.shape).copy() for each in (sigma, grey))
    is_known = np.ones(height.shape, bool) if is_known is None else is_known
    return with_medians(height.astype(np.float32), sigma, grey, is_known, MIN_SIGMA, texture)


def twin(height, sigma, grey, is_known, texture):
    """The definition, cell by cell, in double precision: the least height up to which half the weight lies."""
    out = height.copy()
    for row, col in np.argwhere(is_known & (sigma > MIN_SIGMA)):
        found = []
        for r in range(max(row - RADIUS, 0), min(row + RADIUS + 1, height.shape[0])):
            for c in range(max(col - RADIUS, 0), min(col + RADIUS + 1, height.shape[1])):
                if is_known[r, c]:
                    weight = max(sigma[r, c], MIN_SIGMA_STEPS) ** -WEIGHT_POWER
                    weight *= np.exp(-((r - row) ** 2 + (c - col) ** 2) / (2 * SPREAD_CELLS**2))
                    if np.isfinite(grey[r, c] - grey[row, col]) and texture > 0:
                        weight *= np.exp(-abs(grey[r, c] - grey[row, col]) / (GREY_SPREAD_TEXTURES * texture))
                    found.append((height[r, c], weight))
        found.sort()
        weights = np.cumsum([weight for _, weight in found])
        out[row, col] = found[int(np.searchsorted(weights, weights[-1] / 2))][0]
    return out


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), texture=st.sampled_from([0.0, 0.3, 2.0]), has_grey=st.booleans())
def test_it_is_its_twin(seed, texture, has_grey):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 14, 2))
    height = rng.normal(50, 5, shape).astype(np.float32)
    sigma = rng.lognormal(0.7, 1, shape).astype(np.float32)
    grey = rng.normal(0, 1, shape).astype(np.float32)
    grey[rng.random(shape) < (0.1 if has_grey else 1.0)] = np.nan
    is_known = rng.random(shape) < 0.9
    found = with_medians(height, sigma, grey, is_known, MIN_SIGMA, texture)
    np.testing.assert_array_equal(found, twin(height, sigma, grey, is_known, texture))


def test_certain_and_unknown_heights_stay():
    rng = np.random.default_rng(1)
    height = rng.normal(0, 5, (30, 40)).astype(np.float32)
    sigma = np.where(rng.random(height.shape) < 0.5, CERTAIN, UNCERTAIN)
    is_known = rng.random(height.shape) < 0.8
    found = medians(height, sigma, is_known=is_known)
    stays = ~is_known | (sigma < MIN_SIGMA)
    np.testing.assert_array_equal(found[stays], height[stays])
    assert (found != height)[~stays].mean() > 0.9


def test_single_false_heights_are_replaced():
    row, col = np.mgrid[:40, :40]
    exact = (0.01 * row + 0.02 * col).astype(np.float32)
    height = exact.copy()
    height[::5, ::5] += 30.0
    assert np.abs(medians(height) - exact).max() < 0.01 * RADIUS + 0.02 * RADIUS + 1e-6


@pytest.mark.parametrize("is_brighter", [True, False])
def test_the_corner_of_a_roof_stays_where_grey_values_show_it(is_brighter):
    """Of the window around its corner a roof has a quarter: without grey values it takes the height of the street."""
    height = np.zeros((40, 40), np.float32)
    height[:20, 20:] = 20.0
    grey = np.where(height > 0, 10 * TEXTURE * is_brighter, 0.0)
    found = medians(height, grey=grey)
    assert np.array_equal(found, height) == is_brighter


def test_precise_heights_count_more():
    height = np.where(np.arange(40) % 2, 10.0, 0.0) * np.ones((40, 1))
    sigma = np.where(height > 0, 100 * UNCERTAIN, UNCERTAIN)
    assert medians(height, sigma).max() == 0.0
    assert medians(height, sigma[:, ::-1]).min() == 10.0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_every_height_is_one_of_its_window(seed):
    rng = np.random.default_rng(seed)
    height, sigma = rng.normal(0, 5, (12, 12)).astype(np.float32), rng.lognormal(1, 1, (12, 12))
    found = medians(height, sigma)
    for row, col in np.ndindex(found.shape):
        rows, cols = (slice(max(i - RADIUS, 0), i + RADIUS + 1) for i in (row, col))
        assert found[row, col] in height[rows, cols]
