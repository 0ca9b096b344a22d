"""An evaluation as a text table, the absolute and the aligned figures side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from zlocus.evaluation.accuracy import Accuracy
from zlocus.evaluation.coregistration import METHOD as COREGISTERED
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.mvs3dm import Mvs3dm
from zlocus.evaluation.shift import Shift
from zlocus.evaluation.slopes import UNKNOWN
from zlocus.evaluation.statistics import ErrorStatistics

KINDS = ("absolute", "aligned")
ERROR_COLUMNS = {"median": "median", "NMAD": "nmad", "RMSE": "rmse", "LE90": "le90", "LE95": "le95"}
# So that a line of text stays below 100 characters.
TEXT_ERROR_COLUMNS = ("median", "NMAD", "RMSE", "LE90")
# Shares closer than this to 0 or 1 would be shown as 0.00 or 100.00 %.
HALF_OF_LAST_DIGIT = 0.5e-4
COLUMN_GAP, KIND_GAP = " ", "   "


class AccuracyTable(NamedTuple):
    """Figures of the groups of the reference's cells, absolute and aligned.

    first_headings : of the columns that both kinds share, the first one empty. kind_headings : of the columns that each
    kind has. rows : cells as text: those of the first columns, of the absolute and of the aligned figures.
    """

    first_headings: tuple[str, ...]
    kind_headings: tuple[str, ...]
    rows: Sequence[tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]]


def evaluation_table(evaluation: Evaluation) -> str:
    """Text with a row for all cells, for each class and for each band of slope, errors in m; notes follow.

    Several thresholds have a table of their own below.
    """
    thresholds = _thresholds(evaluation)
    lines = table_lines(accuracy_table(evaluation, thresholds[:1], TEXT_ERROR_COLUMNS))
    if len(thresholds) > 1:
        lines += ["", *table_lines(accuracy_table(evaluation, thresholds, ()))]
    return "\n".join([*lines, *notes(evaluation)])


def accuracy_table(
    evaluation: Evaluation, thresholds: Sequence[float] | None = None, errors: Sequence[str] = tuple(ERROR_COLUMNS)
) -> AccuracyTable:
    """The figures as a table. thresholds : whose shares are shown, all if None. errors : of `ERROR_COLUMNS`."""
    shown = _thresholds(evaluation) if thresholds is None else thresholds
    within = [f"< {limit:g} m" for limit in shown] if len(_thresholds(evaluation)) > 1 else ["within"]
    absolute = _groups(evaluation.absolute_accuracy)
    aligned = {} if evaluation.aligned_accuracy is None else _groups(evaluation.aligned_accuracy)
    rows = [
        (
            (name, str(statistics.n), _percent(statistics.completeness)),
            _figures(statistics, shown, errors),
            _figures(aligned.get(name), shown, errors),
        )
        for name, statistics in absolute.items()
    ]
    return AccuracyTable(("", "cells", "complete"), (*within, *errors), rows)


def _groups(accuracy: Accuracy) -> dict[str, ErrorStatistics]:
    bands = {_band_name(name): statistics for name, statistics in accuracy.slope_statistics.items()}
    return {"all": accuracy.statistics} | accuracy.class_statistics | bands


def table_lines(table: AccuracyTable) -> list[str]:
    """Lines of a table, under a line that names the two kinds of figures."""
    headings = (table.first_headings, table.kind_headings, table.kind_headings)
    parts = [_justified([heading, *(row[part] for row in table.rows)]) for part, heading in enumerate(headings)]
    absolute, aligned = (kind.center(len(part[0])) for kind, part in zip(KINDS, parts[1:], strict=True))
    kinds = (" " * len(parts[0][0]), absolute, aligned)
    return [KIND_GAP.join(line).rstrip() for line in (kinds, *zip(*parts, strict=True))]


def _justified(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines of equal length; names, which have an empty heading, start at the left."""
    columns = []
    for heading, *cells in zip(*rows, strict=True):
        width = max(map(len, (heading, *cells)))
        columns.append([cell.rjust(width) if heading else cell.ljust(width) for cell in (heading, *cells)])
    return [COLUMN_GAP.join(line) for line in zip(*columns, strict=True)]


def _thresholds(evaluation: Evaluation) -> list[float]:
    return [limit for limit, _ in evaluation.statistics.shares] or [evaluation.threshold_m]


