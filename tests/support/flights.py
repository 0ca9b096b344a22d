"""Flights of line scanners along straight lines and circles, for the tests of scanners and of their files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from zlocus.io.cameras.linescan_files import navigation_rotations
from zlocus.sensors.earth_frame import WGS84_EARTH, EarthSpace, FrameSpace, east_north_up
from zlocus.sensors.linescan import FocalLine, LineScanModel, LineTimes
from zlocus.sensors.trajectory import Trajectory

UTM = CRS.from_epsg(32632)
CENTRE = (462_000.0, 5_247_000.0)
GROUND_M, FLIGHT_M = 440.0, 2440.0
FOCAL_MM, PIXEL_MM, ADVANCE_M, INTERVAL_S = 62.5, 6.5e-3, 0.208, 0.003
ROWS, COLUMNS = 900, 1200


@dataclass(frozen=True)
class Flight:
    """A flight in level steps of `INTERVAL_S`, row ROWS/2 over `CENTRE`; heading and turn in degrees and degrees per
    row; wobble of position (m) and attitude (degrees), in so many rows."""

    heading: float = 0.0
    turn: float = 0.0
    wobble_m: float = 0.0
    wobble_deg: float = 0.0
    wobble_rows: float = 3000.0
    crab: float = 0.0

    def pose(self, row):
        """Centres (n, 3) m and frame from camera (n, 3, 3) at rows (n,)."""
        since = row - ROWS / 2
        phase = 2 * np.pi * since / self.wobble_rows
        heading = np.deg2rad(self.heading + self.turn * since)
        if self.turn:
            radius = ADVANCE_M / np.deg2rad(self.turn)
            start = np.deg2rad(self.heading)
            east, north = radius * (np.cos(start) - np.cos(heading)), radius * (np.sin(heading) - np.sin(start))
        else:
            east, north = since * ADVANCE_M * np.sin(heading), since * ADVANCE_M * np.cos(heading)
        wave = [np.sin(rate * phase + lag) for rate, lag in ((1, 0.3), (0.8, 2), (0.6, 4), (0.7, 1), (0.9, 3))]
        centres = np.column_stack([CENTRE[0] + east, CENTRE[1] + north, np.full(len(row), FLIGHT_M)])
        centres += self.wobble_m * np.column_stack([wave[3], wave[4], wave[3]])
        roll, pitch, yaw = np.deg2rad(self.wobble_deg) * np.array(wave[:3])
        return centres, navigation_rotations(roll, pitch, heading + yaw + np.deg2rad(self.crab))

    def trajectory(self, margin=4500.0, every_rows=1.6):
        row = np.arange(-margin, ROWS + margin, every_rows)
        centres, frame_from_camera = self.pose(row)
        return Trajectory(row * INTERVAL_S, centres, np.ascontiguousarray(frame_from_camera.swapaxes(-1, -2)))


def focal_line(along_deg=0.0, bend_mm=0.0, turn_deg=0.0, columns=COLUMNS):
    x = (np.arange(columns) - (columns - 1) / 2) * PIXEL_MM
    y = FOCAL_MM * np.tan(np.deg2rad(along_deg)) + bend_mm * (x / x[-1]) ** 2
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return FocalLine(np.column_stack([x, y]) @ [[c, s], [-s, c]], FOCAL_MM)


def scanner(flight=None, line=None, interval=INTERVAL_S, space=None, **changes) -> LineScanModel:
    start = 0.0 if interval > 0 else (ROWS - 1) * INTERVAL_S
    lines = LineTimes.regular(start, interval, ROWS)
    flight = flight or Flight()
    return LineScanModel(line or focal_line(), lines, flight.trajectory(), space or FrameSpace(), **changes)


def on_earth(heading, along, base, lon, lat):
    """A level flight of constant heading 2000 m above `base`, and its local axes at the middle row."""
    crs = CRS.from_epsg((32600 if lat >= 0 else 32700) + int((lon + 180) // 6) + 1)
    local = east_north_up(np.deg2rad([lon]), np.deg2rad([lat]))[0]
    row = np.arange(-4500.0, ROWS + 4500.0, 1.6)
    heading = np.deg2rad(heading)
    ahead = local @ [np.sin(heading), np.cos(heading), 0.0]
    start = WGS84_EARTH.cartesian_from_ground(np.array([[lon, lat, base + 2000.0]]))
    centres = start + ((row - ROWS / 2) * ADVANCE_M)[:, None] * ahead
    camera = local @ navigation_rotations(np.zeros(1), np.zeros(1), np.array([heading]))[0]
    trajectory = Trajectory(row * INTERVAL_S, centres, np.broadcast_to(camera.T, (len(row), 3, 3)))
    lines = LineTimes.regular(0.0, INTERVAL_S, ROWS)
    return LineScanModel(focal_line(along), lines, trajectory, EarthSpace(crs)), local
