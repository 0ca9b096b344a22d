"""The pinhole camera: against the formula by hand, there and back, and what its angles mean."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.errors import InputError
from zlocus.io.camera_kinds import FrameCamera
from zlocus.io.strict import validated
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.model import SensorModel

ROUND_TRIP_PX = 1e-6
EXACT = 1e-9
CENTRE = (700_120.0, 4_790_230.0, 1450.0)
GOOD = {"focal": 500.0, "principal_point": [10.0, 20.0], "centre": [0, 0, 0]}

small_angles = st.floats(-40.0, 40.0)
pixels = st.tuples(st.floats(0.0, 6000.0), st.floats(0.0, 4000.0))


def camera(omega=0.0, phi=0.0, kappa=0.0) -> FrameModel:
    return FrameModel(CENTRE, rotation_from_angles(omega, phi, kappa), 4200.0, (2999.5, 1999.5))


def test_is_a_sensor_model():
    assert isinstance(camera(), SensorModel)
    assert camera().height_bounds() is None


def test_looking_down_north_is_up():
    # 1000 m below: 100 m east are 420 px to the right, 50 m north are 210 px up.
    xyz = np.array([[CENTRE[0] + 100.0, CENTRE[1] + 50.0, CENTRE[2] - 1000.0]])
    np.testing.assert_allclose(camera().image_from_ground(xyz), [[2999.5 + 420.0, 1999.5 - 210.0]], atol=EXACT * 1e3)


def test_collinearity_equations():
    """Against x = -c (r11 X + r21 Y + r31 Z) / (r13 X + r23 Y + r33 Z) written out (Kraus 2007, equation 5.3-4)."""
    omega, phi, kappa = 3.0, -7.0, 40.0
    o, p, k = np.deg2rad([omega, phi, kappa])
    r = np.array([
        [np.cos(p) * np.cos(k), -np.cos(p) * np.sin(k), np.sin(p)],
        [np.cos(o) * np.sin(k) + np.sin(o) * np.sin(p) * np.cos(k),
         np.cos(o) * np.cos(k) - np.sin(o) * np.sin(p) * np.sin(k), -np.sin(o) * np.cos(p)],
        [np.sin(o) * np.sin(k) - np.cos(o) * np.sin(p) * np.cos(k),
         np.sin(o) * np.cos(k) + np.cos(o) * np.sin(p) * np.sin(k), np.cos(o) * np.cos(p)],
    ])  # fmt: skip
    xyz = np.add(CENTRE, [210.0, -330.0, -1100.0])
    d = r.T @ (xyz - CENTRE)
    right, up = -4200.0 * d[0] / d[2], -4200.0 * d[1] / d[2]
    expected = [[2999.5 + right, 1999.5 - up]]
    np.testing.assert_allclose(camera(omega, phi, kappa).image_from_ground(xyz[None]), expected, atol=ROUND_TRIP_PX)


@given(small_angles, small_angles, st.floats(-180.0, 180.0), pixels, st.floats(-50.0, 500.0))
def test_there_and_back(omega, phi, kappa, pixel, height):
    model = camera(omega, phi, kappa)
    xyz = model.ground_from_image(np.array([pixel]), np.array([height]))
    if np.isnan(xyz).any():
        assert model.ray_from_image(np.array([pixel]))[0, 2] >= 0  # it looks at the sky
        return
    assert xyz[0, 2] == height
    np.testing.assert_allclose(model.image_from_ground(xyz), [pixel], rtol=0, atol=ROUND_TRIP_PX)


def test_behind_the_camera_is_nothing():
    above = np.array([[CENTRE[0], CENTRE[1], CENTRE[2] + 10.0]])
    assert np.isnan(camera().image_from_ground(above)).all()
    assert np.isnan(camera().ground_from_image(np.array([[0.0, 0.0]]), np.array([CENTRE[2] + 10.0]))).all()


def test_depth_is_along_the_axis():
    xyz = np.add(CENTRE, [[300.0, 0.0, -1000.0], [0.0, 0.0, 5.0]])
    np.testing.assert_allclose(camera().depth(xyz), [1000.0, -5.0], atol=1e-6)


def test_moved_shifts_the_image():
    xyz = np.add([CENTRE], [10.0, 20.0, -900.0])
    shift = camera().moved(2.5, -1.5).image_from_ground(xyz) - camera().image_from_ground(xyz)
    np.testing.assert_allclose(shift, [[2.5, -1.5]], atol=EXACT * 1e3)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"angles": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "either rotation"),
        ({}, "either rotation"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "right angles"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "right-handed"),
        ({"angles": [0, 0, 0], "focal": 0}, "focal"),
    ],
)
def test_cameras_that_make_no_sense_are_refused(tmp_path, changes, says):
    with pytest.raises(InputError, match=says):
        validated(FrameCamera, GOOD | changes, tmp_path / "scene.yaml", "views[0].camera")


def test_the_camera_entry_becomes_the_model(tmp_path):
    entry = validated(FrameCamera, GOOD | {"angles": [1, 2, 3]}, tmp_path / "scene.yaml")
    source = entry.read(tmp_path, tmp_path / "a.tif")
    assert source.centre((100, 100)) is None
    assert source.model == FrameModel((0, 0, 0), rotation_from_angles(1, 2, 3), 500.0, (10.0, 20.0))
