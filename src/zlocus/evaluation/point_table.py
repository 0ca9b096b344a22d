"""An evaluation at points as text: the table of `zlocus evaluate`, and the accuracy by the ASPRS standard."""

from __future__ import annotations

import math
from collections.abc import Iterator

from zlocus.core.quoting import counted
from zlocus.evaluation.asprs import MIN_POINTS, VerticalAccuracy
from zlocus.evaluation.point_evaluation import PointEvaluation
from zlocus.evaluation.table import TEXT_ERROR_COLUMNS, accuracy_table, aligned_lines, table_lines


def point_table(point_evaluation: PointEvaluation) -> str:
    """Text with a row for all points and for each kind of ground, then the accuracy by the standard, and notes."""
    evaluation = point_evaluation.evaluation
    table = accuracy_table(evaluation, None, TEXT_ERROR_COLUMNS)
    lines = table_lines(table._replace(first_headings=("", "points", "complete")))
    return "\n".join([*lines, *_notes(point_evaluation), "", *asprs_lines(point_evaluation)])


def _notes(point_evaluation: PointEvaluation) -> Iterator[str]:
    evaluation = point_evaluation.evaluation
    yield "share of all points in error by less than the limit; errors are surface less point, m; LE90: 90th percentile"
    yield "absolute: the surface as it lies"
    yield from aligned_lines(evaluation)
    if len(point_evaluation.points) < point_evaluation.n_points:
        n_judged = len(point_evaluation.points)
        yield f"{point_evaluation.n_points} points lie in the surface; {n_judged} of them, chosen at random, are judged"
    for reason, n in point_evaluation.left_out.items():
        yield f"{counted(n, 'point')} left out: {reason}"
    yield from point_evaluation.assumed
    if evaluation.geoid_added_to is not None:
        yield f"the geoid's heights were added to those of {evaluation.geoid_added_to}"


def asprs_lines(point_evaluation: PointEvaluation) -> Iterator[str]:
    """Vertical and horizontal accuracy by the standard, and what keeps them from being a statement by it."""
    kind = "aligned" if point_evaluation.evaluation.is_aligned else "absolute"
    yield f"ASPRS positional accuracy, edition 2 (2023), {kind} errors, m"
    yield "                    points   RMSE_V1   RMSE_V2    RMSE_V      LE90"
    yield _vertical_line("non-vegetated (NVA)", point_evaluation.nva)
    if point_evaluation.vva is not None:
        yield _vertical_line("vegetated (VVA)", point_evaluation.vva)
    yield "RMSE_V1: of the errors; RMSE_V2: of the points themselves; RMSE_V: of both; LE90: 1.6449 RMSE_V"
    if not point_evaluation.has_cover:
        yield "no kind of ground is known: all points count as non-vegetated"
    named = {"NVA": point_evaluation.nva} | ({} if point_evaluation.vva is None else {"VVA": point_evaluation.vva})
    for name, accuracy in named.items():
        if not accuracy.is_enough:
            yield (
                f"{name}: {counted(accuracy.n_compared, 'point')}, fewer than the {MIN_POINTS} that the standard asks "
                "for: this is an indication, and no statement of accuracy by the standard"
            )
    if any(math.isnan(accuracy.rmse_v2) for accuracy in named.values() if accuracy.n_compared):
        yield (
            "the accuracy of the points is not known and not included in RMSE_V; give it in a column sigma, or with "
            "--points-sigma"
        )
    if point_evaluation.is_cloud:
        yield "laser points are no surveyed check points: the figures hold the errors of the cloud as well"
    if point_evaluation.evaluation.is_aligned:
        yield "the shift was found at these points and removed, so that they no longer check the surface independently"
    yield from _horizontal_lines(point_evaluation)


def _vertical_line(name: str, accuracy: VerticalAccuracy) -> str:
    values = (accuracy.rmse_v1, accuracy.rmse_v2, accuracy.rmse_v, accuracy.le90)
    return f"{name:<19} {accuracy.n_compared:>6}" + "".join(f" {_metres(value):>9}" for value in values)


def _horizontal_lines(point_evaluation: PointEvaluation) -> Iterator[str]:
    horizontal = point_evaluation.horizontal
    if horizontal is None:
        yield (
            "RMSE_H and CE90 are not known: heights do not show where a point lies in the surface. Measure the points "
            "in the ortho-image and give columns measured_x and measured_y"
        )
        return
    yield (
        f"horizontal: {counted(horizontal.n, 'point')}, RMSE_x {_metres(horizontal.rmse_x)}, RMSE_y "
        f"{_metres(horizontal.rmse_y)}, RMSE_H1 {_metres(horizontal.rmse_h1)}, RMSE_H2 {_metres(horizontal.rmse_h2)}, "
        f"RMSE_H {_metres(horizontal.rmse_h)}, CE90 {_metres(horizontal.ce90)}"
    )
    if math.isnan(horizontal.ce90):
        yield "CE90 is not known: the errors in x and y are too unequal to lie in a circle"
    if not horizontal.is_enough:
        yield (
            f"horizontal: {counted(horizontal.n, 'point')}, fewer than the {MIN_POINTS} that the standard asks for: "
            "this is an indication, and no statement of accuracy by the standard"
        )
    if point_evaluation.rmse_3d is not None:
        yield f"RMSE_3D {_metres(point_evaluation.rmse_3d)}: of the errors in space"


def _metres(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
