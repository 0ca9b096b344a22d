"""Triangulation: ground points from the image points that see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray, SensorModel

MAX_ITERATIONS = 10
TOLERANCE_PX = 1e-3
# After larger steps the derivatives are computed again. Sensors are nearly linear over smaller ones.
RELINEARISE_PX = 5.0
DIFFERENCE_M = 1.0


@dataclass(frozen=True)
class Observations:
    """Image points of ground points, one row per observation.

    view, point : (m,) int, numbers of the image and of the ground point; xy : (m, 2) px.
    """

    view: NDArray[np.int64]
    point: NDArray[np.int64]
    xy: FloatArray

    def __len__(self) -> int:
        return len(self.view)

    def kept(self, keep: NDArray[np.bool_]) -> Observations:
        """The observations where `keep` (m,) is true; points keep their numbers."""
        return Observations(self.view[keep], self.point[keep], self.xy[keep])


@dataclass(frozen=True)
class GroundPoints:
    """Triangulated ground points and how well they explain their observations.

    xyz : (n, 3) m, NaN where the rays do not meet; sigma_z : (n,) standard deviation of the height, in m per px of
    noise; residual : (m, 2) px, observed minus projected; by_ground : (m, 2, 3) px per m, derivatives of the image
    points.
    """

    xyz: FloatArray
    sigma_z: FloatArray
    residual: FloatArray
    by_ground: FloatArray


def triangulate(
    sensors: Sequence[SensorModel],
    observations: Observations,
    xyz: FloatArray,
    weight: FloatArray | None = None,
    by_ground: FloatArray | None = None,
) -> GroundPoints:
    """Ground points by least squares (Gauss-Newton, all points at once).

    xyz : (n, 3) m to start from; weight : (m,) of each observation (1 where not given); by_ground : (m, 2, 3) px per m,
    derivatives from an earlier round near these points. A point with fewer than two observations on distinct rays is
    NaN.
    """
    weight = np.ones(len(observations)) if weight is None else weight
    by_ground = ground_jacobian(sensors, observations, xyz) if by_ground is None else by_ground
    inverse = point_covariance(by_ground, weight, observations.point, len(xyz))
    step_px = 0.0
    for _ in range(MAX_ITERATIONS):
        if step_px > RELINEARISE_PX:
            by_ground = ground_jacobian(sensors, observations, xyz)
            inverse = point_covariance(by_ground, weight, observations.point, len(xyz))
        residual = observations.xy - project_points(sensors, observations, xyz)
        pull = summed(np.einsum("mji,mj,m->mi", by_ground, residual, weight), observations.point, len(xyz))
        step = np.einsum("nij,nj->ni", inverse, pull)
        xyz = xyz + step
        moved_px = np.einsum("mji,mi->mj", by_ground, step[observations.point])
        step_px = np.nanmax(np.abs(moved_px), initial=0.0)
        if step_px <= TOLERANCE_PX:
            break
    return GroundPoints(xyz, np.sqrt(inverse[:, 2, 2]), residual - moved_px, by_ground)


def project_points(sensors: Sequence[SensorModel], observations: Observations, xyz: FloatArray) -> FloatArray:
    """Projections (m, 2) px of each observation's ground point into its image; xyz : (n, 3) m."""
    xy = np.full((len(observations), 2), np.nan)
    for i, rows in enumerate(rows_of_views(observations, len(sensors))):
        if len(rows):
            xy[rows] = sensors[i].image_from_ground(xyz[observations.point[rows]])
    return xy


def rows_of_views(observations: Observations, n_views: int) -> list[NDArray[np.intp]]:
    """Row numbers of the observations of each view, in their order."""
    return rows_by_view(observations.view, n_views)


def rows_by_view(view: NDArray[np.int64], n_views: int) -> list[NDArray[np.intp]]:
    """Numbers of the rows of each view, in their order. view : (m,) number of the view of each row."""
    order = np.argsort(view, kind="stable")
    return np.split(order, np.searchsorted(view, np.arange(1, n_views), sorter=order))


def ground_jacobian(sensors: Sequence[SensorModel], observations: Observations, xyz: FloatArray) -> FloatArray:
    """Derivatives (m, 2, 3) of image positions by ground positions, px per m, by differences over a metre."""
    here = project_points(sensors, observations, xyz)
    columns = [
        (project_points(sensors, observations, xyz + step) - here) / DIFFERENCE_M for step in np.eye(3) * DIFFERENCE_M
    ]
    return np.stack(columns, axis=2)


def point_covariance(by_ground: FloatArray, weight: FloatArray, point: NDArray[np.int64], n_points: int) -> FloatArray:
    """Inverse normal matrices (n, 3, 3) m2 per px2 of the points; NaN where the rays do not fix one."""
    normal = summed(np.einsum("mji,mjk,m->mik", by_ground, by_ground, weight).reshape(-1, 9), point, n_points)
    normal = normal.reshape(-1, 3, 3)
    scale = np.trace(normal, axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        solvable = np.isfinite(scale) & (np.linalg.det(np.nan_to_num(normal)) > 1e-12 * np.nan_to_num(scale) ** 3)
    inverse = np.full(normal.shape, np.nan)
    inverse[solvable] = np.linalg.inv(normal[solvable])
    return inverse


def summed(values: FloatArray, point: NDArray[np.int64], n_points: int) -> FloatArray:
    """Sums (n, k) of values (m, k) over the observations of each point."""
    return np.stack([np.bincount(point, column, n_points) for column in values.T], axis=1)
