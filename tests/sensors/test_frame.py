"""The frame camera: against the formula by hand and OpenCV, there and back, its angles, and the curved Earth."""

from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Proj, Transformer

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import SensorModel
from zlocus.io.cameras.camera_kinds import FrameCamera
from zlocus.io.schema import validate_document
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles

ROUND_TRIP_PX = 1e-6
# Positions on the Earth, 6400 km from its centre, come back this exactly; in an image whose pixels are 0.1 m or more.
BACK_M, BACK_PX = 1e-6, 1e-5
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
        validate_document(FrameCamera, GOOD | changes, tmp_path / "scene.yaml", "views[0].camera")


def test_the_camera_entry_becomes_the_model(tmp_path):
    entry = validate_document(FrameCamera, GOOD | {"angles": [1, 2, 3]}, tmp_path / "scene.yaml")
    source = entry.read(tmp_path, tmp_path / "a.tif")
    assert source.centre((100, 100)) is None
    assert source.sensor_in_own_crs == FrameModel((0, 0, 0), rotation_from_angles(1, 2, 3), 500.0, (10.0, 20.0))


LENSES = {
    "ideal": None,
    "brown": BrownDistortion(-0.12, 0.05, 6e-4, -3e-4, 0.01),
    "rational": BrownDistortion(-0.21, 0.09, 8e-4, -5e-4, 0.03, 0.02, -0.01, 0.004),
    "fisheye": FisheyeDistortion(0.03, -0.02, 0.008, -0.003),
}
small = st.floats(-0.2, 0.2)
tiny = st.floats(-2e-3, 2e-3)
lenses = st.one_of(
    st.none(),
    st.builds(BrownDistortion, small, small, tiny, tiny, small, small, small, small),
    st.builds(FisheyeDistortion, *(st.floats(-0.05, 0.05),) * 4),
)
UTM = CRS.from_epsg(32631)


@st.composite
def cameras(draw):
    """Any camera over the ground: wide and long lenses, oblong and slanted pixels, upright and oblique."""
    angles = [draw(st.floats(-60.0, 60.0)), draw(st.floats(-60.0, 60.0)), draw(st.floats(-180.0, 180.0))]
    model = FrameModel(
        CENTRE, rotation_from_angles(*angles), draw(st.floats(2000.0, 12_000.0)),
        (draw(st.floats(2500.0, 3500.0)), draw(st.floats(1500.0, 2500.0))), draw(st.floats(0.9, 1.1)),
        draw(st.floats(-5.0, 5.0)), draw(lenses),
    )  # fmt: skip
    return model.on_earth(UTM, UTM) if draw(st.booleans()) else model


@given(cameras(), st.lists(pixels, min_size=1, max_size=8), st.floats(-50.0, 900.0))
def test_there_and_back_of_any_camera(model, xy, height):
    xy = np.array(xy)
    xyz = model.ground_from_image(xy, np.full(len(xy), height))
    back = model.image_from_ground(xyz)
    seen = np.isfinite(xyz).all(axis=1)
    # Far away a map's own figures, of a billionth of a metre, are more than that of a ray that hardly falls.
    near = seen & (np.abs(xyz[:, :2] - CENTRE[:2]).max(axis=1) < 20_000.0)
    rim = near & ~np.isfinite(back).all(axis=1)
    assert not rim.any() or model.distortion is not None
    assert np.abs(back - xy)[near & ~rim].max(initial=0.0) < ROUND_TRIP_PX


@given(cameras(), st.lists(st.tuples(st.floats(-900.0, 900.0), st.floats(-900.0, 900.0)), min_size=1, max_size=8))
def test_back_and_there_of_any_camera(model, offsets):
    xyz = np.array([*CENTRE[:2], 300.0]) + np.column_stack([offsets, np.zeros(len(offsets))])
    xy = model.image_from_ground(xyz)
    seen = np.isfinite(xy).all(axis=1)
    back = model.ground_from_image(xy, xyz[:, 2])
    assert np.isfinite(back[seen]).all()
    np.testing.assert_allclose(back[seen], xyz[seen], rtol=0, atol=BACK_M)
    assert np.abs(model.image_from_ground(back) - xy)[seen].max(initial=0.0) < BACK_PX


