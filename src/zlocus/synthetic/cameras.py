"""Exact cameras of rendered scenes. Easting, northing and height are taken as Cartesian, and rays are straight in them.

All are pushbroom cameras: every row has its own projection centre, because it is exposed at its own time. All are
`SensorModel`s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine

from zlocus.core.sensor_model import FloatArray

CHORD_ITERATIONS = 20
CHORD_TOLERANCE_ROWS = 1e-8
SHAKE_STREAM = 83
SHAKE_WAVES = 16


def axes_of_heading(heading_deg: float) -> tuple[FloatArray, FloatArray]:
    """Forward and right unit vectors (east, north) of a flight heading, clockwise from north."""
    a = np.deg2rad(heading_deg)
    return np.array([np.sin(a), np.cos(a)]), np.array([np.cos(a), -np.sin(a)])


@dataclass(frozen=True)
class SatelliteCamera:
    """A pushbroom satellite with constant view angles. Both projections have a closed form.

    Row 0 is the far end in flight direction, as in north-up images.

    target : easting, northing and height (m) of a point; centre : its position (column, row) px in the image.
    gsd_m : ground pixel at the target's height. altitude_m : of the orbit above the target.
    along_deg, across_deg : view angles from the nadir, positive forward and to the right of the satellite.
    heading_deg : clockwise from north.
    """

    target: tuple[float, float, float]
    centre: tuple[float, float]
    gsd_m: float
    along_deg: float
    across_deg: float
    heading_deg: float = 0.0
    altitude_m: float = 600_000.0

    def _frame(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Forward and right unit vectors, and the offset (east, north) from target to projection centre of its row."""
        forward, right = axes_of_heading(self.heading_deg)
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
class Shake:
    """Unsteadiness of a flight from row to row: sums of sines with random phases. Equal seeds give equal motion.

    turn_deg : standard deviation of roll, pitch and yaw, with amplitudes proportional to 1 / frequency (the motion that
    remains behind a stabilised mount); offset_m : standard deviation of the position along each axis, with amplitudes
    proportional to 1 / frequency^2; shortest_rows, longest_rows : shortest and longest period. The periods are spread
    evenly on a logarithmic scale.
    """

    seed: tuple[int, ...]
    turn_deg: float = 0.006
    offset_m: float = 0.03
    shortest_rows: float = 24.0
    longest_rows: float = 1200.0

    def at(self, since: FloatArray) -> FloatArray:
        """Offsets along three axes (m) and rotations about them (rad) at rows (n,), in that order: (n, 6)."""
        rng = np.random.default_rng([*self.seed, SHAKE_STREAM])
        shares = (np.arange(SHAKE_WAVES)[:, None] + rng.random((SHAKE_WAVES, 6))) / SHAKE_WAVES
        periods = self.shortest_rows * (self.longest_rows / self.shortest_rows) ** shares
        amplitudes = np.hstack([periods[:, :3] ** 2, periods[:, 3:]])
        amplitudes *= np.sqrt(2.0 / (amplitudes**2).sum(axis=0))
        amplitudes *= [self.offset_m] * 3 + [float(np.deg2rad(self.turn_deg))] * 3
        phases = 2.0 * np.pi * rng.random((SHAKE_WAVES, 6))
        return np.asarray((amplitudes * np.sin(2.0 * np.pi * since[:, None, None] / periods + phases)).sum(axis=1))


