"""The kernel of frame cameras against its twin in plain NumPy, which takes any model of distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.distortion import BrownDistortion, Distortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles

POSITION_PX = 1e-9
LENS = BrownDistortion(k1=-0.26, k2=0.10, p1=7e-4, p2=3e-4, k3=-0.025)
RATIONAL = BrownDistortion(k1=0.4, k2=0.1, k3=0.02, k4=0.5, k5=0.2, k6=0.03)


@dataclass(frozen=True)
class Hidden:
    """A distortion that the kernel does not know."""

    lens: BrownDistortion | None

    def distorted(self, at: FloatArray) -> FloatArray:
        return at.copy() if self.lens is None else self.lens.distorted(at)

    def undistorted(self, at: FloatArray) -> FloatArray:
        return at.copy() if self.lens is None else self.lens.undistorted(at)


def camera(lens: Distortion | None) -> FrameModel:
    turn = rotation_from_angles(3.0, -7.0, 40.0)
    return FrameModel((10.0, 20.0, 80.0), turn, 3000.0, (2010.0, 1490.0), 1.001, 0.7, lens)


@pytest.mark.parametrize("lens", [None, LENS, RATIONAL], ids=["ideal", "drone", "rational"])
def test_images_of_rays_are_those_of_plain_numpy(lens):
    rng = np.random.default_rng(4)
    ray = rng.normal(0, 60, (4000, 3)) - (0, 0, 60)
    found = camera(lens).image_from_ray(ray)
    expected = replace(camera(lens), distortion=Hidden(lens)).image_from_ray(ray)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=POSITION_PX, equal_nan=True)
    behind = ray @ camera(lens).rotation[2] <= 0
    assert 0 < behind.sum() < len(ray)
    assert np.isnan(found[behind]).all()
    assert np.isfinite(found[~behind]).all() == (lens is None)


def test_ideal_positions_are_those_of_plain_bisection():
    """Without a tangential part a position moves along its radius, and the radius is that of a root of one equation."""
    lens, radial = replace(RATIONAL, p1=0.0, p2=0.0), np.linspace(0.0, 0.7, 200)
    low, high = np.zeros_like(radial), np.full_like(radial, lens._disc.radius)
    for _ in range(100):
        middle = (low + high) / 2
        is_below = middle * lens._radial(middle**2)[0] < radial
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    direction = np.array([0.6, -0.8])
    found = lens.undistorted(radial[:, None] * direction)
    np.testing.assert_allclose(found, low[:, None] * direction, rtol=1e-12, atol=1e-12)
    # Positions do not depend on those beside them.
    one_by_one = np.vstack([lens.undistorted(at[None]) for at in radial[:, None] * direction])
    np.testing.assert_array_equal(found, one_by_one)


def test_a_point_without_coordinates_has_no_image():
    assert np.isnan(camera(LENS).image_from_ray(np.array([[np.nan, 0.0, -50.0]]))).all()
