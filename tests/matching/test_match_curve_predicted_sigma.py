"""Predicted standard deviation of the peak of a mean match curve."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.matching.match_curve import predicted_sigma


def bump(rho=0.9, bend=0.1, n=9):
    """A parabola of correlations: rho - bend k^2 / 2 around the middle."""
    k = np.arange(n) - n // 2
    return (rho - 0.5 * bend * k**2)[None]


def test_predicted_sigma_is_the_formula():
    """sqrt(2 (1 - rho) / (c N m)) = sqrt(2 x 0.1 / (0.1 x 25 x 2)) = 0.2."""
    found = predicted_sigma(bump(), np.full((1, 9), 2), 25)
    assert found.tolist() == pytest.approx([0.2])
    assert predicted_sigma(bump(rho=1.0), np.full((1, 9), 2), 25)[0] == 0.0


def test_predicted_sigma_falls_with_images_curvature_window_and_correlation():
    one = np.ones((1, 9), int)
    base = predicted_sigma(bump(), one, 25)[0]
    assert predicted_sigma(bump(), 4 * one, 25)[0] == pytest.approx(base / 2)
    assert predicted_sigma(bump(bend=0.4), one, 25)[0] == pytest.approx(base / 2)
    assert predicted_sigma(bump(), one, 100)[0] == pytest.approx(base / 2)
    assert predicted_sigma(bump(rho=0.95), one, 25)[0] == pytest.approx(base / 2**0.5)


def test_images_count_where_the_peak_is():
    count = np.ones((1, 9), int)
    count[0, 4] = 4
    assert predicted_sigma(bump(), count, 25)[0] == pytest.approx(predicted_sigma(bump(), 4 + 0 * count, 25)[0])


def test_predicted_sigma_is_infinite_without_two_sides():
    count = np.ones((1, 9), int)
    for gap in (3, 5):
        curve = bump()
        curve[0, gap] = np.nan
        assert predicted_sigma(curve, count, 25)[0] == np.inf
    even = np.full((1, 9), 0.5)
    assert predicted_sigma(even, count, 25)[0] == np.inf
    assert predicted_sigma(np.full((1, 9), np.nan), count, 25)[0] == np.inf


def test_predicted_sigma_of_a_peak_at_an_end_is_infinite():
    """The curve still rises where the range ends: the peak has one side."""
    rising = bump()[:, :5]
    for curve in (rising, rising[:, ::-1]):
        assert predicted_sigma(curve, np.ones((1, 5), int), 25)[0] == np.inf
