"""Patches that stand far above or below their surroundings, with too little evidence for it.

Where the images say little, two of them agree by chance somewhere within a wide search range, and a small patch of
cells stands at a height that is wrong by tens of metres. A tower stands off its surroundings too, but its cells, taken
together, cost far less at its height than at that of the surroundings. How much less they must cost grows with the
height of the patch, because the more heights lie between, the likelier is an agreement by chance; and it decreases with
the root of the area, because errors of many cells average out. A patch along whose border the surface goes on is part
of something larger, such as the corner of a roof into which the window of the surroundings does not fit.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.prior_costs import write_misfit
from zlocus.matching.slope_surface import SlopeSurface

# Side of the window, in finest cells, beyond which surroundings are sought; at coarser levels it has at least as many
# cells as MIN_SIDE_CELLS.
SIDE_CELLS, MIN_SIDE_CELLS = 41, 9
# Heights are in sides of a finest cell, so that a tree is as high for images with a wide base, whose steps are small. A
# cell stands off where it differs from its surroundings by more than MIN_OFF; a patch of such cells is judged where it
# does so by more than MIN_MEAN_OFF in the mean: 18 m for cells of half a metre.
MIN_OFF, MIN_MEAN_OFF = 21.0, 36.0
# A pit is judged only where it lies so far below the lowest surroundings: streets between tall roofs do not.
MIN_BELOW_LOWEST = 5.0
# Mean gain in cost that a patch of REFERENCE_CELLS finest cells needs for each side of a cell that it stands off, and
# at most.
GAIN_PER_SIDE, MAX_GAIN, REFERENCE_CELLS = 1.25, 150.0, 100.0
# The same as a factor from each level to the next coarser one, where a patch may still grow.
GAIN_FACTOR_PER_LEVEL = 0.5
# A patch is part of something larger where, over this share of its border, the surface goes on: neighbouring cells
# differ by less than so many sides.
MIN_JOINED_SHARE, MAX_STEP_OF_JOINED = 0.25, 5.0


def heights_of_surroundings(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    slope_surface: SlopeSurface,
    surface: NDArray[np.float32],
    level: int,
    step_cells: float,
) -> NDArray[np.float32]:
    """Heights (r, c) of the surroundings where a patch of the surface stands off them without evidence, NaN elsewhere.

    cost : (v,) uint8; surface : (r, c) float32, level indices; level : 0 is the finest; step_cells : finest height step
    divided by the side of a finest cell.
    """
    side = max(SIDE_CELLS >> level, MIN_SIDE_CELLS) | 1
    window, wide_window = np.ones((side, side), np.uint8), np.ones((2 * side + 1, 2 * side + 1), np.uint8)
    below, above = (_filtered(surface, operation, window) for operation in (cv2.MORPH_OPEN, cv2.MORPH_CLOSE))
    sides = np.float32(2**level * step_cells)
    height, depth = (surface - below) * sides, (above - surface) * sides
    depth[(cv2.erode(above, wide_window) - surface) * sides <= MIN_BELOW_LOWEST] = 0.0
    found = np.full(surface.shape, np.nan, np.float32)
    for off, surroundings in ((height, below), (depth, above)):
        if off.max() > MIN_MEAN_OFF:
            gain = _cost_at(cost, lattice, slope_surface, surroundings, off > MIN_OFF)
            gain -= _cost_at(cost, lattice, slope_surface, surface, off > MIN_OFF)
            where = lacks_evidence(off, gain, surface * sides, level)
            found[where] = surroundings[where]
    return found


def lacks_evidence(
    off: NDArray[np.float32], gain: NDArray[np.float32], height: NDArray[np.float32], level: int = 0
) -> NDArray[np.bool_]:
    """Cells (r, c) of patches that stand off their surroundings without evidence.

    off : (r, c), sides of a finest cell by which a cell stands off; gain : (r, c), by how much its cost at the height
    of its surroundings is above that at its own height; height : (r, c), sides; level : 0 is the finest.
    """
    count, labels = cv2.connectedComponents((off > MIN_OFF).astype(np.uint8), connectivity=4)
    cells = np.bincount(labels.ravel(), minlength=count)
    mean_off, mean_gain = (np.bincount(labels.ravel(), values.ravel(), count) / cells for values in (off, gain))
    needed = np.minimum(GAIN_PER_SIDE * mean_off, MAX_GAIN) * GAIN_FACTOR_PER_LEVEL**level
    lacks = (mean_gain * np.sqrt(cells * 4.0**level / REFERENCE_CELLS) < needed) & (mean_off > MIN_MEAN_OFF)
    lacks &= joined_share(labels, height, count) < MIN_JOINED_SHARE
    lacks[0] = False
    return np.asarray(lacks[labels])


def joined_share(labels: NDArray[np.int32], height: NDArray[np.float32], count: int) -> NDArray[np.float64]:
    """Share of the border of each patch over which the surface goes on, (count,).

    labels : (r, c), number of the patch of each cell, 0 where there is none; height : (r, c), sides of a finest cell.
    """
    border, joined = np.zeros(count), np.zeros(count)
    for here, beside in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        goes_on = np.abs(height[here] - height[beside]) < MAX_STEP_OF_JOINED
        for of_patch, of_other in ((labels[here], labels[beside]), (labels[beside], labels[here])):
            is_border = (of_patch > 0) & (of_other == 0)
            border += np.bincount(of_patch[is_border], minlength=count)
            joined += np.bincount(of_patch[is_border & goes_on], minlength=count)
    return joined / np.maximum(border, 1.0)


def _filtered(surface: NDArray[np.float32], operation: int, window: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Opening or closing (r, c) of a surface, which goes on beyond the borders of the tile at its heights there."""
    side = window.shape[0]
    wide = cv2.copyMakeBorder(surface, side, side, side, side, cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(cv2.morphologyEx(wide, operation, window)[side:-side, side:-side])


def _cost_at(
    cost: NDArray[np.uint8],
    lattice: HeightLattice,
    slope_surface: SlopeSurface,
    surface: NDArray[np.float32],
    is_wanted: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Cost (r, c) above the least of each cell at the nearest height to a surface, (r, c) level indices; 0 elsewhere
    than in the cells that are wanted."""
    found = np.empty(lattice.shape, np.float32)
    write_misfit(cost, lattice.layout, np.rint(surface - slope_surface.cells).astype(np.int32), is_wanted, found)
    return found
