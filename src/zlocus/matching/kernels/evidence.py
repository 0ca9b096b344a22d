"""Evidence: what correlation, local contrast and grey difference of two views say for or against a height.

Every pair of views at every height of a cell falls into a bin of a table. The table holds the logarithm of how often
such a bin occurs at right heights, over how often it occurs at wrong heights. `zlocus.matching.evidence` learns it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.ncc import SLACK, ColumnSums, ViewPair, add_correlation, column_products

# Bins of the four features of a pair: local contrast of both windows, difference of the two contrasts, grey
# difference, and correlation, which is interpolated between bins.
N_CONTRAST, N_CONTRAST_DIFFERENCE, N_GREY, N_CORRELATION = 14, 3, 14, 20
TABLE_SHAPE = (N_CONTRAST, N_CONTRAST_DIFFERENCE, N_GREY, N_CORRELATION)
# The sum of the two contrasts, log2(variance / noise), is counted from here, one bin for a doubling.
LOWEST_CONTRAST = np.float32(-4.0)
# A variance of so many times that of the noise is added before the logarithm, so that windows without texture have a
# contrast.
CONTRAST_FLOOR = np.float32(0.25)
# Contrasts of two windows differ little, more, or much: the limits are doublings of the variance.
SOME_DIFFERENCE, LARGE_DIFFERENCE = np.float32(1.2), np.float32(2.5)
# Bins are equal steps of the square root of the grey difference, the last one begins near this root. Grey values are in
# units of the standard deviation of an image.
LARGEST_GREY_ROOT = np.float32(1.2)
# Grey values beyond this are those of views that do not see the cell.
GREY_LIMIT = np.float32(1e5)
# Heights so many steps from the reference are wrong, nearer ones may be right.
FIRST_WRONG_STEP, LAST_WRONG_STEP = np.float32(5.0), np.float32(40.0)
RIGHT_STEPS = np.float32(3.0)


class EvidenceTable(NamedTuple):
    """The table, and how costs follow from it. Without a table (no elements) the cost is that of correlation."""

    log_ratios: np.ndarray  # (e,) f4: log-likelihood ratios by bin, less their mean at wrong heights
    noise_variance: np.float32  # f4: variance of the noise of the images, grey values squared
    unit: np.float32  # f4: cost of one natural unit of mean evidence of one pair
    highest: np.float32  # f4: largest log ratio
    neutral: np.float32  # f4: log ratio of no evidence
    pair_exponent: np.float32  # f4: the mean over n pairs counts n ** pair_exponent times
    max_cost: np.float32  # f4: cost of a height without evidence for or against it, at most


class Learning(NamedTuple):
    """Counts that a table is learned from. Without counts (no elements) nothing is counted."""

    reference: np.ndarray  # (r,c) f4: height index that counts as right in each cell, NaN where no cell is counted
    right: np.ndarray  # (e,) i8: how often each bin occurs at right heights
    wrong: np.ndarray  # (e,) i8: how often at wrong heights


class TableAndCounts(NamedTuple):
    """The table of a tile, and the counts of one that is being learned; at most one of the two is in use."""

    table: EvidenceTable  # EvidenceTable: the table
    learning: Learning  # Learning: the counts


class PairScratch(NamedTuple):
    """Arrays that the pairs of a block use one after the other."""

    contrast: np.ndarray  # (i,p) f4: contrast of every view, see `log_contrasts`
    work: np.ndarray  # (4,p) f4: sums
    position: np.ndarray  # (p,) f4: position between two bins of correlation, from 0 at the lower to 1 at the higher
    bins: np.ndarray  # (p,) i4: index of the lower bin


class PairWindows(NamedTuple):
    """The views of a block at one height, on flat planes."""

    planes: np.ndarray  # (i,p) f4: grey values less that of one cell
    windows: np.ndarray  # (w,) i8: half widths of the windows, ascending
    greys: np.ndarray  # (i,p) f4: grey values of the cells, times grey_factor
    grey_factor: np.float32  # f4: see greys
    width: int  # i8: floats from a row to the next


# i8, i8, (4,p) f4 -> PairScratch
@kernel
def pair_scratch(n_views, size, work):
    """Arrays for the pairs of views of a block on flat planes of a size, not filled."""
    contrast, position = np.empty((n_views, size), np.float32), np.empty(size, np.float32)
    return PairScratch(contrast, work, position, np.empty(size, np.int32))


# (i,w,p) f4, (w,) i8, f4, i8, (i,p) f4 -> None
@kernel
def log_contrasts(scale, windows, noise_variance, n, out):
    """Write log2 of the variance of the largest window of each view over that of the noise, at the first n places.

    scale : 1 / norm of the windows, see `ncc.WindowMoments`; 0 for a window without texture.
    """
    last = windows.shape[0] - 1
    size = np.float32((2 * windows[last] + 1) ** 2)
    for view in range(scale.shape[0]):
        unit = scale[view, last]
        for j in range(n):
            square = unit[j] * unit[j] * size * noise_variance
            ratio = np.float32(1.0) / square if square > np.float32(0.0) else np.float32(0.0)
            out[view, j] = np.log2(ratio + CONTRAST_FLOOR)


# PairWindows, ViewPair, WindowMoments, PairScratch, i8 -> None
@kernel
def pair_bins(views, pair, moments, scratch, n):
    """Write the bin of a pair of views, and its position between two bins of correlation, at the first n places."""
    contrast, work, position, bins = scratch.contrast, scratch.work, scratch.position, scratch.bins
    windows, half, columns, done = views.windows, views.windows[-1], work[0], 0
    position[:n] = 0.0
    for w in range(windows.shape[0]):
        window = windows[w]
        column_products(views.planes, pair, ColumnSums(half, done, window, views.width, n + SLACK), columns)
        add_correlation(columns[half - window :], window, n, pair, w, moments, work[1], position)
        done = window
    one, zero, last = np.float32(1.0), np.float32(0.0), np.float32(N_CORRELATION - 1.001)
    per_window, to_bin = one / np.float32(windows.shape[0]), np.float32(0.5 * (N_CORRELATION - 1))
    to_grey, per_factor = np.float32(N_GREY) / LARGEST_GREY_ROOT, one / views.grey_factor
    grey_a, grey_b, contrast_a, contrast_b = (
        views.greys[pair.a],
        views.greys[pair.b],
        contrast[pair.a],
        contrast[pair.b],
    )
    for j in range(n):
        both = contrast_a[j] + contrast_b[j] - LOWEST_CONTRAST
        both = min(max(both, zero), np.float32(N_CONTRAST - 1))
        apart = abs(contrast_a[j] - contrast_b[j])
        difference = np.int32(apart >= SOME_DIFFERENCE) + np.int32(apart >= LARGE_DIFFERENCE)
        grey = min(np.sqrt(abs(grey_a[j] - grey_b[j]) * per_factor) * to_grey, np.float32(N_GREY - 1))
        place = min(max((position[j] * per_window + one) * to_bin, zero), last)
        lower = np.int32(place)
        position[j] = place - np.float32(lower)
        row = np.int32(both) * np.int32(N_CONTRAST_DIFFERENCE) + difference
        bins[j] = (row * np.int32(N_GREY) + np.int32(grey)) * np.int32(N_CORRELATION) + lower


# PairWindows, WindowMoments, PairScratch, i8, i4, TableAndCounts -> None
@kernel
def count_bins(views, moments, scratch, n, height, evidence):
    """Count the bins of all pairs of views at one height, at right and at wrong heights of the cells of a block."""
    learning = evidence.learning
    reference, right, wrong = learning.reference, learning.right, learning.wrong
    log_contrasts(moments.scale, views.windows, evidence.table.noise_variance, n, scratch.contrast)
    position, bins = scratch.position, scratch.bins
    rows, cols = reference.shape
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            pair_bins(views, ViewPair(np.uint64(a), np.uint64(b)), moments, scratch, n)
            for r in range(rows):
                for c in range(cols):
                    j = r * views.width + c
                    away = abs(np.float32(height) - reference[r, c])
                    if not away <= LAST_WRONG_STEP:
                        continue
                    if abs(views.greys[a, j]) > GREY_LIMIT or abs(views.greys[b, j]) > GREY_LIMIT:
                        continue
                    nearest = bins[j] + np.int32(position[j] > np.float32(0.5))
                    if away <= RIGHT_STEPS:
                        right[nearest] += 1
                    elif away > FIRST_WRONG_STEP:
                        wrong[nearest] += 1


# PairWindows, WindowMoments, PairScratch, i8, EvidenceTable, (p,) f4 -> None
@kernel
def add_evidence(views, moments, scratch, n, evidence, total):
    """Add the log-likelihood ratios of all pairs of views that see the cell, at the first n places."""
    table, position, bins, one = evidence.log_ratios, scratch.position, scratch.bins, np.float32(1.0)
    log_contrasts(moments.scale, views.windows, evidence.noise_variance, n, scratch.contrast)
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            pair_bins(views, ViewPair(np.uint64(a), np.uint64(b)), moments, scratch, n)
            grey_a, grey_b = views.greys[a], views.greys[b]
            for j in range(n):
                at, share = np.uint64(bins[j]), position[j]
                ratio = table[at] * (one - share) + table[at + np.uint64(1)] * share
                is_seen = abs(grey_a[j]) < GREY_LIMIT and abs(grey_b[j]) < GREY_LIMIT
                total[j] += ratio if is_seen else np.float32(0.0)


# (p,) f4, (p,) f4, (p,) f4, EvidenceTable, i8, i8, (p,) u1 -> None
@kernel
def evidence_costs(total, pair_weight, n_covering, evidence, n_views, n, out):
    """Write the costs of a block at one height, rounded, from the sums of evidence over the pairs of views.

    pair_weight : (p,), weight of a pair of views that see the cell; n_covering : (p,), views that cover the cell there;
    n_views : views that cover the block. Heights that fewer than two views cover have no evidence.
    """
    scale = evidence.unit * np.float32((n_views * (n_views - 1) / 2) ** evidence.pair_exponent)
    highest = min(scale * evidence.highest, evidence.max_cost)
    without = highest - scale * evidence.neutral
    for j in range(n):
        cost = highest - scale * total[j] * pair_weight[j]
        total[j] = (cost if n_covering[j] > np.float32(1.5) else without) + np.float32(0.5)
    for j in range(n):
        out[j] = np.uint8(np.int32(min(max(total[j], np.float32(0.0)), np.float32(255.0))))
