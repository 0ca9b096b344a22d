"""What every sensor can do: ground to image and, at a given height, image to ground."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@runtime_checkable
class SensorModel(Protocol):
    """Ground <-> image for one exposure.

    Image points are `xy` = (column, row) in pixels; (0, 0) is the centre of the first pixel.
    Ground points are `xyz` in the scene's frame: easting, northing and ellipsoidal height in metres.
    Points the model cannot map are NaN in the result, never an exception.
    """

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Image position of ground points. xyz : (n, 3) m -> (n, 2) px."""
        ...

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """Ground points seen by image positions at given heights. xy : (n, 2) px, z : (n,) m -> (n, 3) m."""
        ...

    def height_bounds(self) -> tuple[float, float] | None:
        """Lowest and highest ellipsoidal height (m) the model was made for; None where it holds at any height."""
        ...


@runtime_checkable
class Stationed(Protocol):
    """A sensor that knows where it stood."""

    def station_height(self) -> float:
        """Lowest height (m) of its projection centres, as ground points have heights."""
        ...


@runtime_checkable
class Scanning(Protocol):
    """A sensor whose image was taken in flight, line by line, so that it looks the same way all along."""

    def flight_time(self) -> float:
        """How long that took, s."""
        ...


def bare(sensor: SensorModel) -> SensorModel:
    """The sensor without the corrections laid over it."""
    while hasattr(sensor, "base"):
        sensor = sensor.base
    return sensor


def lowest_station(sensors: Iterable[SensorModel]) -> float | None:
    """Height (m) of the lowest projection centre; None where not all sensors know where they stood."""
    heights = []
    for sensor in map(bare, sensors):
        if not isinstance(sensor, Stationed):
            return None
        heights.append(sensor.station_height())
    return min(heights, default=None)


def capped(z_range: tuple[float, float], station: float | None, clearance: float) -> tuple[float, float]:
    """A range of heights (m) without those whose depth below a station is less than a share of the lowest's."""
    if station is None or z_range[0] >= station:
        return z_range
    return z_range[0], min(z_range[1], station - clearance * (station - z_range[0]))
