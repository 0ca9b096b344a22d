"""An evaluation as a text table."""

from __future__ import annotations

import math
from collections.abc import Iterator

from zlocus.evaluation.evaluate import Evaluation, Shift
from zlocus.evaluation.slopes import UNKNOWN
from zlocus.evaluation.statistics import ErrorStatistics

ERROR_COLUMNS = ("median", "NMAD", "RMSE", "LE90", "LE95")


def evaluation_table(evaluation: Evaluation) -> str:
    """Text with a row for all cells, for each class and for each band of slope, errors in m; notes follow.

    Where a shift was removed, a row and a note give the statistics before and the shift.
    """
    rows = evaluation_rows(evaluation)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    return "\n".join([*lines, *notes(evaluation)])


def evaluation_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """Headings of the table, the first one empty, then a row for each group of the reference's cells."""
    thresholds = _thresholds(evaluation)
    within = [f"< {limit:g} m" for limit in thresholds] if len(thresholds) > 1 else ["within"]
    groups = {"all": evaluation.statistics}
    if evaluation.unshifted_statistics is not None:
        groups["as it lies"] = evaluation.unshifted_statistics
    bands = {_band_name(name): statistics for name, statistics in evaluation.slope_statistics.items()}
    groups |= evaluation.class_statistics | bands
    return [("", "cells", "complete", *within, *ERROR_COLUMNS), *(_row(*group) for group in groups.items())]


def _thresholds(evaluation: Evaluation) -> list[float]:
    return [limit for limit, _ in evaluation.statistics.shares]


def _row(name: str, statistics: ErrorStatistics) -> tuple[str, ...]:
    within = [share for _, share in statistics.shares] or [statistics.within]
    shares = (f"{100 * share:.2f} %" for share in (statistics.completeness, *within))
    errors = (
        f"{e:.3f}" for e in (statistics.median, statistics.nmad, statistics.rmse, statistics.le90, statistics.le95)
    )
    return (name, str(statistics.n), *("-" if "nan" in text else text for text in (*shares, *errors)))


def _band_name(name: str) -> str:
    return "slope unknown" if name == UNKNOWN else f"{name} deg"


def notes(evaluation: Evaluation) -> Iterator[str]:
    """Lines that explain the table: what its figures mean, what was assumed, and which shift was removed."""
    if evaluation.statistics.n and math.isnan(evaluation.statistics.median):
        yield "no error is known: no cell has a height in both the surface and the reference"
    if len(_thresholds(evaluation)) > 1:
        yield "< M m: share of all cells in error by less; errors in m"
    else:
        yield f"within: share of all cells in error by less than {evaluation.threshold_m:g} m; errors in m"
    if evaluation.mvs3dm is not None:
        error_m = evaluation.mvs3dm.median_error_m
        yield (
            f"MVS3DM (single cells): completeness {100 * evaluation.mvs3dm.completeness:.2f} %, "
            f"median error {'-' if math.isnan(error_m) else f'{error_m:.3f} m'}"
        )
    if evaluation.places_per_block is not None:
        down, across = evaluation.places_per_block
        yield (
            f"the reference is coarser: each of its cells is compared with the mean of the surface at {down} x "
            f"{across} places in it, where at least half of them have a height"
        )
    for sentence in (evaluation.assumed_datum, evaluation.assumed_crs):
        if sentence is not None:
            yield sentence
    if evaluation.geoid_added_to is not None:
        yield f"the geoid's heights were added to those of {evaluation.geoid_added_to}"
    if evaluation.shift is not None:
        yield _shift_line(evaluation.shift)


def _shift_line(shift: Shift) -> str:
    known = "" if shift.sigma_m is None else f", sigma {shift.sigma_m:.3f} m"
    found_by = "" if shift.steps is None else f" ({shift.method}, {shift.steps} steps{known})"
    return f"removed first: {shift.east_m:+.3f} m east, {shift.north_m:+.3f} m north, {shift.up_m:+.3f} m up{found_by}"
