"""Which views each block of cells is matched with: ranked at tie points, added until their match curve is distinct.

At the tie points in and around a tile, every pair of views gets a label (`match_curve`). A block takes as its reference
the most nadir view that shows it and agrees with others. The other views follow in the order of the labels around the
block (`view_ranking`). How many of them the block takes is decided one level up, on a few sampled cells, where the
range of heights that labels need is cheap to search. Views beyond that number are not evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import SelectionOptions
from zlocus.core.scene import View
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import HIDDEN
from zlocus.matching.match_curve import ProgressiveMatch, SearchPlan, match_progressively
from zlocus.matching.match_scene import parallax_rate
from zlocus.matching.occlusion import NOTHING_HIDDEN, covers
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_directions import cells_per_step
from zlocus.matching.view_ranking import (
    FeaturePoints,
    PairLabels,
    Samples,
    SearchGeometry,
    candidate_images,
    closeness,
    order_images,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# A reference shows this share of a block.
WHOLE = 0.95
# Sampled cells along the side of a block.
SAMPLES = 3


@dataclass(frozen=True)
class ViewOrder:
    """The views of every block.

    reference : (b,) int64; search : (b, i - 1) int64, the others, best first; is_worth : (b, i - 1) bool, whether they
    help: those that do stand before those that mislead.
    """

    reference: IntArray
    search: IntArray
    is_worth: NDArray[np.bool_]


def preselected(views: Sequence[View], corners: FloatArray, z: float, options: SelectionOptions) -> list[int]:
    """Numbers of the views worth reading for a patch of ground, ascending: a reference and its `candidates`.

    views : in the order in which they may be the reference; corners : (n, 2) m, a grid of points over the patch; z : m.
    Of a scene of hundreds of images few see the patch, and fewer are worth comparing; see `candidate_images`.
    """
    xyz = np.column_stack([corners, np.full(len(corners), z)])
    inside = [_inside(view, xyz) for view in views]
    overlap = np.array([seen.mean() for seen in inside])
    reference = int(np.argmax(overlap >= WHOLE)) if (overlap >= WHOLE).any() else int(overlap.argmax())
    slant = np.array([_slant_at(view, xyz[seen], z) for view, seen in zip(views, inside, strict=True)])
    angle = np.degrees(np.arctan(np.hypot(*(slant - slant[reference]).T)))
    days = np.array([_days_between(view, views[reference]) for view in views])
    overlap[reference] = 0.0
    return sorted([reference, *candidate_images(SearchGeometry(overlap, angle, days), options).tolist()])


def _slant_at(view: View, xyz: FloatArray, z: float) -> FloatArray:
    """`parallax_rate` amid the points (n, 3) that a view sees: a wide lens looks another way at every place."""
    return parallax_rate(
        view, z, view.sensor.image_from_ground(xyz.mean(axis=0, keepdims=True))[0] if len(xyz) else None
    )


def _inside(view: View, xyz: FloatArray) -> NDArray[np.bool_]:
    """Which ground points (n, 3) fall into a view, (n,) bool."""
    xy = view.sensor.image_from_ground(xyz)
    with np.errstate(invalid="ignore"):
        return np.asarray(((xy >= -0.5) & (xy < np.array(view.image.shape[::-1]) - 0.5)).all(axis=1))


def _days_between(one: View, other: View) -> float:
    """Days between the dates of two views, NaN where either is unknown."""
    if one.date is None or other.date is None:
        return np.nan
    return float(abs((one.date - other.date).days))


def order_views(ranking: PairLabels, share: FloatArray, at: FloatArray, options: SelectionOptions) -> ViewOrder:
    """Reference and order of the other views of blocks.

    share : (i, b) float64, of each block that each view covers, the views in the order in which they may be the
    reference; at : (b, 2) float64, the blocks' middles, as `PairLabels.xy`. The reference is the first view that shows the
    whole block and has a label above zero with another view around it; far from all tie points, at those of the whole
    tile. A view whose accumulated label is below `least_worth` of the best one's misleads more than it helps. Those
    that help come in the order of their angles, see `closeness`: labels are a matter of tens of points, and
    neighbouring blocks should not differ by the luck of one.
    """
    n_views, n_blocks = share.shape
    reference = share.argmax(axis=0)
    search, is_worth = np.zeros((n_blocks, n_views - 1), np.int64), np.zeros((n_blocks, n_views - 1), bool)
    is_open = np.ones(n_blocks, bool)
    for last_resort in (False, True):
        for view in range(n_views):
            rows = np.flatnonzero(is_open & ((reference == view) if last_resort else (share[view] >= WHOLE)))
            if not len(rows):
                continue
            others = np.delete(np.arange(n_views), view)
            order = order_images(FeaturePoints(ranking.xy, ranking.labels[:, view][:, others]), at[rows], options)
            value = np.take_along_axis(order.accumulated, order.images, axis=1)
            fits = last_resort | (value[:, 0] > 0) | (len(ranking.xy) == 0)
            rows, images, value = rows[fits], others[order.images[fits]], value[fits]
            helps = value >= options.least_worth * np.maximum(value[:, :1], 0)
            if options.order == "angle":
                first = np.where(helps, closeness(ranking.angle_deg[view, images], options), -1.0)
                by_angle = np.argsort(-first, axis=1, kind="stable")
                images, helps = np.take_along_axis(images, by_angle, 1), np.take_along_axis(helps, by_angle, 1)
            search[rows], is_worth[rows], reference[rows], is_open[rows] = images, helps, view, False
    return ViewOrder(reference, search, is_worth)


def chosen_views(
    order: ViewOrder, n_search: IntArray, covered: NDArray[np.bool_], of_cell: IntArray, options: SelectionOptions
) -> NDArray[np.bool_]:
    """The views that each block takes, (i, b) bool.

    Views are taken in their order until every cell is covered by the reference and `n_search` (b,) others, those that
    mislead until it is by `least_images`. covered : (i, n) bool, cells that each view covers; of_cell : (n,) int64, the
    block of each cell.
    """
    n_blocks, cells = len(order.reference), np.arange(len(of_cell))
    chosen = np.zeros((len(covered), n_blocks), bool)
    chosen[order.reference, np.arange(n_blocks)] = True
    count = covered[order.reference[of_cell], cells].astype(np.int64)
    for rank in range(order.search.shape[1]):
        view = order.search[:, rank]
        wanted = 1 + np.where(order.is_worth[:, rank], n_search, np.minimum(n_search, options.least_images))
        gains = covered[view[of_cell], cells]
        is_taken = np.bincount(of_cell[gains & (count < wanted[of_cell])], minlength=n_blocks) > 0
        chosen[view[is_taken], np.flatnonzero(is_taken)] = True
        count += gains & is_taken[of_cell]
    return chosen


def only_chosen(seen: NDArray[np.int32], chosen: NDArray[np.bool_], lattice: HeightLattice) -> NDArray[np.int32]:
    """`seen` without the views that a block does not take. chosen : (i, b) bool."""
    by_block = chosen.reshape(len(chosen), *lattice.count.shape)
    rows, cols = lattice.shape
    left_out = ~by_block.repeat(lattice.block, axis=1).repeat(lattice.block, axis=2)[:, :rows, :cols]
    kept = seen.copy()
    kept[0][left_out], kept[1][left_out] = HIDDEN, NOTHING_HIDDEN
    return kept


def sampled_cells(lattice: HeightLattice) -> tuple[IntArray, IntArray]:
    """Cells of every block whose match curves decide, (n, 2) int64 row and column, and the block of each (n,)."""
    along = []
    for n in lattice.shape:
        first = np.arange(-(-n // lattice.block))[:, None] * lattice.block
        inner = ((np.arange(SAMPLES) + 0.5) * lattice.block / SAMPLES).astype(np.int64)
        along.append(np.minimum(first + inner, n - 1).ravel())
    row, col = (v.ravel() for v in np.meshgrid(*along, indexing="ij"))
    return np.stack([row, col], axis=1), row // lattice.block * lattice.count.shape[1] + col // lattice.block


@dataclass(frozen=True)
class Coarser:
    """A coarser level, on which match curves are looked at.

    views, seen : see `TileViews`, `coverage`; surface : (r, c) float32, smooth height indices that windows follow; side
    : cells of a window; reach : height indices to both sides of the surface.
    """

    views: TileViews
    seen: NDArray[np.int32]
    surface: NDArray[np.float32]
    side: int
    reach: int

    def samples(self, cells: IntArray) -> Samples:
        """The match curves' windows of cells (n, 2), moved off the border."""
        half, surface = self.side // 2, self.surface
        row, col = np.clip(cells, half, np.subtract(surface.shape, half + 1)).T
        offsets = [(i, j) for i in range(-half, half + 1) for j in range(-half, half + 1)]
        around = np.stack([surface[row + i, col + j] for i, j in offsets], axis=1)
        here = surface[row, col]
        relief = np.ascontiguousarray(around - here[:, None])
        return Samples(np.stack([row, col], axis=1), here.astype(np.float64) - self.reach, 2 * self.reach + 1, relief)

    def windows(self, samples: Samples, view: int, rows: IntArray) -> NDArray[np.float32]:
        """Windows of one view, NaN where it does not show them and at heights where something hides them."""
        found = samples.windows(self.views, view, rows)
        row, col = samples.cells[rows].T
        index = samples.first[rows, None] + np.arange(samples.n_heights)
        found[index < self.seen[2, view, row, col][:, None]] = np.nan
        return found


