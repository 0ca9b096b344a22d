"""Derivatives and reduced normal equations against dense twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import (
    AFFINE_SIZE,
    FRAME_SIZE,
    SCAN_COLUMNS,
    SCAN_ROWS,
    affine_sensors,
    control_of,
    flawed_frames,
    flight_of_frames,
    frame_ground,
    scan_ground,
    seen_by,
    strips_of_lines,
    views_of,
)
from orientation_scenes import random_ground
from reference.bundle_adjustment import dense_jacobians, dense_reduced
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.orientation.bundle_adjustment import problem_of
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.normal_equations import ground_information, linearise, reduced, weights
from zlocus.orientation.parameter_groups import parameter_groups_of
from zlocus.orientation.self_calibration import calibration_groups
from zlocus.orientation.triangulate import project_points
from zlocus.sensors.rolling_shutter import RollingShutter

OPTIONS = OrientationOptions(
    bundle_adjustment=BundleAdjustmentOptions(
        self_calibration=("all",), sigma_focal_px=10.0, rpc_correction="affine", drift_knot_interval_s=20.0
    )
)
# Of the largest derivative: one-sided differences over a twentieth of a sigma.
DERIVATIVES = 2e-3


def problems(kind, n=40, control=None, terrain=None):
    """A small problem of one kind of sensor, with parameters that are not zero."""
    if kind == "frame":
        motion = RollingShutter(0.03, (50.0, 0.0, 0.0), FRAME_SIZE[1])
        sensors = [replace(camera, rolling_shutter=motion) for camera in flight_of_frames(1, 3)]
        xyz, size = frame_ground(n), FRAME_SIZE
    elif kind == "linescan":
        sensors, xyz, size = strips_of_lines((0.0,)), scan_ground(n), (SCAN_COLUMNS, SCAN_ROWS)
    else:
        sensors, xyz, size = affine_sensors(), random_ground(n), AFFINE_SIZE
    seen, xyz = seen_by(sensors, xyz, size, noise_px=0.3)
    views = views_of(sensors, size)
    groups = (*parameter_groups_of(views, OPTIONS), *calibration_groups(views, OPTIONS))
    problem = problem_of(tuple(sensors), groups, seen, xyz, OPTIONS, control or GroundControl.none(), terrain)
    parameters = np.random.default_rng(2).normal(0.0, 0.5, problem.n_parameters)
    return problem, parameters, np.concatenate([xyz, problem.control_xyz])


@pytest.mark.parametrize("kind", ["frame", "linescan", "rpc"])
def test_derivatives_are_those_of_central_differences(kind):
    problem, parameters, xyz = problems(kind)
    linear = linearise(problem, parameters, xyz)
    by_parameters, by_ground = dense_jacobians(problem, parameters, xyz)
    assert linear.usable.all()
    largest = np.abs(by_parameters).max(axis=0)
    assert (largest > 0).all()
    assert (np.abs(linear.by_parameters.toarray() - by_parameters) / largest).max() < DERIVATIVES
    rows = np.arange(len(problem.observations))
    own = by_ground.reshape(len(rows), 2, -1, 3)[rows, :, problem.observations.point]
    assert np.abs(linear.by_ground - own).max() / np.abs(own).max() < DERIVATIVES


@pytest.mark.parametrize("known", [False, True])
def test_reduced_normal_equations_are_the_dense_ones(known):
    heights = TerrainHeights(np.add.outer(np.linspace(0, 90, 40), np.linspace(0, 30, 40)), -1950.0, 1950.0, 100.0)
    control = control_of(flight_of_frames(1, 3), frame_ground(4, seed=8), FRAME_SIZE) if known else None
    problem, parameters, xyz = problems("frame", control=control, terrain=heights if known else None)
    linear = linearise(problem, parameters, xyz)
    residual = problem.observations.xy - project_points(problem.sensors, problem.observations, xyz)
    sigma, weight = weights(problem, residual, linear)
    ground = ground_information(problem, xyz, sigma)
    found = reduced(problem, linear, residual, weight, ground)
    by_parameters = linear.by_parameters.toarray()
    by_ground = np.zeros((len(problem.observations), 2, len(xyz), 3))
    by_ground[np.arange(len(problem.observations)), :, problem.observations.point] = linear.by_ground
    by_ground = by_ground.reshape(2 * len(problem.observations), -1)
    normal, pull = dense_reduced(by_parameters, by_ground, weight, residual, ground.precision, ground.pull)
    np.testing.assert_allclose(found.normal, normal, rtol=0, atol=1e-9 * np.abs(normal).max())
    np.testing.assert_allclose(found.pull, pull, rtol=0, atol=1e-8 * np.abs(by_parameters.T @ residual.ravel()).max())


def test_what_is_known_of_the_ground_is_the_gradient_of_its_misfit():
    """Pull is minus half the gradient of the weighted squares, precision half their second derivative, within Huber's
    bounds."""
    heights = TerrainHeights(np.add.outer(np.linspace(0, 9, 40), np.linspace(0, 30, 40)), -1950.0, 1950.0, 100.0)
    problem, _, xyz = problems("frame", n=10, terrain=heights)
    xyz[:, 2] = heights.at(xyz[:, :2])[0] + np.linspace(-5.0, 5.0, len(xyz))
    ground = ground_information(problem, xyz, sigma=1.0)

    def squares(at):
        off = at[:, 2] - heights.at(at[:, :2])[0]
        return off**2 / problem.terrain_m**2

    for axis in np.eye(3):
        step = 0.01 * axis
        slope = (squares(xyz + step) - squares(xyz - step)) / 0.02
        np.testing.assert_allclose(ground.pull @ axis, -slope / 2, rtol=0, atol=1e-6)
        bend = (squares(xyz + step) - 2 * squares(xyz) + squares(xyz - step)) / 1e-4
        np.testing.assert_allclose(ground.precision @ axis @ axis, bend / 2, rtol=0, atol=1e-6)


def test_heights_far_from_the_terrain_pull_no_harder():
    flat = TerrainHeights(np.zeros((40, 40)), -1950.0, 1950.0, 100.0)
    problem, _, xyz = problems("frame", n=10, terrain=flat)
    near, far = (
        ground_information(problem, np.where([False, False, True], height, xyz), 1.0).pull[:, 2]
        for height in (6.0, 500.0)
    )
    assert np.abs(far).max() <= 1.01 * 1.5 / problem.terrain_m
    assert np.abs(near).max() < np.abs(far).max()
    beyond = replace(problem, terrain=TerrainHeights(np.zeros((2, 2)), 1e6, 1e6, 1.0))
    assert not ground_information(beyond, xyz, 1.0).precision.any()


def test_points_without_distinct_rays_say_nothing():
    """A tie seen by one image alone would fix that camera, as if its ground point were known."""
    exact = flight_of_frames(1, 3)
    seen, xyz = seen_by(exact, frame_ground(60), FRAME_SIZE)
    first = np.flatnonzero(seen.point == 0)[0]
    lonely = seen.kept((seen.point != 0) | (np.arange(len(seen)) == first))
    flawed = tuple(flawed_frames(exact))
    groups = parameter_groups_of(views_of(flawed, FRAME_SIZE), OPTIONS)
    problem = problem_of(flawed, groups, lonely, xyz, OPTIONS, GroundControl.none(), None)
    linear = linearise(problem, np.zeros(problem.n_parameters), xyz)
    residual = lonely.xy - project_points(flawed, lonely, xyz)
    weight = np.ones(len(lonely)), (lonely.point > 0).astype(float)
    with_it, without_it = (reduced(problem, linear, residual, w, None) for w in weight)
    np.testing.assert_allclose(with_it.normal, without_it.normal, rtol=1e-12, atol=0)
    np.testing.assert_allclose(with_it.pull, without_it.pull, rtol=1e-12, atol=0)
    assert not with_it.covariance[0].any()
