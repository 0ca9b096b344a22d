"""Uncertainty of fits: independent and correlated scores, areas and passes."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.evaluation.fit_uncertainty import areas, covariance_of, passes

N = 4000


def mean_of(residuals, relative, time_s=None):
    """Standard deviation of a mean by its scores, and the number of groups."""
    time_s = np.full(len(residuals), np.nan) if time_s is None else time_s
    covariance, n = covariance_of(residuals[:, None], np.array([[-float(len(residuals))]]), relative, time_s)
    return float(np.sqrt(covariance[0, 0])), n


@pytest.fixture
def relative():
    return np.random.default_rng(0).uniform(-1, 1, (N, 2))


def test_independent_residuals_give_the_usual_standard_error(relative):
    residuals = np.random.default_rng(1).normal(0, 0.5, N)
    # The largest of several estimates: areas, of which there are few, scatter by a tenth to a fifth.
    assert 0.98 * 0.5 / np.sqrt(N) < mean_of(residuals, relative)[0] < 1.5 * 0.5 / np.sqrt(N)


def test_what_an_area_has_in_common_is_not_averaged_away(relative):
    rng, area = np.random.default_rng(2), areas(relative, 6)
    common = rng.normal(0, 0.5, area.max() + 1)[area]
    sigma, _ = mean_of(common + rng.normal(0, 0.1, N), relative)
    # 36 areas: 0.5 / 6 m, known to an eighth.
    assert sigma == pytest.approx(0.5 / 6, rel=0.4)


def test_what_a_pass_has_in_common_is_not_averaged_away(relative):
    rng = np.random.default_rng(3)
    number = rng.integers(0, 20, N)
    residuals = rng.normal(0, 0.3, 20)[number] + rng.normal(0, 0.1, N)
    time_s = number * 86400.0 * 30 + rng.uniform(0, 5, N)
    assert mean_of(residuals, relative)[0] < 0.02
    sigma, n = mean_of(residuals, relative, time_s)
    assert n == 20
    assert sigma == pytest.approx(0.3 / np.sqrt(20), rel=0.5)


def test_passes_are_parted_by_time_in_any_order():
    time_s = np.array([5000.0, 0.0, 5001.0, 3.0, 1e6])
    assert passes(time_s).tolist() == [1, 0, 1, 0, 2]
