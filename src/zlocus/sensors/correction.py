"""Corrections of a sensor model in its image: a shift, an affine map, or larger pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zlocus.core.sensor_model import FloatArray, SensorModel


@dataclass(frozen=True)
class ShiftedModel:
    """A sensor model with a constant shift in the image.

    column, row : pixels added to the positions that `base_sensor` projects. A sensor that projects 2 px too far left is
    corrected by column = +2.
    """

    base_sensor: SensorModel
    column: float
    row: float

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.asarray(self.base_sensor.image_from_ground(xyz) + np.array([self.column, self.row]), float)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return self.base_sensor.ground_from_image(np.asarray(xy, float) - np.array([self.column, self.row]), z)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return self.base_sensor.height_bounds()


@dataclass(frozen=True)
class AffinelyShiftedModel:
    """A sensor model with a shift in the image that changes linearly over the image.

    column, row : (constant px, per column, per row), added to the column and to the row that `base_sensor` projects.
    Source: Grodecki and Dial 2003, Photogrammetric Engineering & Remote Sensing 69 (1), 59-68, equations 3 and 4, whose
    line and sample are `row` and `column`.
    """

    base_sensor: SensorModel
    column: tuple[float, float, float]
    row: tuple[float, float, float]

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xy = self.base_sensor.image_from_ground(xyz)
        return np.asarray(self._constant + xy @ self._growth.T, float)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        before = (np.asarray(xy, float) - self._constant) @ np.linalg.inv(self._growth).T
        return self.base_sensor.ground_from_image(before, z)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return self.base_sensor.height_bounds()

    @property
    def _constant(self) -> FloatArray:
        """Constant part of the correction, (2,) px."""
        return np.array([self.column[0], self.row[0]])

    @property
    def _growth(self) -> FloatArray:
        """Derivatives (2, 2) of the corrected image positions by those that `base_sensor` projects."""
        return np.asarray(np.eye(2) + np.array([self.column[1:], self.row[1:]]), float)


@dataclass(frozen=True)
class ReducedModel:
    """The sensor model of a reduced image: each pixel is `factor` x `factor` pixels of the image of `base_sensor`."""

    base_sensor: SensorModel
    factor: int

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.asarray((self.base_sensor.image_from_ground(xyz) + 0.5) / self.factor - 0.5, float)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return self.base_sensor.ground_from_image((np.asarray(xy, float) + 0.5) * self.factor - 0.5, z)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return self.base_sensor.height_bounds()
