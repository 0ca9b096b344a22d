"""Line scanner: one line of a focal plane, exposed repeatedly along a trajectory. Each row is an exposure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.earth_frame import Space
from zlocus.sensors.trajectory import Drift, Trajectory

# Width of the frame around the image in which points are still mapped, because tiles and blocks extend beyond it.
MARGIN_PX = 4096.0
# Points that are projected at once, so that their arrays stay in the processor's cache.
CHUNK = 8192
MAX_STEPS = 8
# Newton steps converge quadratically: the step after one of this size is below 1e-9 rows.
TOLERANCE_ROWS = 1e-7
SCAN_KNOTS = 129
# Exposures whose heights are compared for the lowest projection centre.
STATIONS = 65
SCAN_STEPS = 60
# Heights at which the first guess is fitted, as parts of the depth at which pixels are square.
GUESS_DEPTHS = (0.8, 1.0)
GUESS_COLUMNS = 5
# A flight that turns by more than this (cosine of 20 degrees) can see one place in two exposures.
TURNS_COS = 0.94


@dataclass(frozen=True, eq=False)
class FocalLine:
    """One line of detectors in the focal plane.

    xy_mm : (c, 2) where the centre of each column's detector lies, in the image coordinates of the camera (positive
    image); straight lines between the columns, and beyond the ends. focal_mm : a column sees along (x, y, -focal_mm).
    """

    xy_mm: FloatArray
    focal_mm: float

    def along(self) -> FloatArray:
        """Rotation (2, 2) of image coordinates after which the line runs along the first axis."""
        x, y = self.xy_mm[-1] - self.xy_mm[0]
        return np.asarray(np.array([[x, y], [-y, x]]) / np.hypot(x, y))

    def goes_on(self) -> bool:
        """Whether each column lies further along the line than the one before, so that no two columns see the same."""
        is_open = bool((self.xy_mm[0] != self.xy_mm[-1]).any())
        return is_open and bool((np.diff(self.xy_mm @ self.along()[0]) > 0).all())


@dataclass(frozen=True, eq=False)
class LineTimes:
    """Exposure times of the rows: linear between known rows, and beyond them.

    rows : (k,) increasing, the first and the last row of the image among them; times : (k,) s, all increasing or all
    decreasing (where row 0 is the last one flown).
    """

    rows: FloatArray
    times: FloatArray

    @classmethod
    def regular(cls, start: float, interval: float, n_rows: int) -> LineTimes:
        """Rows exposed every `interval` s (negative: backwards), row 0 at `start` s."""
        last = max(n_rows - 1, 1)
        return cls(np.array([0.0, last]), np.array([start, start + last * interval]))

    @property
    def interval(self) -> float:
        """Mean time from row to row, s."""
        return float((self.times[-1] - self.times[0]) / (self.rows[-1] - self.rows[0]))

    def time(self, row: FloatArray) -> FloatArray:
        """Exposure times (n,) s of rows (n,)."""
        return _straight(row, self.rows, self.times)

    def row(self, time: FloatArray) -> FloatArray:
        """Rows (n,) exposed at times (n,) s."""
        if self.times[-1] > self.times[0]:
            return _straight(time, self.times, self.rows)
        return _straight(time, self.times[::-1], self.rows[::-1])


@dataclass(frozen=True, eq=False)
class LineScanModel:
    """A line scanner as a `SensorModel`: the raw image (level 0), whose rows are exposures.

    space : where rays are straight. margin_px : how far around the image, in rows and columns, points are mapped; NaN
    beyond, and where the ground is not in front of the camera.
    """

    line: FocalLine
    lines: LineTimes
    trajectory: Trajectory
    space: Space
    margin_px: float = MARGIN_PX
    _track: _Track = field(init=False, repr=False)

    def __post_init__(self) -> None:
        assert self.line.goes_on(), "columns lie one after the other"
        object.__setattr__(self, "_track", _Track.of(self))

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`. The time at which the point crosses the line is searched by Newton's method."""
        ground = self.space.cartesian_from_ground(xyz)
        xy = np.empty((len(ground), 2))
        for first in range(0, len(ground), CHUNK):
            part = slice(first, first + CHUNK)
            xy[part] = self._track.image(np.ascontiguousarray(ground[part].T))
        return xy

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xy = np.asarray(xy, float)
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        xyz = np.empty((len(xy), 3))
        for first in range(0, len(xy), CHUNK):
            part = slice(first, first + CHUNK)
            xyz[part] = self.space.meet(*self._track.rays(xy[part]), z[part])
        return xyz

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None

    def station_height(self) -> float:
        """See `Stationed`."""
        times = self.lines.time(np.linspace(self.lines.rows[0], self.lines.rows[-1], STATIONS))
        return float(self.space.ground_from_cartesian(self.trajectory.pose(times)[9:].T)[:, 2].min())

    def flight_time(self) -> float:
        """See `Scanning`."""
        return abs(float(self.lines.times[-1] - self.lines.times[0]))

    def corrected(self, drift: Drift) -> LineScanModel:
        """The model with a drift of its trajectory added."""
        return replace(self, trajectory=drift.corrected(self.trajectory))


