"""States of the Community Sensor Model for a satellite on a polar orbit."""

from __future__ import annotations

import numpy as np

from zlocus.io.cameras.csm import MODEL
from zlocus.sensors.earth_frame import MAJOR_M, MINOR_M


def state(z=1, sign=1, pieces=False, distortion=(0.0, 0.0, 0.0), **changes):
    """A satellite 500 km up on a polar orbit over 9 degrees east, its camera level but for slow turns; CSM's sights
    have no sign, so `sign` turns the camera around without changing them."""
    n = 21
    t = -1.0 + 0.1 * np.arange(n)
    angle = np.deg2rad(47.0) + t * 7.6e3 / (MAJOR_M + 5e5)
    radius = MAJOR_M + 5e5
    lon = np.deg2rad(9.0)
    positions = radius * np.column_stack([np.cos(angle) * np.cos(lon), np.cos(angle) * np.sin(lon), np.sin(angle)])
    quaternions = []
    for k in range(n):
        up = positions[k] / radius
        north = np.array([-np.sin(angle[k]) * np.cos(lon), -np.sin(angle[k]) * np.sin(lon), np.cos(angle[k])])
        tilt = 2e-3 * np.sin(t[k])
        down = -up * np.cos(tilt) + north * np.sin(tilt)
        ahead = north * np.cos(tilt) + up * np.sin(tilt)
        # Camera axes: x along the flight, z along the sight.
        axes = np.column_stack([ahead, np.cross(down, ahead), down])
        if sign < 0:
            axes = axes @ np.diag([1.0, -1.0, -1.0])
        quaternions.append(quaternion(axes))
    quaternions = np.array(quaternions)
    flips = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1, 1))
    quaternions[1:] *= flips[:, None]
    lines, starts, steps = [0.5], [-0.02], [TIME_STEP]
    if pieces:
        lines, starts, steps = [0.5, 200.5], [-0.02, 0.0], [TIME_STEP, 1.2 * TIME_STEP]
    return {
        "m_modelName": MODEL, "m_nLines": ROWS, "m_nSamples": COLUMNS, "m_platformFlag": 1,
        "m_intTimeLines": lines, "m_intTimeStartTimes": starts, "m_intTimes": steps,
        "m_detectorSampleSumming": 1.0, "m_detectorLineSumming": 1.0, "m_startingDetectorSample": 10.0,
        "m_startingDetectorLine": 0.0, "m_detectorSampleOrigin": 160.0, "m_detectorLineOrigin": 5.0,
        "m_iTransS": [0.1, 0.02, 100.0], "m_iTransL": [-0.2, 100.0, -0.03], "m_focalLength": 5000.0,
        "m_zDirection": z, "m_distortionType": 0, "m_opticalDistCoeffs": list(distortion),
        "m_majorAxis": MAJOR_M, "m_minorAxis": MINOR_M, "m_t0Ephem": -1.0, "m_dtEphem": 0.1,
        "m_positions": positions.ravel().tolist(), "m_velocities": [0.0] * (3 * n), "m_t0Quat": -1.0, "m_dtQuat": 0.1,
        "m_quaternions": quaternions.ravel().tolist(), "m_currentParameterValue": [0.0] * 16, "m_gsd": 1.0,
    } | changes  # fmt: skip


ROWS, COLUMNS = 400, 300
TIME_STEP = 1e-4


def quaternion(matrix):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_quat()
