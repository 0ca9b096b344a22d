"""Cells at the edge of the overlap of the images, which two views cover at wrong heights only.

Outside the overlap, rays of two views still meet, at heights that the ground does not have, and matching always finds a
height there. Two tests tell it from a surface: two views must cover the cell at the height of the ground around it, and
an object that stands off that ground must be seen alike by more images than agree by chance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow, on_cells
from zlocus.core.mask_box import box_of
from zlocus.matching.free_rays import agreement_on
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.occlusion import PAIR, covered_heights, covers, covers_at, n_seeing
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews

NEIGHBOURS = np.ones((3, 3), np.uint8)
# Cells around the overlap that are matched too.
MARGIN_CELLS = 4
# The ground rises from a cell to the next by at most this share of the distance, and half a step of height. Two views
# cover it if they cover any height within so many steps more.
MAX_SLOPE, HALF_STEP, TOLERANCE_STEPS = 1.0, 0.5, 4.0
# An object stands higher above the ground than this, in steps of the coarsest level; where the ground itself is not
# known, it may also rise by this share of the distance from known ground.
MAX_GROUND_STEPS, MAX_RISE_BY_DISTANCE = 8.0, 0.5
# Buildings and woods narrower than this are not taken for ground.
MAX_OBJECT_WIDTH_M = 50.0
# Cells are judged by the overlap only where two views could be compared at all expected heights in at least this share
# of the cells that they cover.
MIN_COMPARED_SHARE = 0.5


class ExpectedBounds(NamedTuple):
    """Lowest and highest height index at which the surface is expected in each cell, of those that were searched."""

    lowest: NDArray[np.float32]
    highest: NDArray[np.float32]


@dataclass(frozen=True)
class CoarsestHeights:
    """What the coarsest level found, as the ground around the overlap is estimated from it.

    tile_views, lattice, visible : of the level, see `LevelResult`; window : its cells; level : its number; surface :
    (r, c) float32, heights; expected : where the surface is expected in each
    cell. Heights are level indices.
    """

    tile_views: TileViews
    lattice: HeightLattice
    visible: VisibleHeights
    window: CellWindow
    level: int
    surface: NDArray[np.float32]
    expected: ExpectedBounds


@dataclass(frozen=True)
class OverlapGround:
    """The ground at the edge of the overlap of the images, as the coarsest level found it.

    window : cells of level `level`; covered : (r, c) bool, see `covered_ground`; is_at_edge : (r, c) bool, cells at
    which two views could not be compared at every expected height; is_outside : (r, c) bool, those of them at which
    they could not be compared at the height of the ground either; max_ground : (r, c) float32, height index up to which
    a height may be that of the ground. Where most cells would be at the edge, as for oblique views, none is.
    """

    window: CellWindow
    level: int
    covered: NDArray[np.bool_]
    is_at_edge: NDArray[np.bool_]
    is_outside: NDArray[np.bool_]
    max_ground: NDArray[np.float32]

    def is_uncovered_in(self, window: CellWindow) -> NDArray[np.bool_]:
        """Finest cells (r, c) of a window that two views do not cover at the height of the ground."""
        return ~on_cells(self.covered, self.window, window, self.level)

    def is_at_edge_in(self, window: CellWindow) -> NDArray[np.bool_]:
        """Finest cells (r, c) of a window that lie at the edge of the overlap."""
        return on_cells(self.is_at_edge, self.window, window, self.level)

    def needs_support(self, window: CellWindow, height: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Finest cells (r, c) of a window outside the overlap whose heights stand off the ground.

        Such a height counts only if more images support it. height : (r, c) float32, height indices of the finest
        level.
        """
        max_ground = 2**self.level * on_cells(self.max_ground, self.window, window, self.level)
        return np.asarray(on_cells(self.is_outside, self.window, window, self.level) & (height > max_ground))


