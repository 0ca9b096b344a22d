"""Epipolar curves: where the ray of one image's pixel runs in another image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray, SensorModel

MIN_CURVE_LENGTH_PX = 1.0
# Heights at which rays are computed, in half ranges of height from the middle of the range, and the largest distance
# from the middle at which the cubic through these is used.
NODES, MAX_CUBIC_T = np.array([-1.0, -1.0 / 3.0, 1.0 / 3.0, 1.0]), 1.25
# The coefficients of the cubic through values at the nodes, of the highest power first, are this times the values.
COEFFICIENTS_OF_NODES = np.linalg.inv(np.vander(NODES))


@dataclass(frozen=True)
class Sightlines:
    """Rays of an image's points, as cubics through the ground points that they meet at four heights.

    Rays are straight, except for the curvature of the Earth and the approximation of an RPC. xy : (n, 2) px; z_range :
    lowest and highest height, m; coefficients : (4, n, 3) m, of the cubics in half ranges of height from the middle of
    the range, of the highest power first; NaN where a ray does not reach one of the heights.
    """

    sensor: SensorModel
    xy: FloatArray
    z_range: tuple[float, float]
    coefficients: FloatArray

    @classmethod
    def of(cls, sensor: SensorModel, xy: FloatArray, z_range: tuple[float, float]) -> Sightlines:
        """Rays of the points xy (n, 2) px over a range of heights (m)."""
        heights = sum(z_range) / 2 + NODES * (z_range[1] - z_range[0]) / 2
        ground = np.stack([sensor.ground_from_image(xy, np.full(len(xy), z)) for z in heights])
        return cls(sensor, xy, z_range, np.einsum("km,mnj->knj", COEFFICIENTS_OF_NODES, ground))

    def only(self, rows: NDArray[np.int64]) -> Sightlines:
        """The rays of some points, rows (k,)."""
        return Sightlines(self.sensor, self.xy[rows], self.z_range, self.coefficients[:, rows])

    def at(self, z: FloatArray) -> FloatArray:
        """Ground points (n, 3) m at heights z (n,) m: by the cubic near the range, by the sensor model beyond."""
        t = (z - sum(self.z_range) / 2) / max((self.z_range[1] - self.z_range[0]) / 2, 1e-9)
        cubed, squared, linear, constant = self.coefficients
        along_ray = t[:, None]
        xyz: FloatArray = ((cubed * along_ray + squared) * along_ray + linear) * along_ray + constant
        xyz[:, 2] = z
        beyond = np.flatnonzero((np.abs(t) > MAX_CUBIC_T) | np.isnan(xyz).any(axis=1))
        xyz[beyond] = self.sensor.ground_from_image(self.xy[beyond], z[beyond])
        return xyz


@dataclass(frozen=True)
class EpipolarCurves:
    """Epipolar curves as straight chords, between the second image's points that see a ray at two heights.

    low, high : (n, 2) px at the heights z_low and z_high (m); NaN where a sensor cannot map the point.
    """

    low: FloatArray
    high: FloatArray
    z_low: float
    z_high: float

    @property
    def length_px(self) -> FloatArray:
        """Lengths (n,) px between the two heights."""
        return np.asarray(np.hypot(*(self.high - self.low).T))

    def part(self, rows: slice) -> EpipolarCurves:
        """Some of the curves."""
        return EpipolarCurves(self.low[rows], self.high[rows], self.z_low, self.z_high)

    def moved(self, shift_px: FloatArray) -> EpipolarCurves:
        """The curves of a second image whose points are moved by shift_px (2,)."""
        return EpipolarCurves(self.low + shift_px, self.high + shift_px, self.z_low, self.z_high)


@dataclass(frozen=True)
class EpipolarOffsets:
    """Positions of matched points relative to their epipolar curves.

    z : (n,) m, height of the nearest point of the curve; distance_px : (n,) signed distance from it; normal : (n, 2)
    unit vectors across the curve. NaN where there is no curve.
    """

    z: FloatArray
    distance_px: FloatArray
    normal: FloatArray


def epipolar_curves(sightlines: Sightlines, sensor: SensorModel, z_range: tuple[float, float]) -> EpipolarCurves:
    """Epipolar curves of an image's points (n,) in another image, over a range of heights (m)."""
    low, high = (sensor.image_from_ground(sightlines.at(np.full(len(sightlines.xy), z))) for z in z_range)
    return EpipolarCurves(low, high, *z_range)


def epipolar_offsets(
    sightlines: Sightlines, sensor: SensorModel, xy: FloatArray, z_range: tuple[float, float]
) -> EpipolarOffsets:
    """Heights and distances from the epipolar curves of points (n, 2) px that were matched with those of `sightlines`.

    sensor, xy : of the other image. One Newton step leads from the chord to the curve, because the curves of every
    sensor are straight to well below a pixel over such a step.
    """
    chord = epipolar_curves(sightlines, sensor, z_range)
    by_z = (chord.high - chord.low) / (chord.z_high - chord.z_low)
    by_z[~(chord.length_px > MIN_CURVE_LENGTH_PX)] = np.nan
    z = chord.z_low + along(xy - chord.low, by_z)
    here = sensor.image_from_ground(sightlines.at(z))
    there = sensor.image_from_ground(sightlines.at(z + 0.01 * (chord.z_high - chord.z_low)))
    tangent = (there - here) / (0.01 * (chord.z_high - chord.z_low))
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    return EpipolarOffsets(z + along(xy - here, tangent), np.einsum("nj,nj->n", xy - here, normal), normal)


def along(offset: FloatArray, by_z: FloatArray) -> FloatArray:
    """Height differences (n,) m that best explain offsets (n, 2) px. by_z : (n, 2) px per m along the curve."""
    return np.asarray(np.einsum("nj,nj->n", offset, by_z) / np.einsum("nj,nj->n", by_z, by_z))
