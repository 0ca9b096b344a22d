"""Free rays: an image that clearly sees a surface behind a cell proves that nothing obstructs that ray.

The costs of pixels cannot tell this. A false height in free air, above untextured ground, beside a tower, or outside
the overlap of two images, is occluded from no image, and two images may agree there by chance. But the same pixels also
show the surface behind it, and there other images agree with them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.mask_box import box_of
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.free_rays import add_ray_costs, lowest_free_ray
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.local_contrast import ALL, Part
from zlocus.matching.occlusion import MANY_VIEWS, PAIR, covers_at, usual_number
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews
from zlocus.matching.true_ortho import ortho_image
from zlocus.matching.view_directions import cells_along_rays, cells_per_step, parts_of_one_direction

# Two images agree on a cell where their correlation in a window of this many cells is larger than MIN_NCC and their
# grey values differ by less than MAX_GREY_DIFFERENCE, as a share of the standard deviation of an image's grey values.
WINDOW_CELLS = 5
MIN_NCC, MAX_GREY_DIFFERENCE = 0.6, 0.3
# Where there are only two images, the surface was chosen for their agreement, so that they often agree by chance. To
# clearly see a cell they must agree better, and to keep it at its own height less well.
MIN_NCC_TO_SEE_OF_PAIR, MIN_NCC_AT_HEIGHT_OF_PAIR = 0.75, 0.5
# On ground without texture, such as a plain roof, correlation is noise. Two images agree there where the standard
# deviations of both windows and the difference of the grey values are less than this.
MAX_DEVIATION_WITHOUT_TEXTURE = 0.15
# The variance of a window is at least this in a correlation (grey values in units of an image's standard deviation).
MIN_VARIANCE = 1e-6
# An image clearly sees a cell where it agrees with so many others (of a pair: with the other), over at least the cells
# of this shape.
MIN_AGREEING_TO_SEE = 2
MIN_SEEN_SHAPE = np.ones((3, 3), np.uint8)
# An image that agrees with so many others at a cell's own height has no ray that passes below it. With many images some
# agree at any height, so that it takes this share of those that cover the cell.
MIN_AGREEING_AT_HEIGHT, MIN_SHARE_AGREEING = 2, 0.4
# Holes of this shape between such cells are closed where so many images take part.
MIN_VIEWS_TO_CLOSE = 5
CLOSED_SHAPE = np.ones((5, 5), np.uint8)
# A height must stand so many steps above a ray to obstruct it, at the finest level and at coarser ones, where a step is
# higher; and no more than so many sides of a cell of the level, because with a narrow base steps are high.
MARGIN_STEPS, COARSER_MARGIN_STEPS = 8.0, 4.0
MARGIN_SIDES, COARSER_MARGIN_SIDES = 7.2, 3.6
# The cost of obstructing a ray, at the finest level and at coarser ones, where a step is higher and jumps are cheaper,
# and the largest cost. A pair has no more than two rays, and each costs more. Where many views cover the cells, no view
# is excluded by the coarser surface, and the rays alone tell that a tower is too wide.
RAY_COST, COARSER_RAY_COST, MAX_RAY_COST = 12, 20, 80
RAY_COST_OF_PAIR = 40
RAY_COST_OF_MANY, COARSER_RAY_COST_OF_MANY, MAX_RAY_COST_OF_MANY = 20, 25, 160


@dataclass(frozen=True)
class PairAgreement:
    """Number of other images with which each image agrees on each cell of a surface.

    textured, untextured : (i, r, c) uint8, images that agree by correlation, and as ground without texture of the same
    grey value; clearly : (i, r, c) uint8, images that agree by the correlation that clearly seeing a cell needs;
    n_covering : (r, c), images that cover the cell.
    """

    textured: NDArray[np.uint8]
    clearly: NDArray[np.uint8]
    untextured: NDArray[np.uint8]
    n_covering: NDArray[np.integer]

    @property
    def clearly_seen(self) -> NDArray[np.bool_]:
        """(i, r, c), cells that an image clearly sees."""
        enough = (self.clearly >= min(MIN_AGREEING_TO_SEE, len(self.clearly) - 1)).astype(np.uint8)
        return np.stack([cv2.morphologyEx(mask, cv2.MORPH_OPEN, MIN_SEEN_SHAPE) for mask in enough]) > 0

    @property
    def height_is_seen(self) -> NDArray[np.bool_]:
        """(i, r, c), cells that an image sees at the height of the surface, so that none of its rays passes below."""
        n_views = len(self.textured)
        share = np.rint(np.float32(MIN_SHARE_AGREEING) * self.n_covering)
        need = np.minimum(np.maximum(share, MIN_AGREEING_AT_HEIGHT), n_views - 1)
        is_seen = ((self.textured >= need) | (self.untextured >= need)).astype(np.uint8)
        if n_views >= MIN_VIEWS_TO_CLOSE:
            is_seen = np.stack([cv2.morphologyEx(mask, cv2.MORPH_CLOSE, CLOSED_SHAPE) for mask in is_seen])
        return np.asarray(is_seen > 0, np.bool_)


class _BoxedImage(NamedTuple):
    """An image on a surface, only in a box around the cells that it covers: outside it agrees with no other.

    box : rows and columns; grey, mean, inverse : (m, n) float32 of the box: grey values, their means in windows, and
    the inverse of their standard deviations; is_covered, is_plain : (m, n), cells that are covered, and without
    texture.
    """

    box: Part
    grey: NDArray[np.float32]
    mean: NDArray[np.float32]
    inverse: NDArray[np.float32]
    is_covered: NDArray[np.bool_]
    is_plain: NDArray[np.bool_]

    @classmethod
    def of(cls, image: NDArray[np.float32], covers_cell: NDArray[np.bool_]) -> _BoxedImage:
        """An image in its box. image : (r, c) float32; covers_cell : (r, c), cells that it covers."""
        box = _box_around(covers_cell)
        grey, is_covered = image[box].copy(), covers_cell[box]
        if not grey.size:
            return cls(box, grey, grey, grey, is_covered, is_covered)
        mean = _mean(grey)
        variance = _mean(grey * grey) - mean * mean
        inverse = np.reciprocal(np.sqrt(np.maximum(variance, np.float32(MIN_VARIANCE))))
        is_plain = (variance < np.float32(MAX_DEVIATION_WITHOUT_TEXTURE**2)) & is_covered
        return cls(box, grey, mean, inverse, is_covered, is_plain)

    def part(self, box: Part) -> _BoxedImage:
        """The image on a part of its box. box : rows and columns of the whole surface."""
        inside = (
            slice(box[0].start - self.box[0].start, box[0].stop - self.box[0].start),
            slice(box[1].start - self.box[1].start, box[1].stop - self.box[1].start),
        )
        grey, mean, inverse = (each[inside] for each in (self.grey, self.mean, self.inverse))
        return _BoxedImage(box, grey, mean, inverse, self.is_covered[inside], self.is_plain[inside])


def pair_agreement(grey: Iterable[NDArray[np.float32]], covering: NDArray[np.bool_]) -> PairAgreement:
    """Count the images that agree with each image on each cell.

    grey : (r, c) float32 each, the images resampled on a surface, one after the other, in units of their standard
    deviations, 0 where they do not cover it; covering : (i, r, c) bool, where an image covers that surface.
    """
    images = [_BoxedImage.of(image, shows) for image, shows in zip(grey, covering, strict=True)]
    textured, clearly, untextured = (np.zeros(covering.shape, np.uint8) for _ in range(3))
    to_see, at_height = np.float32(MIN_NCC), np.float32(MIN_NCC)
    if len(images) == PAIR:
        to_see, at_height = np.float32(MIN_NCC_TO_SEE_OF_PAIR), np.float32(MIN_NCC_AT_HEIGHT_OF_PAIR)
    for i, j in combinations(range(len(images)), 2):
        box = _shared(images[i].box, images[j].box)
        if box[0].start >= box[0].stop or box[1].start >= box[1].stop:
            continue
        first, second = images[i].part(box), images[j].part(box)
        apart = np.abs(first.grey - second.grey)
        ncc = (_mean(first.grey * second.grey) - first.mean * second.mean) * (first.inverse * second.inverse)
        is_alike = first.is_covered & second.is_covered & (apart < np.float32(MAX_GREY_DIFFERENCE))
        both_plain = first.is_plain & second.is_plain & (apart < np.float32(MAX_DEVIATION_WITHOUT_TEXTURE))
        for view in (i, j):
            textured[view][box] += is_alike & (ncc > at_height)
            clearly[view][box] += is_alike & (ncc > to_see)
            untextured[view][box] += both_plain
    return PairAgreement(textured, clearly, untextured, covering.sum(axis=0, dtype=np.int32))


def _box_around(mask: NDArray[np.bool_]) -> Part:
    """Rows and columns that hold all cells of a mask (r, c) with the windows around them."""
    half = WINDOW_CELLS // 2
    if not mask.any():
        return slice(0, 0), slice(0, 0)
    rows, cols = (slice(max(along.start - half, 0), along.stop + half) for along in box_of(mask))
    return rows, cols


def _shared(box: Part, other: Part) -> Part:
    """Rows and columns that two boxes share."""
    rows, cols = (slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(box, other, strict=True))
    return rows, cols


def agreement_on(tile_views: TileViews, surface: NDArray[np.float32], covering: NDArray[np.bool_]) -> PairAgreement:
    """Number of images with which each image agrees on a surface.

    tile_views : projections of level indices; surface : (r, c) float32, level indices; covering : (i, r, c) bool, where
    a view covers it.
    """
    grey = (
        np.where(shows, ortho_image(tile_views, surface, view, shows), np.float32(0.0))
        for view, shows in enumerate(covering)
    )
    return pair_agreement(grey, covering)


def free_rays(
    tile_views: TileViews, surface: NDArray[np.float32], covering: NDArray[np.bool_], highest: float
) -> NDArray[np.float32]:
    """Height index of the lowest ray that each view has above each cell to a surface behind it, (i, r, c) float32.

    Infinite where a view has no such ray, or itself sees the cell at the height of the surface. highest : height index
    above which no ray matters; the other arguments: see `agreement_on`.
    """
    agreement = agreement_on(tile_views, surface, covering)
    clearly_seen, height_is_seen = agreement.clearly_seen, agreement.height_is_seen
    rays, span = np.empty(covering.shape, np.float32), highest - float(surface.min())
    for i in range(len(covering)):
        for part in parts_of_one_direction(tile_views, i):
            by_cell = cells_per_step(tile_views, i, part)
            around, inside = cells_along_rays(part, by_cell, span, surface.shape)
            lowest = np.empty(surface[around].shape, np.float32)
            lowest_free_ray(
                np.ascontiguousarray(surface[around]), np.ascontiguousarray(clearly_seen[i][around]), *by_cell, lowest
            )
            rays[i][part] = lowest[inside]
    rays[height_is_seen] = np.inf
    return rays


def add_costs_of_rays(
    cost: NDArray[np.uint8],
    tile_views: TileViews,
    slope_surface: SlopeSurface,
    lattice: HeightLattice,
    visible: VisibleHeights,
    height: NDArray[np.float32],
    level: int,
    step_cells: float,
) -> bool:
    """Add to the costs of heights that obstruct free rays; returns whether there are such rays.

    cost : (v,) uint8, the cost volume, changed; tile_views : projections of level indices; slope_surface : from which
    the heights of the volume are counted; visible : slope indices; height : (r, c) float32, the heights found, slope
    indices; level : 0 is the finest; step_cells : height step divided by the side of a cell, the same at all levels.
    """
    highest = float((lattice.first + lattice.count).max()) + float(slope_surface.cells.max())
    rays = free_rays(tile_views, height + slope_surface.cells, covers_at(visible, height), highest)
    if not np.isfinite(rays).any():
        return False
    rays += np.float32(margin_above_ray(level, step_cells))
    ray_cost, max_cost = costs_of_ray(level, usual_number(visible, ALL))
    add_ray_costs(rays, slope_surface.cells, lattice.layout, ray_cost, max_cost, cost)
    return True


def margin_above_ray(level: int, step_cells: float) -> float:
    """Steps by which a height must stand above a ray to obstruct it. step_cells : see `add_costs_of_rays`."""
    steps, sides = (COARSER_MARGIN_STEPS, COARSER_MARGIN_SIDES) if level else (MARGIN_STEPS, MARGIN_SIDES)
    return min(steps, sides / step_cells)


def costs_of_ray(level: int, n_covering: float) -> tuple[int, int]:
    """Cost of a height for each ray that it obstructs, and the largest cost, where so many views cover the cells."""
    if n_covering <= PAIR:
        return RAY_COST_OF_PAIR, MAX_RAY_COST
    if n_covering < MANY_VIEWS:
        return (COARSER_RAY_COST if level else RAY_COST), MAX_RAY_COST
    return (COARSER_RAY_COST_OF_MANY if level else RAY_COST_OF_MANY), MAX_RAY_COST_OF_MANY


def _mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean (r, c) of the window around every cell."""
    return np.asarray(cv2.blur(image, (WINDOW_CELLS, WINDOW_CELLS), borderType=cv2.BORDER_REFLECT))