def _figures(statistics: ErrorStatistics | None, thresholds: Sequence[float], errors: Sequence[str]) -> tuple[str, ...]:
    """Shares within the thresholds, then errors, as text; `-` for what is not known."""
    if statistics is None:
        return ("-",) * (len(thresholds) + len(errors))
    share_within = dict(statistics.shares) or {thresholds[0]: statistics.within}
    shares = (_percent(share_within[limit]) for limit in thresholds)
    values = (getattr(statistics, ERROR_COLUMNS[name]) for name in errors)
    return (*shares, *("-" if math.isnan(value) else f"{value:z.3f}" for value in values))


def _percent(share: float) -> str:
    """A share with two decimals, of which 0 and 100 are exact; `-` where it is not known."""
    if math.isnan(share):
        return "-"
    if 0 < share < HALF_OF_LAST_DIGIT:
        return "< 0.01 %"
    if 1 - HALF_OF_LAST_DIGIT <= share < 1:
        return "> 99.99 %"
    return f"{100 * share:.2f} %"


def _band_name(name: str) -> str:
    return "slope unknown" if name == UNKNOWN else f"{name} deg"


def notes(evaluation: Evaluation) -> Iterator[str]:
    """Lines that explain the table: its figures, the shift that was removed, and what was assumed."""
    if evaluation.statistics.n and math.isnan(evaluation.statistics.median):
        yield "no error is known: no cell has a height in both the surface and the reference"
    if len(_thresholds(evaluation)) > 1:
        yield "< M m: share of all cells in error by less; errors in m"
    else:
        yield f"within: share of all cells in error by less than {evaluation.threshold_m:g} m; errors in m"
    yield "absolute: the surface as it lies"
    yield from aligned_lines(evaluation)
    yield from _mvs3dm_lines(evaluation)
    if UNKNOWN in evaluation.slope_statistics:
        yield f"{_band_name(UNKNOWN)}: a neighbour of the cell has no height in the reference, or lies outside of it"
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


def aligned_lines(evaluation: Evaluation) -> Iterator[str]:
    """What was removed before the aligned figures were computed, or why there are none."""
    shift = evaluation.found_shift
    if shift is None:
        if evaluation.no_shift is not None:
            yield f"aligned: there are no figures, because {evaluation.no_shift}"
    elif shift.undetermined is None:
        yield f"aligned: removed first: {shift_text(shift)}"
    else:
        yield f"aligned: removed first: {shift.up_m:+z.3f} m up alone"
        yield f"the horizontal shift is not determined: {shift.undetermined}"


def shift_text(shift: Shift) -> str:
    """A shift east, north and up, with the steps and the precision of a co-registration."""
    known = "" if shift.sigma_m is None else f", sigma {shift.sigma_m:.3f} m"
    found_by = "" if shift.steps is None else f" ({shift.method}, {shift.steps} steps{known})"
    return f"{shift.east_m:+z.3f} m east, {shift.north_m:+z.3f} m north, {shift.up_m:+z.3f} m up{found_by}"


def main_figures_line(evaluation: Evaluation) -> str:
    """Which of the two kinds are the main figures, and which option decides it."""
    main = "main figures (of files and JSON):"
    if evaluation.shift is None:
        return f"{main} the absolute ones; --align or --coregister makes them the aligned ones"
    method = evaluation.shift.method
    return f"{main} the aligned ones, because of {'--align' if method != COREGISTERED else f'--coregister {method}'}"


def _mvs3dm_lines(evaluation: Evaluation) -> Iterator[str]:
    aligned = None if evaluation.aligned_accuracy is None else evaluation.aligned_accuracy.mvs3dm
    for kind, mvs3dm in zip(KINDS, (evaluation.absolute_accuracy.mvs3dm, aligned), strict=True):
        if mvs3dm is not None:
            yield f"MVS3DM, {kind}: {_mvs3dm(mvs3dm)}"
    if evaluation.absolute_accuracy.mvs3dm is not None:
        yield "MVS3DM: as that benchmark counts, single cells within 1 m, and the median of absolute errors"


def _mvs3dm(mvs3dm: Mvs3dm) -> str:
    error_m = mvs3dm.median_error_m
    return (
        f"completeness {100 * mvs3dm.completeness:.2f} %, "
        f"median error {'-' if math.isnan(error_m) else f'{error_m:.3f} m'}"
    )
