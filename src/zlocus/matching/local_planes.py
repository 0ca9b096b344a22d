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

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.local_planes import N_PLANE_SUMS, mean_heights_of_planes

FloatGrid = NDArray[np.float32]
# Sides of the windows, cells, from the smallest to the largest.
SIDES = (5, 9, 17, 33)
# Standard deviations count as at most so many times the median of the tile: a crown whose heights are uncertain is no
# part of the ground around it.
MAX_SIGMA_OF_USUAL = 2.0
# No height moves by more standard deviations than this.
MAX_MOVE_SIGMAS = 3.0


class SmoothedHeights(NamedTuple):
    """height : (r, c) float32; side : (r, c) uint8, side of the windows whose planes a height was taken from, cells, 0
    where it was kept."""

    height: FloatGrid
    side: NDArray[np.uint8]


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
    limited = np.minimum(sigma, np.float32(MAX_SIGMA_OF_USUAL * np.median(usual)))
    for side in sides:
        found = mean_of_planes(height, limited, is_known, side)
        takes = is_known & (np.abs(found - height) < np.float32(MAX_MOVE_SIGMAS) * limited)
        smooth.height[takes], smooth.side[takes] = found[takes], np.uint8(side)
    return smooth


def mean_of_planes(height: FloatGrid, sigma: FloatGrid, is_known: NDArray[np.bool_], side: int) -> FloatGrid:
    """Mean height (r, c) float32 of the kept planes of all windows that hold a cell, NaN where none was kept.

    The planes are fitted to the heights in windows of `side` cells with the weights 1 / sigma^2; see
    `smoothed_by_planes`.
    """
    weight = np.where(is_known, 1.0 / np.square(sigma.astype(np.float64)), 0.0)
    # Numbers near zero keep the differences of squares exact.
    origin = float(height[is_known].mean(dtype=np.float64)) if is_known.any() else 0.0
    found, planes = np.empty(height.shape, np.float32), np.empty((N_PLANE_SUMS, *height.shape), np.float64)
    mean_heights_of_planes(np.ascontiguousarray(height), weight, origin, side, planes, found)
    return found
