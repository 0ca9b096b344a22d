"""Frame camera: one projection centre and a flat image, with or without lens distortion and rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pyproj import CRS

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.distortion import BrownDistortion, Distortion
from zlocus.sensors.earth_frame import FRAME_SPACE, EarthSpace, Space
from zlocus.sensors.frame_kernel import CameraNumbers, LensNumbers, image_of_rays
from zlocus.sensors.rolling_shutter import RollingShutter

Row = tuple[float, float, float]
IDEAL_LENS = LensNumbers(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf)


@dataclass(frozen=True)
class FrameModel:
    """A frame camera as a `SensorModel`.

    centre : of projection, xyz m; camera_from_ground : rows of the rotation, which are the camera's axes: along image
    rows (to the right), down the columns, and forwards along the optical axis; focal : px, along rows;
    principal_point : (column, row) px where the optical axis meets the image. aspect : focal length down the columns
    over `focal`; skew : px by which columns grow per y (of the plane at depth 1). distortion : None is an ideal lens.
    rolling_shutter : motion during the read-out, in which `centre` is that of the middle row; None is a camera that
    takes all rows at once.

    space : where rays are straight; centre and camera_from_ground are in its axes, ground points in the scene's frame.
    """

    centre: Row
    camera_from_ground: tuple[Row, Row, Row]
    focal: float
    principal_point: tuple[float, float]
    aspect: float = 1.0
    skew: float = 0.0
    distortion: Distortion | None = None
    space: Space = FRAME_SPACE
    rolling_shutter: RollingShutter | None = None

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`; NaN behind the camera, and where its distortion is not one to one."""
        return self.image_from_ray(self._from_centre(xyz))

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`; NaN where the ray does not meet that height in front of the camera."""
        ray = self.ray_from_image(xy)
        z = np.broadcast_to(np.asarray(z, float), (len(ray),))
        return self.space.meet(np.array(self.centre) + self.displacement(xy), ray, z)

    def height_bounds(self) -> tuple[float, float] | None:
        """See `SensorModel`."""
        return None

    def station_height(self) -> float:
        """See `Stationed`."""
        centres = np.array([self.centre])
        if self.rolling_shutter is not None:
            rows = np.array([0.0, self.rolling_shutter.rows - 1.0])
            centres = centres + self.rolling_shutter.displacement(rows)
        return float(self.space.ground_from_cartesian(centres)[:, 2].min())

    def ground_at_depth(self, xy: FloatArray, depth: FloatArray) -> FloatArray:
        """Ground points (n, 3) m that pixels (n, 2) see at depths (n,) m along the optical axis; see `depth`."""
        ray = self.ray_from_image(xy)
        if self.rolling_shutter is None:
            return self._along(ray, depth)
        displacement = self.displacement(xy)
        depth = np.asarray(depth) - displacement @ self.rotation[2]
        return self.space.ground_from_cartesian(np.array(self.centre) + displacement + depth[:, None] * ray)

    def displacement(self, xy: FloatArray) -> FloatArray:
        """Motion of the projection centre from the middle row to the rows of pixels (n, 2): (n, 3) m, or (3,) zeros
        without a rolling shutter."""
        if self.rolling_shutter is None:
            return np.zeros(3)
        return self.rolling_shutter.displacement(np.asarray(xy, float)[:, 1])

    def ray_from_image(self, xy: FloatArray) -> FloatArray:
        """Rays (n, 3) m from the projection centre to a depth of 1, of pixels (n, 2); NaN where a pixel has no ray.

        With a rolling shutter they start where the camera is at the row of the pixel, see `displacement`.
        """
        at = (np.asarray(xy, float) - np.array(self.principal_point)) / [self.focal, self.focal * self.aspect]
        if self.skew:
            at[:, 0] -= self.skew / self.focal * at[:, 1]
        if self.distortion is not None:
            at = self.distortion.undistorted(at)
        return np.column_stack([at, np.ones(len(at))]) @ self.rotation

    def image_from_ray(self, ray: FloatArray, nearness: FloatArray | float = 1.0) -> FloatArray:
        """Image positions (n, 2) px of rays (n, 3) from the projection centre, of any length; NaN behind the camera.

        nearness : (n,) or one number, the length of the ray over the distance in m to the point that is seen. Only a
        rolling shutter uses it, whose rays start at the projection centre of the middle row.
        """
        if self.rolling_shutter is None:
            return self._image_at_rest(ray)
        return self.rolling_shutter.image_in_motion(self._image_at_rest, np.asarray(ray, float), nearness)

    def _image_at_rest(self, ray: FloatArray) -> FloatArray:
        """Image positions (n, 2) px of rays (n, 3) from the projection centre at which their points are seen."""
        if isinstance(self.distortion, BrownDistortion | None):
            lens = IDEAL_LENS if self.distortion is None else self.distortion.numbers
            focal, aspect, column, row, skew = map(float, (self.focal, self.aspect, *self.principal_point, self.skew))
            camera = CameraNumbers(self.rotation, focal, aspect, column, row, skew)
            xy = np.empty((len(ray), 2))
            image_of_rays(np.ascontiguousarray(ray, np.float64), camera, lens, xy)
            return xy
        in_camera = np.asarray(ray, float) @ self.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = in_camera[:, :2] / in_camera[:, 2:]
        at[~(in_camera[:, 2] > 0)] = np.nan
        at = self.distortion.distorted(at)
        xy = at * [self.focal, self.focal * self.aspect] + np.array(self.principal_point)
        if self.skew:
            xy[:, 0] += self.skew * at[:, 1]
        return np.asarray(xy)

    def depth(self, xyz: FloatArray) -> FloatArray:
        """Distance (n,) m of ground points (n, 3) along the optical axis, from the projection centre of the middle row;
        negative behind the camera."""
        return np.asarray(self._from_centre(xyz) @ self.rotation[2])

    def moved(self, column: float, row: float) -> FrameModel:
        """The camera with its image positions increased by `column` and `row` pixels; rows keep their time."""
        return replace(self, principal_point=(self.principal_point[0] + column, self.principal_point[1] + row))

    def corrected(self, offset: FloatArray, turn: FloatArray) -> FrameModel:
        """The camera moved and turned along and about its own axes: right, down, forwards.

        offset : (3,) m; turn : (3,) rad, a rotation vector (its length is the angle).
        """
        # SciPy's rotations cost 0.2 s to import, and few runs need them here.
        from scipy.spatial.transform import Rotation

        centre = np.array(self.centre) + np.asarray(offset, float) @ self.rotation
        rows = Rotation.from_rotvec(-np.asarray(turn, float)).as_matrix() @ self.rotation
        return replace(self, centre=as_row(centre), camera_from_ground=as_rows(rows))

    def turned(self, rotation: FloatArray) -> FrameModel:
        """The camera in a rotated Cartesian frame. rotation : (3, 3), new frame from old frame."""
        assert self.space == FRAME_SPACE, "the Earth is not turned"
        centre, rows = rotation @ np.array(self.centre), self.rotation @ rotation.T
        return replace(
            self, centre=as_row(centre), camera_from_ground=as_rows(rows), rolling_shutter=self._motion(rotation)
        )

    def on_earth(self, given: CRS, crs: CRS) -> FrameModel:
        """The camera over the curved Earth, for ground points in `crs`.

        Its own centre is a point of the map `given`, and its axes are relative to that map's at the centre: grid east,
        grid north and up (see `EarthSpace.poses`).
        """
        earth = EarthSpace(crs)
        centre, axes = earth.pose(given, np.array(self.centre))
        rows = as_rows(self.rotation @ axes)
        return replace(
            self, centre=as_row(centre), camera_from_ground=rows, space=earth, rolling_shutter=self._motion(axes.T)
        )

    def _motion(self, rotation: FloatArray) -> RollingShutter | None:
        """The rolling shutter in rotated axes. rotation : (3, 3), new from old axes."""
        return None if self.rolling_shutter is None else self.rolling_shutter.turned(rotation)

    def _from_centre(self, xyz: FloatArray) -> FloatArray:
        """Rays (n, 3) m from the projection centre to ground points (n, 3)."""
        return np.asarray(self.space.cartesian_from_ground(xyz) - np.array(self.centre))

    def _along(self, ray: FloatArray, depth: FloatArray) -> FloatArray:
        """Ground points (n, 3) at depths (n,) along rays (n, 3)."""
        return self.space.ground_from_cartesian(np.array(self.centre) + np.asarray(depth)[:, None] * ray)

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
    from scipy.spatial.transform import Rotation

    from_image = Rotation.from_euler("XYZ", [omega, phi, kappa], degrees=True).as_matrix()
    return as_rows(np.diag([1.0, -1.0, -1.0]) @ from_image.T)


def as_row(vector: FloatArray) -> Row:
    """A vector (3,) as plain numbers."""
    x, y, z = (float(v) for v in vector)
    return x, y, z


def as_rows(matrix: FloatArray) -> tuple[Row, Row, Row]:
    """A matrix (3, 3) as plain numbers."""
    return as_row(matrix[0]), as_row(matrix[1]), as_row(matrix[2])
