"""Evaluation of a surface at points: check points of a survey, or laser points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.accuracy import Accuracy
from zlocus.evaluation.asprs import (
    STANDARD,
    HorizontalAccuracy,
    VerticalAccuracy,
    horizontal_accuracy,
    vertical_accuracy,
)
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.fit_sample import sample_around
from zlocus.evaluation.frame import in_metres
from zlocus.evaluation.height_file import HeightFile
from zlocus.evaluation.point_choice import PointChoice
from zlocus.evaluation.point_reference import PointReference
from zlocus.evaluation.shift import Shift
from zlocus.evaluation.statistics import error_statistics
from zlocus.evaluation.surface_fit import MIN_FOR_HEIGHT, fit_surface
from zlocus.io.points.ground_points import KnownPoints, PointOptions

# Of larger clouds so many points are judged, chosen at random.
MAX_JUDGED = 1_000_000
# How far a surface is moved at most to find its shift, m.
MAX_SHIFT_M = 10.0
METHOD = "points"


@dataclass(frozen=True, eq=False)
class PointEvaluation:
    """Accuracy of a surface at points.

    evaluation : the figures, as of a reference surface; classes are kinds of ground. nva, vva : vertical accuracy by
    the ASPRS standard on ground without and with vegetation; vva is None where no point is vegetated. has_cover :
    whether the kind of ground of the points is known. horizontal : None where no point was measured in the product.
    points : those that were judged; cover : kind of ground of each; z : (n,) heights of the surface there, m, as it
    lies; errors : (n,) the main ones, m. n_points : number of points in the surface; left_out : of others, by the
    reason. assumed : sentences on what was assumed.
    """

    evaluation: Evaluation
    nva: VerticalAccuracy
    vva: VerticalAccuracy | None
    has_cover: bool
    horizontal: HorizontalAccuracy | None
    points: KnownPoints
    cover: Sequence[str]
    z: FloatArray
    errors: FloatArray
    n_points: int
    left_out: dict[str, int]
    is_cloud: bool
    assumed: tuple[str, ...]

    def columns(self) -> dict[str, FloatArray]:
        """The points as columns of numbers by name, NaN where unknown."""
        x, y, z = self.points.xyz.T
        return {
            "x": x, "y": y, "z": z, "sigma": self.points.sigma_m, "surface_z": self.z, "error": self.z - z,
            "main_error": self.errors,
        }  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """The evaluation as JSON holds it."""
        record = self.evaluation.as_dict() | {"assumed": "; ".join(self.assumed) or None}
        of_points = {"n": self.n_points, "judged": len(self.points), "left_out": self.left_out}
        asprs = {
            "standard": STANDARD,
            "nva": self.nva.as_dict(),
            "vva": None if self.vva is None else self.vva.as_dict(),
            "horizontal": None if self.horizontal is None else self.horizontal.as_dict(),
            "rmse_3d": self.rmse_3d,
            "classes_known": self.has_cover,
        }
        return record | {"points": of_points, "asprs": asprs}

    @property
    def rmse_3d(self) -> float | None:
        """Root mean square of the errors in space, √(rmse_h² + rmse_v²), m; None where one is not known."""
        if self.horizontal is None or math.isnan(self.nva.rmse_v):
            return None
        return math.hypot(self.horizontal.rmse_h, self.nva.rmse_v)


def evaluate_at_points(
    dsm: Path, comparison: Comparison, options: PointOptions, more: Sequence[Path] = ()
) -> PointEvaluation:
    """Compare a surface with points whose heights are taken as true.

    The surface is interpolated between its four cells around each point. A point where it has no height counts as
    missing; one outside of its raster does not count. more : clouds beside the reference of the comparison.

    Raises
    ------
    InputError
        A file is missing, damaged or not understood; the points lie elsewhere; or none has a height in the surface.
    ConfigError
        Options that do not go together with points, or a kind of ground that may be vegetated or not.
    """
    if comparison.classes is not None:
        raise ConfigError(
            f"--classes {comparison.classes} is for reference surfaces. Points have their kind of ground in a column, "
            "or a class. Leave it out."
        )
    if comparison.coregister is not None:
        raise ConfigError(
            f"--coregister {comparison.coregister} needs the slopes of a reference surface, and points have none. Give "
            "--align, which finds the shift at points."
        )
    height_file = HeightFile.open(dsm)
    reference = PointReference.open(height_file, (comparison.reference, *more), options, comparison.geoid)
    choice = PointChoice(MAX_JUDGED)
    for points in reference.chunks():
        choice.add(points, height_file.bilinear(points.xyz[:, :2]))
    points, z = choice.points, choice.values
    errors = z - points.xyz[:, 2]
    if not np.isfinite(errors).any():
        raise InputError(
            f"{dsm} has no height at any of the {len(points)} points of {comparison.reference} that lie in it. Check "
            "that both are of the same ground."
        )
    return _judged(reference, comparison, options, (points, z, choice.n))


def _judged(
    reference: PointReference,
    comparison: Comparison,
    options: PointOptions,
    points_read: tuple[KnownPoints, FloatArray, int],
) -> PointEvaluation:
    """The figures of points. points_read : points, heights of the surface there, and number of points in all."""
    points, z, n_points = points_read
    point_file, errors = reference.point_file, z - points.xyz[:, 2]
    names = point_file.cover_names
    vegetated = [code for code, name in names.items() if options.is_vegetated(name, point_file.is_cloud)]
    is_vegetated = np.isin(points.cover, vegetated)
    cover = [names.get(int(code), "") for code in points.cover]
    members = {name or "no class": points.cover == code for code, name in sorted(names.items())}

    def accuracy(found: FloatArray) -> Accuracy:
        statistics = error_statistics(found, comparison.threshold_m, comparison.more_thresholds_m)
        of_classes = {
            name: error_statistics(found[chosen], comparison.threshold_m, comparison.more_thresholds_m)
            for name, chosen in members.items()
            if chosen.any()
        }
        return Accuracy(statistics, of_classes)

    shift = _shift(reference.height_file, points, errors)
    moved = points.xyz[:, :2] + (shift.east_m, shift.north_m)
    aligned = (reference.height_file.bilinear(moved) if shift.is_horizontal else z) - points.xyz[:, 2] - shift.up_m
    main = aligned if comparison.removes_shift else errors
    evaluation = Evaluation(
        absolute_accuracy=accuracy(errors), threshold_m=comparison.threshold_m, aligned_accuracy=accuracy(aligned),
        found_shift=shift, is_aligned=comparison.removes_shift, vertical_datums=reference.datums,
        geoid_added_to=reference.geoid_added_to,
    )  # fmt: skip
    return PointEvaluation(
        evaluation, vertical_accuracy(main[~is_vegetated], points.sigma_m[~is_vegetated]),
        vertical_accuracy(main[is_vegetated], points.sigma_m[is_vegetated]) if is_vegetated.any() else None,
        bool(names), horizontal_accuracy(points.measured_xy - points.xyz[:, :2], points.sigma_xy_m), points, cover, z,
        main, n_points, reference.dropped, point_file.is_cloud, reference.assumed,
    )  # fmt: skip


def _shift(height_file: HeightFile, points: KnownPoints, errors: FloatArray) -> Shift:
    """The shift of the surface against points; its height is the median error after the horizontal shift."""
    if not in_metres(height_file.horizontal):
        reason = "the surface is not on a map in metres"
    elif np.count_nonzero(height_file.has_four(points.xyz[:, :2])) < MIN_FOR_HEIGHT:
        reason = f"fewer than {MIN_FOR_HEIGHT} points lie between four cells with heights"
    else:
        fit = fit_surface(sample_around(height_file, points, MAX_SHIFT_M), MAX_SHIFT_M)
        if fit.undetermined is None:
            east_m, north_m, _ = fit.shift_m
            moved = height_file.bilinear(points.xyz[:, :2] + (east_m, north_m)) - points.xyz[:, 2]
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(fit.covariance[:2, :2])[-1]))
            return Shift(east_m, north_m, float(np.nanmedian(moved)), METHOD, fit.steps, sigma_m)
        reason = fit.undetermined
    return Shift(0.0, 0.0, float(np.nanmedian(errors)), METHOD, undetermined=reason)
