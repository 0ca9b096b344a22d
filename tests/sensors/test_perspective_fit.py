"""Perspective cameras fitted to others: exact where these are perspective, and with the error that they state."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.local_frame import LocalFrame
from zlocus.sensors.perspective_fit import PixelPart, fit_perspective, without_skew
from zlocus.synthetic.cameras import LineScanner, SatelliteCamera

UTM = CRS.from_epsg(32632)
GROUND = np.array([462_000.0, 5_247_000.0, 400.0])
FRAME = LocalFrame.shifted(UTM, GROUND)
HEIGHTS = (380.0, 460.0)
PART = PixelPart(120, 80, 700, 500)
EXACT_PX = 1e-3


def satellite(along: float, across: float) -> SatelliteCamera:
    return SatelliteCamera(tuple(GROUND), (450.0, 350.0), 0.5, along, across, 10.0)


def test_a_perspective_camera_is_found():
    """A camera far above with skew and unequal focal lengths, whose optical axis looks at the part."""
    rotation = rotation_from_angles(12.0, -20.0, 30.0)
    forwards = np.array(rotation[2])
    centre = GROUND - 500_000.0 * forwards
    camera = FrameModel(tuple(centre), rotation, 1e6, (470.0, 330.0), 1.02, 3e4)
    fit = fit_perspective(camera, FRAME, PART, HEIGHTS)
    assert fit.fit_error.max_px < EXACT_PX
    assert fit.sensor.skew / fit.sensor.focal == pytest.approx(0.03, abs=1e-4)
    assert fit.sensor.aspect == pytest.approx(1.02, abs=1e-4)
    np.testing.assert_allclose(fit.sensor.centre, FRAME.local_from_ground(centre[None])[0], rtol=5e-3)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (25.0, 10.0), (-22.0, -25.0)])
def test_the_error_of_a_satellite_is_what_it_says(angles):
    sensor = satellite(*angles)
    fit = fit_perspective(sensor, FRAME, PART, HEIGHTS)
    rng = np.random.default_rng(2)
    low, high = np.array([PART.col, PART.row]) - 0.5, np.array([PART.col + PART.cols, PART.row + PART.rows]) - 0.5
    xy = rng.uniform(low, high, (4000, 2))
    xyz = sensor.ground_from_image(xy, rng.uniform(*HEIGHTS, len(xy)))
    away = np.hypot(*(fit.sensor.image_from_ground(FRAME.local_from_ground(xyz)) - xy).T)
    assert away.max() <= 1.02 * fit.fit_error.max_px
    assert np.sqrt((away**2).mean()) == pytest.approx(fit.fit_error.rms_px, rel=0.3)
    assert fit.fit_error.max_px < 0.1
    assert fit.sensor.centre[2] > 1e5


@pytest.mark.parametrize("wobble_rows", [6000.0, 900.0])
def test_an_unsteady_line_scanner_is_no_perspective_view_and_that_is_said(wobble_rows):
    sensor = LineScanner(
        (462_000.0, 5_246_000.0, 2440.0), (300.0, 5000.0), 1.0, 26.0, 0.208,
        wobble_m=0.5, wobble_deg=0.03, wobble_rows=wobble_rows,
    )  # fmt: skip
    frame = LocalFrame.shifted(UTM, sensor.ground_from_image(np.array([[470.0, 330.0]]), np.array([420.0]))[0])
    fit = fit_perspective(sensor, frame, PART, HEIGHTS)
    xy = np.random.default_rng(3).uniform((PART.col, PART.row), (PART.col + PART.cols, PART.row + PART.rows), (4000, 2))
    xyz = sensor.ground_from_image(xy, np.random.default_rng(4).uniform(*HEIGHTS, len(xy)))
    away = np.hypot(*(fit.sensor.image_from_ground(frame.local_from_ground(xyz)) - xy).T)
    assert away.max() <= 1.05 * fit.fit_error.max_px
    assert fit.fit_error.max_px > 1.0


def test_without_skew_pixels_show_the_same_ground():
    fit = fit_perspective(satellite(25.0, 15.0), FRAME, PART, HEIGHTS)
    plain, (rows, cols) = without_skew(fit.sensor, PART)
    assert plain.skew == 0.0
    assert rows == PART.rows
    assert cols >= PART.cols
    xy = PART.grid(5)
    moved = plain.image_from_ray(fit.sensor.ray_from_image(xy))
    np.testing.assert_allclose(moved[:, 1], xy[:, 1] - PART.row, atol=1e-6)
    assert (moved >= -0.5 - 1e-6).all()
    assert (moved <= np.array([cols, rows]) - 0.5 + 1e-6).all()
    shear = fit.sensor.skew / (fit.sensor.focal * fit.sensor.aspect)
    np.testing.assert_allclose(np.diff(moved[:, 0] - xy[:, 0] + shear * xy[:, 1]), 0.0, atol=1e-6)


def test_a_mirror_image_is_refused():
    class Mirrored(SatelliteCamera):
        def ground_from_image(self, xy, z):
            return super().ground_from_image(np.asarray(xy) * [-1.0, 1.0] + [900.0, 0.0], z)

    mirrored = Mirrored(tuple(GROUND), (450.0, 350.0), 0.5, 5.0, 5.0)
    with pytest.raises(GeometryError, match="mirror image"):
        fit_perspective(mirrored, FRAME, PART, HEIGHTS)
