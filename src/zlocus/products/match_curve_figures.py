"""What is shown of one point: text, point.json, curves.csv, and the figures that Ji et al. 2014 draw.

match_curves.png: NCC with each search image (figures 3 to 5); selected.png: the mean of the images that were needed
(figure 6); all_images.png: the mean of all (figure 7); loci.png: the vertical line in every image (figure 8).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.options import SelectionOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray
from zlocus.io.run_record import write_atomically, write_record
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.point_match import JudgedCurves, PlaceCurves, PointCurves
from zlocus.matching.view_ranking import OrderSource

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 3
DPI = 110
SMALL = (3.7, 3.5)
# Okabe and Ito's colours, told apart by all eyes; the mean is black.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B5A2B", "#7A5195")
DASHES = ("-", "--", ":")
LABELS = {1: "good", 0: "fair", -1: "poor"}
LABEL_COLOURS = {1: "#00704F", 0: "#8A6100", -1: "#B03A00"}
STRETCH_PERCENT = (1.0, 99.0)
# Pixels around a locus that are shown.
CROP_MARGIN_PX, LEAST_CROP_PX = 12, 48
MOST_FEATURES = 8
# From here on a stop rests on the label alone.
LABEL_ALONE_STEPS = 1000.0


@dataclass(frozen=True)
class Locus:
    """A vertical line in an image.

    first : row and column of the crop; grey : (r, c) float32, NaN where not valid; line : (h, 2) px of the image;
    start, peak : (2,) px, at the height it began with and at that of the peak.
    """

    name: str
    first: tuple[int, int]
    grey: NDArray[np.float32]
    line: FloatArray
    start: FloatArray
    peak: FloatArray


@dataclass(frozen=True)
class PointReport:
    """A point and its match.

    asked : as given; xyz : (3,) m, at the height about which curves are sampled; height_from : what tells it; middle :
    (2,) m, of the cell that was matched, of side cell_m; names : of the views that were compared; left_out :
    of those that do not show it or promise less; heights_m : (h,) m; peak_m : height found, NaN without one.
    """

    asked: str
    crs: str
    xyz: FloatArray
    height_from: str
    middle: FloatArray
    cell_m: float
    names: tuple[str, ...]
    left_out: tuple[str, ...]
    heights_m: FloatArray
    step_m: float
    curves: PointCurves
    peak_m: float

    @classmethod
    def of(cls, asked: str, place_curves: PlaceCurves, match_scene: MatchScene, crs: CRS) -> PointReport:
        """Of a place whose curves are known. match_scene, crs : of the scene."""
        place, curves = place_curves.place, place_curves.curves
        return cls(
            asked=asked, crs=crs.to_string().splitlines()[0], xyz=place.xyz, height_from=place.height_from,
            middle=place.middle, cell_m=match_scene.cell_m, names=tuple(view.name for view in place_curves.views),
            left_out=tuple(view.name for view in match_scene.views if view not in place_curves.views),
            heights_m=place_curves.heights_m, curves=curves, peak_m=match_scene.origin_m + curves.peak_index * match_scene.step_m,
            step_m=match_scene.step_m,
        )  # fmt: skip

    @property
    def reference(self) -> str:
        """Name of the reference."""
        return self.names[self.curves.order.reference]

    @property
    def search(self) -> list[str]:
        """Names of the search images, in their order."""
        return [self.names[i] for i in self.curves.order.search]


def loci(views: Sequence[View], report: PointReport) -> list[Locus]:
    """The vertical line in every image of a report, the reference first, then the others in their order.

    views : that were compared.
    """
    order, found = report.curves.order, []
    peak_m = report.peak_m if math.isfinite(report.peak_m) else float(report.xyz[2])
    heights = np.concatenate([report.heights_m, [report.xyz[2], peak_m]])
    xyz = np.column_stack([np.broadcast_to(report.middle, (len(heights), 2)), heights])
    for i in (order.reference, *order.search.tolist()):
        xy = views[i].sensor.image_from_ground(xyz)
        row, col, pixels, valid = crop(views[i], xy[np.isfinite(xy).all(axis=1)])
        grey = np.where(valid, pixels, np.float32(np.nan))
        found.append(Locus(views[i].name, (row, col), grey, xy[:-2], xy[-2], xy[-1]))
    return found


def crop(view: View, xy: FloatArray) -> tuple[int, int, NDArray[np.float32], NDArray[np.bool_]]:
    """The square around image points (n, 2) px: its first row and column, pixels and which of them are valid."""
    shape, centre = np.array(view.image.shape), (xy.min(axis=0) + xy.max(axis=0))[::-1] / 2
    side = max(float(np.ptp(xy, axis=0).max()) + 2 * CROP_MARGIN_PX, LEAST_CROP_PX)
    first = np.clip(np.floor(centre - side / 2), 0, shape - 1).astype(int)
    last = np.clip(np.ceil(centre + side / 2), first + 1, shape).astype(int)
    read = view.image.read(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))
    return int(first[0]), int(first[1]), read.pixels, read.valid


def point_text(report: PointReport, options: SelectionOptions) -> str:
    """All that was found, as lines of text."""
    curves, order = report.curves, report.curves.order
    reach = len(report.heights_m) // 2
    x, y, z = report.xyz
    lines = [
        f"Point      E {x:.2f}, N {y:.2f} m ({report.crs}); the cell of {report.cell_m:g} m around "
        f"E {report.middle[0]:.2f}, N {report.middle[1]:.2f} is matched",
        f"Height     {z:.2f} m: {report.height_from}",
        f"Range      {report.heights_m[0]:.2f} to {report.heights_m[-1]:.2f} m: {reach} steps of {report.step_m:.3f} m "
        "to both sides",
        f"Reference  {report.reference}" + (f"; not compared: {', '.join(report.left_out)}" if report.left_out else ""),
        "",
        f"Match curves against {report.reference}",
        *table(("image", "label", "rho1", "rho2", "ratio", "peak m"), _single_rows(report)),
        "",
        f"Order, from {what_order_rests_on(report, options)}",
        *table(("image", "labels", "used"), _order_rows(report)),
    ]
    if len(order.features):
        heads = ("tie point", *report.search)
        shown = list(zip(order.distance, order.labels, strict=True))[:MOST_FEATURES]
        rows = [(f"{d * report.cell_m:.1f} m away", *map(_signed, labels)) for d, labels in shown]
        lines += ["", f"Labels at {'these' if len(shown) == len(order.features) else 'the nearest'} tie points"]
        lines += table(heads, rows)
    lines += [
        "",
        "Mean of the images added so far",
        *table(("images", "added", "label", "rho1", "rho2", "ratio", "sigma", "peak m", ""), _mean_rows(report)),
        "",
        where_it_stops(report, options),
        f"Height of the peak: {report.peak_m:.3f} m"
        f" (predicted sigma {curves.sigma_steps[curves.n_used - 1] * report.step_m:.3f} m).",
    ]
    return "\n".join(lines)


def what_order_rests_on(report: PointReport, options: SelectionOptions) -> str:
    """The order_source of the order, in words."""
    order = report.curves.order
    n = len(order.features)
    if order.order_source is OrderSource.NEIGHBOURS:
        if options.neighbours == "tin":
            return f"the {n} corners of the triangle of tie points around it"
        return f"the {n} tie points within {options.radius_px * report.cell_m:g} m"
    if order.order_source is OrderSource.NEAREST:
        return f"the {n} nearest tie points (none is within {options.radius_px * report.cell_m:g} m)"
    return "the scene as a whole (no tie point is near)"


def where_it_stops(report: PointReport, options: SelectionOptions) -> str:
    """After how many images the match ends, and why, in a sentence."""
    curves = report.curves
    n, total = curves.n_used, len(report.search)
    is_precise = options.max_sigma_steps < LABEL_ALONE_STEPS
    if curves.is_stopped:
        rule = f" and its sigma is at most {options.max_sigma_steps:g} steps" if is_precise else ""
        return f"Stops after {n} of {total} search images: the mean is good{rule}."
    rule = f" and precise to {options.max_sigma_steps:g} steps at once" if is_precise else ""
    why = f"the mean is never good{rule}"
    rest = "no image is left" if n == total else "the images left do not help"
    return f"Does not stop before {n} of {total} search images: {why}, and {rest}."


def _single_rows(report: PointReport) -> list[tuple[str, ...]]:
    judged = report.curves.single_curves
    return [
        (name, *_judgement(judged, j), f"{report.heights_m[judged.peaks.peak[j]]:.2f}")
        for j, name in enumerate(report.search)
    ]


def _order_rows(report: PointReport) -> list[tuple[str, ...]]:
    curves, order = report.curves, report.curves.order
    rows: list[tuple[str, ...]] = []
    for j, name in enumerate(report.search):
        unused = "not needed" if order.is_helpful[j] else "does not help"
        rows.append((name, _signed(order.accumulated[j]), "yes" if j < curves.n_used else unused))
    return rows


def _mean_rows(report: PointReport) -> list[tuple[str, ...]]:
    curves = report.curves
    rows: list[tuple[str, ...]] = []
    for j, name in enumerate(report.search):
        sigma, peak = curves.sigma_steps[j], report.heights_m[curves.mean_curves.peaks.peak[j]]
        end = "<- ends here" if j + 1 == curves.n_used else ""
        rows.append((str(j + 1), name, *_judgement(curves.mean_curves, j), _number(sigma, 3), f"{peak:.2f}", end))
    return rows


def _judgement(judged: JudgedCurves, j: int) -> tuple[str, str, str, str]:
    """Label, rho1, rho2 and ratio of a curve."""
    peaks = judged.peaks
    return _signed(judged.labels[j]), _number(peaks.rho1[j], 4), _number(peaks.rho2[j], 4), _number(peaks.ratio[j], 3)


def _signed(value: int) -> str:
    return f"{value:+d}" if value else "0"


def _number(value: float, digits: int) -> str:
    if math.isinf(value):
        return "inf"
    return "none" if math.isnan(value) else f"{value:.{digits}f}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: numbers to the right under their head, columns of words to the left."""
    columns = []
    for head, *cells in zip(heads, *rows, strict=True):
        width = max(map(len, (head, *cells)))
        is_numbers = bool(cells) and all(cell[-1:].isdigit() or cell in ("inf", "none") for cell in cells)
        is_numbers &= not all(cell[:1].isalpha() for cell in cells) or all(cell in ("inf", "none") for cell in cells)
        columns.append([cell.rjust(width) if is_numbers else cell.ljust(width) for cell in (head, *cells)])
    return [("  " + "  ".join(cells)).rstrip() for cells in zip(*columns, strict=True)]


