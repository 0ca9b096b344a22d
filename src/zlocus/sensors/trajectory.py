"""Trajectory of a line scanner: its position and rotation at any time, and slow errors (drift) of these."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

# Samples that a cubic spline needs.
MIN_SAMPLES = 4
# Beyond an end, the mean motion of its last `MEAN_SECONDS` continues, and the rotation slows down within
# `EASE_SECONDS`.
MEAN_SECONDS = 0.25
EASE_SECONDS = 6.0
EASE_SAMPLES = 60


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Projection centres and rotations at given times, with cubic splines between them.

    times : (n,) s, increasing, four or more; centres : (n, 3) m in Cartesian axes; rotations : (n, 3, 3), from those
    axes to the camera's (x, y in its image plane, z backwards). The elements of the matrices are interpolated; they
    differ from rotations by the fourth power of the rotation between two samples, over 400. Beyond the ends the flight
    continues, and its rotation slows down smoothly: a sudden stop would bend the rays from one row to the next.
    """

    times: FloatArray
    centres: FloatArray
    rotations: FloatArray
    _knots: FloatArray = field(init=False, repr=False)
    _starts: FloatArray = field(init=False, repr=False)
    _pieces: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # SciPy's interpolation costs 0.2 s to import, and only line scanners need it.
        from scipy.interpolate import CubicSpline

        assert len(self.times) >= MIN_SAMPLES, "a cubic spline needs four samples"
        before, first_velocity = self._continued(0, -1)
        after, last_velocity = self._continued(-1, 1)
        own = np.column_stack([self.times, self.rotations.reshape(-1, 9), self.centres])
        samples = np.concatenate([before[::-1], own, after])
        times, values = samples[:, 0], samples[:, 1:]
        pieces = np.zeros((4, 12, len(times) + 1))
        pieces[:, :, 1:-1] = CubicSpline(times, values).c[::-1].transpose(0, 2, 1)
        pieces[0, :, [0, -1]] = values[[0, -1]]
        pieces[1, 9:, 0], pieces[1, 9:, -1] = first_velocity, last_velocity
        object.__setattr__(self, "_knots", times)
        object.__setattr__(self, "_starts", np.append(times[0], times))
        object.__setattr__(self, "_pieces", np.ascontiguousarray(pieces.reshape(48, -1)))

    def pose(self, time: FloatArray) -> FloatArray:
        """Rotations (row by row) and centres at times (n,) s: (12, n)."""
        (a, b, c, d), since = self._piece(time)
        return np.asarray(((d * since + c) * since + b) * since + a)

    def moving(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same as `pose`, and its derivative by time: (12, n) each."""
        (a, b, c, d), since = self._piece(time)
        return ((d * since + c) * since + b) * since + a, (3.0 * d * since + 2.0 * c) * since + b

    def _continued(self, end: int, way: int) -> tuple[FloatArray, FloatArray]:
        """Samples (k, 13) of time, rotation and centre beyond an end of the trajectory, outwards, and the velocity
        (3,).

        end, way : (0, -1) for the first end, (-1, 1) for the last.
        """
        from scipy.spatial.transform import Rotation

        away = np.abs(self.times - self.times[end])
        inner = int(np.argmin(np.where(away >= min(MEAN_SECONDS, away.max()), away, np.inf)))
        span = self.times[end] - self.times[inner]
        turn = self.rotations[end] @ self.rotations[inner].T
        skew = turn - turn.T
        rate = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (2 * span)
        velocity = (self.centres[end] - self.centres[inner]) / span
        since = way * EASE_SECONDS * np.arange(1, EASE_SAMPLES + 1) / EASE_SAMPLES
        eased = since * (1 - np.abs(since) / (2 * EASE_SECONDS))
        rotations = Rotation.from_rotvec(eased[:, None] * rate).as_matrix() @ self.rotations[end]
        centres = self.centres[end] + since[:, None] * velocity
        return np.column_stack([self.times[end] + since, rotations.reshape(-1, 9), centres]), velocity

    def _piece(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients (4, 12, n) of the spline pieces at times (n,), and the time (n,) since the pieces start."""
        piece: NDArray[np.intp] = np.searchsorted(self._knots, time, side="right")
        return np.take(self._pieces, piece, axis=1).reshape(4, 12, -1), time - self._starts[piece]


@dataclass(frozen=True, eq=False)
class Drift:
    """A slow error of a trajectory, to be estimated; it is added to the trajectory.

    knots : (k,) s, increasing; values : (k, 6), what to add there: offsets along the camera's x, y, z axes (m) and
    turns about them (rad). Between the knots it is the polynomial of lowest degree for up to three knots, a cubic
    spline from four on; beyond them it stays.
    """

    knots: FloatArray
    values: FloatArray

    @classmethod
    def zero(cls, start: float, end: float, n_knots: int) -> Drift:
        """A drift of zero, with evenly spaced knots between two times (s)."""
        return cls(np.linspace(start, end, n_knots), np.zeros((n_knots, 6)))

    @property
    def parameters(self) -> FloatArray:
        """The values (6 k,), knot by knot."""
        return self.values.ravel()

    def with_parameters(self, parameters: FloatArray) -> Drift:
        """The drift of other parameters (6 k,)."""
        return replace(self, values=np.asarray(parameters, float).reshape(-1, 6))

    def at(self, time: FloatArray) -> FloatArray:
        """Offsets (m) and turns (rad) at times (n,) s: (n, 6)."""
        if len(self.knots) == 1:
            return np.repeat(self.values, len(time), axis=0)
        from scipy.interpolate import make_interp_spline

        spline = make_interp_spline(self.knots, self.values, k=min(3, len(self.knots) - 1))
        return np.asarray(spline(np.clip(time, self.knots[0], self.knots[-1])))

    def corrected(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory with the drift added at its samples."""
        from scipy.spatial.transform import Rotation

        drift = self.at(trajectory.times)
        offset = np.einsum("nji,nj->ni", trajectory.rotations, drift[:, :3])
        turned = Rotation.from_rotvec(-drift[:, 3:]).as_matrix() @ trajectory.rotations
        return Trajectory(trajectory.times, trajectory.centres + offset, turned)
