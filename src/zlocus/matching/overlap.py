"""Cells beside the ground that views share, which two views cover at wrong heights only.

Beside that ground, rays of two views still meet at heights that the ground does not have, and something is always
found there. Two things tell it from a surface: two views must cover the cell at the height of the ground around it, and
what stands off that ground must be seen alike by more images than chance makes agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow, on_cells
from zlocus.matching.free_rays import agreement_on
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.occlusion import PAIR, coverage, covers, n_seeing
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews, ViewPixels

AROUND = np.ones((3, 3), np.uint8)
# Cells around those that are worth matching.
MARGIN = 4
# Ground rises by so much of the way to its neighbour at most, to half a step of its height; what views show is asked
# for within so many steps more.
STEEPEST, HALF_STEP, ASKED_STEPS = 1.0, 0.5, 4.0
# What stands higher above the ground than this, in steps of the coarsest level, is no ground; and above ground that
# rises by so much of the distance, where the ground itself is not known.
OFF_GROUND_STEPS, RISE_BY_DISTANCE = 8.0, 0.5
# Buildings and woods narrower than this are not taken for ground.
WIDEST_OBJECT_M = 50.0
# Border is what is left over where two views could be compared at all heights in at least this share of the cells that
# they cover.
LEAST_COMPARED = 0.5


@dataclass(frozen=True)
class BorderGround:
    """What the coarsest level knows of the ground at the borders of what views share.

    window : its cells, of level `level`; covered : (r, c) bool, see `covered_ground`; is_border : (r, c) bool, cells at
    which two views could not be compared at every height searched; is_beside : (r, c) bool, those of them at which they
    could not at the height of the ground either; highest : (r, c) float32, height index up to which a height may be
    that of the ground. Where most cells would be border, as of oblique views, none is.
    """

    window: CellWindow
    level: int
    covered: NDArray[np.bool_]
    is_border: NDArray[np.bool_]
    is_beside: NDArray[np.bool_]
    highest: NDArray[np.float32]

    def is_beyond(self, window: CellWindow) -> NDArray[np.bool_]:
        """Finest cells (r, c) of a window that two views do not cover at the height of the ground."""
        return ~on_cells(self.covered, self.window, window, self.level)

    def is_near(self, window: CellWindow) -> NDArray[np.bool_]:
        """Finest cells (r, c) of a window that are border."""
        return on_cells(self.is_border, self.window, window, self.level)

    def needs_support(self, window: CellWindow, height: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Finest cells (r, c) of a window beside the ground that stand off it: such a height needs the support of more
        images. height : (r, c) float32, height indices of the finest level."""
        highest = 2**self.level * on_cells(self.highest, self.window, window, self.level)
        return np.asarray(on_cells(self.is_beside, self.window, window, self.level) & (height > highest))


def border_ground(
    pixels: Sequence[ViewPixels],
    views: TileViews,
    lattice: HeightLattice,
    matched: NDArray[np.int32],
    surface: NDArray[np.float32],
    searched: tuple[NDArray[np.float32], NDArray[np.float32]],
    window: CellWindow,
    level: int,
    n_steps: int,
    cell_m: float,
) -> BorderGround:
    """The ground at the borders of what views share, as the coarsest level found it.

    pixels, views, lattice, n_steps : see `shown_heights`; matched, surface, searched : see `covered_ground`; window,
    level : of the cells; cell_m : side of a cell of that level.
    """
    shown = shown_heights(pixels, views, level, lattice, n_steps)
    cell_steps = cell_m / lattice.height_step
    covered = covered_ground(shown, matched, surface, searched, cell_steps)
    known = compared_at_all(matched, searched)
    if known.sum() < LEAST_COMPARED * covered.sum():
        nowhere = np.zeros_like(known)
        return BorderGround(window, level, covered, nowhere, nowhere, np.full(known.shape, np.inf, np.float32))
    ground, rise = ground_nearby(surface, known, round(WIDEST_OBJECT_M / cell_m), cell_steps)
    is_beside = ~known & ~_two_show(matched, ground, np.float32(HALF_STEP))
    return BorderGround(window, level, covered, ~known, is_beside, ground + rise + np.float32(OFF_GROUND_STEPS))


def unsupported(
    border: BorderGround,
    window: CellWindow,
    views: TileViews,
    seen: NDArray[np.int32],
    height: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Finest cells (r, c) at the border that stand off the ground and that no image sees as enough others do.

    window : of the cells; views : of the finest level; seen : (3, i, r, c) height indices, see `coverage`; height :
    (r, c) float32, the heights found. Two images agree by chance at some height in free air, three rarely do; where
    only two images see a tile, they have to agree.
    """
    doubtful = border.needs_support(window, height)
    if not doubtful.any():
        return doubtful
    covering = (seen[0] <= height) & (height <= seen[1])
    return doubtful & ~agreement_on(views, height, covering).defended.any(axis=0)


def compared_at_all(
    matched: NDArray[np.int32], searched: tuple[NDArray[np.float32], NDArray[np.float32]]
) -> NDArray[np.bool_]:
    """Cells (r, c) at which two views could be compared at every height searched. See `covered_ground`."""
    at_all = (matched[0] <= searched[0] + 1) & (matched[1] >= searched[1] - 1)
    return np.asarray(at_all.sum(axis=0) >= PAIR)


def ground_nearby(
    surface: NDArray[np.float32], known: NDArray[np.bool_], widest_object: int, cell_steps: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Height index (r, c) of the ground in or nearest to every cell, and by how much it may have risen on the way.

    The ground is the surface without what is narrower than `widest_object` cells (a grey opening). surface : (r, c)
    float32 height indices; known : (r, c), cells whose surface counts, not none; cell_steps : side of a cell in steps
    of height.
    """
    wide = np.ones((widest_object | 1,) * 2, np.uint8)
    far = np.float32(np.finfo(np.float32).max)
    lowest = cv2.erode(np.where(known, cv2.medianBlur(surface, 3), far), wide, borderValue=float(far))
    opened = cv2.dilate(np.where(known, lowest, -far), wide, borderValue=-float(far))
    distance, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, np.float32)
    of_label[nearest[known]] = opened[known]
    return of_label[nearest], np.asarray(np.float32(RISE_BY_DISTANCE * cell_steps) * distance, np.float32)


