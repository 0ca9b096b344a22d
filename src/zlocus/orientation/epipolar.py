"""EpipolarCurves between two images: where the ray of one image's pixel runs in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray, SensorModel

MIN_CURVE_LENGTH_PX = 1.0
# Heights of a range at which rays are looked up, from its middle in half ranges, and how far from it the cubic through
# these is taken.
NODES, MAX_CUBIC_T = np.array([-1.0, -1.0 / 3.0, 1.0 / 3.0, 1.0]), 1.25


@dataclass(frozen=True)
class Sightlines:
    """Where an image's points look: the ground they see at a few heights of a range, and, by the cubic through these,
    at heights in and near it. Rays are straight but for the curvature of the Earth and what an RPC makes of them.

    xy : (n, 2) px; z_range : m; ground : (4, n, 3) m at `NODES` of it, NaN where a ray does not come there.
    """

    sensor: SensorModel
    xy: FloatArray
    z_range: tuple[float, float]
    ground: FloatArray

    @classmethod
    def of(cls, sensor: SensorModel, xy: FloatArray, z_range: tuple[float, float]) -> Sightlines:
        """Of points xy (n, 2) px for a range of heights (m)."""
        heights = sum(z_range) / 2 + NODES * (z_range[1] - z_range[0]) / 2
        return cls(sensor, xy, z_range, np.stack([sensor.ground_from_image(xy, np.full(len(xy), z)) for z in heights]))

    def only(self, rows: NDArray[np.int64]) -> Sightlines:
        """Some of them."""
        return Sightlines(self.sensor, self.xy[rows], self.z_range, self.ground[:, rows])

    def at(self, z: FloatArray) -> FloatArray:
        """Ground points (n, 3) m at heights z (n,) m; where the cubic does not hold, as the sensor has them."""
        t = (z - sum(self.z_range) / 2) / max((self.z_range[1] - self.z_range[0]) / 2, 1e-9)
        xyz = np.zeros((len(z), 3))
        for k, ground in enumerate(self.ground):
            others = np.delete(NODES, k)
            xyz += np.prod((t[:, None] - others) / (NODES[k] - others), axis=1)[:, None] * ground
        xyz[:, 2] = z
        beyond = np.flatnonzero((np.abs(t) > MAX_CUBIC_T) | np.isnan(xyz).any(axis=1))
        xyz[beyond] = self.sensor.ground_from_image(self.xy[beyond], z[beyond])
        return xyz


@dataclass(frozen=True)
class EpipolarCurves:
    """Straight chords of loci: the second image's points that see the same ray at two heights.

    low, high : (n, 2) px at z_low and z_high (m); NaN where a sensor cannot map the point.
    """

    low: FloatArray
    high: FloatArray
    z_low: float
    z_high: float

    @property
    def length_px(self) -> FloatArray:
        """(n,) px between the two heights."""
        return np.asarray(np.hypot(*(self.high - self.low).T))

    def part(self, rows: slice) -> EpipolarCurves:
        """Some of them."""
        return EpipolarCurves(self.low[rows], self.high[rows], self.z_low, self.z_high)

    def moved(self, shift_px: FloatArray) -> EpipolarCurves:
        """The loci of a second image whose points are moved by (2,) px."""
        return EpipolarCurves(self.low + shift_px, self.high + shift_px, self.z_low, self.z_high)


@dataclass(frozen=True)
class EpipolarOffsets:
    """Where matched points lie with respect to their loci.

    z : (n,) m, height of the nearest point of the locus; distance_px : (n,) signed distance from it;
    normal : (n, 2) unit vectors across the locus. NaN where there is no locus.
    """

    z: FloatArray
    distance_px: FloatArray
    normal: FloatArray


def trace(lines: Sightlines, sensor: SensorModel, z_range: tuple[float, float]) -> EpipolarCurves:
    """The loci of an image's points (n,) in another one, over a range of heights in m."""
    low, high = (sensor.image_from_ground(lines.at(np.full(len(lines.xy), z))) for z in z_range)
    return EpipolarCurves(low, high, *z_range)


def epipolar_offsets(
    lines: Sightlines, sensor: SensorModel, xy: FloatArray, z_range: tuple[float, float]
) -> EpipolarOffsets:
    """Height and distance from the locus of points (n, 2) px of another image, matched with those of `lines`.

    One Newton step from the chord: loci of every sensor are straight to well below a pixel over such a step.
    """
    chord = trace(lines, sensor, z_range)
    by_z = (chord.high - chord.low) / (chord.z_high - chord.z_low)
    by_z[~(chord.length_px > MIN_CURVE_LENGTH_PX)] = np.nan
    z = chord.z_low + along(xy - chord.low, by_z)
    here = sensor.image_from_ground(lines.at(z))
    there = sensor.image_from_ground(lines.at(z + 0.01 * (chord.z_high - chord.z_low)))
    tangent = (there - here) / (0.01 * (chord.z_high - chord.z_low))
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    return EpipolarOffsets(z + along(xy - here, tangent), np.einsum("nj,nj->n", xy - here, normal), normal)


def along(offset: FloatArray, by_z: FloatArray) -> FloatArray:
    """Height difference (n,) m that best explains offsets (n, 2) px, by_z (n, 2) px per m."""
    return np.asarray(np.einsum("nj,nj->n", offset, by_z) / np.einsum("nj,nj->n", by_z, by_z))
