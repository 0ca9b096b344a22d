"""Order of the search images of a cell, by their labels at the feature points around it.

Feature points are the tie points with labels (`zlocus.matching.pair_labels`). Before any matching, `candidate_images`
limits the number of images by their overlap, angle and date.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SelectionOptions
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_curve import GOOD

if TYPE_CHECKING:
    from scipy.spatial import Delaunay, cKDTree

IntArray = NDArray[np.int64]
# Cells whose feature points are looked up together, to limit the memory.
CELLS_PER_LOOKUP = 20000
# For this many cells the distances to all feature points are computed sooner than a tree of the points is built.
FEW_CELLS = 16
# Between images of equal accumulated labels the labels at so many nearest feature points decide: as digits of base 3
# they fit into 64 bits.
POINTS_FOR_EQUAL_IMAGES = 40
# Relative margin of distances that are compared with a radius.
ROUNDING = 1e-9


class OrderSource(IntEnum):
    """Which feature points the order of the images of a cell rests on."""

    NEIGHBOURS = 0  # those within the radius, or the corners of the TIN triangle around the cell
    NEAREST = 1  # the nearest ones, because none is within the radius
    SCENE = 2  # all feature points, because none is near


@dataclass(frozen=True)
class FeaturePoints:
    """Feature points and the labels of the search images there.

    xy : (n, 2) float64 px, in the reference image, or on the ground in cells of the finest level; labels : (n, i) int8,
    of every search image at every point. Search images stand in the order that holds where nothing is known.
    """

    xy: FloatArray
    labels: NDArray[np.int8]


@dataclass(frozen=True)
class ImageOrder:
    """Search images of every cell, best first.

    images : (c, i) int64, numbers of search images; accumulated : (c, i) int64, labels accumulated over the cell's
    feature points, in the order of `FeaturePoints.labels`; order_source : (c,) uint8 `OrderSource`.
    """

    images: IntArray
    accumulated: IntArray
    order_source: NDArray[np.uint8]


@dataclass(frozen=True)
class Neighbours:
    """Feature points of every cell, by growing distance, then by number; one cell after the other.

    index : (p,) int64, numbers of feature points; start : (c + 1,) int64, where those of each cell begin; order_source
    : (c,) uint8 `OrderSource`, where SCENE stands for all feature points.
    """

    index: IntArray
    start: IntArray
    order_source: NDArray[np.uint8]


def order_images(feature_points: FeaturePoints, xy: FloatArray, options: SelectionOptions) -> ImageOrder:
    """Order of the search images at cells.

    xy : (c, 2) float64 px, positions of the cells in the frame of the feature points. Images are ordered by accumulated
    labels. Between equal ones the label at the nearest feature point decides, then at the next, and so on (over the
    nearest `POINTS_FOR_EQUAL_IMAGES`), then the order of the whole scene.
    Source: Ji et al. 2014, section 3.3, steps 1 and 2, and table 4. The text counts the labels that are 1, the table
    sums them with their signs; `options.accumulate` chooses.
    """
    neighbour_search = NeighbourSearch(feature_points.xy, options)
    of_scene = scene_labels(feature_points.labels, options)
    parts = [
        _ordered(neighbour_search.of(xy[first : first + CELLS_PER_LOOKUP]), feature_points.labels, of_scene, options)
        for first in range(0, max(len(xy), 1), CELLS_PER_LOOKUP)
    ]
    return ImageOrder(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("images", "accumulated", "order_source"))
    )


def scene_labels(labels: NDArray[np.int8], options: SelectionOptions) -> IntArray:
    """Labels of the search images accumulated over all feature points, (i,) int64. labels : (n, i) int8; n may be 0."""
    return np.asarray(_label_values(labels, options).sum(axis=0))


def _label_values(labels: NDArray[np.int8], options: SelectionOptions) -> IntArray:
    """What each label adds to the accumulated label, (n, i) int64."""
    return (labels if options.accumulate == "sum" else labels == GOOD).astype(np.int64)


def _ordered(
    neighbours: Neighbours, labels: NDArray[np.int8], of_scene: IntArray, options: SelectionOptions
) -> ImageOrder:
    """Order of the images at cells with these neighbours. of_scene : (i,) int64, see `scene_labels`."""
    position = np.arange(len(neighbours.index)) - np.repeat(neighbours.start[:-1], np.diff(neighbours.start))
    exponent = np.maximum(POINTS_FOR_EQUAL_IMAGES - 1 - position, 0)
    digit = np.where(position < POINTS_FOR_EQUAL_IMAGES, 3**exponent, 0).astype(np.int64)
    accumulated, by_nearest = (
        _sums(neighbours, factor, values)
        for factor, values in (
            (np.ones_like(digit), _label_values(labels, options)),
            (digit, labels.astype(np.int64)),
        )
    )
    accumulated[neighbours.order_source == OrderSource.SCENE] = of_scene
    last = np.broadcast_to(-of_scene, accumulated.shape)
    images = np.lexsort((last, -by_nearest, -accumulated), axis=-1)
    return ImageOrder(images.astype(np.int64), accumulated, neighbours.order_source)


def _sums(neighbours: Neighbours, factor: IntArray, values: IntArray) -> IntArray:
    """Sums over the neighbours of each cell, (c, i) int64. factor : (p,), of each neighbour; values : (n, i)."""
    sums = np.zeros((len(neighbours.start) - 1, values.shape[1]), np.int64)
    for column, into in zip(values.T, sums.T, strict=True):
        until = np.concatenate([[0], np.cumsum(factor * column[neighbours.index])])
        into[:] = until[neighbours.start[1:]] - until[neighbours.start[:-1]]
    return sums


class NeighbourSearch:
    """The feature points around a cell: those within a radius, or the corners of the TIN triangle that holds it.

    Where there are none, the nearest ones within `max_radii` times the radius are taken; where there are none either,
    the cell has no neighbours.
    Source: Ji et al. 2014, section 3.3, step 1; the paper does not treat points without neighbours.
    """

    def __init__(self, xy: FloatArray, options: SelectionOptions) -> None:
        """xy : (n, 2) float64 px, any number of feature points."""
        # Map coordinates are large and triangulation squares them, so they are counted from their mean.
        self.centre = xy.mean(axis=0) if len(xy) else np.zeros(2)
        self.xy = xy - self.centre
        self.options = options
        self.triangles = triangulated(self.xy) if options.neighbours == "tin" else None

    def of(self, cell_xy: FloatArray) -> Neighbours:
        """Feature points of the cells at (c, 2) px."""
        cell_xy = cell_xy - self.centre
        if not len(self.xy):
            of_scene = np.full(len(cell_xy), OrderSource.SCENE, np.uint8)
            return Neighbours(np.zeros(0, np.int64), np.zeros(len(cell_xy) + 1, np.int64), of_scene)
        radius, n_nearest = self.options.radius_px, self.options.nearest
        # Infinite where there are fewer points.
        distance = self._nearest_distances(cell_xy, n_nearest)
        simplex = np.full(len(cell_xy), -1) if self.triangles is None else self.triangles.find_simplex(cell_xy)
        is_close = simplex >= 0 if self.options.neighbours == "tin" else distance[:, 0] <= radius * (1 + ROUNDING)
        max_distance = self.options.max_radii * radius
        is_near = distance[:, 0] <= max_distance * (1 + ROUNDING)
        source = np.where(is_close, OrderSource.NEIGHBOURS, np.where(is_near, OrderSource.NEAREST, OrderSource.SCENE))
        reach = np.where(is_close, radius, np.minimum(distance[:, -1], max_distance))
        cells, index = self._within(cell_xy, np.flatnonzero(simplex < 0), reach * (1 + ROUNDING))
        if self.triangles is not None:
            held = np.flatnonzero(simplex >= 0)
            cells = np.concatenate([cells, np.repeat(held, 3)])
            index = np.concatenate([index, self.triangles.simplices[simplex[held]].ravel()])
        offset = cell_xy[cells] - self.xy[index]
        by_distance = np.lexsort((index, np.hypot(offset[:, 0], offset[:, 1]), cells))
        start = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=len(cell_xy)))])
        return Neighbours(index[by_distance].astype(np.int64), start.astype(np.int64), source.astype(np.uint8))

    @cached_property
    def tree(self) -> cKDTree:
        """Tree of the feature points."""
        # SciPy takes a third of a second to import, which runs that look up a few cells only do not have to spend.
        from scipy.spatial import cKDTree

        return cKDTree(self.xy)

    def _nearest_distances(self, cell_xy: FloatArray, count: int) -> FloatArray:
        """Distances (c, count) of the nearest feature points; infinite where there are fewer points."""
        if len(cell_xy) > FEW_CELLS:
            return np.asarray(self.tree.query(cell_xy, k=list(range(1, count + 1)))[0], np.float64)
        nearest = np.full((len(cell_xy), count), np.inf)
        found = np.sort(_distances(cell_xy, self.xy), axis=1)[:, :count]
        nearest[:, : found.shape[1]] = found
        return nearest

    def _within(self, cell_xy: FloatArray, cells: IntArray, reach: FloatArray) -> tuple[IntArray, IntArray]:
        """Pairs of a cell and a feature point within the cell's reach, each (p,) int64. reach : (c,)."""
        if len(cell_xy) <= FEW_CELLS:
            rows, index = np.nonzero(_distances(cell_xy[cells], self.xy) <= reach[cells, None])
            return cells[rows], index
        balls = self.tree.query_ball_point(cell_xy[cells], reach[cells])
        counts = np.fromiter(map(len, balls), np.int64, len(cells))
        index = np.fromiter(chain.from_iterable(balls), np.int64, int(counts.sum()))
        return np.repeat(cells, counts), index


