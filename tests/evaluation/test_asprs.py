"""Accuracy by the ASPRS standard, edition 2: a table that was worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zlocus.evaluation.asprs import horizontal_accuracy, vertical_accuracy

# The numbers by hand are rounded to a hundredth of a millimetre.
ROUNDED_M = 0.5e-5


def test_vertical_accuracy_worked_by_hand():
    # Errors of 6, -6, 2 and -2 cm: squares 36 + 36 + 4 + 4 = 80 cm2, mean 20, root 4.47214 cm.
    # Points known to 2 cm: √(20 + 4) = 4.89898 cm. LE90: 1.6449 x 4.89898 = 8.05833 cm.
    nva = vertical_accuracy(np.array([0.06, -0.06, 0.02, -0.02]), np.full(4, 0.02))
    assert (nva.n, nva.n_compared, nva.is_enough) == (4, 4, False)
    assert nva.rmse_v1 == pytest.approx(0.0447214, abs=ROUNDED_M)
    assert nva.rmse_v2 == pytest.approx(0.02, abs=ROUNDED_M)
    assert nva.rmse_v == pytest.approx(0.0489898, abs=ROUNDED_M)
    assert nva.le90 == pytest.approx(0.0805833, abs=ROUNDED_M)
    assert nva.mean == pytest.approx(0.0, abs=ROUNDED_M)
    # Errors of 30, -10 and 20 cm: squares 900 + 100 + 400 = 1400, mean 466.667, root 21.60247 cm.
    # Points known to 2, 4 and 4 cm: mean square (4 + 16 + 16) / 3 = 12; √(466.667 + 12) = 21.87846 cm. A fourth point,
    # where the surface has no height, counts in n alone.
    vva = vertical_accuracy(np.array([0.3, -0.1, 0.2, np.nan]), np.array([0.02, 0.04, 0.04, 9.0]))
    assert (vva.n, vva.n_compared) == (4, 3)
    assert vva.rmse_v1 == pytest.approx(0.2160247, abs=ROUNDED_M)
    assert vva.rmse_v2 == pytest.approx(math.sqrt(12) / 100, abs=ROUNDED_M)
    assert vva.rmse_v == pytest.approx(0.2187846, abs=ROUNDED_M)
    assert vva.mean == pytest.approx(0.4 / 3, abs=ROUNDED_M)


def test_points_of_unknown_accuracy_are_said_to_be():
    found = vertical_accuracy(np.array([0.03, -0.04]), np.array([0.02, np.nan]))
    assert math.isnan(found.rmse_v2)
    assert found.rmse_v == found.rmse_v1
    assert found.as_dict()["rmse_v2"] is None
    nothing = vertical_accuracy(np.array([np.nan]), np.array([0.02]))
    assert (nothing.n, nothing.n_compared) == (1, 0)
    assert math.isnan(nothing.rmse_v)


@pytest.mark.parametrize(("n", "is_enough"), [(29, False), (30, True)])
def test_thirty_points_are_enough(n, is_enough):
    assert vertical_accuracy(np.full(n, 0.1), np.full(n, np.nan)).is_enough is is_enough
    assert vertical_accuracy(np.append(np.full(n, 0.1), np.nan), np.zeros(n + 1)).is_enough is is_enough


def test_horizontal_accuracy_worked_by_hand():
    # x: 3, -3, 1, -1 cm: mean square 5; y: 4, 4, -2, -2 cm: mean square 10. RMSE_H1 = √15 = 3.87298 cm.
    # Points known to 1 cm in x and in y: RMSE_H2 = √2 cm; RMSE_H = √(15 + 2) = 4.12311 cm.
    # CE90: 2.1460 x (√6 + √11) / 2 = 2.1460 x (2.44949 + 3.31662) / 2 = 6.18703 cm.
    errors = np.array([[0.03, 0.04], [-0.03, 0.04], [0.01, -0.02], [-0.01, -0.02], [np.nan, np.nan]])
    found = horizontal_accuracy(errors, np.full(5, 0.01))
    assert found.n == 4
    assert found.rmse_x == pytest.approx(0.0223607, abs=ROUNDED_M)
    assert found.rmse_y == pytest.approx(0.0316228, abs=ROUNDED_M)
    assert found.rmse_h1 == pytest.approx(0.0387298, abs=ROUNDED_M)
    assert found.rmse_h2 == pytest.approx(0.0141421, abs=ROUNDED_M)
    assert found.rmse_h == pytest.approx(0.0412311, abs=ROUNDED_M)
    assert found.ce90 == pytest.approx(0.0618703, abs=ROUNDED_M)
    assert found.mean_y == pytest.approx(0.01, abs=ROUNDED_M)
    long = horizontal_accuracy(np.array([[0.1, 0.01], [-0.1, 0.01]]), np.full(2, np.nan))
    assert math.isnan(long.ce90)
    assert long.as_dict()["ce90"] is None
    assert horizontal_accuracy(np.full((3, 2), np.nan), np.zeros(3)) is None


def test_ce90_and_le90_hold_nine_in_ten_normal_errors():
    rng = np.random.default_rng(0)
    errors = rng.normal(0, 0.2, (400_000, 2))
    unknown = np.full(len(errors), np.nan)
    inside = np.hypot(*errors.T) < horizontal_accuracy(errors, unknown).ce90
    # Of so many, the share has a standard deviation of 0.0005.
    assert inside.mean() == pytest.approx(0.9, abs=0.002)
    below = np.abs(errors[:, 0]) < vertical_accuracy(errors[:, 0], unknown).le90
    assert below.mean() == pytest.approx(0.9, abs=0.002)
