"""Exact cameras for rendered scenes: straight rays in the scene's frame, whose easting, northing, height are Cartesian.

Both are pushbroom: every image row has its own projection centre, so that rows are instants. Both are `SensorModel`s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zlocus.sensors.model import FloatArray

CHORD_ITERATIONS = 20
CHORD_TOLERANCE_ROWS = 1e-8


def _axes(heading_deg: float) -> tuple[FloatArray, FloatArray]:
    """Forward and right unit vectors (east, north) of a flight heading, clockwise from north."""
    a = np.deg2rad(heading_deg)
    return np.array([np.sin(a), np.cos(a)]), np.array([np.cos(a), -np.sin(a)])


@dataclass(frozen=True)
class SatelliteCamera:
    """A pushbroom satellite with constant view angles; both directions in closed form.

    The image is flown over so that row 0 is the far end in flight direction (as north-up images have it).

    target : easting, northing and height (m) seen by `centre`; centre : (column, row) px of the target.
    gsd_m : ground pixel at the target's height. altitude_m : of the orbit above the target.
    along_deg, across_deg : tangent angles from the nadir; positive looks forward, respectively to the right, from the
    satellite. heading_deg : clockwise from north.
    """

    target: tuple[float, float, float]
    centre: tuple[float, float]
    gsd_m: float
    along_deg: float
    across_deg: float
    heading_deg: float = 0.0
    altitude_m: float = 600_000.0

    def _frame(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Forward, right, and the offset (east, north) from the target to the projection centre of the centre row."""
        forward, right = _axes(self.heading_deg)
        look = np.tan(np.deg2rad(self.along_deg)) * forward + np.tan(np.deg2rad(self.across_deg)) * right
        return forward, right, -self.altitude_m * look

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xyz = np.asarray(xyz, float)
        forward, right, centre = self._frame()
        depth = 1.0 - (xyz[:, 2:] - self.target[2]) / self.altitude_m
        rest = xyz[:, :2] - np.array(self.target[:2]) - (1.0 - depth) * centre
        col = self.centre[0] + (rest @ right) / (depth[:, 0] * self.gsd_m)
        row = self.centre[1] - (rest @ forward) / self.gsd_m
        return np.column_stack([col, row])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xy = np.asarray(xy, float)
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        forward, right, centre = self._frame()
        depth = (1.0 - (z - self.target[2]) / self.altitude_m)[:, None]
        along = (self.centre[1] - xy[:, 1:]) * self.gsd_m
        across = (xy[:, :1] - self.centre[0]) * self.gsd_m
        ground = np.array(self.target[:2]) + (1.0 - depth) * centre + along * forward + depth * across * right
        return np.column_stack([ground, z])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`: exact at any height."""
        return None


@dataclass(frozen=True)
class LineScanner:
    """One line of an airborne three-line scanner (ADS40): a straight flight with slow, smooth wobble.

    The line sees `along_deg` ahead of the nadir (negative: behind). Rows are exposures, `advance_m` apart; row 0 is the
    last one flown, so that images of a flight to the north are north-up.

    position : easting, northing and height (m) of the projection centre at row `centre[1]`.
    centre : (column, row) px; the column lies in the flight's vertical plane.
    wobble_m, wobble_deg : amplitudes of the position (each axis) and of roll, pitch and yaw; wobble_rows : their
    period.
    """

    position: tuple[float, float, float]
    centre: tuple[float, float]
    heading_deg: float
    along_deg: float
    advance_m: float
    focal_m: float = 0.0625
    pixel_m: float = 6.5e-6
    wobble_m: float = 0.0
    wobble_deg: float = 0.0
    wobble_rows: float = 6000.0

    def poses(self, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Projection centres (n, 3) m and rotations frame_from_camera (n, 3, 3) of rows (n,); camera axes are right,
        forward and up at rest."""
        forward, right = _axes(self.heading_deg)
        since = row - self.centre[1]
        phase = 2.0 * np.pi * since / self.wobble_rows
        roll, pitch, yaw = (np.deg2rad(self.wobble_deg) * np.sin(rate * phase + lag)
                            for rate, lag in ((1.0, 0.3), (0.8, 1.9), (0.6, 4.0)))  # fmt: skip
        centre = np.empty((len(row), 3))
        centre[:, :2] = np.array(self.position[:2]) - (since * self.advance_m)[:, None] * forward
        centre[:, :2] += self.wobble_m * (np.sin(0.7 * phase + 0.5)[:, None] * right)
        centre[:, 2] = self.position[2] + self.wobble_m * np.sin(0.9 * phase + 2.2)
        rest = np.stack([np.append(right, 0.0), np.append(forward, 0.0), np.array([0.0, 0.0, 1.0])], axis=1)
        cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
        turn = np.empty((len(row), 3, 3))
        turn[:, 0] = np.stack([cy * cr - sy * sp * sr, -sy * cp, cy * sr + sy * sp * cr], axis=-1)
        turn[:, 1] = np.stack([sy * cr + cy * sp * sr, cy * cp, sy * sr - cy * sp * cr], axis=-1)
        turn[:, 2] = np.stack([-cp * sr, sp, cp * cr], axis=-1)
        return centre, np.asarray(rest @ turn)

    def _focal_plane(self, xyz: FloatArray, row: FloatArray) -> FloatArray:
        """Where ground points (n, 3) fall in the focal plane at the instants of rows (n,): right, forward (n, 2) m."""
        centre, frame_from_camera = self.poses(row)
        seen = np.einsum("nji,nj->ni", frame_from_camera, xyz - centre)
        return np.asarray(self.focal_m * seen[:, :2] / -seen[:, 2:])

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`. The row is where the point crosses the line: chord steps along the flight, whose slope is
        that of the flight at rest (the wobble turns it by about a hundredth, so each step wins two digits)."""
        xyz = np.asarray(xyz, float)
        line = self.focal_m * np.tan(np.deg2rad(self.along_deg))
        row = np.full(len(xyz), float(self.centre[1]))
        slope = self.focal_m * self.advance_m / (self.position[2] - xyz[:, 2])
        for _ in range(CHORD_ITERATIONS):
            step = (self._focal_plane(xyz, row)[:, 1] - line) / slope
            row = row - step
            if not (np.abs(step) > CHORD_TOLERANCE_ROWS).any():
                break
        col = self.centre[0] + self._focal_plane(xyz, row)[:, 0] / self.pixel_m
        return np.column_stack([col, row])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xy = np.asarray(xy, float)
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        line = self.focal_m * np.tan(np.deg2rad(self.along_deg))
        ray = np.column_stack(
            [(xy[:, 0] - self.centre[0]) * self.pixel_m, np.full(len(xy), line), np.full(len(xy), -self.focal_m)]
        )
        centre, frame_from_camera = self.poses(xy[:, 1])
        towards = np.einsum("nij,nj->ni", frame_from_camera, ray)
        reach = (z - centre[:, 2]) / towards[:, 2]
        ground: FloatArray = centre + reach[:, None] * towards
        ground[:, 2] = z
        return ground

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`: exact at any height."""
        return None
