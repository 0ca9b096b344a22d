"""The order in which search images are matched: what feature points nearby say of them.

Feature points carry a label per search image (`zlocus.matching.curve`). A cell takes the images in the order of the
labels accumulated over the feature points around it; where there are none, of the nearest; and where those are far, of
the whole scene. No cell is left without an order.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.curve import GOOD
from zlocus.options import SelectionOptions

if TYPE_CHECKING:
    from scipy.spatial import Delaunay, cKDTree

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# Cells looked up at a time.
CHUNK = 20000
# Labels of the nearest feature points that settle ties: as base-3 digits, as many as fit into 64 bits.
TIE_POINTS = 40
ROUNDING = 1e-9


class Evidence(IntEnum):
    """What the order of a cell rests on."""

    NEIGHBOURS = 0
    NEAREST = 1
    SCENE = 2


@dataclass(frozen=True)
class FeaturePoints:
    """Feature points with what they say of the search images.

    xy : (n, 2) float64 px, in the reference image, or on the ground in cells of the finest level; labels : (n, i)
    int8, of every search image at every point. Search images stand in the order that holds where nothing is known.
    """

    xy: FloatArray
    labels: NDArray[np.int8]


@dataclass(frozen=True)
class ImageOrder:
    """Search images of every cell, best first.

    images : (c, i) int64, indices of search images; accumulated : (c, i) int64, labels accumulated over the cell's
    feature points, in the order of the labels; evidence : (c,) uint8 `Evidence`, where SCENE says that these are all.
    """

    images: IntArray
    accumulated: IntArray
    evidence: NDArray[np.uint8]


@dataclass(frozen=True)
class Neighbours:
    """Feature points of every cell, those of one cell after those of another, by growing distance, then index.

    index : (p,) int64; start : (c + 1,) int64, where each cell's begin; evidence : (c,) uint8 `Evidence`.
    """

    index: IntArray
    start: IntArray
    evidence: NDArray[np.uint8]


def image_order(features: FeaturePoints, at: FloatArray, options: SelectionOptions) -> ImageOrder:
    """Order of the search images at cells.

    at : (c, 2) float64 px, positions of the cells, as those of the features. Images are ordered by accumulated labels;
    equals by the label at the nearest feature point, then at the next, and so on (over the nearest 40), then by the
    scene-wide order.
    Source: Ji et al. 2014, section 3.3, steps 1 and 2, and table 4. The text counts the labels that are 1, the table
    sums them with their signs: an option.
    """
    search = NeighbourSearch(features.xy, options)
    scene = scene_labels(features.labels, options)
    parts = [
        _ordered(search.of(at[first : first + CHUNK]), features.labels, scene, options)
        for first in range(0, max(len(at), 1), CHUNK)
    ]
    return ImageOrder(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("images", "accumulated", "evidence"))
    )


def scene_labels(labels: NDArray[np.int8], options: SelectionOptions) -> IntArray:
    """Labels of the search images accumulated over all feature points, (i,) int64. labels : (n, i) int8; n may be 0."""
    return np.asarray(_weights(labels, options).sum(axis=0))


def _weights(labels: NDArray[np.int8], options: SelectionOptions) -> IntArray:
    """What each label adds, (n, i) int64."""
    return (labels if options.accumulate == "sum" else labels == GOOD).astype(np.int64)


def _ordered(near: Neighbours, labels: NDArray[np.int8], scene: IntArray, options: SelectionOptions) -> ImageOrder:
    """Order of the images at cells with these neighbours. scene : (i,) int64, labels accumulated over all points."""
    # SciPy costs a third of a second, which scenes whose views are all used need not spend.
    from scipy.sparse import csr_array

    n_cells, counts = len(near.start) - 1, np.diff(near.start)
    shape = (n_cells, len(labels))
    position = np.arange(len(near.index)) - np.repeat(near.start[:-1], counts)
    digit = np.where(position < TIE_POINTS, 3 ** np.maximum(TIE_POINTS - 1 - position, 0), 0).astype(np.int64)
    accumulated, tie = (
        np.asarray(csr_array((factor, near.index, near.start), shape=shape) @ values, np.int64)
        for factor, values in (
            (np.ones_like(digit), _weights(labels, options)),
            (digit, labels.astype(np.int64)),
        )
    )
    accumulated[near.evidence == Evidence.SCENE] = scene
    last = np.broadcast_to(-scene, accumulated.shape)
    images = np.lexsort((last, -tie, -accumulated), axis=-1)
    return ImageOrder(images.astype(np.int64), accumulated, near.evidence)


class NeighbourSearch:
    """The feature points around a cell: those within a radius, or the corners of the TIN triangle that holds it.

    Without any (no point within the radius, no triangle), the nearest ones within `widest` radii; without those, none.
    Source: Ji et al. 2014, section 3.3, step 1; the paper leaves points without neighbours open.
    """

    def __init__(self, xy: FloatArray, options: SelectionOptions) -> None:
        """xy : (n, 2) float64 px, any number of feature points."""
        from scipy.spatial import cKDTree

        # Map coordinates are large, and triangulation squares them.
        self.centre = xy.mean(axis=0) if len(xy) else np.zeros(2)
        self.xy = xy - self.centre
        self.options = options
        self.tree = cKDTree(self.xy)
        self.triangles = triangulated(self.xy) if options.neighbours == "tin" else None

    def of(self, at: FloatArray) -> Neighbours:
        """Feature points of the cells at (c, 2) px."""
        at = at - self.centre
        if not len(self.xy):
            return Neighbours(
                np.zeros(0, np.int64), np.zeros(len(at) + 1, np.int64), np.full(len(at), Evidence.SCENE, np.uint8)
            )
        radius, n_nearest = self.options.radius_px, self.options.nearest
        # Infinite where there are fewer points.
        distance = np.asarray(self.tree.query(at, k=list(range(1, n_nearest + 1)))[0], np.float64)
        simplex = np.full(len(at), -1) if self.triangles is None else self.triangles.find_simplex(at)
        is_close = simplex >= 0 if self.options.neighbours == "tin" else distance[:, 0] <= radius * (1 + ROUNDING)
        widest = self.options.widest * radius
        evidence = np.where(
            is_close,
            Evidence.NEIGHBOURS,
            np.where(distance[:, 0] <= widest * (1 + ROUNDING), Evidence.NEAREST, Evidence.SCENE),
        ).astype(np.uint8)
        reach = np.where(is_close, radius, np.minimum(distance[:, -1], widest))
        cells, index = _within(self.tree, at, np.flatnonzero(simplex < 0), reach)
        if self.triangles is not None:
            held = np.flatnonzero(simplex >= 0)
            cells = np.concatenate([cells, np.repeat(held, 3)])
            index = np.concatenate([index, self.triangles.simplices[simplex[held]].ravel()])
        offset = at[cells] - self.xy[index]
        by_distance = np.lexsort((index, np.hypot(offset[:, 0], offset[:, 1]), cells))
        start = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=len(at)))])
        return Neighbours(index[by_distance].astype(np.int64), start.astype(np.int64), evidence)


def triangulated(xy: FloatArray) -> Delaunay | None:
    """Delaunay triangulation of points around the origin, (n, 2); None for fewer than three, or all on one line."""
    from scipy.spatial import Delaunay, QhullError

    if len(xy) < 3:
        return None
    try:
        return Delaunay(xy)
    except QhullError:
        return None


def _within(tree: cKDTree, at: FloatArray, cells: IntArray, reach: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of a cell and a point of the tree within the cell's reach, each (p,) int64."""
    balls = tree.query_ball_point(at[cells], reach[cells] * (1 + ROUNDING))
    counts = np.fromiter(map(len, balls), np.int64, len(cells))
    index = np.fromiter(chain.from_iterable(balls), np.int64, int(counts.sum()))
    return np.repeat(cells, counts), index


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
    """Search images worth considering for a block, best first, at most `candidates` of them. (j,) int64.

    An image is worth overlap x `closeness` to the best angle x 1/2 per `half_days`; an unknown date counts as the
    farthest known one. Images outside the limits of overlap and angle follow after all others, so that a block without
    better ones still has candidates; images that see nothing of the block, or look along the same ray as the
    reference, are none. Of equals the first.
    """
    overlap, angle = geometry.overlap, geometry.angle_deg
    known = ~np.isnan(geometry.days)
    farthest = np.abs(geometry.days[known]).max(initial=0.0)
    days = np.where(known, np.abs(geometry.days), farthest)
    worth = overlap * closeness(angle, options) * 0.5 ** (days / options.half_days)
    is_outside = (
        (overlap < options.least_overlap) | (angle < options.least_angle_deg) | (angle > options.most_angle_deg)
    )
    best_first = np.lexsort((-worth, is_outside))
    is_any = (overlap > 0) & (angle > 0)
    return best_first[is_any[best_first]][: options.candidates].astype(np.int64)
