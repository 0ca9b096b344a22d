"""Weather between the ground and the sensor: clouds, their shadows, haze, and moisture that changes from day to day."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options.option_fields import Checked, option
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.textures import fractal_surface

CLOUD_STREAM, MOISTURE_STREAM = 71, 73
CLOUD_NODE_M, CLOUD_NODES, CLOUD_M, CLOUD_EXPONENT = 4.0, 512, 160.0, 1.6
MOISTURE_NODE_M, MOISTURE_M = 4.0, 120.0
CLOUD_RADIANCE, SHADOW_LIGHT = 0.9, 0.35
EDGE = 0.35  # width of the soft edge of a cloud, in standard deviations of its fractal field


@dataclass(frozen=True)
class Weather(Checked):
    """Weather of a day; clear by default."""

    cloud_share: float = option(0.0, "Share of the sky that clouds cover.", low=0.0, high=1.0)
    cloud_height_m: float = option(900.0, "Height of the clouds above the ground.", low=10.0, high=12000.0, unit="m")
    haze_share: float = option(0.0, "Share of the light that haze replaces by its own.", low=0.0, high=0.9)
    moisture: float = option(0.0, "Standard deviation of the relative darkening by moisture.", low=0.0, high=0.5)

    @property
    def is_clear(self) -> bool:
        """Whether the weather changes nothing."""
        return self.cloud_share == 0.0 and self.haze_share == 0.0 and self.moisture == 0.0


def weathered(
    radiance: NDArray[np.float32],
    ground_xy: FloatArray,
    weather: Weather,
    to_sensor: FloatArray,
    to_sun: FloatArray,
    seed: tuple[int, ...],
) -> NDArray[np.float32]:
    """The radiance (r, c) of an image through the weather of its day.

    ground_xy : (r, c, 2) m, the ground that pixels show; to_sensor, to_sun : (2,) metres east and north for a metre of
    height; seed : of the day, so that the images of a pass see the same clouds.
    """
    out = radiance.astype(np.float64)
    if weather.moisture:
        field = periodic_field(seed, MOISTURE_STREAM, MOISTURE_NODE_M, MOISTURE_M, 2.0)
        out *= np.exp(weather.moisture * field(ground_xy))
    if weather.cloud_share:
        field = periodic_field(seed, CLOUD_STREAM, CLOUD_NODE_M, CLOUD_M, CLOUD_EXPONENT)
        edge = field.quantile(1.0 - weather.cloud_share)
        shade, cover = (
            np.clip(0.5 + (field(ground_xy + weather.cloud_height_m * towards) - edge) / EDGE, 0.0, 1.0)
            for towards in (to_sun, to_sensor)
        )
        out *= 1.0 - (1.0 - SHADOW_LIGHT) * shade
        out += cover * (CLOUD_RADIANCE - out)
    if weather.haze_share:
        out += weather.haze_share * (0.5 * float(np.median(radiance[radiance > 0])) - out)
    return np.asarray(np.where(radiance > 0, np.maximum(out, 1e-6), 0.0), np.float32)


@dataclass(frozen=True)
class PeriodicField:
    """A fractal field over the ground that repeats. values : (n, n), standard deviation 1; node_m : its spacing."""

    values: NDArray[np.float32]
    node_m: float

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Bilinear values (...,) at places (..., 2) m."""
        n = len(self.values)
        at = xy / self.node_m
        first = np.floor(at).astype(int)
        u, v = np.moveaxis(at - first, -1, 0)
        j, i = np.moveaxis(first, -1, 0)
        upper = (1 - u) * self.values[i % n, j % n] + u * self.values[i % n, (j + 1) % n]
        lower = (1 - u) * self.values[(i + 1) % n, j % n] + u * self.values[(i + 1) % n, (j + 1) % n]
        return np.asarray((1 - v) * upper + v * lower)

    def quantile(self, share: float) -> float:
        """The value that a share of the field is below."""
        return float(np.quantile(self.values, share))


def periodic_field(
    seed: tuple[int, ...], stream: int, node_m: float, longest_m: float, exponent: float
) -> PeriodicField:
    """A fractal field whose amplitude falls with wavelength below `longest_m`, by `exponent`."""
    rng = np.random.default_rng([*seed, stream])
    return PeriodicField(fractal_surface(rng, (CLOUD_NODES, CLOUD_NODES), node_m, longest_m, exponent), node_m)
