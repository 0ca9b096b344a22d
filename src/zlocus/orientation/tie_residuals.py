"""Residuals of ties, for each image and each pair, before and after the cameras were corrected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import Scene, View
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.epipolar import Sightlines, epipolar_offsets
from zlocus.orientation.parameter_groups import kind_of
from zlocus.orientation.shift_adjustment import Adjustment
from zlocus.orientation.triangulate import Observations, rows_of_views
from zlocus.sensors.line_shifts import LineShifts

# About so many ties of a pair (up to twice as many) are enough for the median distance that is reported.
TIES_FOR_MEDIAN = 200


@dataclass(frozen=True)
class Residuals:
    """Statistics of the lengths of tie residuals, px; NaN without ties."""

    median: float
    rms: float
    percent90: float

    @classmethod
    def of(cls, residual: FloatArray) -> Residuals:
        """Statistics of residuals (m, 2) px."""
        length = np.hypot(*residual.T)
        if not len(length):
            return cls(np.nan, np.nan, np.nan)
        return cls(float(np.median(length)), float(np.sqrt(np.mean(length**2))), float(np.percentile(length, 90)))

    def as_dict(self) -> dict[str, float | None]:
        """The statistics for run.json, rounded; None for NaN."""
        values = {"median": self.median, "rms": self.rms, "percent90": self.percent90}
        return {name: round(value, 4) if np.isfinite(value) else None for name, value in values.items()}


@dataclass(frozen=True)
class ViewOrientation:
    """Correction and residuals of one image.

    shift_px : (column, row) added to what its sensor model projects; where more than a shift was corrected, the median
    of the correction at its ties; residuals_before, residuals_after : of its ties; sensor : see
    `parameter_groups.kind_of`; line_shifts : displacements of its lines, None where there are none.
    """

    name: str
    shift_px: tuple[float, float]
    n_ties: int
    residuals_before: Residuals
    residuals_after: Residuals
    sensor: str = "rpc"
    line_shifts: LineShifts | None = None


@dataclass(frozen=True)
class PairOrientation:
    """Number of ties of two images, and the median distance of their points from the epipolar curves, px, before and
    after the correction; NaN where there are no curves."""

    views: tuple[str, str]
    n_ties: int
    epipolar_distance_before_px: float
    epipolar_distance_after_px: float


def view_orientations(
    views: Sequence[View],
    adjustment: Adjustment,
    corrected_sensors: Sequence[SensorModel],
    line_shifts: Sequence[LineShifts | None],
) -> tuple[ViewOrientation, ...]:
    """Corrections and residuals of all views. corrected_sensors : their sensors, but for their shifts."""
    rows = rows_of_views(adjustment.observations, len(views))
    return tuple(
        view_orientation(view, i, adjustment, rows[i], corrected_sensors[i], line_shifts[i])
        for i, view in enumerate(views)
    )


def view_orientation(
    view: View,
    number: int,
    adjustment: Adjustment,
    mine: NDArray[np.intp],
    corrected_sensor: SensorModel,
    line_shifts: LineShifts | None,
) -> ViewOrientation:
    """Correction and residuals of the view of that number. mine : (k,) rows of its observations."""
    column, row = adjustment.shift_px[number]
    if corrected_sensor is not view.sensor and len(mine):
        xyz = adjustment.ground_points.xyz[adjustment.observations.point[mine]]
        moved = corrected_sensor.image_from_ground(xyz) - view.sensor.image_from_ground(xyz)
        column, row = np.nanmedian(moved, axis=0)
    before, after = Residuals.of(adjustment.before_px[mine]), Residuals.of(adjustment.after_px[mine])
    shift = (float(column), float(row))
    return ViewOrientation(view.name, shift, len(mine), before, after, kind_of(view.sensor), line_shifts)


def pair_orientations(
    scene: Scene, corrected_sensors: Sequence[SensorModel], adjustment: Adjustment, z_range: tuple[float, float]
) -> tuple[PairOrientation, ...]:
    """Distances of each pair's points from the epipolar curves, over the ties that both its images see.

    corrected_sensors : of all views, but for their shifts; z_range : lowest and highest height of the curves, m.
    """
    observations, found = adjustment.observations, []
    of_view = rows_of_views(observations, len(scene.views))
    pairs = linked_pairs(observations, len(scene.views))
    for a in np.unique(pairs[:, 0]):
        xy = observations.xy[of_view[a]]
        lines_before = Sightlines.of(scene.views[a].sensor, xy, z_range)
        lines_after = Sightlines.of(corrected_sensors[a], xy - adjustment.shift_px[a], z_range)
        for b in pairs[pairs[:, 0] == a, 1]:
            _, in_a, in_b = np.intersect1d(
                observations.point[of_view[a]], observations.point[of_view[b]], assume_unique=True, return_indices=True
            )
            few = slice(None, None, max(len(in_a) // TIES_FOR_MEDIAN, 1))
            before_b = observations.xy[of_view[b][in_b[few]]]
            after_b = before_b - adjustment.shift_px[b]
            before = epipolar_offsets(lines_before.only(in_a[few]), scene.views[b].sensor, before_b, z_range)
            after = epipolar_offsets(lines_after.only(in_a[few]), corrected_sensors[b], after_b, z_range)
            names = (scene.views[a].name, scene.views[b].name)
            medians = (median_distance(of_pair.distance_px) for of_pair in (before, after))
            found.append(PairOrientation(names, len(in_a), *medians))
    return tuple(found)


def linked_pairs(observations: Observations, n_views: int) -> NDArray[np.int64]:
    """Numbers (k, 2) of the views, the smaller first, that see some point together."""
    by_point = np.lexsort((observations.view, observations.point))
    view, point = observations.view[by_point].astype(np.int64), observations.point[by_point]
    found = [np.zeros(0, np.int64)]
    # Observations of one point follow each other, by views.
    for distance in range(1, len(point)):
        is_same = point[distance:] == point[:-distance]
        if not is_same.any():
            break
        found.append(np.unique(view[:-distance][is_same] * n_views + view[distance:][is_same]))
    pairs = np.column_stack(np.divmod(np.unique(np.concatenate(found)), n_views))
    return np.asarray(pairs[pairs[:, 0] < pairs[:, 1]])


def median_distance(distance_px: FloatArray) -> float:
    """Median length of the signed distances (n,) px that are finite; NaN where none is."""
    known = distance_px[np.isfinite(distance_px)]
    return float(np.median(np.abs(known))) if len(known) else np.nan
