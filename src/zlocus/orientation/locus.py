"""Loci between two images: where the ray of one image's pixel runs in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zlocus.sensors.model import FloatArray, SensorModel

SHORTEST_LOCUS_PX = 1.0


@dataclass(frozen=True)
class Loci:
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

    def moved(self, shift_px: FloatArray) -> Loci:
        """The loci of a second image whose points are moved by (2,) px."""
        return Loci(self.low + shift_px, self.high + shift_px, self.z_low, self.z_high)


@dataclass(frozen=True)
class OnLocus:
    """Where matched points lie with respect to their loci.

    z : (n,) m, height of the nearest point of the locus; across_px : (n,) signed distance from it;
    normal : (n, 2) unit vectors across the locus. NaN where there is no locus.
    """

    z: FloatArray
    across_px: FloatArray
    normal: FloatArray


def project(sensor_a: SensorModel, sensor_b: SensorModel, xy_a: FloatArray, z: FloatArray) -> FloatArray:
    """Image b's (n, 2) px of the ground that image a's (n, 2) px see at heights z (n,) m."""
    return sensor_b.image_from_ground(sensor_a.ground_from_image(xy_a, z))


def trace(sensor_a: SensorModel, sensor_b: SensorModel, xy_a: FloatArray, z_range: tuple[float, float]) -> Loci:
    """The loci in image b of points (n, 2) px of image a over a height range in m."""
    low, high = (project(sensor_a, sensor_b, xy_a, np.full(len(xy_a), z)) for z in z_range)
    return Loci(low, high, *z_range)


def locate(
    sensor_a: SensorModel, sensor_b: SensorModel, xy_a: FloatArray, xy_b: FloatArray, z_range: tuple[float, float]
) -> OnLocus:
    """Height and distance from the locus of matched points xy_a, xy_b (n, 2) px.

    One Newton step from the chord: loci of every sensor are straight to well below a pixel over such a step.
    """
    chord = trace(sensor_a, sensor_b, xy_a, z_range)
    by_z = (chord.high - chord.low) / (chord.z_high - chord.z_low)
    by_z[~(chord.length_px > SHORTEST_LOCUS_PX)] = np.nan
    z = chord.z_low + along(xy_b - chord.low, by_z)
    here = project(sensor_a, sensor_b, xy_a, z)
    there = project(sensor_a, sensor_b, xy_a, z + 0.01 * (chord.z_high - chord.z_low))
    tangent = (there - here) / (0.01 * (chord.z_high - chord.z_low))
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    return OnLocus(z + along(xy_b - here, tangent), np.einsum("nj,nj->n", xy_b - here, normal), normal)


def along(offset: FloatArray, by_z: FloatArray) -> FloatArray:
    """Height difference (n,) m that best explains offsets (n, 2) px, by_z (n, 2) px per m."""
    return np.asarray(np.einsum("nj,nj->n", offset, by_z) / np.einsum("nj,nj->n", by_z, by_z))
