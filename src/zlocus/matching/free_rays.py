"""Free rays: an image that clearly sees a surface behind a cell proves that nothing stands in that ray.

The costs of pixels cannot tell this. A false height in free air, above even ground, beside a tower, or beyond the
ground that two images share, is hidden from no image, and two images may agree there by chance. But the same pixels
also show the surface behind it, and there other images agree with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.free_rays import add_ray_costs, lowest_free_ray
from zlocus.matching.slope_surface import BaseSurface
from zlocus.matching.tile_views import TileViews
from zlocus.matching.true_ortho import ortho_image
from zlocus.matching.view_directions import cells_per_step, parts_of_one_direction

# Two images agree on a cell where their correlation in a window of this many cells is larger than LEAST_NCC and their
# grey values differ by less than ALIKE, as a share of the deviation of an image's grey values.
WINDOW_CELLS = 5
LEAST_NCC, ALIKE = 0.6, 0.3
# On even ground, such as a plain roof, correlation is noise: two images agree there where both windows and the
# difference of the grey values deviate by less than this.
EVEN = 0.15
# A window whose variance is smaller has no texture to correlate (grey values in units of an image's deviation).
LEAST_VARIANCE = 1e-6
# An image clearly sees a cell where it agrees with so many others, over at least SUPPORT cells.
SUPPORTERS = 2
SUPPORT = np.ones((3, 3), np.uint8)
# An image that agrees with so many others at a cell's own height has no ray that passes below it; with many images some
# agree anywhere.
DEFENDERS, DEFENDERS_OF_MANY, MANY_VIEWS = 2, 4, 13
# Small holes between defended cells are defended too, where this many images take part.
VIEWS_TO_CLOSE = 5
CLOSED = np.ones((5, 5), np.uint8)
# Rays of two images alone say nothing: an image needs two others to be sure of what it sees.
FEWEST_VIEWS = 3
# Height steps by which a height must stand above a ray to stand in its way, and the cost of doing so for each ray, at
# the finest level and at coarser ones, where a step is higher and jumps are cheaper; and the cost at most.
MARGIN_STEPS, COARSER_MARGIN_STEPS = 8.0, 4.0
RAY_COST, COARSER_RAY_COST, MOST_RAY_COST = 12, 20, 80


@dataclass(frozen=True)
class PairAgreement:
    """With how many other images each image agrees on each cell of a surface.

    textured, even : (i, r, c) uint8, by correlation, and as even ground of the same grey value.
    """

    textured: NDArray[np.uint8]
    even: NDArray[np.uint8]

    @property
    def supported(self) -> NDArray[np.bool_]:
        """(i, r, c), cells that an image clearly sees."""
        enough = (self.textured >= SUPPORTERS).astype(np.uint8)
        return np.stack([cv2.morphologyEx(mask, cv2.MORPH_OPEN, SUPPORT) for mask in enough]) > 0

    @property
    def defended(self) -> NDArray[np.bool_]:
        """(i, r, c), cells of which an image sees the height that they have, so that no ray of its passes below."""
        n_views = len(self.textured)
        need = min(DEFENDERS if n_views < MANY_VIEWS else DEFENDERS_OF_MANY, n_views - 1)
        found = ((self.textured >= need) | (self.even >= need)).astype(np.uint8)
        if n_views >= VIEWS_TO_CLOSE:
            found = np.stack([cv2.morphologyEx(mask, cv2.MORPH_CLOSE, CLOSED) for mask in found])
        return found > 0


def pair_agreement(grey: NDArray[np.float32], covers: NDArray[np.bool_]) -> PairAgreement:
    """Count the images that agree with each image on each cell.

    grey : (i, r, c) float32, the images resampled on a surface, in units of their deviations; covers : (i, r, c), where
    an image covers that surface.
    """
    mean = np.stack([_mean(image) for image in grey])
    variance = np.stack([_mean(image * image) for image in grey]) - mean * mean
    inverse = 1.0 / np.sqrt(np.maximum(variance, np.float32(LEAST_VARIANCE)))
    is_even = (variance < np.float32(EVEN**2)) & covers
    textured, even = np.zeros(grey.shape, np.uint8), np.zeros(grey.shape, np.uint8)
    for i, j in combinations(range(len(grey)), 2):
        apart = np.abs(grey[i] - grey[j])
        ncc = (_mean(grey[i] * grey[j]) - mean[i] * mean[j]) * (inverse[i] * inverse[j])
        agree = (ncc > np.float32(LEAST_NCC)) & (apart < np.float32(ALIKE)) & covers[i] & covers[j]
        both_even = is_even[i] & is_even[j] & (apart < np.float32(EVEN))
        for view in (i, j):
            textured[view] += agree
            even[view] += both_even
    return PairAgreement(textured, even)


def agreement_on(views: TileViews, surface: NDArray[np.float32], covers: NDArray[np.bool_]) -> PairAgreement:
    """How many images agree with each other on a surface.

    views : not sheared; surface : (r, c) float32, height indices; covers : (i, r, c) bool, where a view covers it.
    """
    grey = np.stack([ortho_image(views, surface, view) for view in range(len(covers))])
    return pair_agreement(np.where(covers, grey, np.float32(0.0)), covers)


def free_rays(
    views: TileViews, surface: NDArray[np.float32], covers: NDArray[np.bool_], highest: float
) -> NDArray[np.float32]:
    """Height index (i, r, c) of the lowest ray that each view has above each cell to a surface behind it.

    Infinite where a view has no such ray, or itself sees the cell at the height that it has. highest : height index
    above which no ray matters; the other arguments: see `agreement_on`.
    """
    agreement = agreement_on(views, surface, covers)
    supported, defended = agreement.supported, agreement.defended
    rays, span = np.empty(covers.shape, np.float32), highest - float(surface.min())
    for i in range(len(covers)):
        for part in parts_of_one_direction(views, i):
            by_cell = cells_per_step(views, i, part)
            around, inside = _where_rays_come_from(part, by_cell, span, surface.shape)
            lowest = np.empty(surface[around].shape, np.float32)
            lowest_free_ray(
                np.ascontiguousarray(surface[around]), np.ascontiguousarray(supported[i][around]), *by_cell, lowest
            )
            rays[i][part] = lowest[inside]
    rays[defended] = np.inf
    return rays


def _where_rays_come_from(
    part: tuple[slice, slice], by_cell: tuple[float, float], span: float, shape: tuple[int, int]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Rows and columns of the cells that may have rays above a part of a tile, and where the part lies in them.

    by_cell : cells (columns, rows) that the point seen by a fixed pixel moves per step of height; span : steps by which
    a ray can rise before it matters no more.
    """
    around, inside = [], []
    for cells, speed, size in zip(part, by_cell[::-1], shape, strict=True):
        start, stop, _ = cells.indices(size)
        reach = math.ceil(abs(speed) * span) + 1
        first, end = max(start - (reach if speed > 0 else 1), 0), min(stop + (reach if speed < 0 else 1), size)
        around.append(slice(first, end))
        inside.append(slice(start - first, stop - first))
    return (around[0], around[1]), (inside[0], inside[1])