def write_point(folder: Path, report: PointReport, loci: Sequence[Locus], options: SelectionOptions) -> None:
    """All files of a point; each is complete or not there, point.json the last.

    Raises
    ------
    OutputError
        Where the folder cannot be written.
    """
    figures = {
        "match_curves.png": match_curves_figure(report),
        "selected.png": mean_figure(report, report.curves.n_used),
        "all_images.png": mean_figure(report, len(report.search)),
        "loci.png": loci_figure(loci),
    }
    for name, figure in figures.items():
        write_atomically(folder / name, partial(figure.savefig, format="png", dpi=DPI))
    write_atomically(folder / "curves.csv", lambda part: _write_csv(part, report))
    write_record(folder / "point.json", point_record(report, options))


def _write_csv(path: Path, report: PointReport) -> None:
    """Heights, NCC with every search image, and the mean of the first 1, 2, ...; empty where not seen."""
    curves = report.curves
    heads = ["height_m", *(f"ncc_{name}" for name in report.search)]
    heads += [f"sncc_{m + 1}" for m in range(len(report.search))]
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(heads)
        for k, height in enumerate(report.heights_m):
            values = np.concatenate([curves.single_curves.values[:, k], curves.mean_curves.values[:, k]])
            rows.writerow([f"{height:.4f}", *("" if np.isnan(v) else f"{v:.6f}" for v in values)])


