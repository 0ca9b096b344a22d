"""Orientation corrections laid over a sensor model: a shift in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zlocus.sensors.model import FloatArray, SensorModel


@dataclass(frozen=True)
class ShiftedModel:
    """A sensor model whose image positions are moved by a constant.

    column, row : pixels added to what `base` projects (so a base that projects 2 px too far left is mended by
    column = +2).
    """

    base: SensorModel
    column: float
    row: float

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.asarray(self.base.image_from_ground(xyz) + np.array([self.column, self.row]), float)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return self.base.ground_from_image(np.asarray(xy, float) - np.array([self.column, self.row]), z)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return self.base.height_bounds()
