"""The match curves of one cell as a small SVG drawing for the report.

The drawing is written line by line: matplotlib takes longer for five of them than a small area takes to be matched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np

from zlocus.core.sensor_model import FloatArray
from zlocus.products.match_curve_figures import COLOURS, shown_means
from zlocus.products.point_report import PointReport

# Of further images, after as many as there are colours.
DASHES = ("", "4 2", "1.5 2")
# Of a drawing with few curves.
SVG_PX = WIDTH_PX, HEIGHT_PX = 355, 336
# Space for labels left of, right of, above and below the axes; the legend comes below that.
LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX = 50.0, 8.0, 8.0, 38.0
CORRELATIONS = (-1.0, 1.05)
MOST_TICKS = 8
LEGEND_ROW_PX, LEGEND_LINE_PX = 15.0, 20.0
# A legend of longer names has one column.
LONGEST_NAME_IN_COLUMN = 18
FONT = "font-family='DejaVu Sans, Verdana, sans-serif'"


@dataclass(frozen=True)
class DrawnCurve:
    """A curve of the drawing: correlations (h,) with NaN where there is none, its name in the legend and its style."""

    values: FloatArray
    name: str
    colour: str
    width: float
    dashes: str = ""

    @property
    def style(self) -> str:
        """The attributes of the curve and of its sample in the legend."""
        dashes = f" stroke-dasharray='{self.dashes}'" if self.dashes else ""
        return f"fill='none' stroke='{self.colour}' stroke-width='{self.width}'{dashes}"


@dataclass(frozen=True)
class Axes:
    """Where heights and correlations lie in the drawing. low, high : first and last height, m; bottom : px."""

    low: float
    high: float
    bottom: float

    def x(self, height: float) -> float:
        """Column of a height, px."""
        share = (height - self.low) / ((self.high - self.low) or 1.0)
        return LEFT_PX + share * (WIDTH_PX - LEFT_PX - RIGHT_PX)

    def y(self, correlation: float) -> float:
        """Row of a correlation, px."""
        share = (correlation - CORRELATIONS[0]) / (CORRELATIONS[1] - CORRELATIONS[0])
        return self.bottom - share * (self.bottom - TOP_PX)


def mean_svg(report: PointReport, n_images: int) -> str:
    """SVG of the correlation of the first images as thin lines, their mean as a thick one, and the means before it as
    dashed ones, as `mean_figure` draws them; equal reports give equal texts. n_images : number of images in the mean.
    """
    curves, heights = _curves(report, n_images), report.heights_m
    columns = 2 if max(len(curve.name) for curve in curves) <= LONGEST_NAME_IN_COLUMN else 1
    rows = -(-len(curves) // columns)
    # With many images the legend makes the drawing higher, not the axes lower.
    total = HEIGHT_PX + max(rows - 4, 0) * LEGEND_ROW_PX
    axes = Axes(float(heights[0]), float(heights[-1]), total - BOTTOM_PX - rows * LEGEND_ROW_PX - 4.0)
    parts = [
        f"<svg xmlns='http://www.w3.org/2000/svg' width='{WIDTH_PX}' height='{total:.0f}' "
        f"viewBox='0 0 {WIDTH_PX} {total:.0f}' {FONT} font-size='11' fill='#000000'>",
        f"<rect width='{WIDTH_PX}' height='{total:.0f}' fill='#ffffff'/>",
        *_frame(axes, float(report.xyz[2])),
        *(_path(axes, heights, curve) for curve in curves),
        *_peak(axes, report, n_images),
        *_legend(curves, columns, total - rows * LEGEND_ROW_PX),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _curves(report: PointReport, n_images: int) -> list[DrawnCurve]:
    single, mean = report.curves.single_curves.values, report.curves.mean_curves.values
    curves = [
        DrawnCurve(single[j], name, COLOURS[j % len(COLOURS)], 1.2, DASHES[j // len(COLOURS) % len(DASHES)])
        for j, name in enumerate(report.search[:n_images])
    ]
    for m, grey in shown_means(report, n_images):
        shade = 3 * f"{round(255 * grey):02x}"
        curves.append(DrawnCurve(mean[m - 1], f"mean of the first {m}", f"#{shade}", 2.1, "7 3"))
    return [*curves, DrawnCurve(mean[n_images - 1], f"mean of {n_images}", "#000000", 2.9)]


def _path(axes: Axes, heights: FloatArray, curve: DrawnCurve) -> str:
    """The path of a curve, interrupted where it has no value."""
    path, is_drawing = [], False
    for height, value in zip(heights.tolist(), curve.values.tolist(), strict=True):
        if math.isfinite(value):
            path.append(f"{'L' if is_drawing else 'M'}{axes.x(height):.1f} {axes.y(value):.1f}")
        is_drawing = math.isfinite(value)
    return f"<path d='{''.join(path)}' stroke-linejoin='round' {curve.style}/>"


def _peak(axes: Axes, report: PointReport, n_images: int) -> list[str]:
    """A cross at the peak of the mean; nothing where it has none."""
    peaks = report.curves.mean_curves.peaks
    rho = float(peaks.rho1[n_images - 1])
    if not math.isfinite(rho):
        return []
    x, y = axes.x(float(report.heights_m[peaks.peak[n_images - 1]])), axes.y(rho)
    return [f"<path d='M{x - 5:.1f} {y - 5:.1f}l10 10m0 -10l-10 10' fill='none' stroke='#000000' stroke-width='2.6'/>"]


def _frame(axes: Axes, start_m: float) -> list[str]:
    """The frame with its ticks and labels; the height at the start as a dashed line."""
    right, middle = WIDTH_PX - RIGHT_PX, (TOP_PX + axes.bottom) / 2
    zero, start = axes.y(0.0), axes.x(start_m)
    centre = (LEFT_PX + right) / 2
    parts = [f"<path d='M{LEFT_PX} {zero:.1f}H{right}' stroke='#bbbbbb'/>"]
    if axes.low <= start_m <= axes.high:
        parts.append(f"<path d='M{start:.1f} {TOP_PX}V{axes.bottom:.1f}' stroke='#bbbbbb' stroke-dasharray='4 2'/>")
    for height in ticks(axes.low, axes.high):
        x = axes.x(height)
        parts.append(f"<path d='M{x:.1f} {axes.bottom:.1f}v4' stroke='#000000'/>")
        parts.append(
            f"<text x='{x:.1f}' y='{axes.bottom + 15:.1f}' text-anchor='middle'>{with_minus_sign(height, 'g')}</text>"
        )
    for correlation in np.linspace(-1.0, 1.0, 5).tolist():
        y, label = axes.y(correlation), with_minus_sign(correlation, ".1f")
        parts.append(f"<path d='M{LEFT_PX} {y:.1f}h-4' stroke='#000000'/>")
        parts.append(f"<text x='{LEFT_PX - 7:.1f}' y='{y + 4:.1f}' text-anchor='end'>{label}</text>")
    return [
        *parts,
        f"<rect x='{LEFT_PX}' y='{TOP_PX}' width='{right - LEFT_PX}' height='{axes.bottom - TOP_PX:.1f}' "
        "fill='none' stroke='#000000'/>",
        f"<text x='{centre:.1f}' y='{axes.bottom + 31:.1f}' text-anchor='middle' font-size='12'>height, m</text>",
        f"<text transform='translate(13 {middle:.1f}) rotate(-90)' text-anchor='middle' font-size='12'>correlation"
        "</text>",
    ]


def with_minus_sign(value: float, digits: str) -> str:
    """A number as text, with a minus sign in place of a hyphen."""
    return f"{value:{digits}}".replace("-", "\N{MINUS SIGN}")


def ticks(low: float, high: float) -> list[float]:
    """Round numbers from low to high, at most `MOST_TICKS`, 1, 2 or 5 times a power of ten apart."""
    if not high > low:
        return [low]
    least = (high - low) / (MOST_TICKS - 1)
    power = 10.0 ** math.floor(math.log10(least))
    step = next((m * power for m in (1, 2, 5) if m * power >= least), 10 * power)
    found = np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step
    return [round(height, 9) for height in found.tolist()]


def _legend(curves: list[DrawnCurve], columns: int, top: float) -> list[str]:
    """A sample and the name of every curve, column by column."""
    parts, rows, width = [], -(-len(curves) // columns), (WIDTH_PX - 16) / columns
    for number, curve in enumerate(curves):
        x, y = 8 + number // rows * width, top + number % rows * LEGEND_ROW_PX
        parts.append(f"<path d='M{x:.1f} {y:.1f}h{LEGEND_LINE_PX}' {curve.style}/>")
        parts.append(f"<text x='{x + LEGEND_LINE_PX + 6:.1f}' y='{y + 4:.1f}'>{escape(curve.name)}</text>")
    return parts