def point_record(report: PointReport, options: SelectionOptions) -> dict[str, Any]:
    """What point.json holds; numbers that are not finite become null."""
    curves, order = report.curves, report.curves.order

    def judged(which: JudgedCurves, j: int) -> dict[str, Any]:
        peaks = which.peaks
        return {
            "label": int(which.labels[j]), "rho1": float(peaks.rho1[j]), "rho2": float(peaks.rho2[j]),
            "ratio": float(peaks.ratio[j]), "peak_m": float(report.heights_m[peaks.peak[j]]),
        }  # fmt: skip

    return {
        "asked": report.asked,
        "crs": report.crs,
        "xyz": [round(float(v), 4) for v in report.xyz],
        "height_from": report.height_from,
        "cell": {"middle": [round(float(v), 4) for v in report.middle], "side_m": report.cell_m},
        "range_m": [float(report.heights_m[0]), float(report.heights_m[-1])],
        "step_m": report.step_m,
        "reference": report.reference,
        "not_compared": list(report.left_out),
        "order": {
            "rests_on": order.order_source.name.lower(),
            "tie_points": len(order.features),
            "images": [
                {"image": name, "accumulated": int(order.accumulated[j]), "helps": bool(order.is_helpful[j])}
                for j, name in enumerate(report.search)
            ],
        },
        "curves": [{"image": name, **judged(curves.single_curves, j)} for j, name in enumerate(report.search)],
        "means": [
            {"added": name, **judged(curves.mean_curves, j), "sigma_steps": float(curves.sigma_steps[j])}
            for j, name in enumerate(report.search)
        ],
        "stop": {
            "images": curves.n_used, "is_stopped": curves.is_stopped, "sigma_steps_asked": options.max_sigma_steps,
        },
        "peak_m": report.peak_m,
    }  # fmt: skip