@dataclass(frozen=True)
class LineScanner:
    """One line of an airborne three-line scanner (ADS40) on a straight flight with a slow wobble and a faster shake.

    Rows are exposures, `advance_m` apart. Row 0 is exposed last, so images of a flight to the north are north-up.

    position : easting, northing and height (m) of the projection centre at row `centre[1]`.
    centre : (column, row) px; the column lies in the vertical plane of the flight.
    along_deg : view angle of the line ahead of the nadir, negative behind it.
    wobble_m, wobble_deg : amplitudes of the position (each axis) and of roll, pitch and yaw; wobble_rows : their
    period. shake : faster motion of the same flight; None: no such motion.
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
    shake: Shake | None = None

    def poses(self, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Projection centres (n, 3) m and rotations frame_from_camera (n, 3, 3) of rows (n,).

        The camera's axes are right, forward and up, without wobble and shake.
        """
        if self.shake is not None:
            # All pixels of a row have the same pose, so it is computed once per row.
            row, where = np.unique(row, return_inverse=True)
            centre, frame_from_camera = self._poses(row, self.shake.at(row - self.centre[1]))
            return centre[where], frame_from_camera[where]
        return self._poses(row, np.zeros((1, 6)))

    def _poses(self, row: FloatArray, shaken: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Poses of rows. shaken : (n, 6) offsets to the right, forward and up (m), and roll, pitch and yaw (rad), to
        add.
        """
        forward, right = axes_of_heading(self.heading_deg)
        since = row - self.centre[1]
        phase = 2.0 * np.pi * since / self.wobble_rows
        roll, pitch, yaw = (np.deg2rad(self.wobble_deg) * np.sin(rate * phase + lag)
                            for rate, lag in ((1.0, 0.3), (0.8, 1.9), (0.6, 4.0)))  # fmt: skip
        roll, pitch, yaw = roll + shaken[:, 3], pitch + shaken[:, 4], yaw + shaken[:, 5]
        centre = np.empty((len(row), 3))
        centre[:, :2] = np.array(self.position[:2]) - (since * self.advance_m)[:, None] * forward
        centre[:, :2] += self.wobble_m * (np.sin(0.7 * phase + 0.5)[:, None] * right)
        centre[:, 2] = self.position[2] + self.wobble_m * np.sin(0.9 * phase + 2.2)
        rest = np.stack([np.append(right, 0.0), np.append(forward, 0.0), np.array([0.0, 0.0, 1.0])], axis=1)
        centre += shaken[:, :3] @ rest.T
        cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
        turn = np.empty((len(row), 3, 3))
        turn[:, 0] = np.stack([cy * cr - sy * sp * sr, -sy * cp, cy * sr + sy * sp * cr], axis=-1)
        turn[:, 1] = np.stack([sy * cr + cy * sp * sr, cy * cp, sy * sr - cy * sp * cr], axis=-1)
        turn[:, 2] = np.stack([-cp * sr, sp, cp * cr], axis=-1)
        return centre, np.asarray(rest @ turn)

    def _focal_plane(self, xyz: FloatArray, row: FloatArray) -> FloatArray:
        """Positions (n, 2) m, right and forward, of ground points (n, 3) in the focal plane, at the times of rows."""
        centre, frame_from_camera = self.poses(row)
        in_camera = np.einsum("nji,nj->ni", frame_from_camera, xyz - centre)
        return np.asarray(self.focal_m * in_camera[:, :2] / -in_camera[:, 2:])

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`. The row is the one at which the point crosses the line in the focal plane.

        It is found by steps along the flight with the slope of an unshaken flight. The wobble changes the slope by
        about a hundredth, so each step adds two digits.
        """
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
        ray_scale = (z - centre[:, 2]) / towards[:, 2]
        ground: FloatArray = centre + ray_scale[:, None] * towards
        ground[:, 2] = z
        return ground

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`: exact at any height."""
        return None


@dataclass(frozen=True)
class RectifiedScanner:
    """A line scanner's image resampled to a plane (ADS40 level 1).

    raw_camera, raw_shape : camera, rows and columns of the raw image; height : of the plane, m; plane_from_image : from
    pixels (column, row), with (0, 0) at the centre of the first one, to easting and northing.
    """

    raw_camera: LineScanner
    raw_shape: tuple[int, int]
    height: float
    plane_from_image: Affine

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        on_plane = self.raw_camera.ground_from_image(self.raw_camera.image_from_ground(xyz), np.array(self.height))
        return _mapped(~self.plane_from_image, on_plane)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return self.raw_camera.ground_from_image(self.raw_from_image(xy), z)

    def raw_from_image(self, xy: FloatArray) -> FloatArray:
        """Positions (n, 2) px in the raw image."""
        on_plane = _mapped(self.plane_from_image, np.asarray(xy, float))
        return self.raw_camera.image_from_ground(np.column_stack([on_plane, np.full(len(on_plane), self.height)]))

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`: exact at any height."""
        return None


def _mapped(transform: Affine, xy: FloatArray) -> FloatArray:
    """Points (n, 2) after an affine transform of x and y. xy : (n, 2) or wider."""
    x, y = xy[:, 0], xy[:, 1]
    return np.column_stack([
        transform.a * x + transform.b * y + transform.c, transform.d * x + transform.e * y + transform.f
    ])  # fmt: skip
