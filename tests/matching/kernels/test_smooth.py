"""Smoothing of surfaces and their slopes, against the slow twin and by hand."""

from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import rough_surface
from reference import surfaces
from zlocus.matching.kernels.smooth import add_tap, slopes, smaller_slope, smooth_surface

STEPS = 1e-4


def slopes_of(surface, reach=2):
    by_row, by_col = np.empty_like(surface), np.empty_like(surface)
    slopes(surface, reach, by_row, by_col)
    return by_row, by_col


@pytest.mark.parametrize(("spacing", "jump"), [(1, 3.0), (2, 4.0), (8, 50.0)])
def test_smoothing(spacing, jump):
    surface = rough_surface((23, 31), high=6.0) + 100
    by_row, by_col = slopes_of(surface)
    out = np.empty_like(surface)
    smooth_surface(surface, by_row, by_col, spacing, np.float32(jump), out)
    expected = surfaces.smoothed(*(v.astype(float) for v in (surface, by_row, by_col)), spacing, jump)
    np.testing.assert_allclose(out, expected, rtol=0, atol=STEPS)


def test_the_smaller_slope():
    for before, after, expected in (
        (1, 2, 1), (2, 1, 1), (-3, -2, -2), (-2, -3, -2), (1, -1, 0), (-1, 1, 0), (0, 5, 0), (5, 0, 0),
    ):  # fmt: skip
        assert smaller_slope(np.float32(before), np.float32(after)) == expected


def test_one_neighbour_of_a_row():
    """A neighbour two rows down and one column left, 0.3 of the weight; beyond the jump of 4 it counts for nothing."""
    rng = np.random.default_rng(2)
    centre, other, by_row, by_col = rng.normal(0, 2, (4, 40)).astype(np.float32)
    total, weight = np.ones(40, np.float32), np.full(40, 0.5, np.float32)
    add_tap(centre, other, by_row, by_col, np.array([0.3, 2, -1], np.float32), np.float32(0.25), total, weight)
    away = other - centre - 2 * by_row + by_col
    expected = np.where(np.abs(away) < 4, 0.3 * (1 - (away / 4) ** 2) ** 2, 0)
    assert 0 < (expected == 0).sum() < 40
    np.testing.assert_allclose(weight, 0.5 + expected, rtol=0, atol=STEPS)
    np.testing.assert_allclose(total, 1 + expected * away, rtol=0, atol=STEPS)


@pytest.mark.parametrize("reach", [1, 2])
def test_slopes(reach):
    surface = rough_surface((17, 22), high=6.0)
    for axis, found in enumerate(slopes_of(surface, reach)):
        np.testing.assert_allclose(found, surfaces.slope(surface.astype(float), reach, axis), rtol=0, atol=STEPS)


def test_smoothing_keeps_planes_and_jumps():
    row, col = np.indices((20, 30))
    surface = (0.2 * row + 0.1 * col + 10.0 * (col >= 15)).astype(np.float32)
    out = np.empty_like(surface)
    smooth_surface(surface, *slopes_of(surface, 1), 1, np.float32(3.0), out)
    np.testing.assert_allclose(out[3:-3, 3:12], surface[3:-3, 3:12], rtol=0, atol=STEPS)
    assert np.abs(out - surface)[3:-3, 3:-3].max() < 0.5
