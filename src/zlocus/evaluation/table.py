"""An evaluation as a table for people."""

from __future__ import annotations

import math
from collections.abc import Iterator

from zlocus.evaluation.evaluate import Evaluation, Shift
from zlocus.evaluation.slopes import UNKNOWN
from zlocus.evaluation.statistics import ErrorStatistics

ERROR_COLUMNS = ("median", "NMAD", "RMSE", "LE90", "LE95")


def evaluation_table(evaluation: Evaluation) -> str:
    """Lines of text: a row for all cells, one per class and per band of slope, errors in m; then what they mean.

    A shift that was removed is said, with the figures of the surface before.
    """
    rows = evaluation_rows(evaluation)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    return "\n".join([*lines, *notes(evaluation)])


def evaluation_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """The table's cells: the headings (the first is empty), then a row for each group of the reference's cells."""
    thresholds = _thresholds(evaluation)
    within = [f"< {limit:g} m" for limit in thresholds] if len(thresholds) > 1 else ["within"]
    groups = {"all": evaluation.all}
    if evaluation.unshifted is not None:
        groups["as it lies"] = evaluation.unshifted
    groups |= evaluation.classes | {_band_name(name): figures for name, figures in evaluation.slopes.items()}
    return [("", "cells", "complete", *within, *ERROR_COLUMNS), *(_row(*group) for group in groups.items())]


def _thresholds(evaluation: Evaluation) -> list[float]:
    return [limit for limit, _ in evaluation.all.shares]


def _row(name: str, figures: ErrorStatistics) -> tuple[str, ...]:
    within = [share for _, share in figures.shares] or [figures.within]
    shares = (f"{100 * share:.2f} %" for share in (figures.completeness, *within))
    errors = (f"{e:.3f}" for e in (figures.median, figures.nmad, figures.rmse, figures.le90, figures.le95))
    return (name, str(figures.n), *("-" if "nan" in text else text for text in (*shares, *errors)))


def _band_name(name: str) -> str:
    return "slope unknown" if name == UNKNOWN else f"{name} deg"


def notes(evaluation: Evaluation) -> Iterator[str]:
    """What the table's figures mean, what was assumed and what was removed, a line each."""
    if evaluation.all.n and math.isnan(evaluation.all.median):
        yield "no error is known: nowhere do surface and reference both have a height"
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
    if evaluation.mean_of is not None:
        down, across = evaluation.mean_of
        yield (
            f"the reference is coarser: compared is the mean of the surface at {down} x {across} places in each of its "
            "cells, where half of them or more have a height"
        )
    for sentence in (evaluation.assumed, evaluation.places_assumed):
        if sentence is not None:
            yield sentence
    if evaluation.geoid_added_to is not None:
        yield f"the geoid's heights were added to those of {evaluation.geoid_added_to}"
    if evaluation.shift is not None:
        yield _shift_line(evaluation.shift)


def _shift_line(shift: Shift) -> str:
    known = "" if shift.sigma_m is None else f", sigma {shift.sigma_m:.3f} m"
    how = "" if shift.steps is None else f" ({shift.method}, {shift.steps} steps{known})"
    return f"removed first: {shift.east_m:+.3f} m east, {shift.north_m:+.3f} m north, {shift.up_m:+.3f} m up{how}"