def images_needed(
    coarser: Coarser,
    cells: IntArray,
    of_block: IntArray,
    covering: NDArray[np.bool_],
    order: ViewOrder,
    options: SelectionOptions,
) -> ProgressiveMatch:
    """How many search views each block needs, from match curves of sampled cells of the coarser level.

    cells : (n, 2) int64, of the coarser level; of_block : (n,) the finer block of each; covering : (n, i) bool, views
    that cover it. See `match_progressively`.
    """
    samples, n_views = coarser.samples(cells), len(coarser.views.layout)
    reference = order.reference[of_block]
    of_reference = np.empty((len(cells), *samples.shape), np.float32)
    for view in np.unique(reference):
        rows = np.flatnonzero(reference == view)
        of_reference[rows] = coarser.windows(samples, int(view), rows)

    def measure(which: IntArray, images: IntArray) -> NDArray[np.floating]:
        ncc = np.empty((len(which), samples.n_heights))
        for view in np.unique(images):
            rows = np.flatnonzero(images == view)
            shown = coarser.windows(samples, int(view), which[rows])
            ncc[rows] = np.einsum("nhk,nhk->nh", of_reference[which[rows]], shown)
        return ncc

    per_step = np.array([cells_per_step(coarser.views, i) for i in range(n_views)] + [(0.0, 0.0)])
    base = np.hypot(*np.moveaxis(per_step[order.reference][:, None] - per_step[None], -1, 0))
    covering = covering & np.take_along_axis(covering, reference[:, None], axis=1)
    plan = SearchPlan(
        order=np.where(order.is_worth, order.search, n_views),
        block=of_block,
        seen=np.concatenate([covering, np.zeros((len(cells), 1), bool)], axis=1),
        step_px=base,
        sample=np.ones(len(cells), bool),
        window_cells=coarser.side**2,
    )
    return match_progressively(measure, samples.n_heights, plan, options)