def _distances(places: FloatArray, points: FloatArray) -> FloatArray:
    """Distances (m, n) from places (m, 2) to points (n, 2)."""
    offset = places[:, None] - points
    return np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2)


def triangulated(xy: FloatArray) -> Delaunay | None:
    """Delaunay triangulation of points around the origin, (n, 2); None for fewer than three, or all on one line."""
    from scipy.spatial import Delaunay, QhullError

    if len(xy) < 3:
        return None
    try:
        return Delaunay(xy)
    except QhullError:
        return None


@dataclass(frozen=True)
class SearchGeometry:
    """What is known of the search images of a block before any matching.

    overlap : (i,) float64, share of the block that each image sees; angle_deg : (i,) float64 degrees, between the rays
    of the reference and the image at the middle of the block; days : (i,) float64, between their dates, NaN where
    either is unknown.
    """

    overlap: FloatArray
    angle_deg: FloatArray
    days: FloatArray


def closeness(angle_deg: FloatArray, options: SelectionOptions) -> FloatArray:
    """How near angles between two rays are to the best one: the smaller over the larger. Any shape, 0 to 1."""
    best = options.best_angle_deg
    return np.asarray(np.minimum(angle_deg, best) / np.maximum(angle_deg, best))


def candidate_images(geometry: SearchGeometry, options: SelectionOptions) -> IntArray:
    """Search images to be considered for a block, best first, at most `max_candidates` of them. (j,) int64.

    See `ranked_images` for their order.
    """
    return ranked_images(geometry, options)[: options.max_candidates]


def ranked_images(geometry: SearchGeometry, options: SelectionOptions) -> IntArray:
    """All search images that may be considered for a block, best first. (j,) int64.

    The value of an image is its overlap times the `closeness` of its angle times 1/2 for every `half_days` between the
    dates; an unknown date counts as the farthest known one. Images outside the limits of overlap and angle follow after
    all others, so that a block without better ones still has candidates. Images that see nothing of the block, or look
    along the same ray as the reference, are excluded. Of equal images the first comes first.
    """
    overlap, angle = geometry.overlap, geometry.angle_deg
    known = ~np.isnan(geometry.days)
    farthest = np.abs(geometry.days[known]).max(initial=0.0)
    days = np.where(known, np.abs(geometry.days), farthest)
    value = overlap * closeness(angle, options) * 0.5 ** (days / options.half_days)
    is_outside = (overlap < options.min_overlap) | (angle < options.min_angle_deg) | (angle > options.max_angle_deg)
    best_first = np.lexsort((-value, is_outside))
    is_possible = (overlap > 0) & (angle > 0)
    return best_first[is_possible[best_first]].astype(np.int64)
