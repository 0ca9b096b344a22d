"""Figures of a set of height errors, missing cells counted as missing."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from zlocus.sensors.model import FloatArray

NORMAL_SIGMA_FROM_MAD = 1.4826


@dataclass(frozen=True)
class ErrorStatistics:
    """Completeness over all cells, accuracy over those that have a height.

    n : cells of the reference. completeness : share of them with a height. within : share of **all** of them with an
    error below the threshold. median, nmad, rmse, le90 : m, over cells with a height; NaN where there are none.
    """

    n: int
    completeness: float
    within: float
    median: float
    nmad: float
    rmse: float
    le90: float

    def as_dict(self) -> dict[str, float | None]:
        """For JSON: None in place of NaN."""
        return {name: None if math.isnan(value) else value for name, value in asdict(self).items()}


def error_statistics(errors: FloatArray, threshold_m: float) -> ErrorStatistics:
    """The figures of errors (n,) m, NaN where the surface has no height.

    NMAD is 1.4826 times the median absolute deviation from the median; LE90 the 90th percentile of absolute errors
    (Höhle and Höhle 2009, table 3).
    """
    found = errors[np.isfinite(errors)]
    if not found.size:
        missing = 0.0 if errors.size else math.nan
        return ErrorStatistics(errors.size, missing, missing, *(math.nan,) * 4)
    absolute = np.abs(found)
    median = np.median(found)
    return ErrorStatistics(
        n=errors.size,
        completeness=found.size / errors.size,
        within=float(np.count_nonzero(absolute < threshold_m) / errors.size),
        median=float(median),
        nmad=float(NORMAL_SIGMA_FROM_MAD * np.median(np.abs(found - median))),
        rmse=float(np.sqrt(np.mean(found**2))),
        le90=float(np.percentile(absolute, 90)),
    )
