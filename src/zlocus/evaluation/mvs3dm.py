"""Figures as the MVS3DM benchmark of satellite stereo defines them (Bosch et al. 2016, IEEE AIPR)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from zlocus.evaluation.frame import points_on, unit_m
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.shift import Shift, heights_without
from zlocus.evaluation.truth import inside_margin, places

WITHIN_M = 1.0
CELLS_AT_A_TIME = 1_000_000


@dataclass(frozen=True)
class Mvs3dm:
    """Figures of the MVS3DM benchmark.

    completeness : share of the reference's cells with a height at which the surface's height is within 1 m; a cell that
    the surface leaves empty counts as wrong. median_error_m : median of the absolute errors where both have a height,
    m; NaN where no cell has both.
    """

    completeness: float
    median_error_m: float


def mvs3dm_figures(
    surface: HeightRaster,
    reference: HeightRaster,
    frame: CRS | None,
    margin_m: float,
    shift: Shift | None,
) -> Mvs3dm:
    """Figures over single cells of the reference: without blocks, and without edges at which both sides are right.

    shift : removed from the surface first, see `heights_without`; None: the surface as it is. Larger cells of the
    reference are compared with the mean of the surface in them, see `points_on`.
    """
    unit = unit_m(reference, frame)
    rows_at_a_time = max(1, CELLS_AT_A_TIME // reference.z.shape[1])
    n, n_within, errors_of_bands = 0, 0, [np.zeros(0, np.float32)]
    for first in range(0, reference.z.shape[0], rows_at_a_time):
        band = reference.z[first : first + rows_at_a_time]
        row, col = (place.astype(np.float64) + 0.5 for place in np.nonzero(np.isfinite(band)))
        xy = places(reference.transform, row + first, col)
        keep = inside_margin(reference, margin_m, unit, xy)
        points = points_on(surface, reference, frame, xy[keep])
        error = np.abs(heights_without(shift, surface, points) - band[np.isfinite(band)][keep])
        n, n_within = n + error.size, n_within + int(np.count_nonzero(error < WITHIN_M))
        errors_of_bands.append(error[np.isfinite(error)].astype(np.float32))
    errors = np.concatenate(errors_of_bands)
    return Mvs3dm(n_within / n if n else math.nan, float(np.median(errors)) if errors.size else math.nan)
