"""Lens distortion: image positions of an ideal camera to those of the real camera, and back.

Positions lie in the plane at depth 1, without unit: x to the right and y down, divided by the depth. Each distortion
maps a disc about the optical axis one to one; positions outside of the disc are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.frame_kernel import CONVERGED_STEP, MAX_ERROR, MAX_ITERATIONS, LensNumbers, ideal_positions

# Largest angle from the optical axis.
MAX_ANGLE_FROM_AXIS_DEG = 89.5
# Smallest derivative of the distorted by the ideal position, in any direction, at which the map counts as one to one.
MIN_SLOPE = 0.01
# Radii or angles at which the disc is tabulated.
N_NODES = 4096


class Distortion(Protocol):
    """A model of lens distortion. NaN positions stay NaN."""

    def distorted(self, at: FloatArray) -> FloatArray:
        """Real positions of ideal ones, (n, 2); NaN outside of the disc."""
        ...

    def undistorted(self, at: FloatArray) -> FloatArray:
        """Ideal positions of real ones, (n, 2); NaN where no position of the disc is mapped."""
        ...


@dataclass(frozen=True)
class _Disc:
    """A disc that is mapped one to one.

    inside : (n,) radii or angles of ideal positions; outside : (n,) those of the real positions, increasing.
    """

    inside: FloatArray
    outside: FloatArray

    @property
    def radius(self) -> float:
        """Radius or angle of the rim, on the ideal side."""
        return float(self.inside[-1])

    def inverse(self, outside: FloatArray) -> FloatArray:
        """First guess of the ideal radii or angles of real ones; those beyond the rim get the rim."""
        return np.asarray(np.interp(outside, self.outside, self.inside))


def _one_to_one_disc(inside: FloatArray, outside: FloatArray, min_slope: FloatArray) -> _Disc:
    """The disc about the axis in which the smallest slope in any direction stays above `MIN_SLOPE`."""
    usable = (min_slope > MIN_SLOPE) & (np.diff(outside, prepend=-1.0) > 0)
    n = len(usable) if usable.all() else int(np.argmin(usable))
    return _Disc(inside[: max(n, 1)], outside[: max(n, 1)])


@dataclass(frozen=True)
class BrownDistortion:
    """Brown-Conrady distortion with a rational radial part, as OpenCV defines it (its `calib3d`, `projectPoints`).

    x' = x (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6) + 2 p1 x y + p2 (r2 + 2 x2), and y' with x and y,
    p1 and p2 exchanged. The disc ends where the derivative, a symmetric matrix, could stop being positive definite
    (that of the tangential part is 6 r |p| at most): a map with such a derivative all over a disc is one to one.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def distorted(self, at: FloatArray) -> FloatArray:
        """See `Distortion`."""
        at = np.asarray(at, float)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            r2 = (at**2).sum(axis=1)
            out = self._mapped(at, r2, self._radial(r2)[0])
        out[~(r2 <= self._disc.radius**2)] = np.nan
        return out

    def undistorted(self, at: FloatArray) -> FloatArray:
        """See `Distortion`: Newton from the inverse of the radial part, kept in the disc."""
        at = np.asarray(at, float)
        far = np.hypot(at[:, 0], at[:, 1])
        # Positions that no camera has would overflow; they are beyond the disc in any case.
        at = np.where((far < 1e9)[:, None], at, np.nan)
        guess = self._disc.inverse(far)
        ideal = at * np.divide(guess, far, out=np.ones_like(far), where=far > 0)[:, None]
        ideal_positions(at, self.numbers, ideal)
        return ideal

    @cached_property
    def numbers(self) -> LensNumbers:
        """The distortion as `image_of_rays` takes it."""
        k1, k2, p1, p2, k3, k4, k5, k6 = map(
            float, (self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6)
        )  # fmt: skip
        return LensNumbers(k1, k2, p1, p2, k3, k4, k5, k6, self._disc.radius**2)

    @cached_property
    def _disc(self) -> _Disc:
        radius = np.tan(np.deg2rad(np.linspace(0.0, MAX_ANGLE_FROM_AXIS_DEG, N_NODES)))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            factor, slope = self._radial(radius**2)
            tangential = 6.0 * radius * np.hypot(self.p1, self.p2)
            smallest = np.minimum(factor, factor + 2.0 * radius**2 * slope) - tangential
        return _one_to_one_disc(radius, radius * factor, smallest)

    def _radial(self, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The radial factor and its derivative by r2, (n,) each."""
        above = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        above_slope = self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3)
        if not (self.k4 or self.k5 or self.k6):
            return above, above_slope
        below = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        below_slope = self.k4 + r2 * (2.0 * self.k5 + r2 * 3.0 * self.k6)
        return above / below, (above_slope * below - above * below_slope) / below**2

    def _mapped(self, at: FloatArray, r2: FloatArray, factor: FloatArray) -> FloatArray:
        out = at * factor[:, None]
        if self.p1 or self.p2:
            x, y = at.T
            out[:, 0] += 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
            out[:, 1] += self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return out


@dataclass(frozen=True)
class FisheyeDistortion:
    """Equidistant fisheye, as OpenCV defines it (its `fisheye`): the image's radius is the angle t from the axis times
    1 + k1 t2 + k2 t4 + k3 t6 + k4 t8."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def distorted(self, at: FloatArray) -> FloatArray:
        """See `Distortion`."""
        at = np.asarray(at, float)
        radius = np.hypot(at[:, 0], at[:, 1])
        angle = np.arctan(radius)
        out = at * np.divide(self._radius(angle)[0], radius, out=np.ones_like(radius), where=radius > 0)[:, None]
        out[~(angle <= self._disc.radius)] = np.nan
        return out

    def undistorted(self, at: FloatArray) -> FloatArray:
        """See `Distortion`: Newton along the radius, kept in the disc."""
        at = np.asarray(at, float)
        far = np.hypot(at[:, 0], at[:, 1])
        angle = self._disc.inverse(far)
        for _ in range(MAX_ITERATIONS):
            radius, slope = self._radius(angle)
            step = (far - radius) / slope
            angle = np.clip(angle + step, 0.0, self._disc.radius)
            if not (np.abs(step) > CONVERGED_STEP).any():
                break
        ideal = at * np.divide(np.tan(angle), far, out=np.ones_like(far), where=far > 0)[:, None]
        ideal[~(np.abs(self._radius(angle)[0] - far) <= MAX_ERROR)] = np.nan
        return ideal

    @cached_property
    def _disc(self) -> _Disc:
        angle = np.deg2rad(np.linspace(0.0, MAX_ANGLE_FROM_AXIS_DEG, N_NODES))
        radius, slope = self._radius(angle)
        return _one_to_one_disc(angle, radius, slope)

    def _radius(self, angle: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Radius in the image and its derivative by the angle, (n,) each."""
        t = angle**2
        radius = angle * (1.0 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4))))
        slope = 1.0 + t * (3.0 * self.k1 + t * (5.0 * self.k2 + t * (7.0 * self.k3 + t * 9.0 * self.k4)))
        return radius, slope
