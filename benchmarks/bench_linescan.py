"""Speed of the sensor model of the line scanner on one core: points per second in both directions."""

from __future__ import annotations

import numpy as np
import pytest

from bench_kernels import Case, timed
from zlocus.sensors.earth_frame import EarthSpace, FrameSpace
from zlocus.sensors.linescan import LineScanModel, LineTimes
from zlocus.synthetic.linescan import SPEED_M_S, focal_line, sampled_trajectory
from zlocus.synthetic.scenes import demo_spec, exposures_of, steady

SIDE = 700


@pytest.fixture
def scanner(side):
    """The forward line of the demo, of the raw and of a steady flight, and a grid of ground points inside it."""
    spec = steady(demo_spec())
    exposure = exposures_of(spec)[1]
    interval = -exposure.sensor.advance_m / SPEED_M_S
    lines = LineTimes.regular(0.0, interval, exposure.shape[0])
    model = LineScanModel(
        focal_line(exposure.sensor), lines, sampled_trajectory(exposure.sensor, exposure.shape[0]), FrameSpace()
    )
    n = side or SIDE
    x, y = np.meshgrid(np.linspace(0.0, 120.0, n), np.linspace(0.0, -120.0, n))
    xyz = np.column_stack([x.ravel() + spec.west_m, y.ravel() + spec.north_m, np.full(n * n, 440.0)])
    return spec, model, xyz


def test_image_from_ground(benchmark, scanner):
    _, model, xyz = scanner
    timed(benchmark, Case(lambda: model.image_from_ground(xyz), len(xyz), "point"))


def test_ground_from_image(benchmark, scanner):
    _, model, xyz = scanner
    xy = model.image_from_ground(xyz)
    timed(benchmark, Case(lambda: model.ground_from_image(xy, xyz[:, 2]), len(xyz), "point"))


def test_to_the_earth(benchmark, scanner):
    """Conversion of projected to geocentric coordinates, the extra cost of geocentric rays in `image_from_ground`."""
    spec, _, xyz = scanner
    timed(benchmark, Case(lambda: EarthSpace(spec.crs).cartesian_from_ground(xyz), len(xyz), "point"))
