"""Image space: sensor models whose ground is the pixels of a reference image, with heights or depths along its rays.

In image space x is the column, y is minus the row, and z is the hypothesis (a height or a disparity, in units of about
a pixel). A larger hypothesis occludes a smaller one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.sensors.frame import FrameModel


class Rays(Protocol):
    """The rays of a reference image, and the hypotheses along them."""

    def ground(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """Ground points (n, 3) m that pixels (n, 2) see at hypotheses (n,)."""
        ...

    def hypothesis(self, xyz: FloatArray) -> FloatArray:
        """Hypotheses (n,) of ground points (n, 3) m."""
        ...

    def metres_per_unit(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """Metres per unit of the hypothesis, (n,), at pixels (n, 2) and hypotheses (n,): of height, or along the
        ray."""
        ...

    def to(self, sensor: SensorModel) -> SensorModel:
        """The sensor model of another view in image space."""
        ...


@dataclass(frozen=True)
class HeightRays:
    """Hypotheses that are heights above `datum` (m) in units of `unit` (m), the ground pixel of the reference image."""

    sensor: SensorModel
    datum: float
    unit: float

    def ground(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `Rays`."""
        return self.sensor.ground_from_image(xy, self.datum + self.unit * np.asarray(z, float))

    def hypothesis(self, xyz: FloatArray) -> FloatArray:
        """See `Rays`."""
        return np.asarray((xyz[:, 2] - self.datum) / self.unit)

    def metres_per_unit(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `Rays`: of height."""
        return np.full(len(xy), self.unit)

    def to(self, sensor: SensorModel) -> SensorModel:
        """See `Rays`."""
        return HeightModel(self, sensor)


@dataclass(frozen=True)
class HeightModel:
    """A view in the image space of heights, as a `SensorModel`."""

    rays: HeightRays
    sensor: SensorModel

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`. xyz : column, minus row, hypothesis."""
        return self.sensor.image_from_ground(self.rays.ground(xyz[:, :2] * [1.0, -1.0], xyz[:, 2]))

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        ground = self.sensor.ground_from_image(xy, self.rays.datum + self.rays.unit * z)
        return np.column_stack([self.rays.sensor.image_from_ground(ground) * [1.0, -1.0], z])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None


@dataclass(frozen=True)
class DepthRays:
    """Hypotheses that are disparities: `scale` (px m) over the depth (m) along the optical axis of a frame camera.

    Image positions are linear in the disparity, and nearer points have a larger one.
    """

    sensor: FrameModel
    scale: float

    def ground(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `Rays`; NaN at disparities of 0, which are infinitely far, and below."""
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        depth = np.divide(self.scale, z, out=np.full(len(z), np.nan), where=z > 0)
        return self.sensor.ground_at_depth(xy, depth)

    def hypothesis(self, xyz: FloatArray) -> FloatArray:
        """See `Rays`; NaN behind the camera."""
        depth = self.sensor.depth(xyz)
        return np.asarray(np.divide(self.scale, depth, out=np.full(len(depth), np.nan), where=depth > 0))

    def metres_per_unit(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `Rays`: along the ray, on which the depth changes by `scale` / z^2; NaN where `ground` is."""
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        by_unit = np.divide(self.scale, z * z, out=np.full(len(z), np.nan), where=z > 0)
        return np.asarray(by_unit * np.linalg.norm(self.sensor.ray_from_image(xy), axis=1))

    def to(self, sensor: SensorModel) -> SensorModel:
        """See `Rays`."""
        assert isinstance(sensor, FrameModel), "only frame cameras are matched by depth"
        assert sensor.space == self.sensor.space, "rays of both cameras are in the same axes"
        return DepthModel(self, sensor)


@dataclass(frozen=True)
class DepthModel:
    """A frame camera in the image space of disparities, as a `SensorModel`.

    At one disparity the two images, without distortion and motion, are related by a homography, also beyond infinity.
    """

    rays: DepthRays
    sensor: FrameModel

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`. xyz : column, minus row, disparity."""
        reference_sensor, xy = self.rays.sensor, xyz[:, :2] * [1.0, -1.0]
        ray, nearness = reference_sensor.ray_from_image(xy), xyz[:, 2:] / self.rays.scale
        if reference_sensor.rolling_shutter is not None:
            # Seen from the projection centre of the reference's middle row, which disparities refer to.
            displacement = reference_sensor.displacement(xy)
            ray = ray + nearness * (displacement - (displacement @ reference_sensor.rotation[2])[:, None] * ray)
        return self.sensor.image_from_ray(ray + nearness * self._base, nearness[:, 0])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        # The reference's rays end in the plane of depth 1, which the base, scaled to the disparity, shifts.
        towards, axis = self.sensor.ray_from_image(xy), self.rays.sensor.rotation[2]
        shift = z[:, None] / self.rays.scale * (self._base - self.sensor.displacement(xy))
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (1.0 + shift @ axis) / (towards @ axis)
        ray = length[:, None] * towards - shift
        ray[~(length > 0)] = np.nan
        return np.column_stack([self.rays.sensor.image_from_ray(ray, z / self.rays.scale) * [1.0, -1.0], z])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None

    @property
    def _base(self) -> FloatArray:
        """Vector (3,) m from this camera's centre to that of the reference image."""
        return np.asarray(np.array(self.rays.sensor.centre) - np.array(self.sensor.centre))


@dataclass(frozen=True)
class PixelModel:
    """The reference image itself in image space, as a `SensorModel`."""

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.asarray(np.asarray(xyz, float)[:, :2] * [1.0, -1.0])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        return np.column_stack([np.asarray(xy, float) * [1.0, -1.0], np.broadcast_to(z, (len(xy),))])

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None
