"""Accuracy at check points by the ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 2 (2023)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from zlocus.core.sensor_model import FloatArray

STANDARD = "ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 2 (2023)"
# Fewest check points for a statement of accuracy by the standard.
MIN_POINTS = 30
# Of normal errors, 90 % lie within so many standard deviations: of one coordinate, and of two together where both have
# the same (Greenwalt and Shultz 1962, Principles of error theory and cartographic applications).
LE90_SIGMAS, CE90_SIGMAS = 1.6449, 2.1460
# Where the two coordinates differ more than by this ratio, their errors lie in no circle.
MIN_CIRCULAR_RATIO = 0.6


@dataclass(frozen=True)
class VerticalAccuracy:
    """Vertical accuracy at check points of one kind of ground.

    n : number of points; n_compared : of those where the surface has a height. rmse_v1 : root mean square of the
    errors, m. rmse_v2 : of the standard deviations of the points themselves, NaN where one of them is not known.
    rmse_v : of both together, √(rmse_v1² + rmse_v2²), or of the first alone. le90 : within which 90 % of normal errors
    with rmse_v lie, m. mean : of the errors, m. NaN where no point is compared.
    """

    n: int
    n_compared: int
    rmse_v1: float
    rmse_v2: float
    rmse_v: float
    le90: float
    mean: float

    @property
    def is_enough(self) -> bool:
        """Whether the points suffice for a statement by the standard."""
        return self.n_compared >= MIN_POINTS

    def as_dict(self) -> dict[str, Any]:
        """The accuracy as JSON holds it, None in place of NaN."""
        return _record(self) | {"enough_points": self.is_enough}


@dataclass(frozen=True)
class HorizontalAccuracy:
    """Horizontal accuracy at points that were measured in the product too.

    n : number of points. rmse_x, rmse_y : root mean square of the errors, m. rmse_h1 : of both together. rmse_h2 : of
    the points themselves, NaN where it is not known. rmse_h : √(rmse_h1² + rmse_h2²), or the first alone. ce90 : radius
    that holds 90 % of normal errors, m, NaN where x and y are too unequal for a circle. mean_x, mean_y : m.
    """

    n: int
    rmse_x: float
    rmse_y: float
    rmse_h1: float
    rmse_h2: float
    rmse_h: float
    ce90: float
    mean_x: float
    mean_y: float

    @property
    def is_enough(self) -> bool:
        """Whether the points suffice for a statement by the standard."""
        return self.n >= MIN_POINTS

    def as_dict(self) -> dict[str, Any]:
        """The accuracy as JSON holds it, None in place of NaN."""
        return _record(self) | {"enough_points": self.is_enough}


def vertical_accuracy(errors: FloatArray, sigma_m: FloatArray) -> VerticalAccuracy:
    """Vertical accuracy by the standard, section 7.

    errors : (n,) m, surface less point, NaN where the surface has no height; sigma_m : (n,) standard deviations of the
    points, m, NaN where not known.
    """
    known = np.isfinite(errors)
    n = int(np.count_nonzero(known))
    if not n:
        return VerticalAccuracy(len(errors), 0, *(math.nan,) * 5)
    rmse_v1 = root_mean_square(errors[known])
    rmse_v2 = root_mean_square(sigma_m[known])  # NaN where one is
    rmse_v = rmse_v1 if math.isnan(rmse_v2) else math.hypot(rmse_v1, rmse_v2)
    mean = float(np.mean(errors[known]))
    return VerticalAccuracy(len(errors), n, rmse_v1, rmse_v2, rmse_v, LE90_SIGMAS * rmse_v, mean)


def horizontal_accuracy(errors_xy: FloatArray, sigma_xy_m: FloatArray) -> HorizontalAccuracy | None:
    """Horizontal accuracy by the standard, section 7; None where no point was measured in the product.

    errors_xy : (n, 2) m, measured less surveyed, NaN where not measured; sigma_xy_m : (n,) of x and of y of the points.
    """
    known = np.isfinite(errors_xy).all(axis=1)
    if not known.any():
        return None
    errors = errors_xy[known]
    rmse_x, rmse_y = (root_mean_square(column) for column in errors.T)
    of_points = root_mean_square(sigma_xy_m[known])
    rmse_h1, rmse_h2 = math.hypot(rmse_x, rmse_y), math.sqrt(2) * of_points
    both = (rmse_x, rmse_y) if math.isnan(of_points) else (math.hypot(rmse_x, of_points), math.hypot(rmse_y, of_points))
    is_circular = min(both) >= MIN_CIRCULAR_RATIO * max(both)
    mean_x, mean_y = (float(mean) for mean in errors.mean(axis=0))
    return HorizontalAccuracy(
        len(errors), rmse_x, rmse_y, rmse_h1, rmse_h2, math.hypot(*both),
        CE90_SIGMAS * sum(both) / 2 if is_circular else math.nan, mean_x, mean_y,
    )  # fmt: skip


def root_mean_square(values: FloatArray) -> float:
    """Root of the mean square of values (n,); NaN for none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _record(accuracy: VerticalAccuracy | HorizontalAccuracy) -> dict[str, Any]:
    values = {field.name: getattr(accuracy, field.name) for field in fields(accuracy)}
    return {name: None if math.isnan(value) else value for name, value in values.items()}