def shown_heights(
    pixels: Sequence[ViewPixels], views: TileViews, level: int, lattice: HeightLattice, n_steps: int
) -> NDArray[np.int32]:
    """(3, i, r, c) as `coverage`, but up to the last pixel of each image: windows of a coarse level need many pixels
    around a cell, those of the finest, for which this is asked, a few. views : of `level`; n_steps : of the lattice,
    all of which are asked for."""
    unusable = [~view.valid[level].ravel() for view in pixels]
    bare = replace(
        views, blocked=np.concatenate(unusable), has_blocked=np.array([bool(mask.any()) for mask in unusable])
    )
    whole = replace(lattice, first=np.zeros_like(lattice.first), count=np.full_like(lattice.count, n_steps))
    return coverage(bare, SlopeSurface.flat(lattice.shape, views.block), whole, 0.0)


def covered_ground(
    shown: NDArray[np.int32],
    matched: NDArray[np.int32],
    surface: NDArray[np.float32],
    searched: tuple[NDArray[np.float32], NDArray[np.float32]],
    cell_steps: float,
) -> NDArray[np.bool_]:
    """Cells (r, c) that two views show at the height of the ground around, as far as that is known.

    Beside the ground that views share, rays of two views still meet at heights that the ground does not have: something
    would be found there. From the cells that two views show at all heights searched, ground is followed outwards as
    long as two views show it. Cells that no such way leads to, and that are cut off by none, count as shown.

    shown : (3, i, r, c) height indices, see `shown_heights`; matched : the same as far as images could be compared
    there; surface : (r, c) indices found; searched : lowest and highest index, (r, c) each; cell_steps : side of a cell
    in steps of height.
    """
    known = compared_at_all(matched, searched)
    covered = np.asarray(covers(shown).sum(axis=0) >= PAIR)
    if not known.any() or known[covered].all():
        return covered
    rise = np.float32(HALF_STEP + STEEPEST * cell_steps)
    reach = rise + np.float32(ASKED_STEPS)
    ground = np.where(known, cv2.medianBlur(surface, 3), np.float32(0.0))
    beyond = np.zeros_like(known)
    while True:
        weight = cv2.boxFilter(known.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        ring = (weight > 0.5) & covered & ~known & ~beyond
        if not ring.any():
            break
        total = cv2.boxFilter(ground, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        beside, own = total[ring] / weight[ring], surface[ring]
        is_shown = _two_show(shown[:, :, ring], beside, reach)
        # What is no ground, or was looked for elsewhere only, counts as the height beside it.
        is_ground = (np.abs(own - beside) <= rise) & _two_show(matched[:, :, ring], beside, np.float32(0.0))
        ground[ring] = np.where(is_shown, np.where(is_ground, own, beside), 0.0)
        known[ring], beyond[ring] = is_shown, ~is_shown
    count, regions = cv2.connectedComponents((covered & ~known).astype(np.uint8), connectivity=8)
    is_beyond = np.zeros(count, np.bool_)
    is_beyond[regions[beyond]] = True
    found = covered & ~is_beyond[regions]
    # A cell that is cut off alone is as good as those on both sides of it.
    closed = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, AROUND, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(covered & (closed > 0))


def _two_show(seen: NDArray[np.int32], height: NDArray[np.float32], within: np.float32) -> NDArray[np.bool_]:
    """Whether two views see cells at some height around a given one. seen : (3, i, n); height : (n,)."""
    shows = (seen[0] <= height + within) & (seen[1] >= height - within)
    return np.asarray(shows.sum(axis=0) >= PAIR)


def worth_matching(
    seen: NDArray[np.int32], surface: NDArray[np.float32], ground: NDArray[np.bool_], window: CellWindow
) -> CellWindow:
    """The cells of a window, with a margin, whose ground two views see as far as its level can tell.

    seen : (3, i, r, c), see `coverage`; surface : (r, c) height indices; ground : (r, c), see `covered_ground`.
    """
    seeing = (n_seeing(seen, surface) >= PAIR) & ground
    rows, cols = np.flatnonzero(seeing.any(axis=1)), np.flatnonzero(seeing.any(axis=0))
    if not len(rows):
        return CellWindow(window.row, window.col, 0, 0)
    row, col = window.row + int(rows[0]) - MARGIN, window.col + int(cols[0]) - MARGIN
    return CellWindow(row, col, int(rows[-1] - rows[0]) + 1 + 2 * MARGIN, int(cols[-1] - cols[0]) + 1 + 2 * MARGIN)
