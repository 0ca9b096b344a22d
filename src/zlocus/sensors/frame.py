"""Ideal frame camera: one centre of projection, a flat image, no distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from zlocus.sensors.model import FloatArray

Row = tuple[float, float, float]


@dataclass(frozen=True)
class FrameModel:
    """A pinhole camera as a `SensorModel`.

    centre : of projection, xyz m; camera_from_ground : rows of the rotation, which are the camera's axes in the scene's
    frame: along image rows (to the right), down the columns, and forwards along the optical axis; focal : px;
    principal_point : (column, row) px where the optical axis meets the image.
    """

    centre: Row
    camera_from_ground: tuple[Row, Row, Row]
    focal: float
    principal_point: tuple[float, float]

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`; NaN behind the camera."""
        return self.image_from_ray(np.asarray(xyz, float) - np.array(self.centre))

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`; NaN where the ray does not meet that height in front of the camera."""
        ray = self.ray_from_image(xy)
        rise = np.broadcast_to(np.asarray(z, float), (len(ray),)) - self.centre[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = rise / ray[:, 2]
            xyz = np.array(self.centre) + depth[:, None] * ray
        xyz[:, 2] = np.broadcast_to(z, (len(ray),))
        xyz[~((depth > 0) & np.isfinite(depth))] = np.nan
        return np.asarray(xyz)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None

    def ray_from_image(self, xy: FloatArray) -> FloatArray:
        """From the centre of projection to what pixels (n, 2) see at a depth of 1. -> (n, 3) m."""
        at = (np.asarray(xy, float) - np.array(self.principal_point)) / self.focal
        return np.column_stack([at, np.ones(len(at))]) @ self.rotation

    def image_from_ray(self, ray: FloatArray) -> FloatArray:
        """Pixels that see directions from the centre of projection. ray : (n, 3), any length -> (n, 2) px."""
        in_camera = np.asarray(ray, float) @ self.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = self.focal * in_camera[:, :2] / in_camera[:, 2:] + np.array(self.principal_point)
        xy[~(in_camera[:, 2] > 0)] = np.nan
        return np.asarray(xy)

    def depth(self, xyz: FloatArray) -> FloatArray:
        """Distance (n,) m of ground points (n, 3) along the optical axis; negative behind the camera."""
        return np.asarray((np.asarray(xyz, float) - np.array(self.centre)) @ self.rotation[2])

    def moved(self, column: float, row: float) -> FrameModel:
        """The camera whose image positions are `column` and `row` pixels larger."""
        return replace(self, principal_point=(self.principal_point[0] + column, self.principal_point[1] + row))

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) `camera_from_ground` as an array."""
        return np.array(self.camera_from_ground, float)


def rotation_from_angles(omega: float, phi: float, kappa: float) -> tuple[Row, Row, Row]:
    """`FrameModel.camera_from_ground` of photogrammetric angles (degrees).

    The angles turn the scene's axes, about x, then the moved y, then the moved z, into those of an image whose x points
    to the right, y up and z backwards: R = Rx(omega) Ry(phi) Rz(kappa) (Kraus 2007, section 2.1). All zero looks
    straight down with the top of the image to the north.
    """
    (so, sp, sk), (co, cp, ck) = (f(np.deg2rad([omega, phi, kappa])) for f in (np.sin, np.cos))
    about_x = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    rows = np.diag([1.0, -1.0, -1.0]) @ (about_x @ about_y @ about_z).T
    first, second, third = ((float(x), float(y), float(z)) for x, y, z in rows)
    return first, second, third