def match_curves_figure(report: PointReport) -> Figure:
    """NCC with each search image, a panel each, in their order, the peak and its rival marked."""
    judged, n = report.curves.single_curves, len(report.search)
    figure, panels = _panels(n, (4.2, 2.5), share=True)
    for j, (axes, name) in enumerate(zip(panels, report.search, strict=True)):
        curve, peaks, label = judged.values[j], judged.peaks, int(judged.labels[j])
        _frame(axes, report, lowest=-1.3)  # room for the figures
        axes.plot(report.heights_m, curve, color=COLOURS[j % len(COLOURS)], linewidth=1.4)
        if np.isfinite(peaks.rho1[j]):
            axes.plot(report.heights_m[peaks.peak[j]], peaks.rho1[j], "x", color="black", markersize=7)
        if np.isfinite(peaks.rho2[j]):
            axes.axhline(peaks.rho2[j], color="#777777", linewidth=0.8, linestyle=":")
        axes.set_title(as_written(f"{j + 1}. {report.reference} – {name}"), fontsize=9, loc="left")
        rho = f"{_signed(label)} {LABELS[label]}   ρ1 {_number(peaks.rho1[j], 2)}   ratio {_number(peaks.ratio[j], 2)}"
        axes.text(0.02, 0.03, rho, transform=axes.transAxes, fontsize=8, color=LABEL_COLOURS[label])
    _labelled(figure, "Correlation with each search image (x: peak, dotted: rival ρ2)")
    return figure


def mean_figure(report: PointReport, n_images: int, is_small: bool = False) -> Figure:
    """NCC of the first images, thin, and their mean; where it rests on several, the means on the way to it too.

    is_small : as wide as a telephone, without a title.
    """
    figure, (axes,) = _panels(1, SMALL if is_small else (7.6, 4.4))
    _frame(axes, report)
    curves = report.curves
    for j, name in enumerate(report.search[:n_images]):
        values = curves.single_curves.values[j]
        colour, dashes = COLOURS[j % len(COLOURS)], DASHES[j // len(COLOURS) % len(DASHES)]
        axes.plot(report.heights_m, values, color=colour, linestyle=dashes, linewidth=0.9, label=as_written(name))
    mean, j = curves.mean_curves, n_images - 1
    # The mean of one image is that image's own curve.
    steps = [curves.n_used] if n_images > curves.n_used else list(range(2, n_images))
    for k, m in enumerate(steps, 1):
        grey = f"{0.8 - 0.5 * k / len(steps):.2f}"  # the later, the darker
        name = f"mean of the first {m}"
        axes.plot(report.heights_m, mean.values[m - 1], color=grey, linewidth=1.6, linestyle="--", label=name)
    axes.plot(report.heights_m, mean.values[j], color="black", linewidth=2.2, label=f"mean of {n_images}")
    peak = mean.peaks.peak[j]
    axes.plot(report.heights_m[peak], mean.peaks.rho1[j], "x", color="black", markersize=9, markeredgewidth=2)
    label, height = int(mean.labels[j]), report.heights_m[peak]
    figures = f"ρ1 {_number(mean.peaks.rho1[j], 3)}, ratio {_number(mean.peaks.ratio[j], 2)}, peak {height:.2f} m"
    which = "all search images" if n_images == len(report.search) else f"{n_images} of {len(report.search)} images"
    title = f"{report.reference} with {which}: {_signed(label)} {LABELS[label]}, {figures}"
    if is_small:
        figure.legend(loc="outside lower center", fontsize=8, frameon=False, ncols=2)
        axes.set_xlabel("height, m", fontsize=9)  # the figure's own would be under the legend
        axes.set_ylabel("correlation", fontsize=9)
        return figure
    axes.set_title(as_written(title), fontsize=9, loc="left")
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    _labelled(figure, None)
    return figure


def as_written(text: str) -> str:
    """Words with names of views in them, for a figure: to matplotlib a formula stands between two signs of dollar."""
    return text.replace("$", r"\$")


def svg_of(figure: Figure) -> str:
    """A figure as SVG, the same text each time."""
    import matplotlib

    written = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "zlocus"}):
        figure.savefig(written, format="svg", metadata={"Date": None})
    text = written.getvalue()
    return text[text.index("<svg") :]  # without the address of a document type


def loci_figure(loci: Sequence[Locus]) -> Figure:
    """The vertical line over a crop of every image, the reference first."""
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
    figure.suptitle("The vertical line in the images, column and row (+: first height, x: peak)", fontsize=10)
    return figure


def _panels(n: int, size: tuple[float, float], share: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of n panels, (width, height) inches each, without global state."""
    from matplotlib.figure import Figure

    columns = min(n, COLUMNS)
    rows = -(-n // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    for axes in grid.ravel()[n:]:
        axes.set_visible(False)
    for axes in grid.ravel()[max(n - columns, 0) : n]:  # the lowest of its column may have an empty place below
        axes.tick_params(labelbottom=True)
    return figure, list(grid.ravel()[:n])


def _frame(axes: Axes, report: PointReport, lowest: float = -1.0) -> None:
    """What all curves are drawn on: correlation, from `lowest` on, against height, the height they began with."""
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
