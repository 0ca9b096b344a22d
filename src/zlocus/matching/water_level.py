"""The level of a water surface, from the matched heights at its shore or on it.

Moving water looks different in every image, so that heights on it are noise. Within half a correlation window from the
shore the window holds the edge between water and land, which all images show at the level of the water. Where the
ground rises from the shore, and under trees, such heights are too high, never too low but for noise. So the level is a
low quantile of the heights on both sides of the shore; `benchmarks/rows/water.py` measures it on rendered lakes with
different shores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import WaterOptions
from zlocus.matching.quality import EMPTY, Quality

# Heights with one of these flags do not tell a level.
NOT_CONFIDENT = np.uint16(
    EMPTY | Quality.WEAK | Quality.AMBIGUOUS | Quality.JUMP | Quality.FILLED | Quality.DISPUTED | Quality.PLANE
)
# Heights of three images or more tell a level up to this standard deviation, in sides of a cell. On rendered lakes
# levels from three views are off by .064 m (root mean square) with it and by .071 m without.
MAX_SIGMA_CELLS = 0.5
# Quantile of the heights at the shore, weighted by their precision, for outlines that are given. On rendered lakes with
# three views, quantiles from 7.5 to 12.5 % and widths from 4 to 6 cells are off by the same .05 m (root mean square).
# Where the outline is 1 m too wide or too narrow, low quantiles and wide bands are the best: these are off by .07 m.
SHORE_QUANTILE = 0.075
# The same where the outline is that of possible water, which lies inside the shore.
POSSIBLE_QUANTILE = 0.15
# Standard deviation of normally distributed values from their median absolute deviation.
DEVIATION_PER_MAD = 1.4826


@dataclass(frozen=True)
class WaterHeights:
    """Confident heights of a water surface and its shore.

    n_inside : number of its cells away from the shore; inside : (n,) m, heights of these; shore, shore_sigma : (m,) m,
    heights beside the shore on both sides, and their standard deviations; beyond : (k,) m, those on the land side.
    """

    n_inside: int
    inside: NDArray[np.float32]
    shore: NDArray[np.float32]
    shore_sigma: NDArray[np.float32]
    beyond: NDArray[np.float32]


@dataclass(frozen=True)
class WaterLevel:
    """The level of a water surface.

    height_m : NaN where it is not known; sigma_m : standard deviation, NaN where it is not known; source : attribute,
    rim or inside; n_used : number of cells whose heights were used; inside_share : of the cells away from the shore,
    the share that has confident heights, NaN where the level does not come from these.
    """

    height_m: float
    sigma_m: float
    source: str
    n_used: int
    inside_share: float = math.nan


def water_level(
    heights: WaterHeights, options: WaterOptions, share: float = SHORE_QUANTILE
) -> WaterLevel | None:  # fmt: skip
    """The level of a water surface from confident heights; None where there are too few.

    Where most of the surface has confident heights (ice, plants), their median. Else the quantile `share` of those
    beside the shore. The standard deviation contains half of the rise of the ground at the shore, by which the level
    may be too high.
    """
    n = len(heights.inside)
    if n >= options.min_shore_cells and n >= options.min_inside_share * heights.n_inside:
        middle = float(np.median(heights.inside))
        relief = DEVIATION_PER_MAD * float(np.median(np.abs(heights.inside - middle)))
        return WaterLevel(middle, relief, "inside", n, n / heights.n_inside)
    if len(heights.shore) < options.min_shore_cells:
        return None
    level, next_lowest = (weighted_quantile(heights.shore, heights.shore_sigma, each) for each in (share, 2.0 * share))
    rise = float(np.median(heights.beyond)) - level if len(heights.beyond) else 0.0
    sigma = float(np.hypot(next_lowest - level, max(rise, 0.0) / 2.0))
    return WaterLevel(level, sigma, "rim", len(heights.shore))


def weighted_quantile(heights: NDArray[np.float32], sigma: NDArray[np.float32], share: float) -> float:
    """Quantile of heights (n,) m, weighted by the inverse of their variances. sigma : (n,) m."""
    order = np.argsort(heights, kind="stable")
    weight = np.cumsum(1.0 / np.maximum(sigma[order].astype(np.float64), 1e-3) ** 2)
    return float(heights[order[np.searchsorted(weight, share * weight[-1])]])


def tells_level(
    is_sure: NDArray[np.bool_], sigma: NDArray[np.float32], views: NDArray[np.uint8], cell_m: float
) -> NDArray[np.bool_]:
    """(r, c) bool: cells whose heights tell the level at a shore.

    is_sure : (r, c) bool, see `is_confident`; sigma : (r, c) m; views : (r, c), images that measured each height. A
    single pair cannot contradict itself, and its standard deviations say less; all its heights count. cell_m : side of
    a cell.
    """
    return np.asarray(is_sure & ((views <= 2) | (sigma <= np.float32(MAX_SIGMA_CELLS * cell_m))))


def is_confident(height: NDArray[np.float32], quality: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """(r, c) bool: cells with a height and without a sign of doubt. height : (r, c) m; quality : (r, c) uint16."""
    return np.asarray(np.isfinite(height) & ((quality & NOT_CONFIDENT) == 0))


@dataclass(frozen=True)
class ShoreCells:
    """Cells at a shore. water, land : (r, c) bool, those on the water side and on the land side."""

    water: NDArray[np.bool_]
    land: NDArray[np.bool_]


def shore_cells(is_surface: NDArray[np.bool_], is_any: NDArray[np.bool_], width_cells: float) -> ShoreCells:
    """Cells within a distance from the shore of a water surface; the border of the arrays is no shore.

    is_surface, is_any : (r, c) bool, cells of the surface, and of all water surfaces, between which there is no shore.
    """
    disc = _disc(width_cells)
    water = is_surface & (cv2.erode(is_any.astype(np.uint8), disc) == 0)
    land = ~is_any & (cv2.dilate(is_surface.astype(np.uint8), disc) > 0)
    return ShoreCells(np.asarray(water), np.asarray(land))


def _disc(radius: float) -> NDArray[np.uint8]:
    """A disc (n, n) of ones."""
    reach = int(radius)
    away = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1])
    return np.asarray(away <= radius, np.uint8)
