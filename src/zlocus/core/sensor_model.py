"""The protocol of sensor models: ground to image and, at a given height, image to ground."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Largest margin around the heights of a surface, as a share of their depth below the lowest camera.
MAX_MARGIN_SHARE_OF_DEPTH = 0.15


@runtime_checkable
class SensorModel(Protocol):
    """Projection between ground and image for one exposure.

    Image points are `xy` = (column, row) in pixels; (0, 0) is the centre of the first pixel. Ground points are `xyz` in
    the frame of the scene: easting, northing and ellipsoidal height in metres. A point that the model cannot map is NaN
    in the result; it raises no exception.
    """

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Image points (n, 2) px of ground points. xyz : (n, 3) m."""
        ...

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """Ground points (n, 3) m where the rays of image points meet given heights. xy : (n, 2) px; z : (n,) m."""
        ...

    def height_bounds(self) -> tuple[float, float] | None:
        """Lowest and highest ellipsoidal height (m) for which the model is valid; None where it is at any height."""
        ...


@runtime_checkable
class Stationed(Protocol):
    """A sensor model that contains the position of its camera."""

    def station_height(self) -> float:
        """Lowest height (m) of the projection centres, in the heights of ground points."""
        ...


@runtime_checkable
class Scanning(Protocol):
    """A line scanner: its image was taken in flight, line by line, with parallel views along the flight."""

    def flight_time(self) -> float:
        """Duration of the exposure of the whole image, s."""
        ...


@runtime_checkable
class Tabulated(Protocol):
    """A sensor model that is a table of some heights: unlike a formula it ends a little outside of them."""

    def height_limits(self) -> tuple[float, float]:
        """Lowest and highest ellipsoidal height (m) at which it maps points; below and above them all are NaN."""
        ...


def bare(sensor: SensorModel) -> SensorModel:
    """The sensor model without its corrections."""
    while hasattr(sensor, "base_sensor"):
        sensor = sensor.base_sensor
    return sensor


def lowest_station(sensors: Iterable[SensorModel]) -> float | None:
    """Height (m) of the lowest projection centre; None unless every sensor model contains its position."""
    heights = []
    for sensor in map(bare, sensors):
        if not isinstance(sensor, Stationed):
            return None
        heights.append(sensor.station_height())
    return min(heights, default=None)


def limited_margin(margin_m: float, height: float, station: float | None) -> float:
    """A margin (m) around a height (m), no more than `MAX_MARGIN_SHARE_OF_DEPTH` of the depth of that height below a
    projection centre at height `station` (m): a drone flies higher than what it sees is tall. Unchanged without one."""
    return margin_m if station is None else min(margin_m, MAX_MARGIN_SHARE_OF_DEPTH * max(station - height, 0.0))


def capped(z_range: tuple[float, float], station: float | None, clearance: float) -> tuple[float, float]:
    """A height range (m) cut below a projection centre at height `station` (m); unchanged without one.

    What lies nearer below the station than `clearance` times the depth of the lowest height is cut off.
    """
    if station is None or z_range[0] >= station:
        return z_range
    return z_range[0], min(z_range[1], station - clearance * (station - z_range[0]))
