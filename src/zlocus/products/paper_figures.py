"""Tables 3 and 4 and figures 3 to 8 of Ji et al. (2014), from the match of a point P0 and of its feature points.

Beside our values stand the printed ones where there are any. The images of the paper are not available, so the values
differ; what the rules make of the printed values is tested (`zlocus.products.printed_values`).
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from zlocus.io.atomic_write import write_atomically
from zlocus.matching.point_match import JudgedCurves
from zlocus.products.match_curve_figures import DPI, loci_figure, match_curves_figure, mean_figure
from zlocus.products.point_report import Locus, PointReport, decimal, signed, table
from zlocus.products.printed_values import FIGURE_6, PRINTED_GROUPS, TABLE_3, TABLE_4

# The figures of the three feature points.
FIGURES_OF_FEATURES = {"figure3": 0, "figure4": 1, "figure5": 2}
PRINTED = "The printed values are those of the paper's ADS40 images, which are not available."
PRINTED_ORDER = f"Printed order: {'; '.join(', '.join(group) for group in PRINTED_GROUPS)}."
Rows = list[tuple[str, ...]]


@dataclass(frozen=True)
class ComparedPoint:
    """One point with its chosen images and with all of them.

    place : (3,) m, on the ground; n_chosen : search images after which the match stops; chosen, every : rho1, rho2 and
    ratio of the mean curve of these, and of all search images; leaves_out_poor : whether a search image that is not
    used has an accumulated label below 0.
    """

    place: tuple[float, float, float]
    n_chosen: int
    chosen: tuple[float, float, float]
    every: tuple[float, float, float]
    leaves_out_poor: bool


@dataclass(frozen=True)
class PaperPoint:
    """The point P0 with the feature points around it.

    report : of P0; feature_reports : those of the feature points, P1, P2, ..., the nearest first, whose search images
    stand in the order of the scene; where : of P0, in words; line : what the heights follow, in words; loci : images of
    that line, the reference image first; compared_points : many points for figure 7; n_looked_at : number of points
    that were matched for them.
    """

    report: PointReport
    feature_reports: tuple[PointReport, ...]
    where: str
    line: str
    loci: tuple[Locus, ...]
    compared_points: tuple[ComparedPoint, ...] = ()
    n_looked_at: int = 0


def write_paper(folder: Path, what: str, paper_point: PaperPoint) -> str:
    """Write the files of a table or figure, each complete or not at all, and return its values as text.

    what : `table3`, `table4`, or `figure3` to `figure8`.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    report = paper_point.report
    if what in ("table3", "table4"):
        heads, rows = (table_3 if what == "table3" else table_4)(paper_point)
        _write_rows(folder / f"{what}.csv", heads, rows)
        order = ["", PRINTED_ORDER] if what == "table4" else [""]
        return _text(paper_point, [*table(heads, rows), *order, PRINTED])
    if what in FIGURES_OF_FEATURES:
        number = FIGURES_OF_FEATURES[what]
        feature = paper_point.feature_reports[number]
        figure = match_curves_figure(feature, f"Feature point P{number + 1}: correlation with each search image")
        _write_rows(folder / f"{what}.csv", *curve_rows(feature, len(feature.search), has_means=False))
        lines = table(("image", *JUDGED), _judged_rows(feature.search, feature.curves.single_curves))
    elif what == "figure8":
        figure = loci_figure(paper_point.loci, paper_point.line)
        heads, rows = locus_rows(paper_point)
        _write_rows(folder / "figure8.csv", heads, rows)
        lines = table(*search_range_rows(paper_point))
    else:
        n_images = report.curves.n_used if what == "figure6" else len(report.search)
        figure = mean_figure(report, n_images)
        _write_rows(folder / f"{what}.csv", *curve_rows(report, n_images, has_means=True))
        lines = mean_lines(report, n_images)
        if paper_point.n_looked_at:
            _write_rows(folder / "figure7_points.csv", *compared_rows(paper_point.compared_points))
            lines += ["", *compared_lines(paper_point)]
    write_atomically(folder / f"{what}.png", partial(figure.savefig, format="png", dpi=DPI))
    return _text(paper_point, lines)


JUDGED = ("rho1", "rho2", "ratio", "label")