@pytest.mark.parametrize("kind", LENSES)
def test_agrees_with_opencv(kind):
    lens = LENSES[kind]
    rotation = rotation_from_angles(3.0, -7.0, 40.0)
    model = FrameModel(CENTRE, rotation, 4200.0, (2999.5, 1999.5), 1.01, 0.0, lens)
    xyz = np.add(CENTRE, np.random.default_rng(0).uniform([-500, -500, -1300], [500, 500, -900], (200, 3)))
    matrix = np.array([[4200.0, 0, 2999.5], [0, 4242.0, 1999.5], [0, 0, 1.0]])
    vector, _ = cv2.Rodrigues(np.array(rotation))
    local = (xyz - CENTRE)[:, None]
    if isinstance(lens, FisheyeDistortion):
        numbers = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
        theirs = cv2.fisheye.projectPoints(local, vector, np.zeros(3), matrix, numbers)[0][:, 0]
    else:
        lens = lens or BrownDistortion()
        numbers = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6])
        theirs = cv2.projectPoints(local, vector, np.zeros(3), matrix, numbers)[0][:, 0]
    here = model.image_from_ground(xyz)
    assert np.isfinite(here).all()
    np.testing.assert_allclose(here, theirs, rtol=0, atol=ROUND_TRIP_PX)


def test_no_distortion_is_the_pinhole():
    xyz = np.add(CENTRE, np.random.default_rng(0).uniform([-500, -500, -1300], [500, 500, -900], (200, 3)))
    ideal = camera(3.0, -7.0, 40.0)
    real = replace(ideal, distortion=BrownDistortion())
    np.testing.assert_array_equal(real.image_from_ground(xyz), ideal.image_from_ground(xyz))
    xy = ideal.image_from_ground(xyz)
    np.testing.assert_allclose(real.ray_from_image(xy), ideal.ray_from_image(xy), rtol=0, atol=1e-14)


def test_beyond_the_fold_is_nothing():
    model = replace(camera(), distortion=BrownDistortion(-1.0 / 3.0))  # folds at 45 degrees
    xyz = np.add(CENTRE, [[900.0, 0.0, -1000.0], [1100.0, 0.0, -1000.0]])
    assert np.isfinite(model.image_from_ground(xyz)).all(axis=1).tolist() == [True, False]
    xy = np.add(model.principal_point, [[0.6 * 4200.0, 0.0], [0.7 * 4200.0, 0.0]])
    assert np.isfinite(model.ground_from_image(xy, np.zeros(2))).all(axis=1).tolist() == [True, False]


def by_hand_on_earth(model, xyz):
    """PROJ's tangent frame at the camera, turned by the meridian convergence, then the pinhole."""
    lon, lat = Transformer.from_crs(UTM, 4326, always_xy=True).transform(*model.centre[:2])
    tangent = f"+proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={model.centre[2]}"
    chain = f"+proj=pipeline +step +inv +proj=utm +zone=31 +ellps=WGS84 +step +proj=cart +ellps=WGS84 +step {tangent}"
    east, north, up = Transformer.from_pipeline(chain).transform(*xyz.T)
    g = -np.deg2rad(Proj(UTM).get_factors(lon, lat).meridian_convergence)
    of_grid = np.stack([east * np.cos(g) + north * np.sin(g), north * np.cos(g) - east * np.sin(g), up])
    x, y, z = model.rotation @ of_grid
    return np.column_stack([x / z, y / z]) * model.focal + np.array(model.principal_point)


