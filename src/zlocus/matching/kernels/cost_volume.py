"""The cost volume: every view resampled at every height of a block of cells, and how well the views agree there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.evidence import (
    Learning,
    PairWindows,
    TableAndCounts,
    add_evidence,
    cost_of_unit,
    evidence_costs,
    pair_scratch,
    put_movement,
)
from zlocus.matching.kernels.evidence_counts import count_bins, is_height_needed
from zlocus.matching.kernels.ncc import SLACK, WindowMoments, add_closeness, add_pairs, window_moments
from zlocus.matching.kernels.pairs_of_block import (
    PairsOfBlock,
    count_seeing_pairs,
    pairs_of_block,
    weights_of_covering,
    weights_with_occlusion,
)
from zlocus.matching.kernels.reference_pairs import write_best_of_reference
from zlocus.matching.kernels.resample import (
    block_grid,
    block_velocity,
    flat_cells,
    image_of,
    resample_plane,
    resample_scratch,
)
from zlocus.matching.kernels.shared_records import (
    NEVER_COVERED,
    CellBox,
    HeightSpan,
    ViewArrays,
    VisibleHeights,
)

COST_SCALE = np.float32(64.0)
# Cost of a height that fewer than two images cover: less than chance agreement costs, and more than a match.
UNCOVERED_COST = np.float32(40.0)
# Cost of a height far from all candidates of a block, at which the images are not compared: the largest.
COST_IF_FAR = np.uint8(255)
# Grey value of a view where it does not see the cell, times its number: far from every grey value, and from that of
# another view.
GREY_OF_UNSEEING_VIEW = np.float32(1e6)
# How much of a block a view sees at a height.
NOTHING, PART, WHOLE = 0, 1, 2


class CostParameters(NamedTuple):
    """Constants of the matching cost; see `zlocus.core.options.CostOptions`."""

    window_variance: np.float32  # f4: added to the variance of every window, grey values squared
    grey_weight: np.float32  # f4: weight of grey differences beside the correlation
    grey_weight_of_one_pair: np.float32  # f4: the same in blocks that only two views cover
    max_grey_difference: np.float32  # f4: grey difference at which two views do not agree at all
    occluded_pairs_excluded: np.float32  # f4: how far pairs with an occluded view are excluded from the mean
    max_images_for_large_window: int  # i8: blocks that more views cover take the smallest window only
    best_share_of_reference: np.float32  # f4: share of the pairs of the first view that count, 0: all pairs of views


class SlopeArrays(NamedTuple):
    """The slanted support surface of a tile; see `zlocus.matching.slope_surface`."""

    cells: np.ndarray  # (r,c) f4: height index of the surface in the cells and in the cells around the tile
    corners: np.ndarray  # (b,d) f8: height index at the corners of the blocks, which the nodes of the views follow


class PairWeights(NamedTuple):
    """How the pairs of views of a block count at one height."""

    of_covering: np.ndarray  # (p,) f4: weight of a pair of views where all that cover the cell see it
    of_seeing: np.ndarray  # (p,) f4: scratch; weight of a pair that sees the cell where others are occluded
    counts: np.ndarray  # (2,p) f4: how many views cover, and how many see, each cell at this height
    is_part: bool  # b1: whether a view is occluded in a cell, or does not cover it
    excluded: np.float32  # f4: how far pairs with an occluded view are left out of the mean
    of_block: PairsOfBlock  # PairsOfBlock: the pairs of the views that cover the block
    grey_weight: np.float32  # f4: weight of grey differences
    best_share_of_reference: np.float32  # f4: see `CostParameters`; 0 where the first view does not see the block
    height: np.int32  # i4: height index


class FlatVisibility(NamedTuple):
    """`VisibleHeights` of a block on flat planes. Beyond the block a view never covers."""

    lowest_covered: np.ndarray  # (i,p) i4: see `VisibleHeights`
    highest_covered: np.ndarray  # (i,p) i4: see `VisibleHeights`
    lowest_unoccluded: np.ndarray  # (i,p) i4: see `VisibleHeights`


class BlockVisibility(NamedTuple):
    """Height indices at which each view covers or sees any cell, or every cell, of a block."""

    lowest_covering_any: np.ndarray  # (i,) i4: lowest index at which the view covers any cell
    highest_covering_any: np.ndarray  # (i,) i4: highest index at which it covers any cell
    lowest_seeing_all: np.ndarray  # (i,) i4: lowest index at which it sees every cell
    highest_covering_all: np.ndarray  # (i,) i4: highest index at which it covers every cell
    lowest_seeing_any: np.ndarray  # (i,) i4: lowest index at which it sees any cell


# VisibleHeights, i8, FlatVisibility, (p,) f4 -> None
@kernel
def flat_visibility(visible, half, flat, pair_weight):
    """Write the visible heights of a block in the flat layout, and the weight 2 / (n (n - 1)) of a pair of views.

    n is the number of views that cover the cell at any height; the weight is 0 where it is less than two.
    """
    n_views, rows, cols = visible.lowest_covered.shape
    width = cols + 2 * half
    flat.lowest_covered[:] = NEVER_COVERED
    flat.highest_covered[:] = -1
    flat.lowest_unoccluded[:] = NEVER_COVERED
    pair_weight[:] = 0.0
    for i in range(n_views):
        for r in range(rows):
            for c in range(cols):
                flat.lowest_covered[i, r * width + c] = visible.lowest_covered[i, r, c]
                flat.highest_covered[i, r * width + c] = visible.highest_covered[i, r, c]
                flat.lowest_unoccluded[i, r * width + c] = visible.lowest_unoccluded[i, r, c]
        for j in range(pair_weight.shape[0]):
            pair_weight[j] += np.float32(flat.lowest_covered[i, j] <= flat.highest_covered[i, j])
    for j in range(pair_weight.shape[0]):
        usable = pair_weight[j]
        ordered = usable * (usable - np.float32(1.0))
        pair_weight[j] = np.float32(2.0) / ordered if usable > np.float32(1.5) else np.float32(0.0)


# VisibleHeights -> BlockVisibility
@kernel
def block_visibility(visible):
    """Height indices at which each view covers or sees any cell, or every cell, of a block."""
    n_views, n_rows, n_cols = visible.lowest_covered.shape
    block = BlockVisibility(
        np.empty(n_views, np.int32), np.empty(n_views, np.int32), np.empty(n_views, np.int32),
        np.empty(n_views, np.int32), np.empty(n_views, np.int32),
    )  # fmt: skip
    never, always = NEVER_COVERED, np.int32(-NEVER_COVERED)
    for i in range(n_views):
        low, high, all_from, all_to, any_from = never, always, always, never, never
        for r in range(n_rows):
            for c in range(n_cols):
                lowest, highest = visible.lowest_covered[i, r, c], visible.highest_covered[i, r, c]
                seen_from = max(lowest, visible.lowest_unoccluded[i, r, c])
                low, high = min(low, lowest), max(high, highest)
                all_from, any_from = max(all_from, seen_from), min(any_from, seen_from)
                all_to = min(all_to, highest)
        block.lowest_covering_any[i], block.highest_covering_any[i] = low, high
        block.lowest_seeing_all[i], block.highest_covering_all[i] = all_from, all_to
        block.lowest_seeing_any[i] = any_from
    return block


# BlockVisibility, i8, i4 -> i8
@kernel
def extent_at(block, view, height):
    """How much of a block a view sees at a height index: NOTHING, PART or WHOLE."""
    if block.lowest_seeing_all[view] <= height <= block.highest_covering_all[view]:
        return WHOLE
    return PART if block.lowest_seeing_any[view] <= height <= block.highest_covering_any[view] else NOTHING


# BlockVisibility, (i,) i8, i4 -> i8
@kernel
def count_whole_views(block, views, height):
    """How many of the views see the whole block at a height index."""
    n = 0
    for view in views:
        n += 1 if extent_at(block, view, height) == WHOLE else 0
    return n


# BlockVisibility, HeightSpan -> (i,) i8
@kernel
def covering_views(block, span):
    """The views that cover any cell of a block at any height that it searches."""
    views = np.empty(block.lowest_covering_any.shape[0], np.int64)
    n = 0
    for i in range(views.shape[0]):
        if block.highest_covering_any[i] >= span.first and block.lowest_covering_any[i] < span.first + span.n_heights:
            views[n] = i
            n += 1
    return views[:n]


# (r,c) f4, (2,2) f8, i8, i8, (r,c) f4 -> None
@kernel
def block_relief(surface, corners, block, half, relief):
    """Write the slanted support surface of a block, less the bilinear surface through the corners of the block.

    surface : height indices of the block's cells and of `half` cells around them. The nodes of the views follow the
    bilinear surface.
    """
    for r in range(surface.shape[0]):
        u = (r - half) / block
        left = corners[0, 0] + u * (corners[1, 0] - corners[0, 0])
        rise = corners[0, 1] + u * (corners[1, 1] - corners[0, 1]) - left
        for c in range(surface.shape[1]):
            relief[r, c] = np.float32(surface[r, c] - left - (c - half) / block * rise)


# FlatVisibility, i8, i4, i8, (p,) f4, (2,p) f4 -> None
@kernel
def mark_seen_cells(flat, view, height, n, is_seen, counts):
    """Write where a view sees the cells at a height index (1 or 0), and count it.

    counts : (2, p), how many views cover, and how many see, each cell.
    """
    low, high, visible = flat.lowest_covered[view], flat.highest_covered[view], flat.lowest_unoccluded[view]
    for j in range(n):
        covered = np.float32(low[j] <= height and height <= high[j])
        is_seen[j] = covered * np.float32(visible[j] <= height)
        counts[0, j] += covered
        counts[1, j] += is_seen[j]


# (p,) f4, i8, (w,p) f4, (p,) f4, f4 -> None
@kernel
def exclude_unseen(is_seen, n, scale, grey, grey_of_unseen):
    """Exclude a view from all pairs of the cells that it does not see."""
    for w in range(scale.shape[0]):
        unit = scale[w]
        for j in range(n):
            unit[j] *= is_seen[j]
    for j in range(n):
        grey[j] = grey[j] if is_seen[j] > np.float32(0.0) else grey_of_unseen


# (p,) f4, (p,) f4, (p,) f4, f4, i8, i8, (p,) u1 -> None
@kernel
def rounded_costs(total, pair_weight, n_covering, grey_weight, n_sizes, n, out):
    """Write the costs of a block at one height, rounded, from the sums over the pairs of views; see `block_costs`.

    pair_weight : (p,), weight of a pair of views that see the cell. Heights that fewer than two images cover cost
    UNCOVERED_COST, so that a cell whose true height lies outside the images is not matched elsewhere.
    """
    highest = COST_SCALE * (np.float32(1.0) + grey_weight)
    uncovered = UNCOVERED_COST * (np.float32(1.0) + grey_weight)
    factor = COST_SCALE / np.float32(n_sizes)
    for j in range(n):
        cost = highest - factor * total[j] * pair_weight[j]
        total[j] = (cost if n_covering[j] > np.float32(1.5) else uncovered) + np.float32(0.5)
    for j in range(n):
        out[j] = np.uint8(np.int32(min(max(total[j], np.float32(0.0)), np.float32(255.0))))


# (h,p) u1, i8, (r,d) u1 -> None
@kernel
def add_heights_last(codes, width, out):
    """Add costs that are one flat plane per height to rows of cells, each cell with all its heights."""
    count = codes.shape[0]
    for r in range(out.shape[0]):
        for c in range(out.shape[1] // count):
            for k in range(count):
                at = c * count + k
                out[r, at] = np.uint8(min(np.int32(out[r, at]) + np.int32(codes[k, r * width + c]), np.int32(255)))


# (p,) f4, i8, f4, i8, f4, i8, (p,) f4 -> None
@kernel
def subtract_centre(plane, size, centre, start, grey_factor, n, grey):
    """Subtract `centre` from the first `size` values of a plane, and write the grey values of the cells.

    grey : values of the cells themselves, which begin at `start` in the plane, times `grey_factor`; not written where
    that is 0.
    """
    for j in range(size):
        plane[j] -= centre
    if grey_factor > np.float32(0.0):
        inner = plane[start:]
        for j in range(n):
            grey[j] = inner[j] * grey_factor


# PairWindows, WindowMoments, PairScratch, PairWeights, TableAndCounts, (p,) f4, (n,) u1 -> None
@kernel
def costs_at_height(at_height, moments, scratch, weights, evidence, total, out):
    """Write the costs of the cells of a block at one height; where a table is being learned, count its bins instead.

    total : (p,), 0 at all places, changed; out : (n,).
    """
    n, n_sizes, weight = out.shape[0], at_height.windows.shape[0], weights.grey_weight
    of_pair, n_covering = weights.of_seeing if weights.is_part else weights.of_covering, weights.counts[0]
    if evidence.learning.right.shape[0] > 0:
        count_bins(at_height, moments, scratch, n, weights.height, evidence)
    elif evidence.table.log_ratios.shape[0] > 0:
        add_evidence(at_height, moments, scratch, n, weights.of_block.weights, evidence.table, total)
        if weights.is_part:
            weights.of_seeing[:n] = scratch.ratios.seen[:n]
            weights_with_occlusion(weights.of_covering, weights.excluded, n, weights.of_seeing)
        scale = cost_of_unit(evidence.table, weights.of_block.n_effective, n_sizes)
        evidence_costs(total, of_pair, n_covering, evidence.table, scale, n, out)
    elif weights.best_share_of_reference > np.float32(0.0):
        write_best_of_reference(at_height, moments, scratch, weight, weights.best_share_of_reference, n, total)
        weights.of_seeing[:n] = 1.0
        rounded_costs(total, weights.of_seeing, n_covering, weight, n_sizes, n, out)
    else:
        if weights.is_part:
            count_seeing_pairs(weights.counts[1], n, weights.of_seeing)
            weights_with_occlusion(weights.of_covering, weights.excluded, n, weights.of_seeing)
        if weight > 0.0:
            add_closeness(at_height.greys, weight * np.float32(n_sizes), n, total)
        totals = total.reshape((1, 1, total.shape[0]))
        add_pairs(at_height.planes, at_height.windows, moments, at_height.width, n, scratch.work, totals)
        rounded_costs(total, of_pair, n_covering, weight, n_sizes, n, out)


# TableAndCounts, f4, f4 -> f4
@kernel
def factor_of_greys(evidence, weight, max_difference):
    """By what grey values are multiplied before they are compared: 1 where bins are made of them, or where they have no
    weight; else so that the grey difference at which two views do not agree at all becomes the weight."""
    has_bins = evidence.table.log_ratios.shape[0] > 0 or evidence.learning.right.shape[0] > 0
    return np.float32(1.0) if has_bins or weight == np.float32(0.0) else weight / max_difference


# ViewArrays, (r,c) f4, HeightSpan, (w,) i8, VisibleHeights, CostParameters, TableAndCounts, (r,d) u1 -> None
@kernel
def block_costs(views, relief, span, windows, visible, parameters, evidence, out):
    """Add the costs of one block: 64 (1 - mean NCC over all pairs of usable views, averaged over window sizes), and
    as much, weighted, for the grey differences of the same pairs; or, with a table of `evidence`, the costs that follow
    from it. Where a table is being learned, its bins are counted, and the costs have no meaning.

    views, visible : of this block; relief : (r + 2 half, c + 2 half) float32, steps, see `block_relief`; windows : half
    widths, ascending, the last is `half`; out : (r, c * count) uint8. Views that see nothing at a height are left out.
    """
    of_block = block_visibility(visible)
    takes = covering_views(of_block, span)
    weight = parameters.grey_weight_of_one_pair if takes.shape[0] == 2 else parameters.grey_weight
    if takes.shape[0] < 2:
        out += np.uint8(UNCOVERED_COST * (np.float32(1.0) + weight))
        return
    heights, variance = views.heights, parameters.window_variance
    n_views, n_sizes, half, width = takes.shape[0], windows.shape[0], windows[-1], relief.shape[1]
    n, start, steps = visible.lowest_covered.shape[1] * width, half * (width + 1), relief.ravel()
    size, cells = steps.shape[0] + SLACK, flat_cells(relief.shape[0], width)
    planes, greys = np.zeros((n_views, size), np.float32), np.zeros((n_views, size), np.float32)
    mean, scale = np.empty((n_views, n_sizes, size), np.float32), np.empty((n_views, n_sizes, size), np.float32)
    flat, codes = empty_visibility(visible.lowest_covered.shape[0], size), np.full((span.n_heights, n), COST_IF_FAR)
    pairs, shown, total = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    counts, work, scratch = np.empty((2, size), np.float32), np.empty((4, size), np.float32), resample_scratch(size)
    flat_visibility(visible, half, flat, pairs)
    of_pairs, in_block, centre = pair_scratch(n_views, half, size, work), np.empty(n_views, np.int64), np.float32(0.0)
    pairs_compared = pairs_of_block(evidence.table.worth, takes)
    if evidence.table.log_ratios.shape[0] > 0:
        weights_of_covering(flat, takes, pairs_compared.weights, pairs)
    grey_factor = factor_of_greys(evidence, weight * np.float32(n_sizes), parameters.max_grey_difference)
    for k in range(span.n_heights):
        height, m = np.int32(span.first + k), 0
        if not is_height_needed(evidence, span, k, out):
            continue
        t, n_whole = heights[0] + height * heights[1], count_whole_views(of_block, takes, height)
        total[:n], counts[:, :n] = 0.0, n_whole
        for i in range(n_views):
            view, plane, grey = takes[i], planes[m], greys[m]
            extent = extent_at(of_block, view, height)
            if extent < WHOLE:
                mark_seen_cells(flat, view, height, n, shown, counts)
            if extent == NOTHING and i > 0:
                continue
            grid, velocity = block_grid(views, view, t, half), block_velocity(views, view, t)
            put_movement(grid, velocity, of_pairs.movement[m])
            resample_plane(image_of(views, view), grid, velocity, cells, steps, scratch, plane)
            centre = plane[start] if i == 0 else centre
            if extent == NOTHING:
                continue
            subtract_centre(plane, steps.shape[0], centre, start, grey_factor, n, grey)
            window_moments(plane, windows, width, n, variance, work, mean[m], scale[m])
            if extent < WHOLE:
                exclude_unseen(shown, n, scale[m], grey, GREY_OF_UNSEEING_VIEW * np.float32(m + 1))
            in_block[m] = i
            m += 1
        share = parameters.best_share_of_reference if m > 2 and takes[in_block[0]] == 0 else np.float32(0.0)
        excluded, is_part = parameters.occluded_pairs_excluded, n_whole < n_views
        weights = PairWeights(pairs, shown, counts, is_part, excluded, pairs_compared, weight, share, height)
        at_height = PairWindows(planes[:m], windows, greys[:m], grey_factor, width, in_block[:m], takes[in_block[:m]])
        costs_at_height(at_height, WindowMoments(mean[:m], scale[:m]), of_pairs, weights, evidence, total, codes[k])
    add_heights_last(codes, width, out)


# i8, i8 -> FlatVisibility
@kernel
def empty_visibility(n_views, size):
    """Arrays for the visibility of a block on flat planes of a size, not filled."""
    shape = (n_views, size)
    return FlatVisibility(np.empty(shape, np.int32), np.empty(shape, np.int32), np.empty(shape, np.int32))


# VisibleHeights, HeightSpan, (w,) i8, i8 -> (w,) i8
@kernel
def windows_of_block(visible, span, windows, max_views):
    """The windows of a block: all where at most `max_views` views cover it, else the smallest only.

    Many pairs of views average noise as large windows do, and small windows do not reach beyond a small crown.
    """
    return windows if covering_views(block_visibility(visible), span).shape[0] <= max_views else windows[:1]


# as VisibleHeights, sliced: VisibleHeights, CellBox -> VisibleHeights
@kernel
def visible_in(visible, box):
    """The visible heights of the cells of a rectangle."""
    r0, r1, c0, c1 = box.first_row, box.end_row, box.first_col, box.end_col
    return VisibleHeights(
        visible.lowest_covered[:, r0:r1, c0:c1], visible.highest_covered[:, r0:r1, c0:c1],
        visible.lowest_unoccluded[:, r0:r1, c0:c1],
    )  # fmt: skip


# as ViewArrays with sliced nodes: ViewArrays, i8, i8 -> ViewArrays
@kernel
def views_of_block(views, block_row, block_col):
    """The arrays of the views with the projections of one block."""
    nodes = views.nodes[:, block_row : block_row + 2, block_col : block_col + 2]
    bends = views.bends[:, block_row : block_row + 1, block_col : block_col + 1]
    return ViewArrays(views.pixels, views.layout, nodes, bends, views.heights, views.block)


# i8, i8, i8, i8, i8 -> CellBox
@kernel
def cells_of_block(block_row, block_col, block, n_rows, n_cols):
    """The cells of a block; blocks at the end of the tile may be smaller."""
    return CellBox(
        block_row * block, min((block_row + 1) * block, n_rows),
        block_col * block, min((block_col + 1) * block, n_cols),
    )  # fmt: skip


# as TableAndCounts, sliced: TableAndCounts, CellBox -> TableAndCounts
@kernel
def evidence_in(evidence, box):
    """The table, and the counts with the reference heights of the cells of a rectangle."""
    of_tile = evidence.learning
    reference = of_tile.reference[box.first_row : box.end_row, box.first_col : box.end_col]
    by_bin, by_pair = (of_tile.right, of_tile.wrong), (of_tile.right_of_pair, of_tile.wrong_of_pair)
    learning = Learning(reference, of_tile.wrong_every, *by_bin, *by_pair, of_tile.grey_roots)
    return TableAndCounts(evidence.table, learning, evidence.far_cost)


# ViewArrays, SlopeArrays, VolumeLayout, (w,) i8, VisibleHeights, CostParameters, TableAndCounts, (v,) u1 -> None
@kernel
def tile_costs(views, slope, layout, windows, visible, parameters, evidence, volume):
    """Add `block_costs` of every block of a tile. A table is learned from blocks with reference heights.

    views : whose nodes follow the slanted support surface; slope : with as many cells around the tile as the half width
    of the largest window; windows : half widths, ascending; volume : (v,) uint8, laid out as `layout` says, with
    the costs that are known before the images are compared.
    """
    n_rows, n_cols = visible.lowest_covered.shape[1], visible.lowest_covered.shape[2]
    block = views.block
    for br in range(layout.n_heights.shape[0]):
        for bc in range(layout.n_heights.shape[1]):
            box = cells_of_block(br, bc, block, n_rows, n_cols)
            span = HeightSpan(layout.first[br, bc], layout.n_heights[br, bc])
            r0, r1, c0, c1 = box.first_row, box.end_row, box.first_col, box.end_col
            evidence_of_block = evidence_in(evidence, box)
            if evidence.learning.right.shape[0] > 0 and np.isnan(evidence_of_block.learning.reference).all():
                continue
            first, length = layout.block_row_start[br, 0], layout.row_length[br, 0]
            rows = volume[first : first + (r1 - r0) * length].reshape((r1 - r0, length))
            start, of_block = layout.block_start[br, bc], visible_in(visible, box)
            sizes = windows_of_block(of_block, span, windows, parameters.max_images_for_large_window)
            half, beside = sizes[-1], windows[-1] - sizes[-1]
            relief = np.empty((r1 - r0 + 2 * half, c1 - c0 + 2 * half), np.float32)
            corners, r, c = slope.corners[br : br + 2, bc : bc + 2], r0 + beside, c0 + beside
            around = slope.cells[r : r + relief.shape[0], c : c + relief.shape[1]]
            block_relief(around, corners, block, half, relief)
            block_costs(
                views_of_block(views, br, bc), relief, span, sizes, of_block, parameters, evidence_of_block,
                rows[:, start : start + (c1 - c0) * span.n_heights],
            )  # fmt: skip
