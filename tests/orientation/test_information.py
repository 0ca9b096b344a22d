"""Sparse information about the parameters against dense information, and large blocks against small ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from bundle_scenes import FRAME_SIZE, control_of, first_points, flawed_frames, flight_of_frames, frame_ground, seen_by
from bundle_scenes import views_of as blank_views
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.orientation import block_tridiagonal, normal_equations
from zlocus.orientation.bundle_adjustment import adjust_bundle
from zlocus.orientation.information import smallest_eigenvectors, weak_directions

OPTIONS = OrientationOptions(bundle_adjustment=BundleAdjustmentOptions(sigma_position_m=1.0, sigma_attitude_deg=0.05))
N_STRIPS, N_FRAMES = 4, 6
# Of both solutions, in units of the standard deviation of each parameter.
SAME_SIGMAS, SAME_SIGMA = 1e-4, 1e-5


def normal_of_chain(n, seed=3):
    """A normal matrix (3 n, 3 n) of n places in a row, with two directions and one parameter without information."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(n - 1):
        for _ in range(8):
            row = np.zeros(3 * n)
            row[3 * k : 3 * k + 3] = rng.normal(size=3)
            row[3 * k + 3 : 3 * k + 6] = -row[3 * k : 3 * k + 3]
            row[-1] = 0.0
            rows.append(row)
    derivatives = np.array(rows)
    return derivatives.T @ derivatives, np.sqrt((derivatives**2).sum(axis=0) * 1e-6)


@pytest.fixture(scope="module")
def both():
    normal, scale = normal_of_chain(40)
    dense, few = (weak_directions(matrix, scale, 40) for matrix in (normal, sparse.csr_array(normal)))
    return normal, dense, few


def test_weak_directions_of_a_sparse_matrix_are_those_of_the_dense_one(both):
    """The product that takes their share away is compared, because they may be turned among themselves."""
    _, dense, few = both
    assert few.n == dense.n
    assert few.n > 2
    np.testing.assert_allclose(few.ahead @ few.back.T, dense.ahead @ dense.back.T, rtol=0, atol=1e-7)


def test_a_sparse_covariance_is_the_dense_one(both):
    """With information of control besides that of the ties."""
    normal, dense, few = both
    rng = np.random.default_rng(8)
    full = normal + np.diag(rng.uniform(0.0, 2.0, len(normal)))
    variance, vector = rng.uniform(0.5, 2.0, len(normal)), rng.normal(size=len(normal))
    expected = dense.information_without(full, normal).covariance(0.3, variance)
    found = few.information_without(sparse.csr_array(full), sparse.csr_array(normal)).covariance(0.3, variance)
    np.testing.assert_allclose(found.variances, expected.variances, rtol=1e-6)
    np.testing.assert_allclose(found.times(vector), expected.times(vector), rtol=0, atol=1e-6)
    pulls = vector, vector + 1.0
    np.testing.assert_allclose(few.pull_without(*pulls), dense.pull_without(*pulls), rtol=0, atol=1e-5)


@pytest.mark.parametrize("n_small", [0, 3, 40])
def test_all_small_eigenvalues_are_found(n_small):
    """Also more equal ones than directions at first, and none."""
    rng = np.random.default_rng(n_small)
    values = np.concatenate([np.zeros(n_small), rng.uniform(0.5, 2.0, 200 - n_small)])
    turn, _ = np.linalg.qr(rng.normal(size=(200, 200)))
    matrix = turn @ np.diag(values) @ turn.T
    found = smallest_eigenvectors(sparse.csr_array((matrix + matrix.T) / 2), 1e-3)
    assert found.shape == (200, n_small)
    np.testing.assert_allclose(found @ found.T, turn[:, :n_small] @ turn[:, :n_small].T, rtol=0, atol=1e-6)


@pytest.mark.parametrize("is_controlled", [False, True])
def test_a_large_block_is_solved_as_a_small_one(monkeypatch, is_controlled):
    """The joint solution: corrections and standard deviations of all cameras, and what ties do not determine."""
    exact = flight_of_frames(N_STRIPS, N_FRAMES)
    wrong, ground = flawed_frames(exact), frame_ground(1200) * [1.3, 1.6, 1.0] + [400.0, 500.0, 0.0]
    seen, xyz = seen_by(exact, ground, FRAME_SIZE, noise_px=0.2)
    views = blank_views(wrong, FRAME_SIZE)
    control = control_of(exact, frame_ground(8, seed=21), FRAME_SIZE) if is_controlled else None
    asked = views, seen, first_points(wrong, seen, xyz), OPTIONS, control
    dense = adjust_bundle(*asked).solution
    monkeypatch.setattr(normal_equations, "MAX_DENSE_PARAMETERS", 0)
    monkeypatch.setattr(block_tridiagonal, "MIN_GROUP", 16)
    found = adjust_bundle(*asked).solution
    assert not dense.is_held.any()
    assert found.n_determined == dense.n_determined == 6 * N_STRIPS * N_FRAMES - 7
    np.testing.assert_array_equal(found.is_held, dense.is_held)
    np.testing.assert_allclose(found.parameter_sigma, dense.parameter_sigma, rtol=SAME_SIGMA)
    assert np.abs((found.parameters - dense.parameters) / dense.parameter_sigma).max() < SAME_SIGMAS
    assert found.sigma0_px == pytest.approx(dense.sigma0_px, rel=SAME_SIGMA)
