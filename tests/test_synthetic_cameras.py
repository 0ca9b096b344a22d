"""Exact cameras: there and back, and the directions that their angles mean."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.sensors.model import SensorModel
from zlocus.synthetic.cameras import LineScanner, SatelliteCamera

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
