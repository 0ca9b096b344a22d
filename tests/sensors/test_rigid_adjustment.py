"""Adjustments for Ames Stereo Pipeline, judged by an own model of its adjusted RPC camera."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Transformer

from rpc_fixtures import satellite_rpc
from zlocus.products.adjust_files import adjust_file_name, write_adjust
from zlocus.sensors.correction import AffinelyShiftedModel, ShiftedModel
from zlocus.sensors.rigid_adjustment import MAX_CENTRE_M, fit_adjustment
from zlocus.sensors.rpc import RpcModel

UTM = CRS.from_epsg(32631)
SHAPE = (40_000, 40_200)
HEIGHTS = (100.0, 900.0)
GEOCENTRIC = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
# Of the Cartesian coordinates of PROJ, which has another formula for the way back.
ROUNDING_PX = 1e-4


def rotated(quaternion, points):
    """Points (n, 3) turned by a quaternion (w, x, y, z): v + 2 w (q x v) + 2 q x (q x v)."""
    w, q = quaternion[0], quaternion[1:]
    once = np.cross(q, points)
    return points + 2 * w * once + 2 * np.cross(q, once)


def adjusted_positions(path, rpc, centre_up_m, lon_lat_h):
    """Image positions of an RPC camera with the adjustment in a file, as Vision Workbench computes them."""
    numbers = [float(word) for word in path.read_text().split()]
    assert numbers[7:] == [0.0, 0.0, 1.0]
    translation, quaternion = np.array(numbers[:3]), np.array(numbers[3:7])
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
    model = RpcModel(rpc, UTM)
    height = np.array([rpc.height_off + centre_up_m])
    lon, lat = model.geographic_from_image(np.zeros((1, 2)), height)
    centre = np.array(GEOCENTRIC.transform(lon, lat, height)).T
    ground = np.array(GEOCENTRIC.transform(*lon_lat_h.T)).T
    before = rotated(quaternion * [1, -1, -1, -1], ground - centre - translation) + centre
    return model.image_from_geographic(*GEOCENTRIC.transform(*before.T, direction="INVERSE"))


@pytest.mark.parametrize(
    ("correct", "most_px"),
    [
        (lambda sensor: ShiftedModel(sensor, 6.0, -11.0), 0.06),
        # A rotation about the line of sight, and a scale, which no rigid motion has.
        (lambda sensor: AffinelyShiftedModel(sensor, (2.0, 0.0, 2e-5), (-3.0, -2e-5, 0.0)), 0.2),
        (lambda sensor: AffinelyShiftedModel(sensor, (2.0, 3e-5, 0.0), (-3.0, 0.0, 3e-5)), 1.0),
    ],
)
def test_an_adjusted_rpc_projects_as_the_corrected_sensor(tmp_path, correct, most_px):
    rpc = satellite_rpc()
    delivered = RpcModel(rpc, UTM)
    corrected = correct(delivered)
    found = fit_adjustment(delivered, corrected, SHAPE, UTM, HEIGHTS)
    write_adjust(tmp_path / "run-a.adjust", found)
    rng = np.random.default_rng(4)
    xy = rng.uniform((0, 0), (SHAPE[1], SHAPE[0]), (2000, 2))
    xyz = corrected.ground_from_image(xy, rng.uniform(*HEIGHTS, len(xy)))
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(*xyz[:, :2].T)
    # An old version places the camera at another height of the same ray.
    for up in (MAX_CENTRE_M, 0.0):
        seen = adjusted_positions(tmp_path / "run-a.adjust", rpc, up, np.column_stack([lon, lat, xyz[:, 2]]))
        away = np.hypot(*(seen - xy).T)
        assert away.max() <= 1.02 * found.fit_error.max_px + 10 * ROUNDING_PX
        assert np.sqrt((away**2).mean()) == pytest.approx(found.fit_error.rms_px, rel=0.3, abs=ROUNDING_PX)
    assert found.fit_error.max_px < most_px


def test_an_rpc_that_needs_none_gets_none(tmp_path):
    delivered = RpcModel(satellite_rpc(), UTM)
    found = fit_adjustment(delivered, delivered, SHAPE, UTM, HEIGHTS)
    assert np.abs(found.translation).max() < 1e-3
    assert found.fit_error.max_px < ROUNDING_PX


def test_file_names_are_those_that_the_program_looks_for(tmp_path):
    assert adjust_file_name(tmp_path / "deep" / "scene.01.NTF") == "run-scene.01.adjust"
