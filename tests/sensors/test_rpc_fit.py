"""RPC fitted to exact cameras: as good as it says, and honest where it is bad."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import SensorModel
from zlocus.sensors.rpc import RpcModel
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import LineScanner, SatelliteCamera
from zlocus.synthetic.scenes import demo_spec, exposures_of, steady

UTM32 = CRS.from_epsg(32632)
SHAPE = (700, 631)
HEIGHTS = (400.0, 520.0)
SATELLITE_PX = 1e-6
SCANNER_PX = 1e-3


def satellite(along: float, across: float, heading: float) -> SatelliteCamera:
    return SatelliteCamera((462_000.0, 5_247_000.0, 440.0), (320.0, 350.0), 0.5, along, across, heading)


def scanner(wobble_rows: float) -> LineScanner:
    return LineScanner(
        (462_000.0, 5_246_000.0, 2440.0), (300.0, 5000.0), 1.0, 26.0, 0.208,
        wobble_m=0.5, wobble_deg=0.03, wobble_rows=wobble_rows,
    )  # fmt: skip


def worst_px(camera: SensorModel, fitted: SensorModel) -> float:
    rng = np.random.default_rng(5)
    xy = rng.uniform((0, 0), (SHAPE[1], SHAPE[0]), (500, 2))
    xyz = camera.ground_from_image(xy, rng.uniform(*HEIGHTS, 500))
    return float(np.abs(fitted.image_from_ground(xyz) - xy).max())


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (25.0, 10.0, 5.0), (-22.0, 13.0, 190.0), (45.0, -30.0, 77.0)])
def test_satellites_are_fitted_exactly(angles: tuple[float, float, float]) -> None:
    camera = satellite(*angles)
    fit = fit_rpc(camera, SHAPE, UTM32, HEIGHTS)
    assert fit.max_error_px < SATELLITE_PX
    assert worst_px(camera, RpcModel(fit.rpc, UTM32)) < SATELLITE_PX


def test_every_view_of_the_demo_is_fitted() -> None:
    spec = steady(demo_spec())
    for exposure in exposures_of(spec):
        assert fit_rpc(exposure.sensor, exposure.shape, spec.crs, spec.height_range).max_error_px < SCANNER_PX


@pytest.mark.parametrize("wobble_rows", [6000.0, 700.0])
def test_the_error_reported_is_the_error(wobble_rows: float) -> None:
    camera = scanner(wobble_rows)
    fit = fit_rpc(camera, SHAPE, UTM32, HEIGHTS)
    worst = worst_px(camera, RpcModel(fit.rpc, UTM32))
    assert 0.5 * worst < fit.max_error_px < 3.0 * worst + SATELLITE_PX
    assert (fit.max_error_px < SCANNER_PX) == (wobble_rows > 1000.0)


def test_an_rpc_that_fails_somewhere_has_no_finite_error() -> None:
    assert fit_rpc(scanner(400.0), SHAPE, UTM32, HEIGHTS).max_error_px == np.inf


def test_heights_must_be_a_range() -> None:
    with pytest.raises(GeometryError, match="low < high"):
        fit_rpc(satellite(0.0, 0.0, 0.0), SHAPE, UTM32, (500.0, 500.0))


def test_a_sensor_that_sees_nothing_is_refused() -> None:
    with pytest.raises(GeometryError, match="no RPC fits"):
        fit_rpc(satellite(np.nan, 0.0, 0.0), SHAPE, UTM32, HEIGHTS)
