"""Exact cameras: ground to image and back, and the directions of their angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from zlocus.core.sensor_model import SensorModel
from zlocus.synthetic.cameras import LineScanner, RectifiedScanner, SatelliteCamera, Shake

ROUND_TRIP_PX = 1e-6
TARGET = (462_000.0, 5_247_000.0, 440.0)

angles = st.floats(-40.0, 40.0)
headings = st.floats(-180.0, 180.0)
pixels = st.tuples(st.floats(-2000.0, 14_000.0), st.floats(-3000.0, 9000.0))
heights = st.floats(200.0, 900.0)


def assert_round_trip(camera: SensorModel, pixel: tuple[float, float], height: float) -> None:
    xy = np.array([pixel, (0.0, 0.0)])
    xyz = camera.ground_from_image(xy, np.array([height, 440.0]))
    np.testing.assert_array_equal(xyz[:, 2], [height, 440.0])
    np.testing.assert_allclose(camera.image_from_ground(xyz), xy, rtol=0, atol=ROUND_TRIP_PX)


@given(angles, angles, headings, pixels, heights)
def test_satellite_there_and_back(
    along: float, across: float, heading: float, pixel: tuple[float, float], height: float
) -> None:
    assert_round_trip(SatelliteCamera(TARGET, (300.0, 200.0), 0.5, along, across, heading), pixel, height)


@given(angles, headings, st.floats(0.0, 0.1), st.floats(1500.0, 9000.0), pixels, heights)
def test_line_scanner_there_and_back(
    along: float, heading: float, wobble_deg: float, wobble_rows: float, pixel: tuple[float, float], height: float
) -> None:
    camera = LineScanner(
        (TARGET[0], TARGET[1], 2440.0), (6000.0, 3000.0), heading, along, 0.208,
        wobble_m=0.5, wobble_deg=wobble_deg, wobble_rows=wobble_rows,
    )  # fmt: skip
    assert_round_trip(camera, pixel, height)


def test_the_target_is_seen_at_the_centre() -> None:
    camera = SatelliteCamera(TARGET, (123.0, 45.0), 0.5, 20.0, -7.0, 30.0)
    np.testing.assert_allclose(camera.image_from_ground(np.array([TARGET])), [[123.0, 45.0]], atol=ROUND_TRIP_PX)


def test_a_north_up_satellite_looking_forward_and_right() -> None:
    """East is right, north is up, and what is higher moves away from the camera: forward and to the right."""
    camera = SatelliteCamera(TARGET, (0.0, 0.0), 0.5, along_deg=20.0, across_deg=10.0)
    x, y, z = TARGET
    east, north, above = camera.image_from_ground(np.array([(x + 5, y, z), (x, y + 5, z), (x, y, z + 10)]))
    np.testing.assert_allclose(east, [10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(north, [0.0, -10.0], atol=1e-9)
    expected = [20.0 * np.tan(np.deg2rad(10.0)), -20.0 * np.tan(np.deg2rad(20.0))]
    np.testing.assert_allclose(above, expected, rtol=1e-4)


@pytest.mark.parametrize("along", [26.0, 2.0, -14.0])
def test_a_line_scanner_flying_north(along: float) -> None:
    """62.5 mm, 6.5 um, 2000 m: 0.208 m pixels; the line lies ahead of the aircraft by the tangent of its angle."""
    camera = LineScanner((TARGET[0], TARGET[1], 2440.0), (0.0, 0.0), 0.0, along, 0.208)
    seen = camera.ground_from_image(np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]), np.full(3, 440.0))
    ahead = 2000.0 * np.tan(np.deg2rad(along))
    np.testing.assert_allclose(seen[0], [TARGET[0], TARGET[1] + ahead, 440.0], atol=1e-6)
    np.testing.assert_allclose(seen[1] - seen[0], [0.208, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[2] - seen[0], [0.0, -0.208, 0.0], atol=1e-6)


def shaken() -> LineScanner:
    return LineScanner(
        (TARGET[0], TARGET[1], 2440.0), (300.0, 400.0), 5.0, 26.0, 0.208,
        wobble_m=0.5, wobble_deg=0.03, shake=Shake((3, 1)),
    )  # fmt: skip


@given(pixels, heights)
def test_a_shaken_line_scanner_there_and_back(pixel: tuple[float, float], height: float) -> None:
    assert_round_trip(shaken(), pixel, height)


@given(st.tuples(st.floats(-300.0, 900.0), st.floats(-300.0, 900.0)), heights)
def test_a_rectified_scanner_there_and_back(pixel: tuple[float, float], height: float) -> None:
    plane_from_image = Affine(0.21, 0.004, TARGET[0] - 60.0, 0.004, -0.21, TARGET[1] + 1050.0)
    assert_round_trip(RectifiedScanner(shaken(), (800, 700), 440.0, plane_from_image), pixel, height)


def test_level_1_keeps_places_on_its_plane_whatever_the_flight() -> None:
    plane_from_image = Affine(0.21, 0.0, TARGET[0] - 60.0, 0.0, -0.21, TARGET[1] + 1050.0)
    camera = RectifiedScanner(shaken(), (800, 700), 440.0, plane_from_image)
    rng = np.random.default_rng(2)
    xy = rng.uniform(0.0, 600.0, (200, 2))
    on_plane = camera.ground_from_image(xy, np.array(440.0))
    x, y = plane_from_image.a * xy[:, 0] + plane_from_image.c, plane_from_image.e * xy[:, 1] + plane_from_image.f
    np.testing.assert_allclose(on_plane[:, :2], np.column_stack([x, y]), rtol=0, atol=1e-6)
    # Off the plane rays differ by what the flight turned and moved aside: a hundredth of a pixel on 20 m.
    still = replace(camera, raw_camera=replace(camera.raw_camera, shake=None))
    above, steady = (each.ground_from_image(xy, np.array(460.0))[:, :2] for each in (camera, still))
    assert 1e-4 < np.std(above - steady, axis=0).max() < 0.02
    apart = camera.raw_from_image(xy) - still.raw_from_image(xy)
    assert np.std(apart, axis=0).min() > 0.2


def test_a_flight_is_shaken_in_place_and_in_every_turn() -> None:
    camera = shaken()
    rows = np.linspace(-3000.0, 3000.0, 500)
    (place, turned), (still, at_rest) = camera.poses(rows), replace(camera, shake=None).poses(rows)
    assert camera.shake is not None
    expected = camera.shake.at(rows - camera.centre[1])
    apart = at_rest.swapaxes(-1, -2) @ turned
    found = np.column_stack([apart[:, 0, 2], -apart[:, 1, 2], apart[:, 1, 0]])
    # Products of a wobble of 5e-4 and a shake of 1e-4.
    np.testing.assert_allclose(found, expected[:, 3:], rtol=0, atol=3e-7)
    heading = np.deg2rad(camera.heading_deg)
    right, forward = (np.cos(heading), -np.sin(heading), 0.0), (np.sin(heading), np.cos(heading), 0.0)
    axes = np.array([right, forward, (0.0, 0.0, 1.0)])
    np.testing.assert_allclose((place - still) @ axes.T, expected[:, :3], rtol=0, atol=1e-6)


def test_shaking_is_as_strong_as_it_says_and_the_same_again() -> None:
    shake = Shake((7,), turn_deg=0.01, offset_m=0.1)
    found = shake.at(np.arange(0.0, 60_000.0))
    np.testing.assert_allclose(found[:, :3].std(axis=0), 0.1, rtol=0.1)
    np.testing.assert_allclose(np.rad2deg(found[:, 3:].std(axis=0)), 0.01, rtol=0.1)
    np.testing.assert_array_equal(found[:50], Shake((7,), turn_deg=0.01, offset_m=0.1).at(np.arange(50.0)))
    assert np.abs(found[:50] - Shake((8,), turn_deg=0.01, offset_m=0.1).at(np.arange(50.0))).max() > 1e-5
    # A row moves by a fraction of a pixel (0.006 degrees) against the next one.
    assert 1e-4 < np.rad2deg(np.abs(np.diff(found[:, 3:], axis=0)).max()) < 2e-3
