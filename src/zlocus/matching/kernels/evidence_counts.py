"""Counts of the bins of evidence at right and at wrong heights, from which the table is learned."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.evidence import (
    GREY_LIMIT,
    N_LIKENESS,
    NO_COST_IS_FAR,
    POSITION,
    describe_views,
    write_pair_bins,
)
from zlocus.matching.kernels.ncc import ViewPair

# Heights so many steps from the reference are wrong, nearer ones may be right.
FIRST_WRONG_STEP, LAST_WRONG_STEP = np.float32(5.0), np.float32(40.0)
RIGHT_STEPS = np.float32(3.0)


# Learning, i4 -> b1
@kernel
def counts_wrong_heights(learning, height):
    """Whether wrong heights are counted at a height index."""
    return learning.wrong_every > 0 and height % learning.wrong_every == 0


# (r,d) u1, i8, i8, u1 -> b1
@kernel
def any_costs_less(costs, n_heights, block_step, far_cost):
    """Whether a height costs less than `far_cost` in any cell of a block, whose costs (r, c * n_heights) are given."""
    for r in range(costs.shape[0]):
        for at in range(block_step, costs.shape[1], n_heights):
            if costs[r, at] < far_cost:
                return True
    return False


# TableAndCounts, HeightSpan, i8, (r,d) u1 -> b1
@kernel
def is_height_needed(evidence, span, block_step, costs):
    """Whether costs or counts are made at a height of a block. block_step : number of the height in its search range;
    costs : known before the images are compared.

    Where bins are counted, only heights that are right, or counted as wrong, in any of its cells are needed.
    """
    learning, height = evidence.learning, np.int32(span.first + block_step)
    if learning.right.shape[0] == 0:
        is_wanted = evidence.far_cost == NO_COST_IS_FAR
        return is_wanted or any_costs_less(costs, span.n_heights, block_step, evidence.far_cost)
    counts_wrong = counts_wrong_heights(learning, height)
    for r in range(learning.reference.shape[0]):
        for c in range(learning.reference.shape[1]):
            away = abs(np.float32(height) - learning.reference[r, c])
            if away <= RIGHT_STEPS or (counts_wrong and FIRST_WRONG_STEP < away <= LAST_WRONG_STEP):
                return True
    return False


# (r,c) f4, i4, f4, f4, i8, (k,) i4 -> i8
@kernel
def put_cells_away(reference, height, above, at_most, width, cells):
    """Write the places of the cells whose reference height lies so many steps from a height index, and return how many
    they are. above, at_most : limits, steps; width : floats from a row of the flat planes to the next."""
    n = 0
    for r in range(reference.shape[0]):
        for c in range(reference.shape[1]):
            away = abs(np.float32(height) - reference[r, c])
            if above < away <= at_most:
                cells[n] = r * width + c
                n += 1
    return n


# PairWindows, ViewPair, PairScratch, (k,) i4, (e,) i8, (i,i,k) i8 -> f8
@kernel
def count_pair_bins(views, pair, scratch, cells, by_bin, by_likeness):
    """Count the bins of a pair of views in some cells, and return the sum of the roots of its grey differences there.

    by_bin, by_likeness : counts, added to.
    """
    position, bins, per_factor, roots = scratch.rows[POSITION], scratch.bins, np.float32(1.0) / views.grey_factor, 0.0
    of_a, of_b = views.greys[pair.a], views.greys[pair.b]
    of_pair = by_likeness[views.in_tile[pair.a], views.in_tile[pair.b]]
    for j in cells:
        if abs(of_a[j]) > GREY_LIMIT or abs(of_b[j]) > GREY_LIMIT:
            continue
        nearest = bins[j] + np.int32(position[j] > np.float32(0.5))
        by_bin[nearest] += 1
        of_pair[nearest % np.int32(N_LIKENESS)] += 1
        roots += np.sqrt(abs(of_a[j] - of_b[j]) * per_factor)
    return roots


# PairWindows, WindowMoments, PairScratch, i8, i4, TableAndCounts -> None
@kernel
def count_bins(views, moments, scratch, n, height, evidence):
    """Count the bins of all pairs of views at one height, at right and at wrong heights of the cells of a block."""
    learning, width = evidence.learning, views.width
    right_cells, wrong_cells = np.empty(n, np.int32), np.empty(n, np.int32)
    n_right = put_cells_away(learning.reference, height, np.float32(-1.0), RIGHT_STEPS, width, right_cells)
    n_wrong = 0
    if counts_wrong_heights(learning, height):
        first, last = FIRST_WRONG_STEP, LAST_WRONG_STEP
        n_wrong = put_cells_away(learning.reference, height, first, last, width, wrong_cells)
    right_cells, wrong_cells = right_cells[:n_right], wrong_cells[:n_wrong]
    describe_views(views, scratch, n)
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            pair = ViewPair(np.uint64(a), np.uint64(b))
            write_pair_bins(views, pair, moments, scratch, evidence.table, n)
            first, second = views.in_tile[a], views.in_tile[b]
            roots = count_pair_bins(views, pair, scratch, right_cells, learning.right, learning.right_of_pair)
            learning.grey_roots[first, second] += roots
            count_pair_bins(views, pair, scratch, wrong_cells, learning.wrong, learning.wrong_of_pair)
