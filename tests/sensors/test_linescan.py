"""The line scanner: there and back, against closed forms, where the flight turns, and what lies outside."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from flights import (
    ADVANCE_M,
    CENTRE,
    COLUMNS,
    FLIGHT_M,
    FOCAL_MM,
    GROUND_M,
    INTERVAL_S,
    PIXEL_MM,
    ROWS,
    Flight,
    focal_line,
    on_earth,
    scanner,
)
from zlocus.core.sensor_model import SensorModel
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.earth_frame import WGS84_EARTH, FrameSpace
from zlocus.sensors.linescan import FocalLine, LineScanModel, LineTimes, RectifiedModel
from zlocus.sensors.projection_table import TableRequest, projection_table
from zlocus.sensors.trajectory import Drift, Trajectory

ROUND_TRIP_PX = 1e-6
EXACT_PX = 1e-7
EARTH_M = 1e-8


def pixels(n=500, seed=1):
    return np.random.default_rng(seed).uniform((-0.5, -0.5), (COLUMNS - 0.5, ROWS - 0.5), (n, 2))


flights = st.builds(
    Flight,
    heading=st.floats(-180, 180),
    turn=st.one_of(st.just(0.0), st.floats(1e-3, 0.02), st.floats(-0.02, -1e-3)),
    wobble_m=st.floats(0, 2),
    wobble_deg=st.floats(0, 1.0),
    wobble_rows=st.floats(2000, 9000),
    crab=st.floats(-15, 15),
)
lines = st.builds(
    focal_line, st.sampled_from([-40.0, -14.0, 0.0, 2.0, 26.0]), st.floats(-0.3, 0.3), st.floats(-180, 180)
)


@given(flights, st.floats(-30, 30), st.floats(-0.3, 0.3), st.booleans(), st.floats(100, 1000))
def test_there_and_back(flight, along, bend, backwards, height):
    model = scanner(flight, focal_line(along, bend), -INTERVAL_S if backwards else INTERVAL_S)
    xy = pixels(200)
    xyz = model.ground_from_image(xy, np.full(len(xy), height))
    assert (xyz[:, 2] == height).all()
    np.testing.assert_allclose(model.image_from_ground(xyz), xy, rtol=0, atol=ROUND_TRIP_PX)


@given(st.floats(-180, 180), st.floats(-30, 30), st.floats(-400, 6000), st.floats(-179, 179), st.floats(-75, 75))
def test_there_and_back_on_the_earth(heading, along, base, lon, lat):
    model, _ = on_earth(heading, along, base, lon, lat)
    xy = pixels(100)
    z = base + np.linspace(-100, 400, len(xy))
    xyz = model.ground_from_image(xy, z)
    np.testing.assert_array_equal(xyz[:, 2], z)
    np.testing.assert_allclose(model.image_from_ground(xyz), xy, rtol=0, atol=ROUND_TRIP_PX)


@pytest.mark.parametrize("heading", [0.0, 90.0, -133.0])
@pytest.mark.parametrize("along", [26.0, 2.0, -14.0])
def test_a_straight_flight_is_its_formula(heading, along):
    """Columns are perspective across the flight, rows parallel along it (Kraus 2007, line cameras)."""
    rng = np.random.default_rng(3)
    model = scanner(Flight(heading), focal_line(along))
    h, ahead = np.deg2rad(heading), (FLIGHT_M - GROUND_M) * np.tan(np.deg2rad(along))
    middle = np.array(CENTRE) + ahead * np.array([np.sin(h), np.cos(h)])
    xyz = np.column_stack([rng.uniform(-60, 60, (500, 2)) + middle, rng.uniform(300, 600, 500)])
    forward = (xyz[:, :2] - CENTRE) @ [np.sin(h), np.cos(h)]
    right = (xyz[:, :2] - CENTRE) @ [np.cos(h), -np.sin(h)]
    depth = FLIGHT_M - xyz[:, 2]
    column = (COLUMNS - 1) / 2 + FOCAL_MM / PIXEL_MM * right / depth
    row = ROWS / 2 + (forward - depth * np.tan(np.deg2rad(along))) / ADVANCE_M
    np.testing.assert_allclose(model.image_from_ground(xyz), np.column_stack([column, row]), rtol=0, atol=EXACT_PX)


def test_the_centre_of_the_first_pixel_is_the_origin():
    """Column 0 is the first detector's middle, row 0 the first exposure's: the ray of (0, 0) has no half pixels."""
    model = scanner()
    centre, rotation = Flight().pose(np.zeros(1))
    x, y = model.line.xy_mm[0]
    expected = centre[0] + (FLIGHT_M - GROUND_M) / FOCAL_MM * rotation[0] @ [x, y, -FOCAL_MM]
    np.testing.assert_allclose(
        model.ground_from_image(np.zeros((1, 2)), np.array([GROUND_M])), [expected], rtol=0, atol=1e-8
    )


def test_rows_are_exposures():
    """One row has one projection centre: its rays at two heights meet there, the next row's one advance further."""
    model = scanner(Flight(30.0, wobble_deg=0.3))
    for row in (0.0, 411.0):
        xy = np.column_stack([np.linspace(0, COLUMNS - 1, 9), np.full(9, row)])
        low, high = (model.ground_from_image(xy, np.full(9, z)) for z in (0.0, 1000.0))
        centre = Flight(30.0, wobble_deg=0.3).pose(np.array([row]))[0][0]
        at = low + (centre[2] / 1000.0) * (high - low)
        np.testing.assert_allclose(at, np.broadcast_to(centre, (9, 3)), rtol=0, atol=1e-5)


