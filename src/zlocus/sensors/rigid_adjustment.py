"""The rigid motion of an RPC's rays that makes them those of a corrected sensor, as Ames Stereo Pipeline takes it.

Its adjusted camera sees a geocentric point P where the camera as delivered sees R^-1 (P - c - t) + c: t is a
translation, R a rotation, and c the centre of the camera for the pixel (0, 0), which for an RPC is a point of that
pixel's ray near the ground. Sources: Ames Stereo Pipeline's manual, "Format of .adjust files"; the class
`AdjustedCameraModel` of Vision Workbench, and `RPCModel::camera_center`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.sensors.earth_frame import WGS84, WGS84_EARTH, between
from zlocus.sensors.perspective_fit import FitError, PixelPart
from zlocus.sensors.rpc import RpcModel

# Points along each side of the image, and heights, of the fit. It is judged at twice as many.
GRID_POINTS, GRID_HEIGHTS = 9, 3
# Height above the middle of an RPC's range at which Ames Stereo Pipeline places its camera: a share of the range,
# within limits, m. Old versions take the middle itself. As rotations are tiny, that changes no position.
CENTRE_SHARE, MIN_CENTRE_M, MAX_CENTRE_M = 0.9, 0.1, 50.0
STEP_M = 1.0
# A rotation counts as much as the motion that it causes at this distance, m.
LEVER_M = 1e4
# Directions of the parameters that move positions by less than this share of the others are left at zero.
MIN_SHARE = 1e-4
STEPS = 4


@dataclass(frozen=True)
class RigidAdjustment:
    """A rigid motion of rays. translation : (3,) m, geocentric; turn : (3,) rad, rotation vector; centre : (3,) m;
    fit_error : distance from the corrected sensor model over the image and a range of heights."""

    translation: FloatArray
    turn: FloatArray
    centre: FloatArray
    fit_error: FitError

    @property
    def quaternion(self) -> FloatArray:
        """(4,) the rotation, the scalar first."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_rotvec(self.turn).as_quat()
        return np.array([w, x, y, z])


def fit_adjustment(
    rpc_model: RpcModel, corrected_sensor: SensorModel, shape: tuple[int, int], crs: CRS, heights: tuple[float, float]
) -> RigidAdjustment:
    """The adjustment of a delivered RPC that comes nearest to a corrected sensor model.

    shape : rows and columns of the image; crs : of the ground points of both models; heights : lowest and highest, m.

    Raises
    ------
    GeometryError
        A model does not map all of the image.
    """
    part = PixelPart(0, 0, shape[1], shape[0])
    xy, ground = _seen(corrected_sensor, part, crs, heights, GRID_POINTS, GRID_HEIGHTS)
    if not np.isfinite(ground).all():
        raise GeometryError("The sensor model does not map all of the image. Give other --heights.")
    centre, parameters = _centre(rpc_model), np.zeros(6)
    for _ in range(STEPS):
        away = (xy - _projected(rpc_model, moved_points(ground, centre, parameters))).ravel()
        jacobian = np.empty((len(away), 6))
        for k, step in enumerate(np.diag([STEP_M] * 3 + [STEP_M / LEVER_M] * 3)):
            ahead, behind = (
                _projected(rpc_model, moved_points(ground, centre, parameters + sign * step)) for sign in (1.0, -1.0)
            )
            jacobian[:, k] = (ahead - behind).ravel() / (2.0 * STEP_M)
        added = np.linalg.lstsq(jacobian, away, rcond=MIN_SHARE)[0]
        parameters = parameters + added / np.array([1.0] * 3 + [LEVER_M] * 3)
    xy, ground = _seen(corrected_sensor, part, crs, heights, 2 * GRID_POINTS, GRID_HEIGHTS + 1)
    fit_error = FitError.of(_projected(rpc_model, moved_points(ground, centre, parameters)) - xy)
    return RigidAdjustment(parameters[:3], parameters[3:], centre, fit_error)


def moved_points(ground: FloatArray, centre: FloatArray, parameters: FloatArray) -> FloatArray:
    """Geocentric points (n, 3) m at which the delivered camera sees those of an adjusted one. parameters : (6,)
    translation and rotation vector."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(parameters[3:]).as_matrix()
    return np.asarray((ground - centre - parameters[:3]) @ rotation + centre)


def _seen(
    sensor: SensorModel, part: PixelPart, crs: CRS, heights: tuple[float, float], per_side: int, n_heights: int
) -> tuple[FloatArray, FloatArray]:
    """Image positions (n, 2) px, and the geocentric points (n, 3) m that they show."""
    at = part.grid(per_side)
    xy = np.tile(at, (n_heights, 1))
    xyz = sensor.ground_from_image(xy, np.repeat(np.linspace(*heights, n_heights), len(at)))
    lon, lat = between(crs.to_2d(), WGS84).transform(xyz[:, 0], xyz[:, 1])
    return xy, WGS84_EARTH.cartesian_from_ground(np.column_stack([lon, lat, xyz[:, 2]]))


def _projected(rpc_model: RpcModel, ground: FloatArray) -> FloatArray:
    """Image positions (n, 2) px of geocentric points (n, 3) m."""
    lon, lat, height = WGS84_EARTH.geographic_from_cartesian(ground).T
    return rpc_model.image_from_geographic(lon, lat, height)


def _centre(rpc_model: RpcModel) -> FloatArray:
    """The geocentric point (3,) m about which the camera of an RPC is turned."""
    rpc = rpc_model.rpc
    up = min(max(CENTRE_SHARE * rpc.height_scale, MIN_CENTRE_M), MAX_CENTRE_M)
    height = np.array([rpc.height_off + up])
    lon, lat = rpc_model.geographic_from_image(np.zeros((1, 2)), height)
    return np.asarray(WGS84_EARTH.cartesian_from_ground(np.column_stack([lon, lat, height]))[0])
