"""Figures of the match of one point, as Ji et al. 2014 draw them.

match_curves.png: NCC with each search image (figures 3 to 5); selected.png: the mean of the images that were used
(figure 6); all_images.png: the mean of all search images (figure 7); loci.png: the vertical line in every image (figure
8).
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from zlocus.core.options import SelectionOptions
from zlocus.io.atomic_write import write_atomically
from zlocus.io.run_record import write_record
from zlocus.products.point_report import (
    LABELS,
    Locus,
    PointReport,
    decimal,
    point_record,
    signed,
    write_csv,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 3
POINT = "point.json"
DPI = 110
# The colours of Okabe and Ito, which colour-blind readers can distinguish. The mean is black.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B5A2B", "#7A5195")
DASHES = ("-", "--", ":")
LABEL_COLOURS = {1: "#00704F", 0: "#8A6100", -1: "#B03A00"}
STRETCH_PERCENT = (1.0, 99.0)


def write_point(folder: Path, report: PointReport, loci: Sequence[Locus], options: SelectionOptions) -> None:
    """Write all files of a point, each complete or not at all; point.json is the last.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    figures = {
        "match_curves.png": match_curves_figure(report),
        "selected.png": mean_figure(report, report.curves.n_used),
        "all_images.png": mean_figure(report, len(report.search)),
        "loci.png": loci_figure(loci),
    }
    for name, figure in figures.items():
        write_atomically(folder / name, partial(figure.savefig, format="png", dpi=DPI))
    write_atomically(folder / "curves.csv", lambda part: write_csv(part, report))
    write_record(folder / POINT, point_record(report, options))


def match_curves_figure(report: PointReport, title: str = "Correlation with each search image") -> Figure:
    """NCC with each search image in a panel of its own, in their order, with peak and secondary peak marked."""
    curves, n = report.curves.single_curves, len(report.search)
    figure, panels = _panels(n, (4.2, 2.5), share=True)
    for j, (axes, name) in enumerate(zip(panels, report.search, strict=True)):
        curve, peaks, label = curves.values[j], curves.peaks, int(curves.labels[j])
        _frame(axes, report, lowest=-1.3)  # room for the text
        axes.plot(report.heights_m, curve, color=COLOURS[j % len(COLOURS)], linewidth=1.4)
        if np.isfinite(peaks.rho1[j]):
            axes.plot(report.heights_m[peaks.peak[j]], peaks.rho1[j], "x", color="black", markersize=7)
        if np.isfinite(peaks.rho2[j]):
            axes.axhline(peaks.rho2[j], color="#777777", linewidth=0.8, linestyle=":")
        axes.set_title(as_written(f"{j + 1}. {report.reference} – {name}"), fontsize=9, loc="left")
        rho = f"{signed(label)} {LABELS[label]}   ρ1 {decimal(peaks.rho1[j], 2)}   ratio {decimal(peaks.ratio[j], 2)}"
        axes.text(0.02, 0.03, rho, transform=axes.transAxes, fontsize=8, color=LABEL_COLOURS[label])
    _labelled(figure, f"{title} (x: peak, dotted: secondary peak ρ2)")
    return figure


def shown_means(report: PointReport, n_images: int) -> list[tuple[int, float]]:
    """The means that are drawn beside that of `n_images`: the number of images of each, and its grey, 0 for black."""
    # The mean of one image is that image's own curve.
    used = report.curves.n_used
    steps = [used] if n_images > used else list(range(2, n_images))
    return [(m, 0.8 - 0.5 * k / len(steps)) for k, m in enumerate(steps, 1)]  # the later, the darker


