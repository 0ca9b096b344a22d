"""Rendered ortho-photos: the ground straight from above, on any date, and images of several bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.synthetic.objects import add_objects
from zlocus.synthetic.render import Optics, Sun, expose, render, sunlit
from zlocus.synthetic.scenes import SceneSpec, bare_terrain
from zlocus.synthetic.terrain import MATERIAL, SyntheticGround

BAND_STREAM = 83


@dataclass(frozen=True)
class OrthographicCamera:
    """A camera that looks straight down everywhere. west, north : of the first pixel's outer corner, m; pixel_m : side
    of a pixel."""

    west: float
    north: float
    pixel_m: float

    @property
    def transform(self) -> Affine:
        """From pixel corners to the ground."""
        return Affine(self.pixel_m, 0.0, self.west, 0.0, -self.pixel_m, self.north)

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        x, y, _ = np.asarray(xyz, float).T
        return np.column_stack([(x - self.west) / self.pixel_m - 0.5, (self.north - y) / self.pixel_m - 0.5])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        col, row = np.asarray(xy, float).T
        return np.column_stack([self.west + (col + 0.5) * self.pixel_m, self.north - (row + 0.5) * self.pixel_m, z])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None


@dataclass(frozen=True)
class Band:
    """A band of an image. optics : of it; exponent : of the radiance, which makes materials differ from band to
    band."""

    optics: Optics
    exponent: float = 1.0


# Blue, green, red and near infrared of a multispectral sensor.
FOUR_BANDS = (
    Band(Optics(gain=700.0, haze=200.0, blur_px=0.7)),
    Band(Optics(gain=900.0, haze=150.0, blur_px=0.65), 0.9),
    Band(Optics(gain=1100.0, haze=120.0, blur_px=0.62), 1.1),
    Band(Optics(gain=1500.0, haze=90.0, blur_px=0.75), 1.6),
)


def exposed_bands(
    ground: SyntheticGround, sensor: SensorModel, shape: tuple[int, int], sun: Sun, bands: Sequence[Band], seed: int
) -> NDArray[np.integer]:
    """Digital numbers (b, r, c) of an image of several bands."""
    radiance = render(ground, sensor, shape, sun, lit=sunlit(ground, sun))
    return np.stack(
        [
            expose(radiance**band.exponent, band.optics, np.random.default_rng([seed, BAND_STREAM, number]))
            for number, band in enumerate(bands)
        ]
    )


def bare_ground(spec: SceneSpec, ground: SyntheticGround) -> SyntheticGround:
    """The terrain of a scene without its objects."""
    return _rebuilt(spec, ground, 0.0, spec.seed)


def partly_rebuilt(spec: SceneSpec, ground: SyntheticGround, share: float, seed: int) -> SyntheticGround:
    """The ground of a scene years later: in this share of it, from the east, stand other houses and trees."""
    other = _rebuilt(spec, ground, 1.0, seed)
    first = round(ground.heights.shape[1] * (1.0 - share))
    planes, material = ground.planes.copy(), ground.material.copy()
    planes[:, first:] = other.planes[:, first:]
    material[:, first:] = other.material[:, first:] + len(ground.materials)
    materials = np.array([*ground.materials, *other.materials], MATERIAL)
    return replace(ground, planes=planes, material=material.astype(np.uint16), materials=materials)


def _rebuilt(spec: SceneSpec, ground: SyntheticGround, density: float, seed: int) -> SyntheticGround:
    """The same terrain with other objects. density : of them, beside that of the scene."""
    objects = replace(
        spec.objects, buildings_per_ha=spec.objects.buildings_per_ha * density,
        towers_per_ha=spec.objects.towers_per_ha * density, trees_per_ha=spec.objects.trees_per_ha * density,
    )  # fmt: skip
    return add_objects(bare_terrain(spec, (ground.x0, ground.y0), ground.heights.shape), objects, seed)
