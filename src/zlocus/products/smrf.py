"""Terrain without buildings and trees by the simple morphological filter (SMRF).

Source: Pingel, Clarke and McBride (2013), ISPRS Journal of Photogrammetry and Remote Sensing 77, section 2; their
parameters are in `ProductOptions`. Departures: windows are octagons instead of disks, because their cost grows with the
width and not with its square. Gaps are filled by a membrane from coarse to fine, which approximates the springs of the
paper. "Net cutting" is left out, because images show walls and slopes that lidar of one flight line may miss.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import ProductOptions

FloatImage = NDArray[np.float32]
# Cells below their neighbours by more than this slope are low outliers (the paper's 500 %).
OUTLIER_SLOPE, OUTLIER_RADIUS_CELLS = 5.0, 1
# An octagon is the sum of a square and a diamond. The square's share of its radius: tan 22.5 degrees makes it regular.
SQUARE_SHARE = math.tan(math.pi / 8.0)
# Iterations of Jacobi's method on each level of the membrane.
MEMBRANE_ITERATIONS = 16


def terrain(lowest: FloatImage, cell_m: float, options: ProductOptions) -> FloatImage:
    """Provisional terrain, (r, c) float32 m, without gaps; all NaN where there is no height at all.

    lowest : (r, c) float32 m, lowest height of each cell, NaN where it has none; cell_m : side of a cell.
    """
    filled, outside = membrane(lowest), outside_of(lowest)
    if np.isnan(filled).any():
        return filled
    low = rises(-filled, outside, cell_m, OUTLIER_SLOPE, [OUTLIER_RADIUS_CELLS])
    filled = membrane(np.where(low, np.float32(np.nan), filled))
    radii = range(1, max(1, math.ceil(options.ground_window_m / cell_m)) + 1)
    above = rises(filled, outside, cell_m, options.ground_slope, radii)
    return membrane(np.where(above | np.isnan(lowest), np.float32(np.nan), filled))


def outside_of(z: FloatImage) -> NDArray[np.bool_]:
    """Whether a cell belongs to a gap (NaN) that reaches the edge of the raster, (r, c). No ground surrounds these."""
    is_gap = np.isnan(z)
    count, gaps = cv2.connectedComponents(is_gap.astype(np.uint8), connectivity=4)
    at_rim = np.zeros(count, np.bool_)
    for rim in (gaps[0], gaps[-1], gaps[:, 0], gaps[:, -1]):
        at_rim[rim] = True
    return np.asarray(is_gap & at_rim[gaps])


def rises(
    z: FloatImage, outside: NDArray[np.bool_], cell_m: float, slope: float, radii: Iterable[int]
) -> NDArray[np.bool_]:
    """Whether a cell rises above its surroundings by more than slope times radius, for some window; (r, c).

    z : (r, c) without gaps; outside : cells that do not count; radii : of the windows, cells, growing. Each opening is
    applied to the result of the one before (progressive; figure 2 of the paper).
    """
    is_above = np.zeros(z.shape, bool)
    for radius in radii:
        lower = opened(z, outside, radius)
        is_above |= z - lower > np.float32(slope * radius * cell_m)
        z = lower
    return is_above


def opened(z: FloatImage, outside: NDArray[np.bool_], radius: int) -> FloatImage:
    """Morphological opening of z (r, c) with an octagon, which removes everything that is narrower.

    Cells outside keep their height. They and the world beyond the raster do not take part, since a roof beside them
    would otherwise seem to continue.
    """
    square = round(SQUARE_SHARE * radius)
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * square + 1, 2 * square + 1))
    cross, n_crosses = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), radius - square
    lower = np.where(outside, np.float32(np.inf), z)
    lower = cv2.erode(cv2.erode(lower, kernel), cross, iterations=n_crosses)
    lower = np.where(outside, np.float32(-np.inf), lower)
    upper = cv2.dilate(cv2.dilate(lower, kernel), cross, iterations=n_crosses)
    return np.where(outside, z, upper).astype(np.float32)


def membrane(z: FloatImage) -> FloatImage:
    """Heights (r, c) float32 with gaps (NaN) filled by a smooth membrane; unchanged where no height is known.

    Each level starts from the level half as fine, and unknown cells become the mean of their four neighbours (Jacobi's
    method for Laplace's equation, cascadic multigrid).
    """
    known = np.isfinite(z)
    if known.all() or not known.any():
        return z
    rows, cols = z.shape
    coarse = membrane(block_mean(z, 2))
    guess = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    filled = np.where(known, z, guess[:rows, :cols]).astype(np.float32)
    gaps = ~known
    for _ in range(MEMBRANE_ITERATIONS):
        ringed = np.pad(filled, 1, mode="edge")
        around = ringed[:-2, 1:-1] + ringed[2:, 1:-1] + ringed[1:-1, :-2] + ringed[1:-1, 2:]
        filled = np.where(gaps, np.float32(0.25) * around, filled)
    return filled


def block_mean(z: NDArray[np.floating], side: int) -> FloatImage:
    """Mean of the known cells of square blocks, NaN where there is none; blocks at the far edges may be incomplete."""
    blocks = _blocks(z, side)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3), dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(count, total / np.maximum(count, 1), np.nan), np.float32)


def block_min(z: NDArray[np.floating], side: int) -> FloatImage:
    """Minimum of the known cells of square blocks, as `block_mean`."""
    return np.asarray(np.fmin.reduce(np.fmin.reduce(_blocks(z, side), axis=3), axis=1), np.float32)


def _blocks(z: NDArray[np.floating], side: int) -> NDArray[np.floating]:
    """Blocks (rows, side, columns, side) of a raster, NaN beyond its edges."""
    down, across = -(-z.shape[0] // side), -(-z.shape[1] // side)
    whole = np.pad(z, ((0, down * side - z.shape[0]), (0, across * side - z.shape[1])), constant_values=np.nan)
    return whole.reshape(down, side, across, side)


def between_blocks(coarse: FloatImage, side: int, row: int, shape: tuple[int, int]) -> FloatImage:
    """Values at the centres of cells, bilinear between the centres of blocks of `side` cells.

    Beyond the outermost centres values are constant. coarse : (r, c), of the blocks; row : first row of cells; shape :
    of the result.
    """
    upper, lower, down = _places(row, shape[0], side, coarse.shape[0])
    left, right, across = _places(0, shape[1], side, coarse.shape[1])
    lines = coarse[upper] * (1 - down[:, None]) + coarse[lower] * down[:, None]
    return np.asarray(lines[:, left] * (1 - across) + lines[:, right] * across, np.float32)


def _places(first: int, n: int, side: int, n_blocks: int) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatImage]:
    """Blocks before and after each of n cells from `first` on, and the cell's distance from the former, in blocks."""
    place = np.clip((np.arange(first, first + n) + 0.5) / side - 0.5, 0, n_blocks - 1)
    before = np.minimum(place.astype(np.int64), max(n_blocks - 2, 0))
    return before, np.minimum(before + 1, n_blocks - 1), (place - before).astype(np.float32)
