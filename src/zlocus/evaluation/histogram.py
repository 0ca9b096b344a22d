"""The errors of a surface as a histogram."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.statistics import ErrorStatistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

N_BINS = 120
# What is shown: this many times the 95th percentile of absolute errors.
SHOWN_LE95 = 1.25
SIZE_INCHES = (7.5, 4.5)
BAR, CURVE, LINE = "#7A9CC6", "#C03A2B", "#444444"


def histogram_figure(evaluation: Evaluation, size_inches: tuple[float, float] = SIZE_INCHES) -> Figure:
    """Share of the heights per bin of error, with the normal curve of the same median and NMAD, the median, and the
    limits of what counts as within where they lie among what is shown."""
    from matplotlib.figure import Figure

    assert evaluation.error_map is not None, "an evaluation of files has a map of errors"
    known = np.isfinite(evaluation.error_map.errors)
    errors = evaluation.error_map.errors[known].astype(np.float64)
    figure = Figure(figsize=size_inches, layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel("height of the surface less that of the reference, m")
    axes.set_ylabel("share of the heights, %")
    if errors.size:
        _draw(axes, errors, evaluation.all, evaluation.threshold_m)
    else:
        axes.text(0.5, 0.5, "no height where the reference has one", ha="center", transform=axes.transAxes)
    shift = "" if evaluation.shift is None else ", shift removed"
    complete = f"{100 * evaluation.all.completeness:.1f} %"
    if complete == "100.0 %" and evaluation.all.completeness < 1:
        complete = "More than 99.9 %"
    axes.set_title(
        f"{complete} of {evaluation.all.n} cells have a height{shift}", loc="left",
        fontsize=10,
    )  # fmt: skip
    return figure


def _draw(axes: Axes, errors: FloatArray, figures: ErrorStatistics, threshold_m: float) -> None:
    reach = SHOWN_LE95 * figures.le95 or threshold_m
    edges = np.linspace(-reach, reach, N_BINS + 1)
    share = 100 * np.histogram(errors, edges)[0] / errors.size
    axes.stairs(share, edges, fill=True, color=BAR, label="errors")
    if figures.nmad > 0:
        at = np.linspace(-reach, reach, 600)
        bell = np.exp(-0.5 * ((at - figures.median) / figures.nmad) ** 2) / (figures.nmad * np.sqrt(2 * np.pi))
        label = f"normal, NMAD {figures.nmad:.3f} m"
        axes.plot(at, 100 * bell * (edges[1] - edges[0]), color=CURVE, linewidth=1.3, label=label)
    axes.axvline(figures.median, color=LINE, linewidth=1, linestyle="--", label=f"median {figures.median:+.3f} m")
    if threshold_m < reach:
        for limit in (-threshold_m, threshold_m):
            axes.axvline(
                limit, color=LINE, linewidth=1, linestyle=":", label=f"±{threshold_m:g} m" if limit > 0 else None
            )
    axes.set_xlim(-reach, reach)
    axes.set_ylim(0, 1.08 * max(float(share.max()), 1e-9))
    beyond = 100 * float(np.count_nonzero(np.abs(errors) > reach)) / errors.size
    axes.plot([], [], " ", label=f"{beyond:.1f} % beyond")
    axes.legend(fontsize=8, frameon=False)