@dataclass(frozen=True, eq=False)
class RectifiedModel:
    """A line scanner's image resampled to a plane (ADS40 level 1), as a `SensorModel`.

    A pixel belongs to a point of the plane, that to a position in the raw image, and that to a ray. raw_sensor : the
    raw image in the scene's frame; plane_sensor : the raw image in the frame of the plane; height : of the plane, m;
    plane_from_image : from pixels (column, row), with (0, 0) the centre of the first one, to x and y of the plane.
    """

    raw_sensor: LineScanModel
    plane_sensor: LineScanModel
    height: float
    plane_from_image: Affine

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        on_plane = self.plane_sensor.ground_from_image(self.raw_sensor.image_from_ground(xyz), np.array(self.height))
        return _mapped(~self.plane_from_image, on_plane)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        on_plane = _mapped(self.plane_from_image, np.asarray(xy, float))
        on_plane = np.column_stack([on_plane, np.full(len(on_plane), self.height)])
        return self.raw_sensor.ground_from_image(self.plane_sensor.image_from_ground(on_plane), z)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None

    def station_height(self) -> float:
        """See `Stationed`."""
        return self.raw_sensor.station_height()

    def flight_time(self) -> float:
        """See `Scanning`."""
        return self.raw_sensor.flight_time()

    def corrected(self, drift: Drift) -> RectifiedModel:
        """The model with a drift of its trajectory added. The pixels were resampled with the old trajectory, which
        stays."""
        return replace(self, raw_sensor=self.raw_sensor.corrected(drift))


def _mapped(transform: Affine, xy: FloatArray) -> FloatArray:
    """Points (n, 2) that an affine map makes of points (n, 2 or more)."""
    x, y = xy[:, 0], xy[:, 1]
    return np.column_stack(
        [transform.a * x + transform.b * y + transform.c, transform.d * x + transform.e * y + transform.f]
    )