def table_3(paper_point: PaperPoint) -> tuple[tuple[str, ...], Rows]:
    """Heads and rows of table 3: the curve of every feature point with every search image, and the printed values."""
    heads = ("point", "image", *JUDGED, *(f"printed_{name}" for name in JUDGED))
    rows: Rows = []
    for number, feature in enumerate(paper_point.feature_reports, 1):
        for j, name in enumerate(feature.search):
            printed = TABLE_3.get((f"P{number}", name.lower()))
            shown = ("", "", "", "")
            if printed is not None:
                shown = (f"{printed.rho1:.4f}", f"{printed.rho2:.4f}", f"{printed.ratio:.4f}", signed(printed.label))
            rows.append((f"P{number}", name, *_judged(feature.curves.single_curves, j), *shown))
    return heads, rows


def table_4(paper_point: PaperPoint) -> tuple[tuple[str, ...], Rows]:
    """Heads and rows of table 4: search images in the order in which P0 uses them, with their accumulated labels."""
    report, order = paper_point.report, paper_point.report.curves.order
    rows: Rows = []
    for j, name in enumerate(report.search):
        printed = TABLE_4.get(name.lower())
        rows.append((
            str(j + 1), name, signed(order.accumulated[j]), "yes" if j < report.curves.n_used else "no",
            "" if printed is None else signed(printed),
        ))  # fmt: skip
    return ("place", "image", "accumulated_label", "used", "printed_accumulated_label"), rows


def curve_rows(report: PointReport, n_images: int, has_means: bool) -> tuple[tuple[str, ...], Rows]:
    """Heights and NCC with the first search images, and the means of the first 1, 2, ...; empty where not visible."""
    curves = [report.curves.single_curves.values[:n_images]]
    heads = ["height_m", *(f"ncc_{name}" for name in report.search[:n_images])]
    if has_means:
        curves.append(report.curves.mean_curves.values[:n_images])
        heads += [f"sncc_{m + 1}" for m in range(n_images)]
    values = np.concatenate(curves)
    rows: Rows = [
        (f"{height:.4f}", *("" if np.isnan(v) else f"{v:.6f}" for v in values[:, k]))
        for k, height in enumerate(report.heights_m)
    ]
    return tuple(heads), rows


def locus_rows(paper_point: PaperPoint) -> tuple[tuple[str, ...], Rows]:
    """Column and row of every height in every image; the start and the peak are rows of their own."""
    report, rows = paper_point.report, list[tuple[str, ...]]()
    for locus in paper_point.loci:
        points = [("line", height, xy) for height, xy in zip(report.heights_m, locus.line, strict=True)]
        points += [("start", float(report.xyz[2]), locus.start), ("peak", report.peak_m, locus.peak)]
        rows += [(locus.name, kind, f"{z:.4f}", f"{xy[0]:.3f}", f"{xy[1]:.3f}") for kind, z, xy in points]
    return ("image", "point", "height_m", "column", "row"), rows


def search_range_rows(paper_point: PaperPoint) -> tuple[tuple[str, ...], Rows]:
    """Length of the search range in every image, and where it begins and ends."""
    rows: Rows = []
    for locus in paper_point.loci:
        first, last = locus.line[0], locus.line[-1]
        ends = (f"{first[0]:.1f}", f"{first[1]:.1f}", f"{last[0]:.1f}", f"{last[1]:.1f}")
        rows.append((locus.name, f"{float(np.hypot(*(last - first))):.1f}", *ends))
    return ("image", "length_px", "first_col", "first_row", "last_col", "last_row"), rows


def mean_lines(report: PointReport, n_images: int) -> list[str]:
    """rho1, rho2, ratio and label of the mean of the chosen images, of all where they are asked for, and as printed."""
    means, n_used = report.curves.mean_curves, report.curves.n_used
    rows: Rows = [(f"{n_used} chosen: {', '.join(report.search[:n_used])}", *_judged(means, n_used - 1))]
    if n_images > n_used:
        rows.append((f"all {n_images}", *_judged(means, n_images - 1)))
    figures = f"{FIGURE_6.rho1:.4f}", f"{FIGURE_6.rho2:.4f}", f"{FIGURE_6.ratio:.4f}", signed(FIGURE_6.label)
    rows.append(("printed, figure 6 (b1, f1)", *figures))
    stops = "Table 1 calls the mean distinct there, and the other images are not used."
    if not report.curves.is_stopped:
        stops = "The mean never becomes distinct, so that all search images are used."
    return [*table(("mean of", *JUDGED), rows), "", stops, PRINTED]


