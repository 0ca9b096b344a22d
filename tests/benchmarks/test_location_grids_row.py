"""The row that compares location grids with RPC."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from pyproj import CRS

from rows.location_grids import N_POINTS, distances_px
from rpc_fixtures import satellite_rpc
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.rpc import RpcModel

SAME_PX = 1e-6


def test_distances_of_cameras_that_differ_by_a_shift():
    sensor = RpcModel(satellite_rpc(), CRS.from_epsg(32631))
    scene, other_scene = (
        SimpleNamespace(views=[SimpleNamespace(sensor=each, image=SimpleNamespace(shape=(500, 400)))])
        for each in (sensor, ShiftedModel(sensor, 0.3, -0.4))
    )
    found = distances_px(scene, other_scene)
    assert found.shape == (N_POINTS,)
    np.testing.assert_allclose(found, 0.5, rtol=0, atol=SAME_PX)
