"""Image quality, measured in windows spread over an image: no-data pixels, saturation, black borders, blur."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import ImageSource, has_mask, held_window, masked_pixels
from zlocus.pipeline.doctor.findings import NOTE, Finding, poor

SIDE_PX, MOST_WINDOWS = 512, 4  # windows along an axis
# Edges are where the grey value changes most over six pixels: this percentile and above.
STRONG_PERCENT = 90.0
FEWEST_EDGES = 50
BROADEST_PX = 8.0
# Limits beyond which a finding is made.
SATURATED, BLACK, EMPTY = 0.02, 0.02, 0.3
BLURRED_PX = 2.0
BLURRED_BESIDE_OTHERS = 2.0


@dataclass(frozen=True)
class ImageQuality:
    """Quality of an image, as shares of the pixels that were examined.

    nodata : not valid, without masked ones; saturated : of the valid ones, at the greatest value; black : of the valid
    ones, exactly 0; edge_px : sigma of the Gaussian by which a sharp edge is blurred, across the worse axis, NaN where
    there are no edges; masked : covered by the mask of the image, None without one.
    """

    nodata: float
    saturated: float
    black: float
    edge_px: float
    masked: float | None = None


def image_quality(image: ImageSource) -> ImageQuality:
    """The quality of an image of any size, from at most 16 windows.

    Raises
    ------
    InputError
        Where a window cannot be read.
    """
    top, left, *_ = held = held_window(image)
    places = [(top + row, left + col, rows, cols) for row, col, rows, cols in sample_windows(held[2:])]
    windows, masked = [image.read(*place) for place in places], _masked_share(image, places)
    values = np.concatenate([window.pixels[window.valid] for window in windows])
    n_pixels = sum(window.valid.size for window in windows)
    if not len(values):
        return ImageQuality(1.0 - (masked or 0.0), 0.0, 0.0, math.nan, masked)
    # Weighted sums of colour bands are not whole numbers, although the bands are.
    slack = 0.5 if np.dtype(image.dtype).kind in "iu" else 0.0
    edges = []
    for turned in (False, True):
        found = [edge_ratios(*((w.pixels.T, w.valid.T) if turned else (w.pixels, w.valid))) for w in windows]
        edges.append(edge_width(np.concatenate(found)))
    return ImageQuality(
        nodata=max(1.0 - len(values) / n_pixels - (masked or 0.0), 0.0),
        saturated=float(np.mean(values >= values.max() - slack)),
        black=float(np.mean(values == 0.0)),
        edge_px=max((edge for edge in edges if math.isfinite(edge)), default=math.nan),
        masked=masked,
    )


def _masked_share(image: ImageSource, places: Sequence[tuple[int, int, int, int]]) -> float | None:
    """Share of the pixels of some windows that the mask of an image covers; None without a mask."""
    if not has_mask(image):
        return None
    parts = [masked_pixels(image, *place) for place in places]
    masked = np.concatenate([part.ravel() for part in parts if part is not None])
    return float(masked.mean())


def sample_windows(shape: tuple[int, int]) -> Iterator[tuple[int, int, int, int]]:
    """First row, first column, rows and columns of windows spread over an image; one window where it is small."""
    sides = [min(SIDE_PX, length) for length in shape]
    counts = [min(math.ceil(length / SIDE_PX), MOST_WINDOWS) for length in shape]
    starts = [
        np.linspace(0, length - side, n).astype(int) for length, side, n in zip(shape, sides, counts, strict=True)
    ]
    for row, col in product(*starts):
        yield int(row), int(col), sides[0], sides[1]


def edge_ratios(pixels: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Share (k,) of the grey-value change over six columns that happens over the inner two, at vertical edges.

    An edge is where the change over two columns is the greatest of three neighbours, and that over six is among the
    strongest of the window.
    """
    if pixels.shape[1] < 12:
        return np.empty(0, np.float32)
    near = np.abs(pixels[:, 2:] - pixels[:, :-2])[:, 2:-2]  # about column 3 to the one 4 before the end
    far = np.abs(pixels[:, 6:] - pixels[:, :-6])
    known = valid[:, :-6].copy()
    for step in range(1, 7):
        known &= valid[:, step : pixels.shape[1] - 6 + step]
    peak = np.zeros(known.shape, bool)
    peak[:, 1:-1] = (near[:, 1:-1] >= near[:, :-2]) & (near[:, 1:-1] >= near[:, 2:])
    known &= peak & (far > 0)
    if not known.any():
        return np.empty(0, np.float32)
    known &= far >= np.percentile(far[known], STRONG_PERCENT)
    return np.asarray(near[known] / far[known])


def edge_width(ratios: NDArray[np.float32]) -> float:
    """Standard deviation (px) of the blur that gives step edges this median ratio; NaN where edges are too few.

    A step blurred by sigma s changes by erf(d / (s sqrt 2)) over d pixels to both sides.
    """
    if len(ratios) < FEWEST_EDGES:
        return math.nan
    sigma = np.geomspace(BROADEST_PX, 0.2, 60)
    ratio = [math.erf(1.0 / (s * math.sqrt(2.0))) / math.erf(3.0 / (s * math.sqrt(2.0))) for s in sigma]
    return float(np.interp(np.median(ratios), ratio, sigma))


def quality_findings(names: Sequence[str], qualities: Sequence[ImageQuality]) -> list[Finding]:
    """Findings about the quality of the images."""
    findings = []
    edges = np.array([each.edge_px for each in qualities])
    for i, (name, quality) in enumerate(zip(names, qualities, strict=True)):
        others = np.delete(edges, i)
        usual = float(np.median(others[np.isfinite(others)])) if np.isfinite(others).any() else 0.0
        findings += [poor(name, sentence) for sentence in (*grey_sentences(quality), *blur_sentences(quality, usual))]
        if quality.nodata > EMPTY:
            findings.append(Finding(NOTE, f"{name}: {percent(quality.nodata)} of its pixels are nodata.", (name,)))
        if quality.masked is not None:
            findings.append(Finding(NOTE, f"{name}: its mask covers {percent(quality.masked)} of its pixels.", (name,)))
    return findings


def grey_sentences(quality: ImageQuality) -> Iterator[str]:
    """Findings about the grey values of an image."""
    if quality.saturated > SATURATED:
        yield (
            f"{percent(quality.saturated)} of its pixels have the image's greatest value. Where it is saturated there "
            "is nothing to match; take an image that is exposed or stretched less."
        )
    if quality.black > BLACK:
        yield (
            f"{percent(quality.black)} of its pixels are exactly 0 and count as grey values. If they are a border, "
            "declare it: gdal_edit.py -a_nodata 0."
        )


def blur_sentences(quality: ImageQuality, usual_px: float) -> Iterator[str]:
    """Findings about the sharpness of an image. usual_px : edge width of the other images, 0 where unknown."""
    width = f"{quality.edge_px:.1f} px wide (sigma)"
    if math.isnan(quality.edge_px):
        yield "no edges were found in it, so that little can be matched, and its blur is not known."
    elif quality.edge_px <= BLURRED_PX:
        return
    elif quality.edge_px > BLURRED_BESIDE_OTHERS * usual_px:
        beside = f", those of the other images {usual_px:.1f} px" if usual_px else ""
        yield (
            f"it is blurred, its edges are {width}{beside}. Details finer than that are lost; leave it out if there "
            "are others."
        )
    else:
        yield f"its edges are {width}, as are those of the other images. A coarser --resolution loses little."


def percent(share: float) -> str:
    """A share as text."""
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.1f} %"
