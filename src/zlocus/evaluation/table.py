"""An evaluation as a table for people."""

from __future__ import annotations

from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.statistics import ErrorStatistics

COLUMNS = ("", "cells", "complete", "within", "median", "NMAD", "RMSE", "LE90")


def evaluation_table(evaluation: Evaluation) -> str:
    """Lines of text: the shift removed (if any), then a row for all cells and one per class, errors in m."""
    rows = [COLUMNS, *(_row(name, figures) for name, figures in {"all": evaluation.all, **evaluation.classes}.items())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(COLUMNS))]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    lines.append(f"within: share of all cells in error by less than {evaluation.threshold_m:g} m; errors in m")
    if evaluation.shift is not None:
        shift = evaluation.shift
        lines.append(f"removed first: {shift.east_m:+.3f} m east, {shift.north_m:+.3f} m north, {shift.up_m:+.3f} m up")
    return "\n".join(lines)


def _row(name: str, figures: ErrorStatistics) -> tuple[str, ...]:
    shares = (f"{100 * share:.2f} %" for share in (figures.completeness, figures.within))
    errors = (f"{error:.3f}" for error in (figures.median, figures.nmad, figures.rmse, figures.le90))
    return (name, str(figures.n), *("-" if "nan" in text else text for text in (*shares, *errors)))
