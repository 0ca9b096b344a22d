"""Errors of differences from unchanged ground: offset, size, correlation, and a calibrated significance."""

from __future__ import annotations

import numpy as np
import pytest

from overlapping_surfaces import noise
from zlocus.evaluation.change_noise import Correlation, StableWindow, change_noise, fitted_correlation

CELL_M = 0.5
SIDE = 256


def windows_of(difference, sigma=0.2, side=128):
    """A raster of differences in windows, on level ground."""
    found = []
    for row in range(0, difference.shape[0], side):
        for col in range(0, difference.shape[1], side):
            part = difference[row : row + side, col : col + side]
            level = np.zeros((*part.shape, 2))
            found.append(StableWindow(row, col, part, np.full(part.shape, sigma), level))
    return found


def test_offset_and_size():
    rng = np.random.default_rng(0)
    d = 0.3 + 0.5 * noise(rng, (SIDE, SIDE), 0)
    found = change_noise(windows_of(d), CELL_M, is_known=True)
    assert found.offset_m == pytest.approx(0.3, abs=0.01)
    assert found.scale == pytest.approx(2.5, rel=0.02)
    assert found.offset_sigma_m == pytest.approx(0.5 / SIDE, rel=1.0)
    assert found.sigma(np.array([0.2]))[0] == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("is_known", [True, False])
def test_unchanged_ground_is_called_changed_as_often_as_is_asked_for(is_known):
    """Also where errors have heavier tails than normal ones; without known ground they are seen in part only."""
    rng = np.random.default_rng(1)
    d = 0.2 * rng.standard_t(5, (SIDE, SIDE))
    found = change_noise(windows_of(d), CELL_M, is_known)
    share = np.mean(np.abs(found.significance(d, np.full(d.shape, 0.2))) > 1.96)
    assert share == pytest.approx(0.05, abs=0.002 if is_known else 0.02)


def test_change_of_a_tenth_of_the_ground_hides_nothing():
    rng = np.random.default_rng(2)
    d = 0.2 * rng.normal(size=(SIDE, SIDE))
    changed = np.zeros(d.shape, bool)
    changed[: SIDE // 10] = True
    d[changed] += 2.0
    found = change_noise(windows_of(d), CELL_M, is_known=False)
    size = found.significance(d, np.full(d.shape, 0.2))
    assert np.mean(size[changed] > 1.96) > 0.99
    assert np.mean(np.abs(size[~changed]) > 1.96) < 0.06


def test_significance_keeps_its_sign_and_order():
    rng = np.random.default_rng(3)
    found = change_noise(windows_of(rng.normal(size=(SIDE, SIDE))), CELL_M, is_known=True)
    d = np.linspace(-30.0, 30.0, 301)
    size = found.significance(d, np.full(d.shape, 0.2))
    assert (np.diff(size) > 0).all()
    kept = found.significance(d, np.full(d.shape, 0.2), is_removed=False)
    assert np.abs(kept[d == 0.0]).max() == 0.0


@pytest.mark.parametrize("reach_cells", [2.0, 6.0])
def test_the_reach_of_correlated_errors(reach_cells):
    """The area over which errors count as one is that of the planted ones: 4 pi reach^2 of a Gaussian filter."""
    rng = np.random.default_rng(4)
    d = 0.2 * noise(rng, (2 * SIDE, 2 * SIDE), reach_cells)
    found = fitted_correlation(windows_of(d), 0.0, 1.0, CELL_M)
    true_m2 = 4.0 * np.pi * (reach_cells * CELL_M) ** 2
    assert found.area_m2 == pytest.approx(true_m2, rel=0.35)
    assert found.shares.sum() > 0.9


def test_independent_errors_have_no_reach():
    rng = np.random.default_rng(5)
    found = fitted_correlation(windows_of(rng.normal(size=(SIDE, SIDE))), 0.0, 5.0, CELL_M)
    assert found.area_m2 < 2.0 * CELL_M**2
    assert found.at(np.array([0.0]))[0] == 1.0
    assert found.at(np.array([CELL_M]))[0] < 0.05


def test_a_spherical_model():
    one = Correlation(np.array([0.8]), np.array([10.0]))
    assert one.at(np.array([0.0, 5.0, 10.0, 99.0])) == pytest.approx([1.0, 0.8 * 0.3125, 0.0, 0.0])
    # The integral over the plane, by a fine sum.
    r = np.arange(5e-4, 10.0, 1e-3)
    assert one.area_m2 == pytest.approx((2.0 * np.pi * r * one.at(r)).sum() * 1e-3, rel=1e-4)


def test_gross_errors_are_told_apart():
    """Patches of 10 x 10 cells of 3 m, one in each block of 64 x 64: the variance of their sums."""
    rng = np.random.default_rng(7)
    d = 0.2 * rng.normal(size=(SIDE, SIDE))
    for row in range(20, SIDE, 64):
        for col in range(20, SIDE, 64):
            d[row - 15 : row - 5, col - 15 : col - 5] = 3.0 * rng.choice([-1.0, 1.0])
    found = change_noise(windows_of(d), CELL_M, is_known=True)
    assert found.scale == pytest.approx(1.0, rel=0.03)
    assert found.mismatch_m2 == pytest.approx((100 * 3.0) ** 2 / 64**2, rel=0.03)
    assert change_noise(windows_of(d), CELL_M, is_known=False).mismatch_m2 == 0.0


def test_a_shift_in_plan_is_seen_on_slopes():
    """A surface that lies 0.4 m to the east of another one, on hills."""
    rng = np.random.default_rng(6)
    slope = 0.3 * np.stack([noise(rng, (SIDE, SIDE), 8.0), noise(rng, (SIDE, SIDE), 8.0)], axis=-1)
    d = -0.4 * slope[..., 0] + 0.1 * slope[..., 1] + 0.05 * rng.normal(size=(SIDE, SIDE))
    window = StableWindow(0, 0, d, np.full(d.shape, 0.1), slope)
    found = change_noise([window], CELL_M, is_known=True)
    assert found.shift_m == pytest.approx((0.4, -0.1), abs=0.01)
    assert found.is_shift_clear


def test_heights_that_are_the_same_tell_nothing_of_the_others():
    d = np.zeros((SIDE, SIDE))
    d[:20] = 0.1
    found = change_noise(windows_of(d), CELL_M, is_known=False)
    assert found.scale == 1.0
    assert found.significance(np.array([0.1]), np.array([0.2]))[0] == pytest.approx(0.5, abs=0.02)
