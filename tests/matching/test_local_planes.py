"""Heights smoothed by local planes: analytic surfaces, a slow twin, and independence of cells far away."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zlocus.matching.kernels.local_planes import MAX_MISFIT, MIN_KNOWN_SHARE
from zlocus.matching.local_planes import (
    MAX_MOVE_SIGMAS,
    mean_of_planes,
    smoothed_by_planes,
)

SIDES = (5, 9, 17)
WHOLE = (slice(None), slice(None))
NOISE_STEPS = 0.3
# Heights of neighbouring cells err alike, so that they differ from each other by less than their standard deviations.
SIGMA_STEPS = 0.4
# Noise of heights that a plane through 17 x 17 cells leaves, a tenth of it, and a margin.
SMOOTH_STEPS = 0.15 * NOISE_STEPS
ROUNDING_STEPS = 1e-4


def slope(shape, by_row=0.21, by_col=-0.13):
    row, col = np.mgrid[: shape[0], : shape[1]]
    return (40.0 + by_row * row + by_col * col).astype(np.float32)


def smooth(height, sigma=SIGMA_STEPS, is_known=None, sides=SIDES):
    sigma = np.broadcast_to(np.float32(sigma), height.shape).copy()
    is_known = np.ones(height.shape, bool) if is_known is None else is_known
    return smoothed_by_planes(height.astype(np.float32), sigma, is_known, WHOLE, sides).height


def noise(shape, seed=0):
    return np.random.default_rng(seed).normal(0, NOISE_STEPS, shape).astype(np.float32)


def test_a_plane_is_not_changed_and_its_noise_is_removed():
    exact = slope((90, 110))
    np.testing.assert_allclose(smooth(exact), exact, rtol=0, atol=ROUNDING_STEPS)
    inner = (slice(20, -20), slice(20, -20))
    error = (smooth(exact + noise(exact.shape)) - exact)[inner]
    assert np.sqrt(np.mean(error**2)) < SMOOTH_STEPS


def test_an_edge_stays_sharp_and_both_its_sides_are_smoothed():
    """A roof of 8 steps on a slope: no cell takes heights from the other side of its edge."""
    exact = slope((80, 80))
    exact[30:55, 20:60] += 8.0
    error = smooth(exact + noise(exact.shape, 1)) - exact
    assert np.abs(error).max() < MAX_MOVE_SIGMAS * SIGMA_STEPS + 4 * NOISE_STEPS
    beside = np.zeros(exact.shape, bool)
    beside[29:31, 25:55] = True
    assert np.sqrt(np.mean(error[beside] ** 2)) < 0.7 * NOISE_STEPS


def test_relief_above_the_standard_deviation_stays():
    """Waves of 1.5 steps in 12 cells, which are noise where heights are uncertain, and relief where they are not."""
    col = np.arange(96)
    waves = slope((60, 96)) + np.float32(1.5) * np.sin(2 * np.pi * col / 12).astype(np.float32)
    np.testing.assert_allclose(smooth(waves, 0.1), waves, rtol=0, atol=0.1)
    assert np.std((smooth(waves, 2.0) - slope((60, 96)))[20:40, 20:76]) < 0.3


def test_uncertain_heights_are_no_part_of_the_ground():
    """A crown whose heights are uncertain, of a smaller part of the cells than the median: its heights stay."""
    height, sigma = slope((60, 60)), np.full((60, 60), 0.3, np.float32)
    height[25:37, 25:37] += 9.0
    sigma[25:37, 25:37] = 8.0
    found = smooth(height, sigma)
    assert np.abs(found - height).max() < MAX_MOVE_SIGMAS * 2 * 0.3
    np.testing.assert_allclose(found[28:34, 28:34], height[28:34, 28:34], rtol=0, atol=0.3)


def test_unknown_cells_count_for_nothing_and_stay():
    height = slope((60, 70)) + noise((60, 70), 2)
    is_known = np.random.default_rng(3).random(height.shape) < 0.85
    is_known[:, 50:] = False
    wild = np.where(is_known, height, np.random.default_rng(4).uniform(-1e6, 1e6, height.shape)).astype(np.float32)
    found, other = smooth(wild, is_known=is_known), smooth(np.where(is_known, height, 0), is_known=is_known)
    np.testing.assert_array_equal(found[~is_known], wild[~is_known])
    np.testing.assert_allclose(found[is_known], other[is_known], rtol=0, atol=ROUNDING_STEPS)
    error = (found - slope((60, 70)))[20:40, 15:35][is_known[20:40, 15:35]]
    assert np.sqrt(np.mean(error**2)) < 1.5 * SMOOTH_STEPS
    nothing = np.zeros(height.shape, bool)
    np.testing.assert_array_equal(smooth(height, is_known=nothing), height)
    np.testing.assert_array_equal(smooth(height, sides=()), height)


def test_heights_do_not_depend_on_cells_far_away():
    height, sigma = slope((150, 60)) + noise((150, 60), 5), np.full((150, 60), SIGMA_STEPS, np.float32)
    is_known, reach = np.ones(height.shape, bool), 2 * (SIDES[-1] // 2)
    whole = smooth(height)
    part = smoothed_by_planes(height[30:120], sigma[30:120], is_known[30:120], WHOLE, SIDES).height
    np.testing.assert_allclose(part[reach:-reach], whole[30 + reach : 120 - reach], rtol=0, atol=ROUNDING_STEPS)


def twin_of_one_side(height, sigma, is_known, side):
    """The mean of the kept planes that hold each cell, window by window."""
    rows, cols, half = *height.shape, side // 2
    total, weights = np.zeros(height.shape), np.zeros(height.shape)
    for r in range(rows):
        for c in range(cols):
            box = slice(max(r - half, 0), r + half + 1), slice(max(c - half, 0), c + half + 1)
            known = is_known[box]
            if known.sum() < MIN_KNOWN_SHARE * side * side:
                continue
            row, col = (places[box] for places in np.mgrid[:rows, :cols])
            design = np.stack([np.ones(known.sum()), row[known], col[known]], axis=1)
            z, s = height[box][known].astype(float), sigma[box][known].astype(float)
            plane, *_ = np.linalg.lstsq(design / s[:, None], z / s, rcond=None)
            misfit = np.mean(((design @ plane - z) / s) ** 2)
            if misfit < MAX_MISFIT:
                weights[box] += 1 / (1 + misfit)
                total[box] += (plane[0] + plane[1] * row + plane[2] * col) / (1 + misfit)
    return np.where(weights > 0, total / np.maximum(weights, 1e-9), np.nan)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_planes_are_those_of_the_twin(seed):
    rng = np.random.default_rng(seed)
    height = slope((19, 23)) + rng.normal(0, 0.5, (19, 23)).astype(np.float32)
    height[8:, 12:] += np.float32(rng.uniform(0, 6))
    sigma = rng.uniform(0.3, 1.2, height.shape).astype(np.float32)
    is_known = rng.random(height.shape) < 0.9
    found = mean_of_planes(height, sigma, is_known, 5)
    expected = twin_of_one_side(height, sigma, is_known, 5)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING_STEPS)


@pytest.mark.parametrize("side", [5, 17])
def test_no_plane_where_a_window_has_few_heights(side):
    is_known = np.zeros((40, 40), bool)
    is_known[:, ::2] = True
    assert np.isnan(mean_of_planes(slope((40, 40)), np.ones((40, 40), np.float32), is_known, side)).all()


def test_each_height_tells_the_windows_that_it_came_from():
    height = slope((70, 70)) + noise((70, 70), 6)
    height[:, 50:] += 9.0
    sigma, is_known = np.full((70, 70), SIGMA_STEPS, np.float32), np.ones((70, 70), bool)
    is_known[:8] = False
    found = smoothed_by_planes(height, sigma, is_known, WHOLE, SIDES)
    assert set(np.unique(found.side)) <= {0, *SIDES}
    assert (found.side[30:40, 10:20] == SIDES[-1]).all()
    np.testing.assert_array_equal(found.height[found.side == 0], height[found.side == 0])
    assert (found.side[~is_known] == 0).all()
