"""Sensor models over the pixels of a reference image: against the composition by hand, and there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rendered_scenes import UTM, camera
from zlocus.core.sensor_model import SensorModel
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.image_rays import DepthRays, HeightRays, PixelModel
from zlocus.sensors.rpc import RpcModel
from zlocus.sensors.rpc_fit import fit_rpc

SAME_PX = 1e-6
# Metres of UTM against those of the Earth.
SCALE_OF_MAPS = 1e-3
XY = np.array([[3.0, 5.0], [60.5, 80.25], [149.0, 140.0]])
PIXELS = XY * [1.0, -1.0]
HYPOTHESES = np.array([-3.0, 0.5, 12.0])


def rpc(name: str) -> RpcModel:
    return RpcModel(fit_rpc(camera(name), (150, 150), UTM, (0.0, 120.0)).rpc, UTM)


def frame(x: float, kappa: float = 0.0, phi: float = 0.0, z: float = 800.0) -> FrameModel:
    return FrameModel((x, 3.0, z), rotation_from_angles(1.0, phi, kappa), 1200.0, (75.0, 70.0))


HEIGHTS = (HeightRays(rpc("nadir"), 50.0, 0.5), rpc("fore"))
DEPTHS = (DepthRays(frame(0.0), 1200.0 * 90.0), frame(90.0, 12.0, 6.0, 700.0))
LENS = BrownDistortion(-0.1, 0.02, 4e-4, -2e-4)
REAL = [replace(model, distortion=LENS, aspect=1.02, skew=0.3) for model in (DEPTHS[0].sensor, DEPTHS[1])]
AT = [replace(model, centre=tuple(np.add(model.centre, [420_000, 4_790_000, 0]))).on_earth(UTM, UTM) for model in REAL]
LENSES = (DepthRays(REAL[0], 1200.0 * 90.0), REAL[1])
EARTH = (DepthRays(AT[0], 1200.0 * 90.0), AT[1])
both = pytest.mark.parametrize(
    ("rays", "other"), [HEIGHTS, DEPTHS, LENSES, EARTH], ids=["heights", "depths", "lenses", "earth"]
)


@both
def test_composition_is_that_of_its_parts(rays, other):
    z = np.abs(HYPOTHESES) + 20.0
    by_hand = other.image_from_ground(rays.ground(XY, z))
    assert np.isfinite(by_hand).all()
    np.testing.assert_allclose(rays.to(other).image_from_ground(np.column_stack([PIXELS, z])), by_hand, atol=SAME_PX)


@both
def test_the_reference_over_itself_is_its_pixels(rays, other):
    xyz = np.column_stack([PIXELS, np.abs(HYPOTHESES) + 20.0])
    np.testing.assert_allclose(rays.to(rays.sensor).image_from_ground(xyz), XY, atol=SAME_PX)
    np.testing.assert_array_equal(PixelModel().image_from_ground(xyz), XY)


@both
def test_there_and_back(rays, other):
    z = np.abs(HYPOTHESES) + 20.0
    model = rays.to(other)
    assert isinstance(model, SensorModel)
    xyz = np.column_stack([PIXELS, z])
    np.testing.assert_allclose(model.ground_from_image(model.image_from_ground(xyz), z), xyz, atol=1e-5)
    np.testing.assert_array_equal(PixelModel().ground_from_image(XY, z), xyz)


@both
def test_hypotheses_of_ground_are_those_it_was_made_from(rays, other):
    z = np.abs(HYPOTHESES) + 20.0
    np.testing.assert_allclose(rays.hypothesis(rays.ground(XY, z)), z, rtol=1e-9)


@both
def test_a_unit_is_worth_what_it_moves(rays, other):
    z, step = np.abs(HYPOTHESES) + 20.0, 0.01
    way = rays.ground(XY, z + step / 2) - rays.ground(XY, z - step / 2)
    moved = way[:, 2] if rays is HEIGHTS[0] else np.linalg.norm(way, axis=1)
    np.testing.assert_allclose(rays.metres_per_unit(XY, z), moved / step, rtol=SCALE_OF_MAPS)


def test_disparities_are_linear_and_go_on_beyond_infinity():
    level = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    left, right = (FrameModel((x, 0.0, 0.0), level, 500.0, (75.0, 70.0)) for x in (0.0, 2.0))
    model = DepthRays(left, 1000.0).to(right)
    xy = model.image_from_ground(np.column_stack([PIXELS, HYPOTHESES]))
    np.testing.assert_allclose(xy, XY - np.column_stack([HYPOTHESES, np.zeros(3)]), atol=SAME_PX)


def test_what_is_infinitely_far_or_behind_is_nowhere():
    rays = DEPTHS[0]
    assert np.isnan(rays.ground(XY, np.array([0.0, -1.0, 0.0]))).all()
    assert np.isnan(rays.hypothesis(np.array([[0.0, 0.0, 900.0]]))).all()


def test_units_of_heights_are_ground_pixels():
    ground = HEIGHTS[0].ground(XY, np.array([0.0, 2.0, -4.0]))
    np.testing.assert_allclose(ground[:, 2], [50.0, 51.0, 48.0])
