"""What is reported of one point: its match as text (`zlocus curves`), as point.json and as curves.csv."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.options import SelectionOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.point_match import JudgedCurves, PlaceCurves, PointCurves
from zlocus.matching.view_ranking import OrderSource

LABELS = {1: "good", 0: "fair", -1: "poor"}
# A crop extends at least this far beyond the locus, and is at least this large.
CROP_MARGIN_PX, MIN_CROP_PX = 12, 48
MAX_LISTED_TIES = 8
# With a limit of sigma this large, the label of the mean curve alone decides where the match stops.
UNLIMITED_SIGMA_STEPS = 1000.0


@dataclass(frozen=True)
class Locus:
    """A vertical line in an image, with a crop of the image around it.

    name : of the image; first : first row and column of the crop; grey : (r, c) float32, NaN where a pixel is not
    valid; line : (h, 2) px, the image points of the line; start, peak : (2,) px, the image points at the height around
    which curves are sampled and at the peak.
    """

    name: str
    first: tuple[int, int]
    grey: NDArray[np.float32]
    line: FloatArray
    start: FloatArray
    peak: FloatArray


@dataclass(frozen=True)
class PointReport:
    """A point and the match of its cell.

    request : the point as it was given; xyz : (3,) m, the point at the height around which curves are sampled;
    height_from : where that height comes from, in words; middle : (2,) m, of the cell, whose side is cell_m; names : of
    the images that were compared; not_compared : names of the others; heights_m : (h,) m, of the curves; peak_m :
    height of the peak, NaN without one.
    """

    request: str
    crs: str
    xyz: FloatArray
    height_from: str
    middle: FloatArray
    cell_m: float
    names: tuple[str, ...]
    not_compared: tuple[str, ...]
    heights_m: FloatArray
    step_m: float
    curves: PointCurves
    peak_m: float

    @classmethod
    def of(cls, request: str, place_curves: PlaceCurves, match_scene: MatchScene, crs: CRS) -> PointReport:
        """Report of a place whose curves are known. request : the point as it was given; crs : of the scene."""
        place, curves = place_curves.place, place_curves.curves
        return cls(
            request=request, crs=crs.to_string().splitlines()[0], xyz=place.xyz, height_from=place.height_from,
            middle=place.middle, cell_m=match_scene.cell_size, names=tuple(view.name for view in place_curves.views),
            not_compared=tuple(view.name for view in match_scene.views if view not in place_curves.views),
            heights_m=place_curves.heights_m, curves=curves, step_m=match_scene.height_step,
            peak_m=match_scene.height_origin + curves.peak_index * match_scene.height_step,
        )  # fmt: skip

    def above(self, undulation_m: float) -> PointReport:
        """The report with heights above a vertical datum, which lies so far (m) above the ellipsoid."""
        return replace(
            self,
            heights_m=self.heights_m - undulation_m,
            peak_m=self.peak_m - undulation_m,
            xyz=self.xyz - (0.0, 0.0, undulation_m),
        )

    @property
    def reference(self) -> str:
        """Name of the reference image."""
        return self.names[self.curves.order.reference]

    @property
    def search(self) -> list[str]:
        """Names of the search images, in their order."""
        return [self.names[i] for i in self.curves.order.search]


def loci(views: Sequence[View], report: PointReport) -> list[Locus]:
    """The vertical line in every image, the reference image first, then the search images in their order.

    views : that were compared.
    """
    order = report.curves.order
    peak_m = report.peak_m if math.isfinite(report.peak_m) else float(report.xyz[2])
    heights = np.concatenate([report.heights_m, [report.xyz[2], peak_m]])
    xyz = np.column_stack([np.broadcast_to(report.middle, (len(heights), 2)), heights])
    return loci_through([views[i] for i in (order.reference, *order.search.tolist())], xyz)


def loci_through(views: Sequence[View], xyz: FloatArray) -> list[Locus]:
    """The images of a line of ground points, for each view.

    xyz : (h + 2, 3) m, the points of the line, then that at the start and that at the peak.
    """
    lines = []
    for view in views:
        xy = view.sensor.image_from_ground(xyz)
        row, col, pixels, valid = crop(view, xy[np.isfinite(xy).all(axis=1)])
        grey = np.where(valid, pixels, np.float32(np.nan))
        lines.append(Locus(view.name, (row, col), grey, xy[:-2], xy[-2], xy[-1]))
    return lines


def crop(view: View, xy: FloatArray) -> tuple[int, int, NDArray[np.float32], NDArray[np.bool_]]:
    """Cut the square around image points (n, 2) px: its first row and column, its pixels, and which are valid."""
    shape, centre = np.array(view.image.shape), (xy.min(axis=0) + xy.max(axis=0))[::-1] / 2
    side = max(float(np.ptp(xy, axis=0).max()) + 2 * CROP_MARGIN_PX, MIN_CROP_PX)
    first = np.clip(np.floor(centre - side / 2), 0, shape - 1).astype(int)
    last = np.clip(np.ceil(centre + side / 2), first + 1, shape).astype(int)
    read = view.image.read(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))
    return int(first[0]), int(first[1]), read.pixels, read.valid


def point_text(report: PointReport, options: SelectionOptions) -> str:
    """The whole report as lines of text."""
    curves, order = report.curves, report.curves.order
    reach = len(report.heights_m) // 2
    x, y, z = report.xyz
    not_compared = f"; not compared: {', '.join(report.not_compared)}" if report.not_compared else ""
    lines = [
        f"Point      E {x:.2f}, N {y:.2f} m ({report.crs}); the cell of {report.cell_m:g} m around "
        f"E {report.middle[0]:.2f}, N {report.middle[1]:.2f} is matched",
        f"Height     {z:.2f} m: {report.height_from}",
        f"Range      {report.heights_m[0]:.2f} to {report.heights_m[-1]:.2f} m: {reach} steps of {report.step_m:.3f} m "
        "to both sides",
        f"Reference  {report.reference}{not_compared}",
        "",
        f"Match curves against {report.reference}",
        *table(("image", "label", "rho1", "rho2", "ratio", "peak m"), _single_rows(report)),
        "",
        f"Order, from {what_order_rests_on(report, options)}",
        *table(("image", "labels", "used"), _order_rows(report)),
    ]
    if len(order.features):
        heads = ("tie point", *report.search)
        shown = list(zip(order.distance, order.labels, strict=True))[:MAX_LISTED_TIES]
        rows = [(f"{d * report.cell_m:.1f} m away", *map(signed, labels)) for d, labels in shown]
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
    """Which tie points the order of the images rests on, in words."""
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
    """After how many images the match stops, and why, in a sentence."""
    curves = report.curves
    n, total = curves.n_used, len(report.search)
    is_precise = options.max_sigma_steps < UNLIMITED_SIGMA_STEPS
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
        rows.append((name, signed(order.accumulated[j]), "yes" if j < curves.n_used else unused))
    return rows


def _mean_rows(report: PointReport) -> list[tuple[str, ...]]:
    curves = report.curves
    rows: list[tuple[str, ...]] = []
    for j, name in enumerate(report.search):
        sigma, peak = curves.sigma_steps[j], report.heights_m[curves.mean_curves.peaks.peak[j]]
        end = "<- ends here" if j + 1 == curves.n_used else ""
        rows.append((str(j + 1), name, *_judgement(curves.mean_curves, j), decimal(sigma, 3), f"{peak:.2f}", end))
    return rows


def _judgement(curves: JudgedCurves, j: int) -> tuple[str, str, str, str]:
    """Label, rho1, rho2 and ratio of the curve j."""
    peaks = curves.peaks
    return (
        signed(curves.labels[j]),
        decimal(peaks.rho1[j], 4),
        decimal(peaks.rho2[j], 4),
        decimal(peaks.ratio[j], 3),
    )


def signed(value: int) -> str:
    """A whole number with its sign; 0 without one."""
    return f"{value:+d}" if value else "0"


def decimal(value: float, digits: int) -> str:
    """A number with so many decimals, `inf`, or `none` for NaN."""
    if math.isinf(value):
        return "inf"
    return "none" if math.isnan(value) else f"{value:.{digits}f}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a text table: numbers are aligned right, words left."""
    columns = []
    for head, *cells in zip(heads, *rows, strict=True):
        width = max(map(len, (head, *cells)))
        is_numbers = bool(cells) and all(cell[-1:].isdigit() or cell in ("inf", "none") for cell in cells)
        is_numbers &= not all(cell[:1].isalpha() for cell in cells) or all(cell in ("inf", "none") for cell in cells)
        columns.append([cell.rjust(width) if is_numbers else cell.ljust(width) for cell in (head, *cells)])
    return [("  " + "  ".join(cells)).rstrip() for cells in zip(*columns, strict=True)]


def write_csv(path: Path, report: PointReport) -> None:
    """Write heights, NCC with every search image, and mean of the first 1, 2, ... of them; empty where not visible."""
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
    """Content of point.json, where numbers that are not finite become null."""
    curves, order = report.curves, report.curves.order

    def judged(curves: JudgedCurves, j: int) -> dict[str, Any]:
        peaks = curves.peaks
        return {
            "label": int(curves.labels[j]), "rho1": float(peaks.rho1[j]), "rho2": float(peaks.rho2[j]),
            "ratio": float(peaks.ratio[j]), "peak_m": float(report.heights_m[peaks.peak[j]]),
        }  # fmt: skip

    return {
        "asked": report.request,
        "crs": report.crs,
        "xyz": [round(float(v), 4) for v in report.xyz],
        "height_from": report.height_from,
        "cell": {"middle": [round(float(v), 4) for v in report.middle], "side_m": report.cell_m},
        "range_m": [float(report.heights_m[0]), float(report.heights_m[-1])],
        "step_m": report.step_m,
        "reference": report.reference,
        "not_compared": list(report.not_compared),
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
