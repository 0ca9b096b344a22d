"""Frame cameras that move while their rows are read out: against a camera at rest for each row, and there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from zlocus.core.sensor_model import SensorModel
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.image_rays import DepthRays
from zlocus.sensors.projection_table import TableRequest, projection_table
from zlocus.sensors.rolling_shutter import RollingShutter

ROUND_TRIP_PX = 1e-6
SAME_PX = 1e-6
ROWS, COLUMNS = 3000, 4000
CENTRE = (462_200.0, 5_247_300.0, 560.0)
GROUND_M = 480.0
UTM = CRS.from_epsg(32632)
LENSES = {
    "ideal": None,
    "brown": BrownDistortion(-0.26, 0.10, 7e-4, 3e-4, -0.025),
    "fisheye": FisheyeDistortion(0.03, -0.02),
}
# A drone in fast flight with a slow shutter: 0.6 m, or 22 px, from the first to the last row.
MOTION = RollingShutter(0.05, (12.0, 3.0, -1.0), ROWS)
small_angles = st.floats(-40.0, 40.0)
speeds = st.floats(-20.0, 20.0)


def camera(lens=None, motion=MOTION, angles=(2.0, -3.0, 25.0)) -> FrameModel:
    return FrameModel(
        CENTRE, rotation_from_angles(*angles), 3000.0, (2010.0, 1490.0), 1.01, 0.3, lens, rolling_shutter=motion
    )


def pixels(n=200, seed=0):
    return np.random.default_rng(seed).uniform(0, [COLUMNS - 1, ROWS - 1], (n, 2))


@pytest.mark.parametrize("lens", LENSES)
def test_each_row_is_that_of_a_camera_at_rest(lens):
    """Written out: the centre moves linearly, by the whole motion from half a row above the image to half below."""
    moving, xy = camera(LENSES[lens]), pixels(50)
    xyz = moving.ground_from_image(xy, np.full(50, GROUND_M))
    assert np.isfinite(xyz).all()
    for point, (column, row) in zip(xyz, xy, strict=True):
        seconds = 0.05 * (row - 1499.5) / 3000.0
        centre = tuple(np.add(CENTRE, seconds * np.array(MOTION.velocity)))
        at_rest = replace(moving, centre=centre, rolling_shutter=None)
        np.testing.assert_allclose(at_rest.image_from_ground(point[None]), [[column, row]], rtol=0, atol=SAME_PX)
    without = replace(moving, rolling_shutter=None).image_from_ground(xyz) - xy
    assert np.abs(without).max() > 5.0


@given(
    st.sampled_from(sorted(LENSES)), st.tuples(small_angles, small_angles, st.floats(-180.0, 180.0)),
    st.tuples(speeds, speeds, speeds), st.floats(-0.1, 0.1), st.floats(-50.0, 500.0), st.booleans(),
)  # fmt: skip
def test_there_and_back(lens, angles, velocity, readout_s, height, is_on_earth):
    model, xy = camera(LENSES[lens], RollingShutter(readout_s, velocity, ROWS), angles), pixels(40)
    model = model.on_earth(UTM, UTM) if is_on_earth else model
    xyz = model.ground_from_image(xy, np.full(len(xy), height))
    back = model.image_from_ground(xyz)
    near = np.isfinite(xyz).all(axis=1) & (np.abs(xyz[:, :2] - CENTRE[:2]).max(axis=1) < 5000.0)
    rim = ~np.isfinite(back).all(axis=1)
    assert not (near & rim).any() or lens != "ideal"
    assert np.abs(back - xy)[near & ~rim].max(initial=0.0) < ROUND_TRIP_PX


def test_is_a_sensor_model_without_motion_the_one_at_rest():
    at_rest, still = camera(motion=None), camera(motion=RollingShutter(0.03, (0.0, 0.0, 0.0), ROWS))
    assert isinstance(still, SensorModel)
    xyz = at_rest.ground_from_image(pixels(), np.full(200, GROUND_M))
    np.testing.assert_array_equal(still.image_from_ground(xyz), at_rest.image_from_ground(xyz))
    np.testing.assert_array_equal(still.ground_from_image(pixels(), np.full(200, GROUND_M)), xyz)


def test_the_last_row_may_be_read_first():
    upside_down = camera(motion=RollingShutter(-0.05, (-12.0, -3.0, 1.0), ROWS))
    xyz = camera().ground_from_image(pixels(), np.full(200, GROUND_M))
    np.testing.assert_allclose(upside_down.image_from_ground(xyz), pixels(), rtol=0, atol=SAME_PX)


@pytest.mark.parametrize("speed_m_s", [81.0, -81.0])
def test_an_image_as_fast_as_its_readout_shows_nothing(speed_m_s):
    """No row of the image sees the point."""
    level = FrameModel((0.0, 0.0, 80.0), rotation_from_angles(0.0, 0.0, 0.0), 3000.0, (1999.5, 1499.5))
    moving = replace(level, rolling_shutter=RollingShutter(1.0, (0.0, speed_m_s, 0.0), ROWS))
    ((column, row),) = moving.image_from_ground(np.array([[3.0, 7.0, 0.0]]))
    assert np.isnan(column) or not 0 <= row < ROWS


def test_behind_the_camera_is_nothing():
    above = np.array([[*CENTRE[:2], CENTRE[2] + 10.0]])
    assert np.isnan(camera().image_from_ground(above)).all()


def test_rotations_and_maps_keep_the_motion():
    """What all cameras and the ground are turned by together changes no image."""
    local = replace(camera(), centre=(3.0, 4.0, 80.0))
    xyz = local.ground_from_image(pixels(), np.zeros(200))
    rotation = np.array(rotation_from_angles(10.0, 20.0, 30.0))
    np.testing.assert_allclose(
        local.turned(rotation).image_from_ground(xyz @ rotation.T), pixels(), rtol=0, atol=SAME_PX
    )
    flat, curved = camera(), camera().on_earth(UTM, UTM)
    xyz = curved.ground_from_image(pixels(), np.full(200, GROUND_M))
    at_rest = replace(curved, rolling_shutter=None).image_from_ground(xyz) - pixels()
    xyz = flat.ground_from_image(pixels(), np.full(200, GROUND_M))
    at_rest_on_the_map = replace(flat, rolling_shutter=None).image_from_ground(xyz) - pixels()
    # The scale of the map there is 0.9996.
    np.testing.assert_allclose(at_rest, at_rest_on_the_map, rtol=2e-3, atol=0.01)


def test_corrections_keep_the_motion():
    moved = camera().corrected(np.array([0.3, -0.2, 0.1]), np.array([1e-3, -2e-3, 5e-3]))
    assert moved.rolling_shutter == MOTION
    assert camera().moved(2.0, -1.0).rolling_shutter == MOTION


def test_the_station_is_the_lowest_of_the_readout():
    assert camera().station_height() == pytest.approx(CENTRE[2] - 0.025, abs=1e-4)
    assert camera().on_earth(UTM, UTM).station_height() == pytest.approx(CENTRE[2] - 0.025, abs=1e-4)


@pytest.mark.parametrize("lens", ["ideal", "brown"])
def test_depths_and_disparities_of_moving_cameras(lens):
    one = camera(LENSES[lens])
    other = replace(camera(LENSES[lens], replace(MOTION, velocity=(-10.0, 5.0, 2.0))), centre=(*CENTRE[:2], 570.0))
    other = other.corrected(np.array([20.0, 5.0, 0.0]), np.zeros(3))
    rays = DepthRays(one, 3000.0 * 20.0)
    xy, z = pixels(), np.linspace(600.0, 900.0, 200)
    xyz = rays.ground(xy, z)
    np.testing.assert_allclose(one.image_from_ground(xyz), xy, rtol=0, atol=SAME_PX)
    np.testing.assert_allclose(rays.hypothesis(xyz), z, rtol=1e-9)
    model = rays.to(other)
    in_space = np.column_stack([xy * [1.0, -1.0], z])
    np.testing.assert_allclose(model.image_from_ground(in_space), other.image_from_ground(xyz), rtol=0, atol=SAME_PX)
    np.testing.assert_allclose(model.ground_from_image(other.image_from_ground(xyz), z), in_space, rtol=0, atol=1e-5)


def test_a_projection_table_holds_for_a_moving_camera():
    """The motion is smooth over the ground, so that tables are as exact as those of a camera at rest."""
    transform = Affine(0.1, 0.0, CENTRE[0] - 20.0, 0.0, -0.1, CENTRE[1] + 20.0)
    request = TableRequest(transform, (128, 128), 4, (GROUND_M - 3.0, GROUND_M + 3.0))
    table = projection_table(camera(LENSES["brown"]), request, (0, 0, ROWS, COLUMNS))
    assert table.holds.all()