def add_costs_of_rays(
    cost: NDArray[np.uint8],
    views: TileViews,
    base: BaseSurface,
    lattice: HeightLattice,
    seen: NDArray[np.int32],
    height: NDArray[np.float32],
    level: int,
) -> bool:
    """Make heights that stand in free rays more expensive; whether there are such heights.

    cost : (v,) uint8, the cost volume, changed; views : of the level, not sheared; base : from which its heights are
    counted; seen : see `coverage`; height : (r, c) float32, the heights found, counted from `base`; level : 0 is the
    finest.
    """
    if len(views.layout) < FEWEST_VIEWS:
        return False
    covers = (seen[0] <= height) & (height <= seen[1])
    highest = float((lattice.first + lattice.count).max()) + float(base.cells.max())
    rays = free_rays(views, height + base.cells, covers, highest)
    if not np.isfinite(rays).any():
        return False
    margin, per_ray = (COARSER_MARGIN_STEPS, COARSER_RAY_COST) if level else (MARGIN_STEPS, RAY_COST)
    rays += np.float32(margin)
    add_ray_costs(rays, base.cells, lattice.ranges, lattice.address, lattice.block, per_ray, MOST_RAY_COST, cost)
    return True


def _mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean (r, c) of the window around every cell."""
    return np.asarray(cv2.blur(image, (WINDOW_CELLS, WINDOW_CELLS), borderType=cv2.BORDER_REFLECT))
