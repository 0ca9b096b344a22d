"""One camera is corrected by points of known ground, some of them wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rendered_scenes import CENTRE, SIZE_PX, camera
from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.orientation.resection import resected
from zlocus.sensors.correction import AffinelyShiftedModel, ShiftedModel

NOISE_PX, FOUND_PX = 0.2, 0.06


class Image:
    shape, dtype = (SIZE_PX, SIZE_PX), "uint16"


def points(n, seed=3):
    rng = np.random.default_rng(seed)
    return np.column_stack([CENTRE + rng.uniform(-35, 35, (n, 2)), rng.uniform(40, 60, n)])


@pytest.mark.parametrize(
    ("n", "true"),
    [
        (30, lambda sensor: ShiftedModel(sensor, 8.0, -6.0)),
        (200, lambda sensor: AffinelyShiftedModel(sensor, (8.0, 0.004, -0.003), (-6.0, 0.002, 0.005))),
    ],
)
def test_a_camera_is_corrected(n, true):
    sensor = camera("fore")
    view, xyz = View("fore", Path("fore.tif"), Image(), sensor), points(n)
    rng = np.random.default_rng(5)
    xy = true(sensor).image_from_ground(xyz) + rng.normal(0, NOISE_PX, (n, 2))
    xy[: n // 10] += 5.0  # mistaken points
    found = resected(view, xyz, xy, OrientationOptions())
    off = found.sensor.image_from_ground(points(100, 9)) - true(sensor).image_from_ground(points(100, 9))
    assert np.sqrt((off**2).mean()) < (2 * FOUND_PX if n < 60 else FOUND_PX)
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.4)


def test_a_self_calibration_asked_for_elsewhere_does_not_matter():
    options = OrientationOptions()
    bundle = replace(options.bundle_adjustment, self_calibration=("focal",), sigma_focal_px=2.0)
    view, xyz = View("fore", Path("fore.tif"), Image(), camera("fore")), points(20)
    xy = view.sensor.image_from_ground(xyz)
    assert resected(view, xyz, xy, replace(options, bundle_adjustment=bundle)).sigma_px < NOISE_PX
