"""Choice of images: which views each block of cells is matched with.

At the tie points in and around a tile every pair of views has a label (`zlocus.matching.pair_labels`). The reference of
a block is the most nadir view that shows it and agrees with others. The other views follow in the order of their labels
around the block (`zlocus.matching.view_ranking`). How many of them a block needs is decided on the coarser level, from
match curves of a few sampled cells (`zlocus.matching.match_curve`); there few heights have to be compared. Views beyond
that number are not evaluated.

Heights are slope indices, except in the match curves of the coarser level (see `zlocus.matching.height_lattice`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.core.scene import View
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.level_records import LevelResult, PyramidLevel
from zlocus.matching.local_contrast import Part
from zlocus.matching.locus_windows import CurveSamples
from zlocus.matching.match_curve import ProgressiveMatch, SearchPlan, match_progressively
from zlocus.matching.match_scene import parallax_rate
from zlocus.matching.occlusion import covers, exclude, sees, usual_number
from zlocus.matching.pair_labels import PairLabels
from zlocus.matching.subpixel import smoothed
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_directions import cells_per_step
from zlocus.matching.view_ranking import (
    FeaturePoints,
    SearchGeometry,
    candidate_images,
    closeness,
    order_images,
    ranked_images,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# A reference image shows at least this share of a block.
MIN_SHARE_OF_REFERENCE = 0.95
# Points around the core of a tile of close cameras want so many search images: their heights are dropped.
IMAGES_OF_HALO = 3
# Numbers of views are counted in a byte.
MAX_VIEWS = 254
# Sampled cells along the side of a block.
SAMPLES_PER_SIDE = 3
# Every so many cells, along rows and columns, it is checked that enough of the chosen views cover a cell.
COVERAGE_STRIDE_CELLS = 2
# Height steps on each side of a surface over which a match curve is judged, at least.
MIN_CURVE_REACH_STEPS = 4


@dataclass(frozen=True)
class ViewOrder:
    """Order of the views of every block.

    reference : (b,) int64, the reference image; search : (b, i - 1) int64, the other views, best first; is_helpful :
    (b, i - 1) bool, whether each of them improves the match; those that do stand before the others.
    """

    reference: IntArray
    search: IntArray
    is_helpful: NDArray[np.bool_]


@dataclass(frozen=True)
class ChosenViews:
    """Visible height ranges of the views that the blocks of a level use.

    matched : of the views that a block is matched with; helpful : the same of all views that
    improve its match, for what follows; evaluations : cells x heights x images that the choice compared.
    """

    matched: VisibleHeights
    helpful: VisibleHeights
    evaluations: int = 0

    def usual_number(self, core: Part) -> float:
        """Median number of views that the cells of the core of a tile are matched with."""
        return usual_number(self.matched, core)


def choose_views(
    level: PyramidLevel,
    lattice: HeightLattice,
    visible: VisibleHeights,
    surface: NDArray[np.float32] | None,
    coarser_result: LevelResult | None,
    pair_labels: PairLabels,
    config: RunConfig,
) -> ChosenViews:
    """Choose the views of every block.

    visible : slope indices; surface : (r, c) slope indices known before, None where
    nothing is known; coarser_result : the level on which match curves decide how many views a block needs, None at the
    coarsest level, which takes `max_images` everywhere.
    """
    options = config.selection
    middles = block_middles(level.window, level.number, lattice)
    view_order = order_views(pair_labels, block_shares(visible, lattice), middles, options)
    n_all = np.full(len(view_order.reference), view_order.search.shape[1])
    n_needed, evaluations = np.minimum(n_all, options.max_images), 0
    if coarser_result is not None:
        cells, block_of_cell = sampled_cells(lattice)
        covering = covers(visible.at(np.s_[:, cells[:, 0], cells[:, 1]])).T
        curves = CoarserCurves.of(coarser_result, config)
        coarser_cells = cells_one_level_up(cells, level.window, coarser_result.level.window)
        match = images_needed(curves, coarser_cells, block_of_cell, covering, view_order, options)
        n_needed = np.where(match.n_added > 0, np.minimum(match.n_added, options.max_images), n_all)
        evaluations = match.evaluations + len(cells) * curves.n_heights
    every = slice(None, None, COVERAGE_STRIDE_CELLS)
    some = visible.at(np.s_[:, every, every])
    covered = covers(some) if surface is None else sees(some, surface[every, every])
    covered = covered.reshape(len(covered), -1)
    block_of_cell = block_of_cells(lattice, COVERAGE_STRIDE_CELLS).ravel()
    matched, helpful = (
        only_chosen(visible, chosen_views(view_order, n_search, covered, block_of_cell, options), lattice)
        for n_search in (n_needed, n_all)
    )
    return ChosenViews(matched, helpful, evaluations)


def curve_reach_steps(level: int, options: SelectionOptions) -> int:
    """Height steps of a level on each side of a surface over which its match curves are judged."""
    return max(options.reach_steps >> level, MIN_CURVE_REACH_STEPS)


def cells_one_level_up(cells: IntArray, window: CellWindow, coarser_window: CellWindow) -> IntArray:
    """Cells of the coarser level, (n, 2) rows and columns in its window, that hold cells of a level, moved inside
    it."""
    last = np.array([coarser_window.rows - 1, coarser_window.cols - 1])
    coarser_cells = (cells + np.array([window.row, window.col])) // 2
    return np.asarray(np.clip(coarser_cells - np.array([coarser_window.row, coarser_window.col]), 0, last), np.int64)


def preselected(
    views: Sequence[View],
    ground_xy: FloatArray,
    z: float,
    options: SelectionOptions,
    is_core: NDArray[np.bool_] | None = None,
    other_heights: Sequence[float] = (),
) -> list[int]:
    """Numbers of the views to read for a patch of ground, ascending: a reference image and its best candidates.

    views : in the order in which they may be the reference; ground_xy : (n, 2) m, a grid of points over the patch; z :
    m. Of a scene of hundreds of images few see the patch, and fewer are worth a comparison; see `candidate_images`.
    is_core : (n,), points of the core of a tile. Given for close cameras, each of which shows a part of the patch: not
    the patch has a number of candidates then but each of its points, see `candidates_of_points`, at z and at the
    `other_heights`, m.
    """
    xyz = np.column_stack([ground_xy, np.full(len(ground_xy), z)])
    inside = _insides(views, ground_xy, z)
    overlap = inside.mean(axis=1)
    shows_all = overlap >= MIN_SHARE_OF_REFERENCE
    reference = int(np.argmax(shows_all)) if shows_all.any() else int(overlap.argmax())
    rates = np.array([_parallax_rate_at(view, xyz[is_in], z) for view, is_in in zip(views, inside, strict=True)])
    angle = np.degrees(np.arctan(np.hypot(*(rates - rates[reference]).T)))
    days = np.array([_days_between(view, views[reference]) for view in views])
    overlap[reference] = 0.0
    search_geometry = SearchGeometry(overlap, angle, days)
    if is_core is None:
        candidates = candidate_images(search_geometry, options)
    else:
        best_first = ranked_images(search_geometry, options)
        n_wanted = np.where(is_core, options.max_images_of_point, min(options.max_images_of_point, IMAGES_OF_HALO))
        at_heights = [inside, *(_insides(views, ground_xy, height) for height in other_heights)]
        n_wanted = np.tile(n_wanted, len(at_heights))
        candidates = candidates_of_points(best_first, np.concatenate(at_heights, axis=1), n_wanted)[:MAX_VIEWS]
    return sorted([reference, *candidates.tolist()])


def candidates_of_points(best_first: IntArray, inside: NDArray[np.bool_], n_wanted: IntArray) -> IntArray:
    """The images that some point needs, best first: one of whose points are all shown by enough better ones is not.

    best_first : (j,) int64 numbers of images; inside : (i, n) bool, points that each image shows; n_wanted : (n,)
    images that each point wants.
    """
    n_showing, taken = np.zeros(inside.shape[1], np.int64), []
    for number in best_first:
        if (inside[number] & (n_showing < n_wanted)).any():
            taken.append(number)
            n_showing += inside[number]
    return np.array(taken, np.int64)


def _parallax_rate_at(view: View, xyz: FloatArray, z: float) -> FloatArray:
    """`parallax_rate` at the middle of ground points (n, 3): a wide-angle camera looks another way at every place."""
    return parallax_rate(
        view, z, view.sensor.image_from_ground(xyz.mean(axis=0, keepdims=True))[0] if len(xyz) else None
    )


def _insides(views: Sequence[View], ground_xy: FloatArray, z: float) -> NDArray[np.bool_]:
    """Which ground points (n, 2) m of a height fall inside each image, (i, n) bool."""
    xyz = np.column_stack([ground_xy, np.full(len(ground_xy), z)])
    return np.array([_inside(view, xyz) for view in views])


def _inside(view: View, xyz: FloatArray) -> NDArray[np.bool_]:
    """Which ground points (n, 3) fall inside an image, (n,) bool."""
    xy = view.sensor.image_from_ground(xyz)
    with np.errstate(invalid="ignore"):
        return np.asarray(((xy >= -0.5) & (xy < np.array(view.image.shape[::-1]) - 0.5)).all(axis=1))


def _days_between(view_a: View, view_b: View) -> float:
    """Days between the dates of two views, NaN where either is unknown."""
    if view_a.date is None or view_b.date is None:
        return np.nan
    return float(abs((view_a.date - view_b.date).days))


def order_views(
    pair_labels: PairLabels, share: FloatArray, block_xy: FloatArray, options: SelectionOptions
) -> ViewOrder:
    """Reference image and order of the other views of blocks.

    share : (i, b) float64, share of each block that each view covers, the views in the order in which they may be the
    reference; block_xy : (b, 2) float64, middles of the blocks, as `PairLabels.xy`.

    The reference is the first view that shows the whole block and whose label with some other view is above zero around
    it; far from all tie points, the labels of the whole tile count. A view whose accumulated label is below
    `min_label_share` of the best one's misleads more than it helps. The views that help come in the order of their
    angles, see `closeness`: labels rest on tens of points, and neighbouring blocks should not differ by chance.
    """
    n_views, n_blocks = share.shape
    reference = share.argmax(axis=0)
    search, is_helpful = np.zeros((n_blocks, n_views - 1), np.int64), np.zeros((n_blocks, n_views - 1), bool)
    is_open = np.ones(n_blocks, bool)
    for last_resort in (False, True):
        for view in range(n_views):
            may_lead = (reference == view) if last_resort else (share[view] >= MIN_SHARE_OF_REFERENCE)
            rows = np.flatnonzero(is_open & may_lead)
            if not len(rows):
                continue
            images, value, helps = _ordered_search_views(pair_labels, view, block_xy[rows], options)
            fits = last_resort | (value > 0) | (len(pair_labels.xy) == 0)
            rows = rows[fits]
            search[rows], is_helpful[rows] = images[fits], helps[fits]
            reference[rows], is_open[rows] = view, False
    return ViewOrder(reference, search, is_helpful)


def _ordered_search_views(
    pair_labels: PairLabels, reference: int, block_xy: FloatArray, options: SelectionOptions
) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
    """Of blocks with a reference image: the other views, best first (b, i - 1), the highest accumulated label of a
    block (b,), and which views help (b, i - 1)."""
    others = np.delete(np.arange(pair_labels.labels.shape[1]), reference)
    feature_points = FeaturePoints(pair_labels.xy, pair_labels.labels[:, reference][:, others])
    order = order_images(feature_points, block_xy, options)
    value = np.take_along_axis(order.accumulated, order.images, axis=1)
    images = others[order.images]
    helps = value >= options.min_label_share * np.maximum(value[:, :1], 0)
    if options.order == "angle":
        first = np.where(helps, closeness(pair_labels.angle_deg[reference, images], options), -1.0)
        by_angle = np.argsort(-first, axis=1, kind="stable")
        images, helps = np.take_along_axis(images, by_angle, 1), np.take_along_axis(helps, by_angle, 1)
    return images, value[:, 0], helps


def chosen_views(
    view_order: ViewOrder,
    n_search: IntArray,
    covered: NDArray[np.bool_],
    block_of_cell: IntArray,
    options: SelectionOptions,
) -> NDArray[np.bool_]:
    """The views that each block uses, (i, b) bool.

    Views are added in their order until every cell is covered by the reference and `n_search` (b,) others; views that
    do not help are added only until it is covered by `min_images`. covered : (i, n) bool, cells that each view covers;
    block_of_cell : (n,) int64.
    """
    n_blocks, cells = len(view_order.reference), np.arange(len(block_of_cell))
    chosen = np.zeros((len(covered), n_blocks), bool)
    chosen[view_order.reference, np.arange(n_blocks)] = True
    count = covered[view_order.reference[block_of_cell], cells].astype(np.int64)
    for rank in range(view_order.search.shape[1]):
        view = view_order.search[:, rank]
        n_of_unhelpful = np.minimum(n_search, options.min_images)
        wanted = 1 + np.where(view_order.is_helpful[:, rank], n_search, n_of_unhelpful)
        gains = covered[view[block_of_cell], cells]
        is_taken = np.bincount(block_of_cell[gains & (count < wanted[block_of_cell])], minlength=n_blocks) > 0
        chosen[view[is_taken], np.flatnonzero(is_taken)] = True
        count += gains & is_taken[block_of_cell]
    return chosen


def only_chosen(visible: VisibleHeights, chosen: NDArray[np.bool_], lattice: HeightLattice) -> VisibleHeights:
    """Visible height ranges without those of the views that a block does not use. chosen : (i, b) bool."""
    by_block = chosen.reshape(len(chosen), *lattice.count.shape)
    rows, cols = lattice.shape
    excluded = ~by_block.repeat(lattice.block, axis=1).repeat(lattice.block, axis=2)[:, :rows, :cols]
    of_chosen = visible.copy()
    exclude(of_chosen, excluded)
    return of_chosen


def sampled_cells(lattice: HeightLattice) -> tuple[IntArray, IntArray]:
    """Cells whose match curves decide how many views a block needs, (n, 2) int64 row and column, and the block of each
    of them, (n,)."""
    along = []
    for n in lattice.shape:
        first = np.arange(-(-n // lattice.block))[:, None] * lattice.block
        inner = ((np.arange(SAMPLES_PER_SIDE) + 0.5) * lattice.block / SAMPLES_PER_SIDE).astype(np.int64)
        along.append(np.minimum(first + inner, n - 1).ravel())
    row, col = (v.ravel() for v in np.meshgrid(*along, indexing="ij"))
    return np.stack([row, col], axis=1), row // lattice.block * lattice.count.shape[1] + col // lattice.block


@dataclass(frozen=True)
class CoarserCurves:
    """A coarser level, from which match curves are sampled along its surface.

    tile_views : of that level; visible : level indices, see `LevelResult`; surface : (r, c) float32,
    smooth level indices, which the windows follow; side : cells along the side of a window; reach : steps to both sides
    of the surface.
    """

    tile_views: TileViews
    visible: VisibleHeights
    surface: NDArray[np.float32]
    side: int
    reach: int

    @classmethod
    def of(cls, coarser_result: LevelResult, config: RunConfig) -> CoarserCurves:
        """Match curves along the heights of a level."""
        return cls(
            coarser_result.tile_views,
            coarser_result.visible,
            smoothed(coarser_result.heights.vertex, config.refine.jump_steps),
            large_window_side(config.cost),
            curve_reach_steps(coarser_result.level.number, config.selection),
        )

    @property
    def n_heights(self) -> int:
        """Heights of a match curve."""
        return 2 * self.reach + 1

    def samples(self, cells: IntArray) -> CurveSamples:
        """The match curves of cells (n, 2); cells whose windows would cross the border are moved inside."""
        half, surface = self.side // 2, self.surface
        row, col = np.clip(cells, half, np.subtract(surface.shape, half + 1)).T
        offsets = [(i, j) for i in range(-half, half + 1) for j in range(-half, half + 1)]
        around = np.stack([surface[row + i, col + j] for i, j in offsets], axis=1)
        here = surface[row, col]
        relief = np.ascontiguousarray(around - here[:, None])
        first = here.astype(np.float64) - self.reach
        return CurveSamples(np.stack([row, col], axis=1), first, self.n_heights, relief)

    def windows(self, samples: CurveSamples, view: int, rows: IntArray) -> NDArray[np.float32]:
        """Windows of one view, (m, h, k) float32, NaN where it does not show them and at heights that are occluded."""
        windows = samples.windows(self.tile_views, view, rows)
        row, col = samples.cells[rows].T
        level_index = samples.first[rows, None] + np.arange(samples.n_heights)
        windows[level_index < self.visible.lowest_unoccluded[view, row, col][:, None]] = np.nan
        return windows


def images_needed(
    curves: CoarserCurves,
    cells: IntArray,
    block_of_cell: IntArray,
    covering: NDArray[np.bool_],
    view_order: ViewOrder,
    options: SelectionOptions,
) -> ProgressiveMatch:
    """How many search views each block needs, from the match curves of sampled cells of the coarser level.

    cells : (n, 2) int64, of the coarser level; block_of_cell : (n,) the block of the finer level that each belongs to;
    covering : (n, i) bool, views that cover each cell. See `match_progressively`.
    """
    samples, n_views = curves.samples(cells), len(curves.tile_views.layout)
    reference = view_order.reference[block_of_cell]
    of_reference = np.empty((len(cells), *samples.shape), np.float32)
    for view in np.unique(reference):
        rows = np.flatnonzero(reference == view)
        of_reference[rows] = curves.windows(samples, int(view), rows)

    def correlate(which: IntArray, images: IntArray) -> NDArray[np.floating]:
        ncc = np.empty((len(which), samples.n_heights))
        for view in np.unique(images):
            rows = np.flatnonzero(images == view)
            of_view = curves.windows(samples, int(view), which[rows])
            ncc[rows] = np.einsum("nhk,nhk->nh", of_reference[which[rows]], of_view)
        return ncc

    # One column more than views stands for "no view": a view that does not help is never added.
    per_step = np.array([cells_per_step(curves.tile_views, i) for i in range(n_views)] + [(0.0, 0.0)])
    step_px = np.hypot(*np.moveaxis(per_step[view_order.reference][:, None] - per_step[None], -1, 0))
    covering = covering & np.take_along_axis(covering, reference[:, None], axis=1)
    search_plan = SearchPlan(
        order=np.where(view_order.is_helpful, view_order.search, n_views),
        block=block_of_cell,
        covered=np.concatenate([covering, np.zeros((len(cells), 1), bool)], axis=1),
        step_px=step_px,
        sample=np.ones(len(cells), bool),
        window_cells=curves.side**2,
    )
    return match_progressively(correlate, samples.n_heights, search_plan, options)


def block_shares(visible: VisibleHeights, lattice: HeightLattice) -> FloatArray:
    """Share of each block that each view covers, (i, b) float64."""
    block, covered = lattice.block, covers(visible)
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
