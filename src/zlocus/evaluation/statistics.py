"""Statistics of height errors, in which cells without a height count as missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from zlocus.core.sensor_model import FloatArray

NORMAL_SIGMA_FROM_MAD = 1.4826


@dataclass(frozen=True)
class ErrorStatistics:
    """Completeness over all cells, accuracy over those that have a height.

    n : number of cells of the reference. completeness : share of them with a height. within : share of **all** of them
    with an error below the first threshold. median, nmad, rmse, le90, le95, mean, std : m, over cells with a height;
    NaN where there are none. shares : for each threshold, it (m) and the share of **all** cells with a smaller error.
    """

    n: int
    completeness: float
    within: float
    median: float
    nmad: float
    rmse: float
    le90: float
    le95: float = math.nan
    mean: float = math.nan
    std: float = math.nan
    shares: tuple[tuple[float, float], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """The statistics as JSON holds them: None in place of NaN, shares by threshold ("0.5" for 0.5 m)."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "shares"}
        shares = {f"{threshold_m:g}": share for threshold_m, share in self.shares}
        return _without_nan(values) | {"within_m": _without_nan(shares)}


def error_statistics(errors: FloatArray, threshold_m: float, more_m: Sequence[float] = ()) -> ErrorStatistics:
    """Statistics of errors (n,) m, which are NaN where the surface has no height.

    threshold_m : limit of `within`. more_m : further thresholds.
    NMAD is 1.4826 times the median absolute deviation from the median; LE90 and LE95 are the 90th and 95th percentile
    of absolute errors (Höhle and Höhle 2009, table 3), interpolated where they fall between two errors. The standard
    deviation is about the mean and divides by the number of heights.
    """
    known = errors[np.isfinite(errors)]
    thresholds = (threshold_m, *more_m)
    if not known.size:
        missing = 0.0 if errors.size else math.nan
        shares = tuple((limit, missing) for limit in thresholds)
        return ErrorStatistics(errors.size, missing, missing, *(math.nan,) * 7, shares)
    absolute = np.abs(known)
    median = np.median(known)
    shares = tuple((limit, float(np.count_nonzero(absolute < limit) / errors.size)) for limit in thresholds)
    le90, le95 = (float(error) for error in np.percentile(absolute, (90, 95)))
    return ErrorStatistics(
        n=errors.size,
        completeness=known.size / errors.size,
        within=shares[0][1],
        median=float(median),
        nmad=float(NORMAL_SIGMA_FROM_MAD * np.median(np.abs(known - median))),
        rmse=float(np.sqrt(np.mean(known**2))),
        le90=le90,
        le95=le95,
        mean=float(np.mean(known)),
        std=float(np.std(known)),
        shares=shares,
    )


def _without_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {name: None if math.isnan(value) else value for name, value in values.items()}
