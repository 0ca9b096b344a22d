"""Blocks of a drone whose camera is calibrated from its own images: exact cameras, planted errors, ties with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bundle_scenes import first_points, seen_by, views_of
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.orientation.bundle_adjustment import adjust_bundle
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.rolling_shutter import RollingShutter

DRONE_SIZE = (4000, 3000)
SPEED_M_S = 8.0
LENS = BrownDistortion(k1=-0.10, k2=0.03, p1=3e-4, p2=-2e-4)
# GNSS without corrections in real time, averaged; a gimbal.
POSITION_M, ATTITUDE_DEG = 0.05, 0.5


def strip(centre, heading_deg, n, spacing_m, tilt_deg=0.0, seed=0, noise_deg=1.0):
    """Cameras of a strip through a place, which fly towards the top of their images; tilt_deg : forwards."""
    heading = np.deg2rad(heading_deg)
    forward = np.array([np.sin(heading), np.cos(heading), 0.0])
    rng = np.random.default_rng(seed)
    cameras = []
    for k in range(n):
        at = np.add(centre, (k - (n - 1) / 2) * spacing_m * forward)
        omega, phi, kappa = noise_deg * rng.standard_normal(3)
        rotation = rotation_from_angles(0.0, 0.0, -heading_deg + kappa)
        camera = FrameModel(tuple(at), rotation, 3000.0, (1999.5, 1499.5), distortion=LENS)
        # About the camera's own axes: to the right turns the view forwards.
        camera = camera.corrected(np.zeros(3), np.deg2rad([tilt_deg + omega, phi, 0.0]))
        shutter = RollingShutter(0.030, tuple(float(v) for v in SPEED_M_S * forward), DRONE_SIZE[1])
        cameras.append(replace(camera, rolling_shutter=shutter))
    return cameras


def flat_block(noise_deg=1.0):
    """Three parallel strips of nadir images, flown to and fro at one height."""
    return [
        camera
        for row in range(3)
        for camera in strip(((row - 1) * 45.0, 0.0, 80.0), 180.0 * (row % 2), 4, 32.0, seed=row, noise_deg=noise_deg)
    ]


def crossing_block():
    """The flat block, two strips across it and higher, and two of oblique images."""
    across = [strip((0.0, y, 105.0), 90.0 + 180.0 * k, 3, 45.0, seed=10 + k) for k, y in enumerate((-25.0, 25.0))]
    oblique = [
        strip((x, y, 85.0), heading, 3, 35.0, 30.0, seed=20 + k)
        for k, (x, y, heading) in enumerate(((15.0, -60.0, 0.0), (-15.0, 60.0, 180.0)))
    ]
    return [*flat_block(), *(camera for part in (*across, *oblique) for camera in part)]


def block_ground(n, relief_m=0.0, seed=0):
    """Ground points under a block, (n, 3) m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-90, 90, n), rng.uniform(-90, 90, n), rng.uniform(0, relief_m or 1e-9, n)])


def flawed_poses(cameras, seed):
    """The cameras with errors of their poses, as the standard deviations of `options_with` say."""
    rng = np.random.default_rng(seed)
    return [
        camera.corrected(rng.normal(0.0, POSITION_M, 3), np.deg2rad(rng.normal(0.0, ATTITUDE_DEG, 3)))
        for camera in cameras
    ]


def options_with(*names, **changes):
    """Options of a self-calibration of some parameters."""
    return OrientationOptions(
        bundle_adjustment=BundleAdjustmentOptions(
            self_calibration=names, sigma_position_m=POSITION_M, sigma_attitude_deg=ATTITUDE_DEG, **changes
        )
    )


def calibrated(exact, flawed, xyz, options, noise_px=0.3, seed=0, **more):
    """The bundle adjustment of flawed cameras from what the exact ones see."""
    seen, xyz = seen_by(exact, xyz, DRONE_SIZE, noise_px, seed)
    return adjust_bundle(views_of(flawed, DRONE_SIZE), seen, first_points(flawed, seen, xyz), options, **more)
