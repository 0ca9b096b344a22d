"""Local axes for other programs: rays stay straight, and cameras see the same ground at the same pixels."""

from __future__ import annotations

import numpy as np
from pyproj import CRS, Transformer

from zlocus.sensors.earth_frame import FRAME_SPACE
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.local_frame import LocalFrame

UTM = CRS.from_epsg(32632)
GROUND = np.array([462_000.0, 5_247_000.0, 400.0])
SAME_M, SAME_PX = 1e-6, 1e-6


def test_a_tangent_frame_is_that_of_proj():
    """PROJ's own topocentric frame at the same place."""
    frame = LocalFrame.tangent(UTM, GROUND)
    points = GROUND + np.random.default_rng(0).uniform(-3000, 3000, (50, 3))
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(*GROUND[:2])
    topocentric = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=utm +zone=32 +ellps=WGS84 +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={float(GROUND[2])!r}"
    )
    np.testing.assert_allclose(frame.local_from_ground(points), np.column_stack(topocentric.transform(*points.T)),
                               atol=SAME_M)  # fmt: skip
    np.testing.assert_allclose(frame.ground_from_local(frame.local_from_ground(points)), points, atol=SAME_M)
    matrix = np.array(frame.as_dict()["geocentric_from_local"])
    cartesian = frame.space.cartesian_from_ground(points)
    local = np.column_stack([frame.local_from_ground(points), np.ones(len(points))])
    np.testing.assert_allclose((local @ matrix.T)[:, :3], cartesian, atol=SAME_M)


def test_cameras_are_exact_in_their_own_space_only():
    flat = FrameModel((*GROUND[:2], 1500.0), rotation_from_angles(3.0, -8.0, 40.0), 900.0, (400.0, 300.0))
    curved = flat.on_earth(UTM, UTM)
    points = GROUND + np.random.default_rng(1).uniform(-200, 200, (50, 3)) * [1.0, 1.0, 0.2]
    shifted, tangent = LocalFrame.shifted(UTM, GROUND), LocalFrame.tangent(UTM, GROUND)
    for sensor, frame, other in ((flat, shifted, tangent), (curved, tangent, shifted)):
        local = frame.camera(sensor)
        assert local.space == FRAME_SPACE
        assert np.abs(local.centre).max() < 5000.0
        seen = local.image_from_ground(frame.local_from_ground(points))
        np.testing.assert_allclose(seen, sensor.image_from_ground(points), atol=SAME_PX)
        assert other.camera(sensor) is None
