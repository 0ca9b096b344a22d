"""The views of a tile, ranked at the tie points in and around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.kernels.locus_windows import line_windows
from zlocus.matching.match_curve import GOOD, POOR, curve_labels
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.subpixel import smoothed
from zlocus.matching.tile_views import TileViews, ViewPixels, tile_views
from zlocus.matching.view_directions import cells_per_step

# In place of a label that there is not; becomes NULL.
NOT_RANKED = -128


@dataclass(frozen=True)
class KnownGround:
    """A surface found at a level: (r, c) float32 height indices of that level, of the cells `window`."""

    surface: NDArray[np.float32]
    level: int
    window: CellWindow


def label_pairs_at_ties(
    scene: MatchScene, pixels: list[ViewPixels], core: CellWindow, ground: KnownGround | None, config: RunConfig
) -> PairLabels:
    """Labels of the views at the tie points in and around a tile's core; windows follow the slope of the ground, where
    that is known."""
    around = math.ceil(config.selection.radius_px)
    window = core.at_level(0, around).within(scene.seen)
    side = large_window_side(config.cost)
    reach = config.selection.reach_steps * scene.step_m
    z = (scene.origin_m - reach, scene.origin_m + scene.n_steps * scene.step_m + reach)
    transform, shape = scene.transform(window, 0), (window.rows, window.cols)
    xy = (scene.ties[:, :2] - scene.anchor) * (1.0, -1.0) / scene.cell_m
    index = (scene.ties[:, 2] - scene.origin_m) / scene.step_m
    lattice, needed = (scene.origin_m, scene.step_m), _heights_of_ties(scene, xy, window, reach)
    views = tile_views(pixels, 0, transform, shape, config.pyramid.block, lattice, z, side // 2, needed)
    steps_per_cell = scene.cell_m / scene.step_m
    slope = np.zeros((len(xy), 2)) if ground is None else _slopes(ground, xy, config)
    return label_pairs(views, window, xy, index, slope, side, steps_per_cell, config.selection)


def _slopes(ground: KnownGround, xy: NDArray[np.float64], config: RunConfig) -> NDArray[np.float64]:
    """Steps a cell down and across (n, 2), which are the same at every level. xy : (n, 2) finest cells."""
    surface = smoothed(ground.surface, config.refine.jump_steps)
    cell = np.floor(xy[:, ::-1] / 2**ground.level).astype(np.int64)
    at = tuple(np.clip(cell - (ground.window.row, ground.window.col), 1, np.subtract(surface.shape, 2)).T)
    return np.stack(
        [(surface[at[0] + i, at[1] + j] - surface[at[0] - i, at[1] - j]) / 2 for i, j in ((1, 0), (0, 1))], axis=1
    )


def _heights_of_ties(
    scene: MatchScene, xy: NDArray[np.float64], window: CellWindow, reach: float
) -> tuple[float, float] | None:
    """Heights (m) of the ties within a window, widened by `reach`; None where there are none. xy : (n, 2) cells."""
    first, last = (window.col, window.row), (window.col + window.cols, window.row + window.rows)
    z = scene.ties[((xy >= first) & (xy < last)).all(axis=1), 2]
    z = z[np.isfinite(z)]
    return (float(z.min()) - reach, float(z.max()) + reach) if len(z) else None


@dataclass(frozen=True)
class LabelledTies:
    """Tie points of one tile with the labels of its images.

    xyz : (n, 3) m; labels : (n, k, k) int8, of search image (last axis) against reference; views : (k,) int64, which of
    the scene's images they are.
    """

    xyz: FloatArray
    labels: NDArray[np.int8]
    views: NDArray[np.int64]

    @classmethod
    def of(cls, ranking: PairLabels, views: Sequence[int], ties: FloatArray, kept: CellWindow) -> LabelledTies:
        """Those in a window of finest cells, so that no point of two tiles counts twice. ties : (n, 3) m, all."""
        first, size = np.array([kept.col, kept.row]), np.array([kept.cols, kept.rows])
        inside = ((ranking.xy >= first) & (ranking.xy < first + size)).all(axis=1)
        return cls(ties[ranking.tie[inside]], ranking.labels[inside], np.array(views, np.int64))

    def rows(self, n_views: int) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int32], NDArray[np.int16]]:
        """A row per point and reference: its xyz (m, 3) m, reference (m,), how many labels are good (m,), labels
        (m, n_views), `NOT_RANKED` where the image is the reference or was not compared."""
        n, k = self.labels.shape[:2]
        labels = np.full((n, k, n_views), NOT_RANKED, np.int16)
        labels[:, :, self.views] = self._of_others()
        return *self._references(), labels.reshape(n * k, n_views)

    def texts(
        self, names: Sequence[str]
    ) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int32], NDArray[np.object_]]:
        """The same for scenes of very many images: labels as NAME=LABEL of those that were compared, with commas
        between, (m,). names : of the scene's images; a comma in one becomes a blank."""
        mine = [names[number].replace(",", " ") for number in self.views]
        rows = self._of_others().reshape(-1, len(mine)).tolist()
        texts = [
            ",".join(f"{name}={label}" for name, label in zip(mine, row, strict=True) if label != NOT_RANKED)
            for row in rows
        ]
        return *self._references(), np.array(texts, dtype=object)

    def _of_others(self) -> NDArray[np.int8]:
        """Labels (n, k, k), none of an image against itself."""
        labels, itself = self.labels.copy(), np.arange(len(self.views))
        labels[:, itself, itself] = NOT_RANKED
        return labels

    def _references(self) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int32]]:
        """Of every point and reference its xyz, the reference, and how many labels are good."""
        n, k = self.labels.shape[:2]
        n_good = (self._of_others() == GOOD).sum(axis=2).astype(np.int32)
        return np.repeat(self.xyz, k, axis=0), np.tile(self.views, n), n_good.reshape(n * k)