def test_rows_flown_backwards_are_the_image_turned_over():
    rng = np.random.default_rng(0)
    flight = Flight(77.0, wobble_deg=0.2, wobble_m=1.0)
    xyz = np.column_stack([rng.uniform(-50, 50, (300, 2)) + CENTRE, rng.uniform(400, 500, 300)])
    ahead = scanner(flight).image_from_ground(xyz)
    back = scanner(flight, interval=-INTERVAL_S).image_from_ground(xyz)
    np.testing.assert_allclose(back, np.column_stack([ahead[:, 0], ROWS - 1 - ahead[:, 1]]), rtol=0, atol=EXACT_PX)


@given(lines)
def test_the_axes_of_the_image_system_do_not_matter(line):
    """A focal plane drawn in turned axes, and a camera turned back, are the same camera."""
    model = scanner(Flight(10.0, wobble_deg=0.2), line)
    x, y = line.xy_mm[-1] - line.xy_mm[0]
    turn = Rotation.from_euler("Z", np.arctan2(y, x)).as_matrix()
    straight = FocalLine(line.xy_mm @ turn[:2, :2], FOCAL_MM)
    path = model.trajectory
    turned = LineScanModel(
        straight, model.lines, Trajectory(path.times, path.centres, turn.T @ path.rotations), FrameSpace()
    )
    z = np.full(500, 450.0)
    xyz = model.ground_from_image(pixels(), z)
    seen = np.isfinite(xyz).all(axis=1)
    assert seen.any() or np.abs(line.xy_mm).max() > FOCAL_MM
    np.testing.assert_allclose(turned.ground_from_image(pixels(), z)[seen], xyz[seen], rtol=0, atol=1e-6)


def test_times_row_by_row():
    """Rows at uneven times are where the flight was then: the search runs in time, not in rows."""
    rng = np.random.default_rng(5)
    steps = np.cumsum(rng.uniform(0.5, 1.5, ROWS))
    flight = Flight(200.0, wobble_deg=0.1)
    uneven = LineScanModel(
        focal_line(2.0), LineTimes(np.arange(float(ROWS)), steps * INTERVAL_S), flight.trajectory(), FrameSpace()
    )
    xy = pixels()
    xyz = uneven.ground_from_image(xy, np.full(len(xy), 450.0))
    np.testing.assert_allclose(uneven.image_from_ground(xyz), xy, rtol=0, atol=ROUND_TRIP_PX)
    even = scanner(flight, focal_line(2.0)).image_from_ground(xyz)
    np.testing.assert_allclose(np.interp(xy[:, 1], np.arange(ROWS), steps), even[:, 1], rtol=0, atol=0.5 * 1.5)


def test_a_half_circle():
    """Where the flight turns back, two exposures may have a point in their plane: the one within the line is meant."""
    rows, columns = 15_000, 9_000
    path = Flight(0.0, turn=180.0 / rows).trajectory(rows, 10.0)
    model = LineScanModel(
        focal_line(10.0, columns=columns), LineTimes.regular(0.0, INTERVAL_S, rows), path, FrameSpace()
    )
    xy = np.random.default_rng(1).uniform((0, 0), (columns - 1, rows - 1), (2000, 2))
    xyz = model.ground_from_image(xy, np.full(len(xy), 430.0))
    found = model.image_from_ground(xyz)
    assert ((found > -1) & (found < [columns, rows])).all()
    np.testing.assert_allclose(model.ground_from_image(found, xyz[:, 2]), xyz, rtol=0, atol=1e-6)
    assert (np.abs(found - xy).max(axis=1) < ROUND_TRIP_PX).mean() > 0.8