def _straight(at: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Values (n,) interpolated linearly between increasing knots, and extrapolated by the first and last piece."""
    inside = np.interp(at, knots, values)
    below, above = np.minimum(at - knots[0], 0.0), np.maximum(at - knots[-1], 0.0)
    first = (values[1] - values[0]) / (knots[1] - knots[0])
    last = (values[-1] - values[-2]) / (knots[-1] - knots[-2])
    return np.asarray(inside + below * first + above * last)


@dataclass(frozen=True, eq=False)
class _Track:
    """Quantities that a model computes once: its line rotated to the first axis, and a first guess of exposure times.

    In the axes of the line a point lies at u along the line and v across it (mm in the focal plane), at a depth in
    front of the camera.
    """

    lines: LineTimes
    trajectory: Trajectory
    focal: float
    columns: FloatArray  # (c + 2,), with the margin at both ends
    u: FloatArray  # (c + 2,) increasing
    v: FloatArray  # (c + 2,)
    guess: FloatArray  # (4,) instant of a point, to first order
    guessed: FloatArray  # (k,) mean guess of points seen at the instants below
    instants: FloatArray  # (k,) s, increasing, from margin to margin
    turns: bool

    @classmethod
    def of(cls, sensor: LineScanModel) -> _Track:
        """The quantities of a model."""
        turn = np.zeros((3, 3))
        turn[:2, :2], turn[2, 2] = sensor.line.along(), -1.0
        path = sensor.trajectory
        trajectory = Trajectory(path.times, path.centres, turn @ path.rotations)
        n, margin = len(sensor.line.xy_mm), sensor.margin_px
        column = np.array([-0.5 - margin, *range(n), n - 0.5 + margin])
        u, v = (_straight(column, column[1:-1], axis) for axis in turn[:2, :2] @ sensor.line.xy_mm.T)
        ends = sensor.lines.rows[[0, -1]] + [-0.5 - margin, 0.5 + margin]
        start, end = np.sort(sensor.lines.time(ends))
        instants = np.linspace(start, end, SCAN_KNOTS)
        forward = trajectory.pose(instants)[3:6]
        turns = bool((forward.T @ forward).min() < TURNS_COS)
        nothing = np.zeros(0)
        track = cls(sensor.lines, trajectory, sensor.line.focal_mm, column, u, v, nothing, nothing, instants, turns)
        return track._with_guess()

    def _with_guess(self) -> _Track:
        """With the linear map from points to exposure times that fits the points seen by the image and its margin."""
        pose, rate = self.trajectory.moving(self.instants)
        pitch = np.hypot(*((self.u[-1] - self.u[0], self.v[-1] - self.v[0]))) / (self.columns[-1] - self.columns[0])
        speed = np.median(np.linalg.norm(rate[9:], axis=0)) * abs(self.lines.interval)
        depth = speed * self.focal / pitch
        across = np.linspace(self.u[1], self.u[-2], GUESS_COLUMNS)
        seen = np.stack([across, np.interp(across, self.u, self.v), np.full(GUESS_COLUMNS, self.focal)])
        rays = np.einsum("ijk,im->mkj", pose[:9].reshape(3, 3, -1), seen / self.focal)
        points = np.concatenate([pose[9:].T + part * depth * rays for part in GUESS_DEPTHS]).reshape(-1, 3)
        middle, when = points.mean(axis=0), np.tile(self.instants, len(points) // len(self.instants))
        mean = when.mean()
        slopes = np.linalg.lstsq(points - middle, when - mean, rcond=1e-9)[0]
        guess = np.append(slopes, mean - middle @ slopes)
        by_instant = (points @ slopes + guess[3]).reshape(-1, len(self.instants)).mean(axis=0)
        guessed = np.maximum.accumulate(by_instant)
        return replace(self, guess=guess, guessed=guessed)

    def rays(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Projection centres and directions, (n, 3) each, of image positions (n, 2); NaN beyond the margin."""
        pose = self.trajectory.pose(self.lines.time(xy[:, 1]))
        inside = (xy[:, 0] >= self.columns[0]) & (xy[:, 0] <= self.columns[-1]) & self._in_time(xy[:, 1])
        u, v = np.interp(xy[:, 0], self.columns, self.u), np.interp(xy[:, 0], self.columns, self.v)
        a, b, c = pose[:9].reshape(3, 3, -1)
        # The inverse of the matrix, by cross products of its rows: an interpolated matrix is not exactly a rotation.
        ray = u * np.cross(b, c, axis=0) + v * np.cross(c, a, axis=0) + self.focal * np.cross(a, b, axis=0)
        # The line's axes are left-handed, so the products point backwards.
        ray = np.sign((a * np.cross(b, c, axis=0)).sum(axis=0)) * ray
        ray[:, ~inside] = np.nan
        return np.ascontiguousarray(pose[9:].T), np.ascontiguousarray(ray.T)

    def image(self, ground: FloatArray) -> FloatArray:
        """Image positions (n, 2) of Cartesian points (3, n)."""
        time = np.interp(self.guess[:3] @ ground + self.guess[3], self.guessed, self.instants)
        u = np.full(len(time), np.nan)
        going = np.flatnonzero(np.isfinite(ground).all(axis=0))
        enough = TOLERANCE_ROWS * abs(self.lines.interval)
        lost = []
        for _ in range(MAX_STEPS):
            at, off, at_rate, rate = self._crossing(ground[:, going], time[going])
            with np.errstate(all="ignore"):
                step = -off / rate
            step = self._bounded(step, time[going])
            time[going] += step
            u[going] = at + at_rate * step
            done = np.abs(step) < enough
            failed = ~np.isfinite(step)
            lost.append(going[failed])
            going = going[~(done | failed)]
            if not len(going):
                break
        lost.append(going)
        self._recover(ground, time, u, np.concatenate(lost))
        return self._pixels(time, u)

    def _crossing(self, ground: FloatArray, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Positions of points (3, n) along the line and ahead of it (mm) at times (n,), and their rates (mm/s).

        NaN where a point is not in front of the camera.
        """
        pose, rate = self.trajectory.moving(time)
        x, y, z = ground - pose[9:]
        # Points are rotated first, because the rotation and the motion of the camera add up in its own axes.
        right, ahead, depth = (pose[i] * x + pose[i + 1] * y + pose[i + 2] * z for i in (0, 3, 6))
        dx, dy, dz = rate[9:]
        right_rate, ahead_rate, depth_rate = (
            rate[i] * x + rate[i + 1] * y + rate[i + 2] * z - pose[i] * dx - pose[i + 1] * dy - pose[i + 2] * dz
            for i in (0, 3, 6)
        )
        with np.errstate(all="ignore"):
            scale = np.where(depth > 0, self.focal / depth, np.nan)
            shrink = depth_rate / depth
            u, v = right * scale, ahead * scale
            off = v - np.interp(u, self.u, self.v)
            return u, off, right_rate * scale - u * shrink, ahead_rate * scale - v * shrink

    def _bounded(self, step: FloatArray, time: FloatArray) -> FloatArray:
        """Steps (n,) s limited to a quarter of the flight, and to times at most its length before or after it."""
        span = self.instants[-1] - self.instants[0]
        step = np.clip(step, -span / 4, span / 4)
        return np.asarray(np.clip(time + step, self.instants[0] - span, self.instants[-1] + span) - time)

    def _recover(self, ground: FloatArray, time: FloatArray, u: FloatArray, lost: NDArray[np.intp]) -> None:
        """Search the whole flight for points whose steps did not converge; fills in time and u, NaN where none is
        found.

        lost : indices of the points. Where the flight turns, points found outside of the image are searched too,
        because another exposure may see them inside.
        """
        u[lost] = np.nan
        if self.turns:
            xy = self._pixels(time, u)
            lost = np.flatnonzero(~(self._outside(xy[:, 0], xy[:, 1]) <= 0) & np.isfinite(ground).all(axis=0))
        if not len(lost):
            return
        points = ground[:, lost]
        low, high, nearest = np.zeros(len(lost)), np.zeros(len(lost)), np.full(len(lost), np.inf)
        u_before = off_before = np.full(len(lost), np.nan)
        for before, instant in zip(self.instants[[0, *range(SCAN_KNOTS - 1)]], self.instants, strict=True):
            u_here, off_here, _, _ = self._crossing(points, np.full(len(lost), instant))
            with np.errstate(all="ignore"):
                part = off_before / (off_before - off_here)
                xy = self._pixels(before + part * (instant - before), u_before + part * (u_here - u_before))
                better = (off_before * off_here <= 0) & (self._outside(xy[:, 0], xy[:, 1]) < nearest)
            low[better], high[better] = before, instant
            nearest[better] = self._outside(xy[:, 0], xy[:, 1])[better]
            u_before, off_before = u_here, off_here
        found = np.isfinite(nearest)
        time[lost[found]], u[lost[found]] = self._between(points[:, found], low[found], high[found])
        u[lost[~found]] = np.nan

    def _between(self, points: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Times (n,) between low and high at which points (3, n) cross the line, and the positions (n,) mm along it.

        Newton steps that leave the bracket are replaced by its middle.
        """
        rising = self._crossing(points, high)[1] > 0
        time = (low + high) / 2
        for _ in range(SCAN_STEPS):
            _, off, _, rate = self._crossing(points, time)
            above = (off > 0) == rising
            low, high = np.where(above, low, time), np.where(above, time, high)
            with np.errstate(all="ignore"):
                newton = time - off / rate
            time = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        return time, self._crossing(points, time)[0]

    def _pixels(self, time: FloatArray, u: FloatArray) -> FloatArray:
        """Image positions (n, 2) of times and positions along the line, (n,) each; NaN beyond the margin."""
        row = self.lines.row(time)
        xy = np.column_stack([np.interp(u, self.u, self.columns), row])
        xy[~((u >= self.u[0]) & (u <= self.u[-1]) & self._in_time(row))] = np.nan
        return xy

    def _outside(self, column: FloatArray, row: FloatArray) -> FloatArray:
        """Distances (n,) px of image positions from the image's pixels; 0 inside."""
        over = [
            self.columns[1] - column,
            column - self.columns[-2],
            self.lines.rows[0] - row,
            row - self.lines.rows[-1],
        ]
        return np.asarray(np.maximum(np.max(over, axis=0) - 0.5, 0.0))

    def _in_time(self, row: FloatArray) -> NDArray[np.bool_]:
        """Whether rows (n,) lie within the margin."""
        margin = -self.columns[0]
        return np.asarray((row >= self.lines.rows[0] - margin) & (row <= self.lines.rows[-1] + margin))