if TYPE_CHECKING:
    from scipy.spatial import Delaunay, cKDTree

IntArray = NDArray[np.int64]
# Cells looked up at a time.
CHUNK = 20000
# Labels of the nearest feature points that settle ties: as base-3 digits, as many as fit into 64 bits.
TIE_POINTS = 40
ROUNDING = 1e-9


class OrderSource(IntEnum):
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
    feature points, in the order of the labels; order_source : (c,) uint8 `OrderSource`, where SCENE says that these are all.
    """

    images: IntArray
    accumulated: IntArray
    order_source: NDArray[np.uint8]


@dataclass(frozen=True)
class Neighbours:
    """Feature points of every cell, those of one cell after those of another, by growing distance, then index.

    index : (p,) int64; start : (c + 1,) int64, where each cell's begin; order_source : (c,) uint8 `OrderSource`.
    """

    index: IntArray
    start: IntArray
    order_source: NDArray[np.uint8]


def order_images(features: FeaturePoints, at: FloatArray, options: SelectionOptions) -> ImageOrder:
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
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("images", "accumulated", "order_source"))
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
    accumulated[near.order_source == OrderSource.SCENE] = scene
    last = np.broadcast_to(-scene, accumulated.shape)
    images = np.lexsort((last, -tie, -accumulated), axis=-1)
    return ImageOrder(images.astype(np.int64), accumulated, near.order_source)


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
                np.zeros(0, np.int64), np.zeros(len(at) + 1, np.int64), np.full(len(at), OrderSource.SCENE, np.uint8)
            )
        radius, n_nearest = self.options.radius_px, self.options.nearest
        # Infinite where there are fewer points.
        distance = np.asarray(self.tree.query(at, k=list(range(1, n_nearest + 1)))[0], np.float64)
        simplex = np.full(len(at), -1) if self.triangles is None else self.triangles.find_simplex(at)
        is_close = simplex >= 0 if self.options.neighbours == "tin" else distance[:, 0] <= radius * (1 + ROUNDING)
        widest = self.options.widest * radius
        order_source = np.where(
            is_close,
            OrderSource.NEIGHBOURS,
            np.where(distance[:, 0] <= widest * (1 + ROUNDING), OrderSource.NEAREST, OrderSource.SCENE),
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
        return Neighbours(index[by_distance].astype(np.int64), start.astype(np.int64), order_source)


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


@dataclass(frozen=True)
class PairLabels:
    """What tie points say of a tile's views.

    tie : (n,) int64, numbers of the tie points; xy : (n, 2) float64, columns and rows of the finest level's cells;
    labels : (n, i, i) int8, of every pair of views (POOR with itself); angle_deg : (i, i) float64 degrees, between
    their rays at the tile's centre; evaluations : point x height x view that were sampled.
    """

    tie: IntArray
    xy: FloatArray
    labels: NDArray[np.int8]
    angle_deg: FloatArray
    evaluations: int = 0


@dataclass(frozen=True)
class Samples:
    """Cells of a level whose match curves are looked at.

    cells : (n, 2) int64, row and column; first : (n,) float64, lowest height index; n_heights : of each; relief : (n,
    k) float32, steps by which the surface around each cell rises above it, over its window row by row.
    """

    cells: IntArray
    first: FloatArray
    n_heights: int
    relief: NDArray[np.float32]

    @property
    def shape(self) -> tuple[int, int]:
        """Heights and cells of a window."""
        return self.n_heights, self.relief.shape[1]

    def windows(self, views: TileViews, view: int, rows: IntArray | slice) -> NDArray[np.float32]:
        """Normalised windows of one view, (m, h, k) float32, NaN where it does not show them."""
        cells, first, relief = self.cells[rows], self.first[rows], self.relief[rows]
        out = np.empty((len(cells), self.n_heights, self.relief.shape[1]), np.float32)
        half = (round(self.relief.shape[1] ** 0.5) - 1) // 2
        line_windows(
            views.pixels, views.blocked, views.layout, views.nodes, views.heights, views.block, view, cells, first,
            half, relief, out,
        )  # fmt: skip
        return out


def label_pairs(
    views: TileViews, window: CellWindow, xy: FloatArray, index: FloatArray, slope: FloatArray, side: int,
    steps_per_cell: float, options: SelectionOptions,
) -> PairLabels:  # fmt: skip
    """Labels of all pairs of views at tie points.

    views : of the finest level's cells `window`; xy : (n, 2) columns and rows of the tie points on that level; index :
    (n,) float64, their height indices; slope : (n, 2) of the ground there, steps a cell down and across; side : cells
    of the correlation window; steps_per_cell : side of a cell in height steps. Of each square of `feature_cells` cells
    the northernmost point counts.
    """
    square = np.floor(xy / options.feature_cells).astype(np.int64)
    inside = ((xy >= (window.col, window.row)) & (xy < (window.col + window.cols, window.row + window.rows))).all(
        axis=1
    )
    candidates = np.flatnonzero(inside & np.isfinite(index))
    candidates = candidates[np.lexsort((xy[candidates, 0], xy[candidates, 1]))]
    _, of_square = np.unique(square[candidates], axis=0, return_index=True)
    rows = candidates[np.sort(of_square)]
    cells = np.floor(xy[rows][:, ::-1]).astype(np.int64) - (window.row, window.col)
    offsets = np.stack([v.ravel() for v in np.indices((side, side)) - side // 2]).astype(float)
    samples = Samples(
        np.ascontiguousarray(cells), index[rows] - options.reach_steps, 2 * options.reach_steps + 1,
        np.ascontiguousarray(slope[rows] @ offsets, np.float32),
    )  # fmt: skip
    n_views = len(views.layout)
    labels = np.full((len(rows), n_views, n_views), POOR, np.int8)
    seen = [samples.windows(views, i, slice(None)) for i in range(n_views)]
    per_step = np.array([cells_per_step(views, i) for i in range(n_views)])
    apart = np.hypot(*np.moveaxis(per_step[:, None] - per_step[None], -1, 0))
    for i in range(n_views):
        for j in range(i):
            curves = np.einsum("nhk,nhk->nh", seen[i], seen[j])
            labels[:, i, j] = labels[:, j, i] = curve_labels(curves, float(apart[i, j]), options)
    angle_deg = np.degrees(np.arctan(apart * steps_per_cell))
    return PairLabels(rows, xy[rows], labels, angle_deg, len(rows) * n_views * samples.n_heights)
