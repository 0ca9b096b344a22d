"""Groups of exact cameras of every kind, with the ground that they see and control points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flights import CENTRE, FLIGHT_M, INTERVAL_S, Flight, focal_line
from orientation_scenes import AffineSensor, observe
from zlocus.core.scene import View
from zlocus.orientation.control import GroundControl
from zlocus.orientation.shift_adjustment import renumbered
from zlocus.orientation.triangulate import Observations, triangulate
from zlocus.sensors.earth_frame import FrameSpace
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.linescan import LineScanModel, LineTimes

FRAME_SIZE = (6000, 4000)
SCAN_ROWS, SCAN_COLUMNS = 13_000, 1200
AFFINE_SIZE = (800, 800)


@dataclass(frozen=True)
class Blank:
    """An image of a size, without pixels."""

    shape: tuple[int, int]


def views_of(sensors, size):
    """Views of blank images, `size` columns and rows."""
    return [View(f"view{i}", Path(f"view{i}.tif"), Blank(size[::-1]), s) for i, s in enumerate(sensors)]


def seen_by(sensors, xyz, size, noise_px=0.0, seed=0):
    """Image points inside the images of ground points that two images see, and those points."""
    every = observe(sensors, xyz)
    inside = np.isfinite(every.xy).all(axis=1) & ((every.xy >= 0) & (every.xy <= np.array(size) - 1)).all(axis=1)
    seen = every.kept(inside)
    seen = seen.kept(np.bincount(seen.point, minlength=len(xyz))[seen.point] >= 2)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, seen.xy.shape) * noise_px
    return renumbered(Observations(seen.view, seen.point, seen.xy + noise), xyz)


def first_points(sensors, seen, xyz):
    """Where flawed cameras put the ties."""
    return triangulate(sensors, seen, xyz).xyz


def flight_of_frames(n_strips=2, n=4, height_m=1500.0, focal=6000.0):
    """Frame cameras in strips flown to and fro, 450 m apart along, 500 m across."""
    rng = np.random.default_rng(3)
    cameras = []
    for strip in range(n_strips):
        for k in range(n):
            omega, phi, kappa = rng.normal(0.0, 1.0, 3)
            rotation = rotation_from_angles(omega, phi, kappa + 180.0 * (strip % 2))
            centre = (k * 450.0 - 700.0, strip * 500.0 - 250.0, height_m)
            cameras.append(FrameModel(centre, rotation, focal, (2999.5, 1999.5)))
    return cameras


def frame_ground(n, relief_m=120.0, seed=5):
    """Ground points under those cameras, (n, 3) m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-1300, 1300, n), rng.uniform(-900, 900, n), rng.uniform(0, relief_m, n)])


def flawed_frames(cameras, sigma_m=0.5, sigma_deg=0.03, seed=7):
    """The cameras with errors of their poses."""
    rng = np.random.default_rng(seed)
    return [
        camera.corrected(rng.normal(0.0, sigma_m, 3), np.deg2rad(rng.normal(0.0, sigma_deg, 3))) for camera in cameras
    ]


def strips_of_lines(headings=(0.0, 180.0)):
    """Three lines of a scanner in each of some strips that cross the same ground; lines of a strip share its flight."""
    sensors = []
    times = LineTimes.regular(-6000.0 * INTERVAL_S, INTERVAL_S, SCAN_ROWS)
    for heading in headings:
        path = Flight(heading, wobble_m=0.5, wobble_deg=0.2).trajectory(margin=8000.0, every_rows=16.0)
        for along in (26.0, 2.0, -14.0):
            sensors.append(LineScanModel(focal_line(along), times, path, FrameSpace()))
    return sensors


def scan_ground(n, seed=9):
    """Ground points within the strips, (n, 3) m."""
    rng = np.random.default_rng(seed)
    side, along = SCAN_COLUMNS * 0.2 * 0.45, 250.0
    xy = np.array(CENTRE) + np.column_stack([rng.uniform(-side, side, n), rng.uniform(-along, along, n)])
    return np.column_stack([xy, FLIGHT_M - 2000.0 + rng.uniform(-40, 40, n)])


def affine_sensors():
    """Four satellites from different directions."""
    looks = ((0.0, 0.0), (0.3, 0.05), (-0.25, 0.1), (0.1, 0.3))
    return [AffineSensor(*look, centre=(400.0, 400.0)) for look in looks]


def control_of(sensors, xyz, size, is_check=None, moved=None):
    """Control points in all images that show them. is_check : (n,); moved : (n, 3) m added to their coordinates."""
    seen = observe(sensors, xyz)
    inside = np.isfinite(seen.xy).all(axis=1) & ((seen.xy >= 0) & (seen.xy <= np.array(size) - 1)).all(axis=1)
    names = tuple(f"point{i}" for i in range(len(xyz)))
    role = np.zeros(len(xyz), bool) if is_check is None else np.asarray(is_check)
    given = xyz if moved is None else xyz + moved
    return GroundControl(names, given, np.full(xyz.shape, 0.01), role, seen.kept(inside))