def overlap_ground(coarsest: CoarsestHeights, n_steps: int, cell_size: float) -> OverlapGround:
    """Estimate the ground at the edge of the overlap from the coarsest level.

    n_steps : heights of the level's lattice; cell_size : side of a cell of the level.
    """
    cell_steps = cell_size / coarsest.lattice.height_step
    covering = heights_shown(coarsest, n_steps)
    covered = covered_ground(covering, coarsest.visible, coarsest.surface, coarsest.expected, cell_steps)
    known = compared_at_all_heights(coarsest.visible, coarsest.expected)
    window, level = coarsest.window, coarsest.level
    if known.sum() < MIN_COMPARED_SHARE * covered.sum():
        nowhere = np.zeros_like(known)
        return OverlapGround(window, level, covered, nowhere, nowhere, np.full(known.shape, np.inf, np.float32))
    nearby = ground_nearby(coarsest.surface, known, round(MAX_OBJECT_WIDTH_M / cell_size), cell_steps)
    is_outside = ~known & ~_two_cover(coarsest.visible, nearby.height, np.float32(HALF_STEP))
    max_ground = nearby.height + nearby.max_rise + np.float32(MAX_GROUND_STEPS)
    return OverlapGround(window, level, covered, ~known, is_outside, max_ground)


def unsupported(
    ground: OverlapGround,
    window: CellWindow,
    tile_views: TileViews,
    visible: VisibleHeights,
    height: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Mark the finest cells (r, c) outside the overlap that stand off the ground without support.

    window : the cells; tile_views, visible : of the finest level; height : (r, c) float32, height indices. A height is
    supported if some image agrees there with enough others. Two images agree by chance at some height in free air,
    three rarely do; where only two images see a tile, they have to agree.
    """
    doubtful = ground.needs_support(window, height)
    if not doubtful.any():
        return doubtful
    return doubtful & ~agreement_on(tile_views, height, covers_at(visible, height)).height_is_seen.any(axis=0)


def compared_at_all_heights(visible: VisibleHeights, expected: ExpectedBounds) -> NDArray[np.bool_]:
    """Cells (r, c) at which two views could be compared at every expected height. visible : heights covered there."""
    from_lowest = visible.lowest_covered <= expected.lowest + 1
    to_highest = visible.highest_covered >= expected.highest - 1
    return np.asarray((from_lowest & to_highest).sum(axis=0) >= PAIR)


class NearbyGround(NamedTuple):
    """height : (r, c) float32, height index of the ground in or nearest to every cell; max_rise : (r, c) float32, steps
    by which the ground may have risen on the way from there."""

    height: NDArray[np.float32]
    max_rise: NDArray[np.float32]


def ground_nearby(
    surface: NDArray[np.float32], known: NDArray[np.bool_], max_object_cells: int, cell_steps: float
) -> NearbyGround:
    """The ground in or nearest to every cell: the surface without objects narrower than `max_object_cells` cells.

    Objects are removed by a grey opening. surface : (r, c) float32 height indices; known : (r, c), cells whose surface
    counts, at least one; cell_steps : side of a cell in height steps.
    """
    wide = np.ones((max_object_cells | 1,) * 2, np.uint8)
    far = np.float32(np.finfo(np.float32).max)
    lowest = cv2.erode(np.where(known, cv2.medianBlur(surface, 3), far), wide, borderValue=float(far))
    opened = cv2.dilate(np.where(known, lowest, -far), wide, borderValue=-float(far))
    distance, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, np.float32)
    of_label[nearest[known]] = opened[known]
    max_rise = np.asarray(np.float32(MAX_RISE_BY_DISTANCE * cell_steps) * distance, np.float32)
    return NearbyGround(of_label[nearest], max_rise)


def heights_shown(coarsest: CoarsestHeights, n_steps: int) -> VisibleHeights:
    """Heights at which each image shows each cell, up to its last pixel.

    This covers more than `covered_heights`: windows of a coarse level need many pixels around a cell, those of the
    finest level, for which this is computed, a few. n_steps : of the lattice, all of which count.
    """
    tile_views, lattice = coarsest.tile_views, coarsest.lattice
    unusable = [~view.valid.ravel() for view in tile_views.view_pixels]
    plain_views = replace(
        tile_views, blocked=np.concatenate(unusable), has_blocked=np.array([bool(mask.any()) for mask in unusable])
    )
    whole = replace(lattice, first=np.zeros_like(lattice.first), count=np.full_like(lattice.count, n_steps))
    return covered_heights(plain_views, SlopeSurface.flat(lattice.shape, tile_views.block), whole, 0.0)


def covered_ground(
    shown: VisibleHeights,
    visible: VisibleHeights,
    surface: NDArray[np.float32],
    expected: ExpectedBounds,
    cell_steps: float,
) -> NDArray[np.bool_]:
    """Cells (r, c) that two views cover at the height of the ground around them, as far as that is known.

    The ground is followed outwards from the cells that two views cover at all expected heights, as long as two views
    cover it. Cells that cannot be reached in this way, and that no uncovered ground separates from it, count as
    covered.

    shown : heights up to the last pixel of each image, see `heights_shown`; visible : heights at which the images could
    be compared; surface : (r, c) float32, the heights found; cell_steps : side of a cell in height steps.
    """
    known = compared_at_all_heights(visible, expected)
    covered = np.asarray(covers(shown).sum(axis=0) >= PAIR)
    if not known.any() or known[covered].all():
        return covered
    rise = np.float32(HALF_STEP + MAX_SLOPE * cell_steps)
    tolerance = rise + np.float32(TOLERANCE_STEPS)
    ground = np.where(known, cv2.medianBlur(surface, 3), np.float32(0.0))
    beyond = np.zeros_like(known)
    while True:
        weight = cv2.boxFilter(known.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        ring = (weight > 0.5) & covered & ~known & ~beyond
        if not ring.any():
            break
        total = cv2.boxFilter(ground, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        beside, own = total[ring] / weight[ring], surface[ring]
        is_shown = _two_cover(shown.at(np.s_[:, ring]), beside, tolerance)
        # A cell that is no ground, or was searched at other heights only, gets the height beside it.
        is_ground = (np.abs(own - beside) <= rise) & _two_cover(visible.at(np.s_[:, ring]), beside, np.float32(0.0))
        ground[ring] = np.where(is_shown, np.where(is_ground, own, beside), 0.0)
        known[ring], beyond[ring] = is_shown, ~is_shown
    count, regions = cv2.connectedComponents((covered & ~known).astype(np.uint8), connectivity=8)
    is_beyond = np.zeros(count, np.bool_)
    is_beyond[regions[beyond]] = True
    reached = covered & ~is_beyond[regions]
    # A single cell that was cut off is as good as those on both sides of it.
    closed = cv2.morphologyEx(reached.astype(np.uint8), cv2.MORPH_CLOSE, NEIGHBOURS, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(covered & (closed > 0))


def _two_cover(visible: VisibleHeights, height: NDArray[np.float32], within: np.float32) -> NDArray[np.bool_]:
    """Whether two views cover cells at some height within `within` steps of a given one, (...). height : (...)."""
    shows = (visible.lowest_covered <= height + within) & (visible.highest_covered >= height - within)
    return np.asarray(shows.sum(axis=0) >= PAIR)


def find_overlap_window(
    visible: VisibleHeights, surface: NDArray[np.float32], ground: NDArray[np.bool_], window: CellWindow
) -> CellWindow:
    """The smallest window, with a margin, of the cells whose ground two views see as far as their level can tell.

    surface : (r, c) float32, height indices; ground : (r, c) bool, see `covered_ground`.
    """
    seeing = (n_seeing(visible, surface) >= PAIR) & ground
    if not seeing.any():
        return CellWindow(window.row, window.col, 0, 0)
    rows, cols = box_of(seeing)
    row, col = window.row + rows.start - MARGIN_CELLS, window.col + cols.start - MARGIN_CELLS
    n_rows, n_cols = rows.stop - rows.start, cols.stop - cols.start
    return CellWindow(row, col, n_rows + 2 * MARGIN_CELLS, n_cols + 2 * MARGIN_CELLS)
