"""Heights smoothed by local planes, wherever these explain the heights within their precision.

The height of a cell comes from the few cells of its windows, so that it errs by a step or more where these show little.
The ground itself is mostly smooth over a few metres. A plane is therefore fitted to the heights
in a window around every cell, each with the weight of its precision. Where the heights differ from the plane by no more
than their standard deviations say, the plane is a better estimate than they are. Where they differ by more, the window
holds an edge, a tree or relief, and its plane is not used. A cell takes the mean of the planes of all windows that hold
it and were kept (He, Sun, Tang 2013, "Guided image filtering", section 3, with their box filters), of the largest
windows for which it stays near its own height. Cells beside an edge are smoothed too, by the windows on their side.

What is smoothed follows from the standard deviations alone: sharp images, whose heights are precise, keep their relief.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.precision_calibration import REMAINING_OF_PLANES

FloatGrid = NDArray[np.float32]
# Sides of the windows, cells, from the smallest to the largest.
SIDES = (5, 9, 17, 33)
# Standard deviations count as at most so many times the median of the tile: a crown whose heights are uncertain is no
# part of the ground around it.
MAX_SIGMA_OF_USUAL = 2.0
# A plane is kept where the mean squared difference of the heights from it, in units of their variances, is below this
# (below 1 on a plane, because heights of neighbouring cells err alike), and where at least this share of the cells
# of its window has heights.
MAX_MISFIT, MIN_KNOWN_SHARE = 0.8, 0.7
# No height moves by more standard deviations than this.
MAX_MOVE_SIGMAS = 3.0
# Where no cell of a window has a height, its weights are this, so that nothing is divided by zero.
MIN_TOTAL_WEIGHT = 1e-9
# Rows that are smoothed at once, which saves memory.
STRIP_ROWS = 256


class Planes(NamedTuple):
    """A plane for the window around every cell, each (r, c) float64.

    constant : height at the first cell of the grid; by_row, by_col : rise from a row, or column, to the next; misfit :
    mean squared difference of the heights from the plane, in units of their variances; n_known : cells of the window
    that have heights.
    """

    constant: NDArray[np.float64]
    by_row: NDArray[np.float64]
    by_col: NDArray[np.float64]
    misfit: NDArray[np.float64]
    n_known: NDArray[np.float64]


class SmoothedHeights(NamedTuple):
    """height : (r, c) float32; side : (r, c) uint8, side of the windows whose planes a height was taken from, cells, 0
    where it was kept."""

    height: FloatGrid
    side: NDArray[np.uint8]


def remaining_error(side: NDArray[np.uint8]) -> FloatGrid:
    """Standard deviation of heights smoothed by planes of windows of a side, over what it was before, (r, c) float32.

    Measured by `benchmarks/precision.py`.
    """
    by_side = np.ones(max(SIDES) + 1, np.float32)
    for each, share in REMAINING_OF_PLANES.items():
        by_side[each] = share
    return by_side[side]


def smoothed_by_planes(
    height: FloatGrid,
    sigma: FloatGrid,
    is_known: NDArray[np.bool_],
    core: tuple[slice, slice],
    sides: Sequence[int],
) -> SmoothedHeights:
    """Heights smoothed by local planes; those of cells that are not known stay.

    height, sigma : (r, c) float32, of the cells and their standard deviations, in one unit; is_known : (r, c) bool;
    core : the part of the cells whose usual standard deviation counts; sides : of the windows, cells, ascending.
    """
    smooth = SmoothedHeights(height.copy(), np.zeros(height.shape, np.uint8))
    usual = sigma[core][is_known[core]]
    if not (usual.size and len(sides)):
        return smooth
    limit, reach = np.float32(MAX_SIGMA_OF_USUAL * np.median(usual)), 2 * (max(sides) // 2)
    for wide, inner, strip in _strips(height.shape[0], reach):
        of_strip = _smoothed(height[wide], np.minimum(sigma[wide], limit), is_known[wide], sides)
        smooth.height[strip], smooth.side[strip] = of_strip.height[inner], of_strip.side[inner]
    return smooth


def _strips(n_rows: int, reach: int) -> Iterator[tuple[slice, slice, slice]]:
    """Rows of a strip with those that it depends on, its own rows among these, and its own rows."""
    for first in range(0, n_rows, STRIP_ROWS):
        end, top = min(first + STRIP_ROWS, n_rows), max(first - reach, 0)
        yield slice(top, min(end + reach, n_rows)), slice(first - top, end - top), slice(first, end)


def _smoothed(
    height: FloatGrid, sigma: FloatGrid, is_known: NDArray[np.bool_], sides: Sequence[int]
) -> SmoothedHeights:
    """The same for the rows of a strip, with limited standard deviations."""
    smooth = SmoothedHeights(height.copy(), np.zeros(height.shape, np.uint8))
    for side in sides:
        found = mean_of_planes(planes_of_windows(height, sigma, is_known, side), side)
        takes = is_known & (np.abs(found - height) < np.float32(MAX_MOVE_SIGMAS) * sigma)
        smooth.height[takes], smooth.side[takes] = found[takes], np.uint8(side)
    return smooth


def planes_of_windows(height: FloatGrid, sigma: FloatGrid, is_known: NDArray[np.bool_], side: int) -> Planes:
    """Planes fitted to the heights in windows of `side` cells, with weights 1 / sigma^2; see `smoothed_by_planes`."""
    row, col = _places(height.shape)
    # Numbers near zero keep the differences of squares exact.
    origin = float(height[is_known].mean(dtype=np.float64)) if is_known.any() else 0.0
    z = np.where(is_known, height - origin, 0.0).astype(np.float64)
    weight = np.where(is_known, 1.0 / np.square(sigma.astype(np.float64)), 0.0)
    total = np.maximum(_box(weight, side), MIN_TOTAL_WEIGHT)
    of_row, of_col, of_z = weight * row, weight * col, weight * z
    mean_row, mean_col, mean_z = (_box(values, side) / total for values in (of_row, of_col, of_z))
    row_row = _box(of_row * row, side) / total - mean_row * mean_row
    row_col = _box(of_row * col, side) / total - mean_row * mean_col
    col_col = _box(of_col * col, side) / total - mean_col * mean_col
    row_z = _box(of_row * z, side) / total - mean_row * mean_z
    col_z = _box(of_col * z, side) / total - mean_col * mean_z
    z_z = _box(of_z * z, side) / total - mean_z * mean_z
    # Windows with few cells, whose cells may lie on a line, are not kept.
    determinant = np.maximum(row_row * col_col - row_col * row_col, 1e-6)
    by_row = (row_z * col_col - col_z * row_col) / determinant
    by_col = (col_z * row_row - row_z * row_col) / determinant
    n_known = _box(is_known.astype(np.float64), side)
    misfit = np.maximum(z_z - by_row * row_z - by_col * col_z, 0.0) * total / np.maximum(n_known, 1.0)
    constant = origin + mean_z - by_row * mean_row - by_col * mean_col
    return Planes(constant, by_row, by_col, misfit, n_known)


def mean_of_planes(planes: Planes, side: int) -> FloatGrid:
    """Height (r, c) float32 of the kept planes of the windows that hold each cell, NaN where none was kept.

    Planes that fit well count more.
    """
    row, col = _places(planes.constant.shape)
    is_kept = (planes.misfit < MAX_MISFIT) & (planes.n_known >= MIN_KNOWN_SHARE * side * side)
    weight = is_kept / (1.0 + planes.misfit)
    total = _box(weight, side)
    # Sums go on from window to window, so that a plane of any size that is not kept must be left out of them.
    constant, by_row, by_col = (
        _box(np.where(is_kept, weight * part, 0.0), side) for part in (planes.constant, planes.by_row, planes.by_col)
    )
    found = np.full(weight.shape, np.nan, np.float32)
    # Sums of weights that are all zero may differ from it by rounding.
    known = total > 0.25
    found[known] = ((constant + by_row * row + by_col * col)[known] / total[known]).astype(np.float32)
    return found


def _places(shape: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Row (r, 1) and column (1, c) of the cells."""
    return np.arange(shape[0], dtype=np.float64)[:, None], np.arange(shape[1], dtype=np.float64)[None]


def _box(values: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Sums (r, c) over the windows around the cells; beyond the grid there is nothing."""
    return np.asarray(
        cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT), np.float64
    )
