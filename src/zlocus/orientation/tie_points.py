"""Ground points of the ties: where they lie before the adjustment, and all of them after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zlocus.core.scene import Scene
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.shift_adjustment import Adjustment, renumbered, without_outliers, without_shifts
from zlocus.orientation.ties import Ties
from zlocus.orientation.triangulate import GroundPoints, Observations, rows_by_view, triangulate


@dataclass(frozen=True)
class TiePoints:
    """Ground points of ties.

    xyz : (n, 3) m; sigma_z_m : (n,) standard deviations of their heights; observations : their image points.
    """

    xyz: FloatArray
    sigma_z_m: FloatArray
    observations: Observations

    @classmethod
    def of(cls, ground_points: GroundPoints, observations: Observations) -> TiePoints:
        """Triangulated points, with standard deviations from the noise that their residuals show."""
        sigma_px = np.sqrt(np.mean(ground_points.residual**2)) if len(observations) else np.nan
        return cls(ground_points.xyz, ground_points.sigma_z * sigma_px, observations)


def first_ground_points(scene: Scene, ties: Ties) -> FloatArray:
    """Where the ray of each tie's first observation meets the tie's height, (n, 3) m."""
    observations = ties.observations
    xyz = np.full((len(ties.z), 3), np.nan)
    _, first = np.unique(observations.point, return_index=True)
    of_view = rows_by_view(observations.view[first], len(scene.views))
    for view, mine in zip(scene.views, of_view, strict=True):
        rows = first[mine]
        point = observations.point[rows]
        xyz[point] = view.sensor.ground_from_image(observations.xy[rows], ties.z[point])
    return xyz


def with_rough_ties(
    adjustment: Adjustment,
    sensors: Sequence[SensorModel],
    observations: Observations,
    xyz: FloatArray,
    inlier_px: float,
) -> TiePoints:
    """The adjusted ties, followed by those that could not be refined or did not agree with the adjustment.

    sensors : corrected, but for the shifts of `adjustment`; observations, xyz : of all ties as SIFT found them, with
    first ground points (n, 3) m; inlier_px : largest residual of a rough tie. Tree tops and edges of roofs look
    different from every side, so that they cannot be refined. Their rough positions still show how high the search must
    reach.
    """
    precise = TiePoints.of(adjustment.ground_points, adjustment.observations)
    used = np.zeros(len(xyz), bool)
    used[adjustment.numbers] = True
    rough, start = renumbered(observations.kept(~used[observations.point]), xyz)
    if not len(rough):
        return precise
    shifted = without_shifts(rough, adjustment.shift_px)
    rough, start = renumbered(without_outliers(rough, triangulate(sensors, shifted, start), inlier_px), start)
    if not len(rough):
        return precise
    added = TiePoints.of(triangulate(sensors, without_shifts(rough, adjustment.shift_px), start), rough)
    every = Observations(
        np.concatenate([precise.observations.view, rough.view]),
        np.concatenate([precise.observations.point, rough.point + len(precise.xyz)]),
        np.concatenate([precise.observations.xy, rough.xy]),
    )
    return TiePoints(
        np.concatenate([precise.xyz, added.xyz]), np.concatenate([precise.sigma_z_m, added.sigma_z_m]), every
    )