def mean_figure(report: PointReport, n_images: int) -> Figure:
    """NCC of the first images as thin lines, their mean as a thick one, and the means before it as dashed ones.

    n_images : number of images in the mean.
    """
    figure, (axes,) = _panels(1, (7.6, 4.4))
    _frame(axes, report)
    curves = report.curves
    for j, name in enumerate(report.search[:n_images]):
        values = curves.single_curves.values[j]
        colour, dashes = COLOURS[j % len(COLOURS)], DASHES[j // len(COLOURS) % len(DASHES)]
        axes.plot(report.heights_m, values, color=colour, linestyle=dashes, linewidth=0.9, label=as_written(name))
    mean, j = curves.mean_curves, n_images - 1
    for m, grey in shown_means(report, n_images):
        name = f"mean of the first {m}"
        axes.plot(report.heights_m, mean.values[m - 1], color=f"{grey:.2f}", linewidth=1.6, linestyle="--", label=name)
    axes.plot(report.heights_m, mean.values[j], color="black", linewidth=2.2, label=f"mean of {n_images}")
    peak = mean.peaks.peak[j]
    axes.plot(report.heights_m[peak], mean.peaks.rho1[j], "x", color="black", markersize=9, markeredgewidth=2)
    label, height = int(mean.labels[j]), report.heights_m[peak]
    figures = f"ρ1 {decimal(mean.peaks.rho1[j], 3)}, ratio {decimal(mean.peaks.ratio[j], 2)}, peak {height:.2f} m"
    which = "all search images" if n_images == len(report.search) else f"{n_images} of {len(report.search)} images"
    title = f"{report.reference} with {which}: {signed(label)} {LABELS[label]}, {figures}"
    axes.set_title(as_written(title), fontsize=9, loc="left")
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    _labelled(figure, None)
    return figure


def as_written(text: str) -> str:
    """Escape dollar signs in names of images, since matplotlib reads a formula between two of them."""
    return text.replace("$", r"\$")


def svg_of(figure: Figure) -> str:
    """A figure as SVG; equal figures give equal texts."""
    import matplotlib

    written = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "zlocus"}):
        figure.savefig(written, format="svg", metadata={"Date": None})
    text = written.getvalue()
    return text[text.index("<svg") :]  # without the document type, which holds an address


def loci_figure(loci: Sequence[Locus], line: str = "The vertical line") -> Figure:
    """A line over a crop of every image, the reference image first. line : what it is, for the title."""
    figure, panels = _panels(len(loci), (3.1, 3.3))
    for j, (axes, locus) in enumerate(zip(panels, loci, strict=True)):
        row, col = locus.first
        rows, cols = locus.grey.shape
        known = locus.grey[np.isfinite(locus.grey)]
        low, high = np.percentile(known, STRETCH_PERCENT) if known.size else (0.0, 1.0)
        extent = (col - 0.5, col + cols - 0.5, row + rows - 0.5, row - 0.5)
        axes.imshow(locus.grey, cmap="gray", vmin=low, vmax=high, extent=extent, interpolation="nearest")
        if j:
            axes.plot(*locus.line.T, color="#FFD400", linewidth=1.3)
        axes.plot(*locus.start, "+", color="#00D0FF", markersize=17, markeredgewidth=1.6)
        axes.plot(*locus.peak, "x", color="#FF3030", markersize=9, markeredgewidth=2)
        axes.set_xlim(extent[0], extent[1])
        axes.set_ylim(extent[2], extent[3])
        axes.tick_params(labelsize=7)
        title = f"{locus.name} (reference)" if j == 0 else f"{j}. {locus.name}"
        axes.set_title(as_written(title), fontsize=9, loc="left")
    figure.suptitle(f"{line} in the images, column and row (+: height at the start, x: peak)", fontsize=10)
    return figure


def _panels(n: int, size: tuple[float, float], share: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of n panels of (width, height) inches, made without matplotlib's global state."""
    from matplotlib.figure import Figure

    columns = min(n, COLUMNS)
    rows = -(-n // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    for axes in grid.ravel()[n:]:
        axes.set_visible(False)
    for axes in grid.ravel()[max(n - columns, 0) : n]:  # the lowest panel of a column may have an empty place below it
        axes.tick_params(labelbottom=True)
    return figure, list(grid.ravel()[:n])


def _frame(axes: Axes, report: PointReport, lowest: float = -1.0) -> None:
    """Set up axes of correlation, from `lowest` on, against height, and mark the height at the start."""
    axes.axhline(0.0, color="#BBBBBB", linewidth=0.8)
    axes.axvline(float(report.xyz[2]), color="#BBBBBB", linewidth=0.8, linestyle="--")
    axes.set_xlim(report.heights_m[0], report.heights_m[-1])
    axes.set_ylim(lowest, 1.05)
    axes.set_yticks(np.linspace(-1.0, 1.0, 5))
    axes.tick_params(labelsize=8)


def _labelled(figure: Figure, title: str | None) -> None:
    figure.supxlabel("height, m", fontsize=9)
    figure.supylabel("correlation", fontsize=9)
    if title:
        figure.suptitle(title, fontsize=10)