def test_a_block_of_20_km_on_the_curved_earth():
    centre = (CENTRE[0], CENTRE[1], 8000.0)
    flat = FrameModel(centre, rotation_from_angles(2.0, -1.0, 30.0), 10_000.0, (5000.0, 5000.0))
    curved = flat.on_earth(UTM, UTM)
    offsets = np.linspace(-10_000.0, 10_000.0, 9)
    x, y = (v.ravel() for v in np.meshgrid(offsets, offsets))
    xyz = np.column_stack([x + centre[0], y + centre[1], np.tile([0.0, 350.0, 1200.0], 27)])
    here = curved.image_from_ground(xyz)
    np.testing.assert_allclose(here, by_hand_on_earth(flat, xyz), rtol=0, atol=ROUND_TRIP_PX)
    # What a flat Earth would make of it.
    wrong = np.linalg.norm(here - flat.image_from_ground(xyz), axis=1)
    assert wrong[np.hypot(x, y) < 3000.0].max() > 0.3
    assert wrong.max() > 10.0
    np.testing.assert_allclose(curved.ground_from_image(here, xyz[:, 2]), xyz, rtol=0, atol=1e-7)


def test_the_scale_of_the_map():
    """On the central meridian of a UTM zone 1 m on the ground is 0.9996 m on the map."""
    at = (500_000.0, 4_790_230.0, 5000.0)
    down = FrameModel(at, rotation_from_angles(0.0, 0.0, 0.0), 4000.0, (0.0, 0.0))
    xy = np.array([[40.0, 0.0], [0.0, -40.0]])
    for model, scale in ((down, 1.0), (down.on_earth(UTM, UTM), 0.9996)):
        ground = model.ground_from_image(xy, np.zeros(2)) - at
        np.testing.assert_allclose(np.diag(ground), 50.0 * scale, rtol=2e-6)


def test_on_earth_in_another_map():
    """A pose given in UTM, the ground in Lambert-93: the same image."""
    lambert = CRS.from_epsg(2154)
    model = replace(camera(2.0, -1.0, 30.0), distortion=LENSES["brown"])
    xyz = np.add(CENTRE, [[300.0, 200.0, -1000.0], [-250.0, 100.0, -1200.0]])
    x, y = Transformer.from_crs(UTM, lambert, always_xy=True).transform(*xyz.T[:2])
    there = model.on_earth(UTM, lambert).image_from_ground(np.column_stack([x, y, xyz[:, 2]]))
    np.testing.assert_allclose(there, model.on_earth(UTM, UTM).image_from_ground(xyz), rtol=0, atol=1e-4)


def test_what_is_not_seen_on_earth():
    curved = camera(0.0, 0.0, 0.0).on_earth(UTM, UTM)
    above = np.array([[CENTRE[0], CENTRE[1], CENTRE[2] + 10.0]])
    assert np.isnan(curved.image_from_ground(above)).all()
    assert np.isnan(curved.ground_from_image(np.array([[0.0, 0.0]]), np.array([CENTRE[2] + 10.0]))).all()
    level = camera(90.0, 0.0, 0.0).on_earth(UTM, UTM)
    assert np.isnan(level.ground_from_image(np.array([[2999.5, 100.0]]), np.array([0.0]))).all()
    np.testing.assert_allclose(curved.depth(np.add([CENTRE], [0.0, 0.0, -700.0])), [700.0], atol=1e-6)


def test_cameras_travel_between_processes():
    curved = replace(camera(1.0, 2.0, 3.0), distortion=LENSES["fisheye"]).on_earth(UTM, UTM)
    again = pickle.loads(pickle.dumps(curved))
    assert again == curved
    xyz = np.array([CENTRE]) + np.array([10.0, 20.0, -900.0])
    np.testing.assert_array_equal(again.image_from_ground(xyz), curved.image_from_ground(xyz))


def test_turned_with_the_frame():
    turn = np.array(rotation_from_angles(20.0, 30.0, -50.0))
    model = replace(camera(3.0, 4.0, 5.0), distortion=LENSES["brown"])
    xyz = np.add(CENTRE, [[100.0, 50.0, -1000.0], [-20.0, 80.0, -800.0]])
    here = model.turned(turn).image_from_ground(xyz @ turn.T)
    np.testing.assert_allclose(here, model.image_from_ground(xyz), rtol=0, atol=1e-5)