def block_shares(seen: NDArray[np.int32], lattice: HeightLattice) -> FloatArray:
    """Share of each block that each view covers, (i, b) float64. seen : (3, i, r, c), see `coverage`."""
    block, covered = lattice.block, covers(seen)
    rows, cols = np.arange(0, lattice.shape[0], block), np.arange(0, lattice.shape[1], block)
    count = np.add.reduceat(np.add.reduceat(covered, rows, axis=1, dtype=np.int32), cols, axis=2)
    size = np.outer(np.minimum(block, lattice.shape[0] - rows), np.minimum(block, lattice.shape[1] - cols))
    return np.asarray((count / size).reshape(len(covered), -1))


def block_middles(window: CellWindow, level: int, lattice: HeightLattice) -> FloatArray:
    """Middles of the blocks, (b, 2) columns and rows of the finest level."""
    middle = [(np.arange(n) + 0.5) * lattice.block for n in lattice.count.shape]
    row, col = np.meshgrid(*middle, indexing="ij")
    return np.stack([(window.col + col.ravel()) * 2.0**level, (window.row + row.ravel()) * 2.0**level], axis=1)


def block_of_cells(lattice: HeightLattice, stride: int) -> IntArray:
    """Number of the block of every `stride`-th cell of every `stride`-th row, (r, c) int64."""
    row, col = (np.arange(0, n, stride) // lattice.block for n in lattice.shape)
    return np.asarray(row[:, None] * lattice.count.shape[1] + col, np.int64)