def compared_rows(compared_points: Sequence[ComparedPoint]) -> tuple[tuple[str, ...], Rows]:
    """Heads and rows of the points at which the chosen images are compared with all of them."""
    heads = ("easting_m", "northing_m", "height_m", "n_chosen", "leaves_out_poor",
             *(f"{name}_chosen" for name in JUDGED[:3]), *(f"{name}_all" for name in JUDGED[:3]))  # fmt: skip
    rows: Rows = []
    for point in compared_points:
        of_point = (*(f"{v:.2f}" for v in point.place), str(point.n_chosen), str(int(point.leaves_out_poor)))
        rows.append((*of_point, *_digits(point.chosen), *_digits(point.every)))
    return heads, rows


def compared_lines(paper_point: PaperPoint) -> list[str]:
    """What more images do to rho1 and the ratio, over all compared points and over those with a poor image left out."""
    compared_points, looked_at = paper_point.compared_points, paper_point.n_looked_at
    first = f"Of {looked_at} points on a regular grid, {len(compared_points)} stop before the last search image."
    heads = ("points", "n", "rho1 chosen", "rho1 all", "falls", "ratio chosen", "ratio all", "falls ")
    poor = [point for point in compared_points if point.leaves_out_poor]
    rows: Rows = [
        (name, str(len(points)), *_compared(points))
        for name, points in (("that stop early", compared_points), ("with a poor image left out", poor))
    ]
    note = "The values are medians over the points; falls: share of the points at which the value of all is lower."
    return [first, *table(heads, rows), note]


def _compared(compared_points: Sequence[ComparedPoint]) -> tuple[str, ...]:
    """Medians of rho1 and ratio of the chosen and of all images, and at which share of the points they fall."""
    if not compared_points:
        return ("none",) * 6
    chosen, every = (np.array([getattr(p, name) for p in compared_points]) for name in ("chosen", "every"))
    cells: list[str] = []
    for k in (0, 2):
        cells += [decimal(float(np.median(values[:, k])), 3) for values in (chosen, every)]
        cells.append(f"{100 * float((every[:, k] < chosen[:, k]).mean()):.0f} %")
    return tuple(cells)


def _text(paper_point: PaperPoint, lines: list[str]) -> str:
    """The lines below what they are about."""
    report = paper_point.report
    heights = f"{report.heights_m[0]:.2f} to {report.heights_m[-1]:.2f} m"
    steps = f"{len(report.heights_m) // 2} steps of {report.step_m:.3f} m to both sides of {report.xyz[2]:.2f} m"
    head = [
        f"P0         {paper_point.where}",
        f"Reference  {report.reference}; search images {', '.join(report.search)}",
        f"Heights    {heights} along {paper_point.line[:1].lower()}{paper_point.line[1:]}: {steps}",
        f"Around P0  {len(paper_point.feature_reports)} feature points, {_distances(paper_point)} away",
    ]
    return "\n".join([*head, "", *lines])


def _distances(paper_point: PaperPoint) -> str:
    order, cell_m = paper_point.report.curves.order, paper_point.report.cell_m
    away = [f"{distance * cell_m:.1f}" for distance in order.distance[:3]]
    more = f" to {order.distance[-1] * cell_m:.1f}" if len(order.distance) > 3 else ""
    return f"{', '.join(away)}{more} m"


def _judged_rows(names: Sequence[str], curves: JudgedCurves) -> Rows:
    return [(name, *_judged(curves, j)) for j, name in enumerate(names)]


def _judged(curves: JudgedCurves, j: int) -> tuple[str, ...]:
    """rho1, rho2, ratio and label of the curve j."""
    peaks = curves.peaks
    return (*_digits((peaks.rho1[j], peaks.rho2[j], peaks.ratio[j])), signed(int(curves.labels[j])))


def _digits(values: Sequence[float]) -> tuple[str, ...]:
    """Values with four decimals, as the paper prints them."""
    return tuple(decimal(float(value), 4) for value in values)


def _write_rows(path: Path, heads: Sequence[str], rows: Rows) -> None:
    """Write a table as CSV."""

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(heads)
            writer.writerows(rows)

    write_atomically(path, write)
