"""Histogram of the errors of a surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.statistics import ErrorStatistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

N_BINS = 120
# The axis ends at this many times the 95th percentile of absolute errors.
AXIS_END_LE95 = 1.25
SIZE_INCHES = (7.5, 4.5)
BAR, CURVE, LINE = "#7A9CC6", "#C03A2B", "#444444"


def histogram_figure(evaluation: Evaluation, size_inches: tuple[float, float] = SIZE_INCHES) -> Figure:
    """Figure of the share of heights per bin of error, with the normal curve of the same median and NMAD.

    The median is marked, and so are the limits of `within` where they lie inside the axis. The main errors are drawn;
    the title gives the figures of the others.
    """
    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    return errors_figure(evaluation, evaluation.error_map.errors, size_inches)


def errors_figure(
    evaluation: Evaluation, all_errors: NDArray[np.floating], size_inches: tuple[float, float] = SIZE_INCHES,
    places: str = "cells",
) -> Figure:  # fmt: skip
    """The figure of `histogram_figure`. all_errors : main errors of any shape, m; places : what each is of."""
    from matplotlib.figure import Figure

    errors = all_errors[np.isfinite(all_errors)].astype(np.float64)
    figure = Figure(figsize=size_inches, layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel("height of the surface less that of the reference, m")
    axes.set_ylabel("share of the heights, %")
    if errors.size:
        _draw(axes, errors, evaluation.statistics, evaluation.threshold_m)
    else:
        axes.text(0.5, 0.5, "no height where the reference has one", ha="center", transform=axes.transAxes)
    axes.set_title(_title(evaluation, places), loc="left", fontsize=10)
    return figure


def differences_figure(
    differences: FloatArray, statistics: ErrorStatistics, threshold_m: float, size_inches: tuple[float, float]
) -> Figure:
    """Figure of the share of cells per bin of the differences of two surfaces, as `histogram_figure` draws errors.

    differences : (n,) m; statistics : of these.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_inches, layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel("height in B less height in A, m")
    axes.set_ylabel("share of the cells, %")
    _draw(axes, differences, statistics, threshold_m, "differences")
    return figure


def _title(evaluation: Evaluation, places: str) -> str:
    """Completeness, which errors are drawn, and the figures of both kinds of errors beside each other."""
    complete = f"{100 * evaluation.statistics.completeness:.1f} %"
    if complete == "100.0 %" and evaluation.statistics.completeness < 1:
        complete = "More than 99.9 %"
    drawn, other = ("aligned", "absolute") if evaluation.is_aligned else ("absolute", "aligned")
    figures = {"absolute": evaluation.absolute_accuracy, "aligned": evaluation.aligned_accuracy}
    beside = figures[other]
    statistics = None if beside is None else beside.statistics
    there = "not known" if statistics is None else f"median {statistics.median:+z.3f} m, NMAD {statistics.nmad:.3f} m"
    have = f"{complete} of {evaluation.statistics.n} {places} have a height"
    return f"{have}; drawn: {drawn} errors\n{other} errors: {there}"


def _draw(
    axes: Axes, errors: FloatArray, statistics: ErrorStatistics, threshold_m: float, label: str = "errors"
) -> None:
    axis_end = AXIS_END_LE95 * statistics.le95 or threshold_m
    edges = np.linspace(-axis_end, axis_end, N_BINS + 1)
    share = 100 * np.histogram(errors, edges)[0] / errors.size
    axes.stairs(share, edges, fill=True, color=BAR, label=label)
    if statistics.nmad > 0:
        at = np.linspace(-axis_end, axis_end, 600)
        bell = np.exp(-0.5 * ((at - statistics.median) / statistics.nmad) ** 2) / (statistics.nmad * np.sqrt(2 * np.pi))
        curve = f"normal, NMAD {statistics.nmad:.3f} m"
        axes.plot(at, 100 * bell * (edges[1] - edges[0]), color=CURVE, linewidth=1.3, label=curve)
    axes.axvline(statistics.median, color=LINE, linewidth=1, linestyle="--", label=f"median {statistics.median:+.3f} m")
    if threshold_m < axis_end:
        for limit in (-threshold_m, threshold_m):
            axes.axvline(
                limit, color=LINE, linewidth=1, linestyle=":", label=f"±{threshold_m:g} m" if limit > 0 else None
            )
    axes.set_xlim(-axis_end, axis_end)
    axes.set_ylim(0, 1.08 * max(float(share.max()), 1e-9))
    beyond = 100 * float(np.count_nonzero(np.abs(errors) > axis_end)) / errors.size
    axes.plot([], [], " ", label=f"{beyond:.1f} % beyond")
    axes.legend(fontsize=8, frameon=False)