def test_noise_of_every_sample():
    """White noise of the attitude (a thousandth of a degree at 200 Hz) bends the search, not its result."""
    path = Flight(45.0, wobble_deg=0.1).trajectory()
    noise = np.zeros((len(path.times), 6))
    noise[:, 3:] = np.deg2rad(1e-3) * np.random.default_rng(2).standard_normal((len(path.times), 3))
    noisy = LineScanModel(
        focal_line(26.0),
        LineTimes.regular(0.0, INTERVAL_S, ROWS),
        Drift(path.times, noise).corrected(path),
        FrameSpace(),
    )
    xy = pixels(5000)
    xyz = noisy.ground_from_image(xy, np.full(len(xy), 450.0))
    np.testing.assert_allclose(noisy.image_from_ground(xyz), xy, rtol=0, atol=ROUND_TRIP_PX)


def test_beyond_the_margin_and_behind_is_nothing():
    model = scanner(margin_px=20.0)
    inside = np.array([(-20.4, 5.0), (5.0, -20.4), (COLUMNS + 19.4, 5.0), (5.0, ROWS + 19.4)])
    outside = np.array([(-21.0, 5.0), (5.0, -21.0), (COLUMNS + 20.0, 5.0), (5.0, ROWS + 20.0), (np.nan, 1.0)])
    z = np.full(4, 450.0)
    xyz = model.ground_from_image(inside, z)
    np.testing.assert_allclose(model.image_from_ground(xyz), inside, rtol=0, atol=ROUND_TRIP_PX)
    assert np.isnan(model.ground_from_image(outside, np.full(5, 450.0))).all()
    beyond = scanner(margin_px=100.0).ground_from_image(outside[:4], z)
    assert np.isnan(model.image_from_ground(beyond)).all()
    above = np.array([(*CENTRE, FLIGHT_M + 100.0), (*CENTRE, np.nan), (np.inf, CENTRE[1], 400.0), (0.0, 0.0, 0.0)])
    assert np.isnan(model.image_from_ground(above)).all()
    assert np.isnan(model.ground_from_image(inside, np.full(4, FLIGHT_M + 1.0))).all()
    assert model.image_from_ground(np.zeros((0, 3))).shape == (0, 2)


def test_a_trajectory_that_ends_with_the_image_runs_straight_on():
    short = LineScanModel(
        focal_line(2.0), LineTimes.regular(0.0, INTERVAL_S, ROWS), Flight().trajectory(1.0), FrameSpace()
    )
    xy = np.array([(5.0, -3000.0), (5.0, ROWS + 3000.0)])
    xyz = short.ground_from_image(xy, np.full(2, 450.0))
    np.testing.assert_allclose(scanner(line=focal_line(2.0)).image_from_ground(xyz), xy, rtol=0, atol=1e-3)


def test_a_trajectory_that_ends_with_the_image_stays_smooth():
    """Tables of the projection hold across the end of a wobbling trajectory; where it just stopped they would not."""
    flight = Flight(wobble_m=0.5, wobble_deg=0.03, wobble_rows=6000.0)
    model = LineScanModel(
        focal_line(26.0), LineTimes.regular(0.0, INTERVAL_S, ROWS), flight.trajectory(5.0), FrameSpace()
    )
    for row in (0.0, ROWS - 1.0):
        x, y, _ = model.ground_from_image(np.array([[300.0, row]]), np.array([GROUND_M]))[0]
        grid = Affine(0.2, 0.0, x - 30.0, 0.0, -0.2, y + 30.0)
        projection_table(model, TableRequest(grid, (300, 300), 32, (GROUND_M - 10.0, GROUND_M + 80.0)))


def test_is_a_sensor_model_and_can_be_shifted():
    model = scanner()
    assert isinstance(model, SensorModel)
    assert model.height_bounds() is None
    shifted = ShiftedModel(model, 1.5, -0.25)
    xyz = model.ground_from_image(pixels(), np.full(500, 450.0))
    np.testing.assert_allclose(
        shifted.image_from_ground(xyz), pixels() + np.array([1.5, -0.25]), rtol=0, atol=ROUND_TRIP_PX
    )


def test_level_1_is_the_plane_then_the_raw_image():
    raw = scanner(Flight(30.0, wobble_deg=0.2, wobble_m=0.5), focal_line(26.0))
    plane = 430.0
    middle = raw.ground_from_image(np.array([[COLUMNS / 2, ROWS / 2]]), np.array([plane]))[0]
    to_plane = Affine.translation(*middle[:2]) * Affine.rotation(-20.0) * Affine.scale(0.2, -0.2)
    model = RectifiedModel(raw, raw, plane, to_plane)
    assert isinstance(model, SensorModel)
    assert model.height_bounds() is None
    # On the plane itself the image is a map.
    xy = np.random.default_rng(1).uniform(-200, 200, (300, 2))
    x, y = to_plane * tuple(xy.T)
    on_plane = np.column_stack([x, y, np.full(300, plane)])
    np.testing.assert_allclose(model.ground_from_image(xy, on_plane[:, 2]), on_plane, rtol=0, atol=1e-6)
    # Above it a pixel keeps the ray of its raw pixel.
    above = model.ground_from_image(xy, np.full(300, 480.0))
    np.testing.assert_allclose(raw.image_from_ground(above), raw.image_from_ground(on_plane), rtol=0, atol=EXACT_PX)
    np.testing.assert_allclose(model.image_from_ground(above), xy, rtol=0, atol=ROUND_TRIP_PX)


