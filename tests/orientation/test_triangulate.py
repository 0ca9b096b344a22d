"""Ground points from image points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orientation_scenes import AffineSensor, observe, random_ground
from zlocus.orientation.triangulate import Observations, triangulate

EXACT_M = 1e-6
EXACT_PX = 1e-7


@dataclass(frozen=True)
class Pinhole:
    """A frame camera that looks straight down: far from linear at low heights."""

    x: float
    height: float = 300.0
    focal_px: float = 1000.0

    def image_from_ground(self, xyz):
        depth = self.height - xyz[:, 2]
        return np.column_stack([(xyz[:, 0] - self.x) / depth, -xyz[:, 1] / depth]) * self.focal_px


@given(st.floats(-0.5, 0.5), st.floats(0.05, 0.5), st.floats(-180, 180))
def test_affine_rays_meet_exactly(east, north, turn_deg):
    sensors = [AffineSensor(0.0, 0.0), AffineSensor(east, north, (3.0, 5.0), turn_deg)]
    xyz = random_ground(40)
    found = triangulate(sensors, observe(sensors, xyz), xyz + np.array([5.0, -3.0, 40.0]))
    assert np.abs(found.xyz - xyz).max() < EXACT_M
    assert np.abs(found.residual).max() < EXACT_PX


def test_frame_cameras_converge_from_a_far_start():
    sensors = [Pinhole(-60.0), Pinhole(0.0), Pinhole(60.0)]
    xyz = random_ground(50)
    found = triangulate(sensors, observe(sensors, xyz), xyz * np.array([1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 100.0]))
    assert np.abs(found.xyz - xyz).max() < 1e-4


def test_height_precision_is_that_of_the_geometry():
    parallax = 0.4
    sensors = [AffineSensor(-parallax / 2, 0.0), AffineSensor(parallax / 2, 0.0)]
    found = triangulate(sensors, observe(sensors, random_ground(5)), random_ground(5))
    per_pixel = np.sqrt(2.0) * 0.5 / parallax  # two positions of half-metre pixels, over the parallax per metre
    assert found.sigma_z == pytest.approx(np.full(5, per_pixel), rel=1e-6)


def test_precision_matches_the_scatter_of_noisy_heights():
    sensors = [AffineSensor(-0.2, 0.0), AffineSensor(0.05, 0.1), AffineSensor(0.2, 0.0)]
    xyz = random_ground(4000)
    found = triangulate(sensors, observe(sensors, xyz, noise_px=0.3), xyz)
    assert np.std(found.xyz[:, 2] - xyz[:, 2]) == pytest.approx(0.3 * found.sigma_z[0], rel=0.05)


def test_one_ray_or_parallel_rays_fix_no_point():
    sensors = [AffineSensor(0.1, 0.0), AffineSensor(0.1, 0.0), AffineSensor(-0.1, 0.0)]
    view, point = np.array([0, 1, 0, 0, 2]), np.array([0, 0, 1, 2, 2])
    xyz = random_ground(3)
    xy = np.concatenate([sensors[v].image_from_ground(xyz[p : p + 1]) for v, p in zip(view, point, strict=True)])
    found = triangulate(sensors, Observations(view, point, xy), xyz)
    assert np.isnan(found.xyz[:2]).all()
    assert np.abs(found.xyz[2] - xyz[2]).max() < EXACT_M


def test_weights_decide_between_disagreeing_rays():
    sensors = [AffineSensor(-0.2, 0.0), AffineSensor(0.0, 0.0), AffineSensor(0.2, 0.0)]
    xyz = random_ground(30)
    seen = observe(sensors, xyz)
    wrong = seen.view == 1
    seen.xy[wrong] += 50.0
    found = triangulate(sensors, seen, xyz, np.where(wrong, 0.0, 1.0))
    assert np.abs(found.xyz - xyz).max() < EXACT_M
    assert np.abs(found.residual[wrong] - 50.0).max() < EXACT_M
