"""Counts of the bins of evidence at right and at wrong heights, from which the table is learned."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.evidence import GREY_LIMIT, N_LIKENESS, POSITION, describe_views, write_pair_bins
from zlocus.matching.kernels.ncc import ViewPair

# Heights so many steps from the reference are wrong, nearer ones may be right.
FIRST_WRONG_STEP, LAST_WRONG_STEP = np.float32(5.0), np.float32(40.0)
RIGHT_STEPS = np.float32(3.0)


# Learning, i4 -> b1
@kernel
def counts_wrong_heights(learning, height):
    """Whether wrong heights are counted at a height index."""
    return learning.wrong_every > 0 and height % learning.wrong_every == 0


# Learning, i4 -> b1
@kernel
def is_height_needed(learning, height):
    """Whether costs or counts are made at a height index of a block.

    Where bins are counted, only heights that are right, or counted as wrong, in any of its cells are needed.
    """
    if learning.right.shape[0] == 0:
        return True
    counts_wrong = counts_wrong_heights(learning, height)
    for r in range(learning.reference.shape[0]):
        for c in range(learning.reference.shape[1]):
            away = abs(np.float32(height) - learning.reference[r, c])
            if away <= RIGHT_STEPS or (counts_wrong and FIRST_WRONG_STEP < away <= LAST_WRONG_STEP):
                return True
    return False


# PairWindows, WindowMoments, PairScratch, i8, i4, TableAndCounts -> None
@kernel
def count_bins(views, moments, scratch, n, height, evidence):
    """Count the bins of all pairs of views at one height, at right and at wrong heights of the cells of a block."""
    learning = evidence.learning
    reference, right, wrong = learning.reference, learning.right, learning.wrong
    right_of_pair, wrong_of_pair = learning.right_of_pair, learning.wrong_of_pair
    position, bins, per_factor = scratch.rows[POSITION], scratch.bins, np.float32(1.0) / views.grey_factor
    counts_wrong = counts_wrong_heights(learning, height)
    describe_views(views, scratch, n)
    rows, cols = reference.shape
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            write_pair_bins(views, ViewPair(np.uint64(a), np.uint64(b)), moments, scratch, evidence.table, n)
            first, second = views.in_tile[a], views.in_tile[b]
            for r in range(rows):
                for c in range(cols):
                    j = r * views.width + c
                    away = abs(np.float32(height) - reference[r, c])
                    if not away <= LAST_WRONG_STEP:
                        continue
                    if abs(views.greys[a, j]) > GREY_LIMIT or abs(views.greys[b, j]) > GREY_LIMIT:
                        continue
                    nearest = bins[j] + np.int32(position[j] > np.float32(0.5))
                    likeness = nearest % np.int32(N_LIKENESS)
                    if away <= RIGHT_STEPS:
                        right[nearest] += 1
                        right_of_pair[first, second, likeness] += 1
                        difference = abs(views.greys[a, j] - views.greys[b, j]) * per_factor
                        learning.grey_roots[first, second] += np.sqrt(difference)
                    elif counts_wrong and away > FIRST_WRONG_STEP:
                        wrong[nearest] += 1
                        wrong_of_pair[first, second, likeness] += 1