@pytest.mark.parametrize("n_knots", [1, 2, 3, 7])
def test_a_drift_moves_and_turns_the_camera_in_its_own_axes(n_knots):
    flight = Flight(90.0)
    model = scanner(flight)
    start, end = model.trajectory.times[[0, -1]]
    none = Drift.zero(start, end, n_knots)
    xyz = model.ground_from_image(pixels(), np.full(500, GROUND_M))
    np.testing.assert_allclose(model.corrected(none).image_from_ground(xyz), pixels(), rtol=0, atol=ROUND_TRIP_PX)
    # 1 m to the right of a flight to the east moves points 1 m to the left, and rolls do in proportion to the depth.
    drift = none.with_parameters(np.tile([1.0, 0, 0, 0, 0, 0], n_knots))
    np.testing.assert_array_equal(drift.parameters, np.tile([1.0, 0, 0, 0, 0, 0], n_knots))
    per_m = FOCAL_MM / PIXEL_MM / (FLIGHT_M - GROUND_M)
    moved = model.corrected(drift).image_from_ground(xyz) - pixels()
    np.testing.assert_allclose(moved, np.broadcast_to([-per_m, 0.0], moved.shape), rtol=0, atol=1e-5)
    forwards = none.with_parameters(np.tile([0, ADVANCE_M, 0, 0, 0, 0], n_knots))
    moved = model.corrected(forwards).image_from_ground(xyz) - pixels()
    np.testing.assert_allclose(moved, np.broadcast_to([0.0, -1.0], moved.shape), rtol=0, atol=1e-5)
    turned = none.with_parameters(np.tile([0, 0, 0, 0, 1e-4, 0], n_knots))
    below = np.array([(*flight.pose(np.array([400.0]))[0][0, :2], GROUND_M)])
    moved = model.corrected(turned).image_from_ground(below) - model.image_from_ground(below)
    np.testing.assert_allclose(moved, [[1e-4 * FOCAL_MM / PIXEL_MM, 0.0]], rtol=0, atol=1e-6)


def test_a_drift_between_its_knots():
    drift = Drift(np.array([0.0, 1.0, 3.0]), np.arange(18.0).reshape(3, 6))
    np.testing.assert_allclose(drift.at(drift.knots), drift.values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(drift.at(np.array([-5.0, 9.0])), drift.values[[0, -1]], rtol=0, atol=1e-12)


def test_geocentric_there_and_back_as_pyproj():
    rng = np.random.default_rng(0)
    lon, lat, h = rng.uniform(-180, 180, 500), rng.uniform(-89.9, 89.9, 500), rng.uniform(-400, 700_000, 500)
    xyz = WGS84_EARTH.cartesian_from_ground(np.column_stack([lon, lat, h]))
    expected = np.column_stack(Transformer.from_crs(4979, 4978, always_xy=True).transform(lon, lat, h))
    np.testing.assert_allclose(xyz, expected, rtol=0, atol=EARTH_M)
    found = WGS84_EARTH.geographic_from_cartesian(xyz).T
    np.testing.assert_allclose(found[:2], [lon, lat], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[2], h, rtol=0, atol=EARTH_M)


def test_the_earth_is_round_and_maps_stretch():
    """A line 2000 m up, level at its middle, sees 45 degrees aside 0.31 m lower ground than a flat Earth has, and lands
    that much further out; straight below there is no difference."""
    model, local = on_earth(0.0, 0.0, 100.0, 9.0, 47.0)
    tan = 1.0
    column = np.array([[(COLUMNS - 1) / 2 + tan * FOCAL_MM / PIXEL_MM, ROWS / 2], [(COLUMNS - 1) / 2, ROWS / 2]])
    wide = LineScanModel(focal_line(columns=COLUMNS), model.lines, model.trajectory, model.space, margin_px=20_000.0)
    xyz = wide.ground_from_image(column, np.full(2, 100.0))
    above = WGS84_EARTH.cartesian_from_ground(np.array([[9.0, 47.0, 2100.0]]))
    aside = (model.space.cartesian_from_ground(xyz) - above) @ local
    np.testing.assert_allclose(aside[1], [0.0, 0.0, -2000.0], rtol=0, atol=1e-6)
    drop = aside[0, 0] ** 2 / (2 * 6.388e6)
    np.testing.assert_allclose(aside[0], [2000.0 + drop, 0.0, -2000.0 - drop], rtol=0, atol=2e-3)
