"""Evidence: what likeness, local contrast and grey difference of two views say for or against a height.

Every pair of views at every height of a cell falls into a bin of a table. The table holds the logarithm of how often
such a bin occurs at right heights, over how often it occurs at wrong heights. `zlocus.matching.evidence` learns it.

Likeness is the mean of two measures: the correlation of the windows, and their census (Zabih, Woodfill 1994), that is
how many of a cell's neighbours are brighter than the cell in both views, or in neither. Correlation finds roofs of
little texture. The census compares everything with the cell itself, so that it tells the rim of a tree or a roof from
the ground beside it.

Contrast counts only along the direction in which the two views move against each other when the height changes. The
edge of a road along that direction has much contrast and looks alike at all heights, or at wrong ones where the lines
of an image are displaced.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.ncc import SLACK, ColumnSums, ViewPair, add_correlation, column_products

# Bins of the four features of a pair: local contrast of both windows, difference of the two contrasts, grey
# difference, and likeness, which is interpolated between bins.
N_CONTRAST, N_CONTRAST_DIFFERENCE, N_GREY, N_LIKENESS = 14, 3, 14, 20
TABLE_SHAPE = (N_CONTRAST, N_CONTRAST_DIFFERENCE, N_GREY, N_LIKENESS)
# The part of the correlation in the likeness; the rest is that of the census.
CORRELATION_SHARE = np.float32(0.35)
# The sum of the two contrasts, log2(mean squared grey difference / that of noise), is counted from here, one bin for a
# doubling.
LOWEST_CONTRAST = np.float32(-4.0)
# So many times the squared difference of noise is added before the logarithm, so that windows without texture have a
# contrast.
CONTRAST_FLOOR = np.float32(0.25)
# The difference of two cells, two cells apart, has so many times the variance of the noise of one.
NOISE_OF_DIFFERENCE = np.float32(2.0)
# The bits of a float32, read as a whole number, divided by 2^23 and less this, are its logarithm to the base 2 at
# powers of two, and lie on straight lines between them (up to 0.09 below it). This takes a tenth of the time of log2.
BITS_PER_DOUBLING, EXPONENT_OF_ONE = np.float32(1 << 23), np.float32(127.0)
# Contrasts of two windows differ little, more, or much: the limits are doublings of the squared grey difference.
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
    small_window_unit: np.float32  # f4: the same where only the smallest window is used
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

    gradients: np.ndarray  # (i,3,p) f4: mean products of the grey differences of every view, see `mean_gradients`
    movement: np.ndarray  # (i,2) f4: rows and columns that every view moves per step, see `put_movement`
    contrast: np.ndarray  # (2,p) f4: contrasts of the two views of a pair, see `write_contrast`
    work: np.ndarray  # (4,p) f4: sums
    position: np.ndarray  # (p,) f4: position between two bins of likeness, from 0 at the lower to 1 at the higher
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
    gradients, movement = np.empty((n_views, 3, size), np.float32), np.empty((n_views, 2), np.float32)
    contrast, position = np.empty((2, size), np.float32), np.empty(size, np.float32)
    return PairScratch(gradients, movement, contrast, work, position, np.empty(size, np.int32))


# BlockGrid, PixelVelocity, (2,) f4 -> None
@kernel
def put_movement(grid, velocity, movement):
    """Write the rows and columns of cells by which a view resampled on a block moves when the height rises by one
    step."""
    x, y = grid.x, grid.y
    area = x.by_col * y.by_row - x.by_row * y.by_col
    movement[0] = np.float32((x.by_col * velocity.y - y.by_col * velocity.x) / area)
    movement[1] = np.float32((velocity.x * y.by_row - velocity.y * x.by_row) / area)


# (p,) f4, i8, i8, i8, (3,p) f4 -> None
@kernel
def mean_gradients(plane, half, width, n, out):
    """Write the mean products of the grey differences in the window of each cell, at the first n places.

    Differences are those of the cells on both sides. out : (3, p), means of their squares along the columns, along the
    rows, and of their products, over the part of the window in which both cells lie inside it.
    """
    by_row, by_col, mixed, inner = out[0], out[1], out[2], half - 1
    by_row[:n], by_col[:n], mixed[:n] = 0.0, 0.0, 0.0
    per_long = np.float32(1.0) / np.float32((2 * inner + 1) * (2 * half + 1))
    per_inner = np.float32(1.0) / np.float32((2 * inner + 1) ** 2)
    for d in range(-half, half + 1):
        for e in range(-inner, inner + 1):
            across, down = (half + d) * width + half + e, (half + e) * width + half + d
            west, east = plane[across - 1 :], plane[across + 1 :]
            north, south = plane[down - width :], plane[down + width :]
            for j in range(n):
                along_col, along_row = south[j] - north[j], east[j] - west[j]
                by_row[j] += along_col * along_col * per_long
                by_col[j] += along_row * along_row * per_long
            if abs(d) <= inner:
                west, east = plane[down - 1 :], plane[down + 1 :]
                for j in range(n):
                    mixed[j] += (east[j] - west[j]) * (south[j] - north[j]) * per_inner


# (3,p) f4, f4, f4, f4, i8, (p,) f4 -> None
@kernel
def write_contrast(gradients, by_row, by_col, noise_variance, n, out):
    """Write log2 of the mean squared grey difference along a direction over that of noise, at the first n places.

    gradients : see `mean_gradients`; by_row, by_col : the direction, a vector of length 1. See BITS_PER_DOUBLING.
    """
    of_rows, of_cols, mixed = gradients[0], gradients[1], gradients[2]
    per_noise, zero = np.float32(1.0) / (NOISE_OF_DIFFERENCE * noise_variance), np.float32(0.0)
    both = np.float32(2.0) * by_row * by_col
    for j in range(n):
        square = by_row * by_row * of_rows[j] + by_col * by_col * of_cols[j] + both * mixed[j]
        out[j] = max(square, zero) * per_noise + CONTRAST_FLOOR
    bits, per_doubling = out.view(np.int32), np.float32(1.0) / BITS_PER_DOUBLING
    for j in range(n):
        out[j] = np.float32(bits[j]) * per_doubling - EXPONENT_OF_ONE


# PairWindows, ViewPair, PairScratch, f4, i8 -> None
@kernel
def pair_contrasts(views, pair, scratch, noise_variance, n):
    """Write the contrasts of a pair of views along the direction in which they move against each other."""
    movement, contrast = scratch.movement, scratch.contrast
    by_row, by_col = (
        movement[pair.a, 0] - movement[pair.b, 0],
        movement[pair.a, 1] - movement[pair.b, 1],
    )
    length = max(np.sqrt(by_row * by_row + by_col * by_col), np.float32(1e-9))
    by_row, by_col = by_row / length, by_col / length
    write_contrast(scratch.gradients[pair.a], by_row, by_col, noise_variance, n, contrast[0])
    write_contrast(scratch.gradients[pair.b], by_row, by_col, noise_variance, n, contrast[1])


# PairWindows, ViewPair, i8, (p,) f4 -> None
@kernel
def count_same_order(views, pair, n, out):
    """Write how many neighbours of each cell are brighter than it in both views, or in neither, at the first n places.

    The neighbours are those of the largest window.
    """
    half, width = views.windows[-1], views.width
    centre = half * (width + 1)
    one, other = views.planes[pair.a], views.planes[pair.b]
    here, here_too = one[centre:], other[centre:]
    out[:n] = 0.0
    for r in range(2 * half + 1):
        for c in range(2 * half + 1):
            if r == half and c == half:
                continue
            beside, beside_too = one[r * width + c :], other[r * width + c :]
            for j in range(n):
                out[j] += np.float32((beside[j] > here[j]) == (beside_too[j] > here_too[j]))


# PairWindows, ViewPair, WindowMoments, PairScratch, i8 -> None
@kernel
def add_pair_correlation(views, pair, moments, scratch, n):
    """Write the sum of a pair's correlations over the windows to `scratch.position`, at the first n places."""
    work, windows, half, columns, done = scratch.work, views.windows, views.windows[-1], scratch.work[0], 0
    scratch.position[:n] = 0.0
    for w in range(windows.shape[0]):
        window = windows[w]
        column_products(views.planes, pair, ColumnSums(half, done, window, views.width, n + SLACK), columns)
        add_correlation(columns[half - window :], window, n, pair, w, moments, work[1], scratch.position)
        done = window


# PairWindows, ViewPair, WindowMoments, PairScratch, f4, i8 -> None
@kernel
def pair_bins(views, pair, moments, scratch, noise_variance, n):
    """Write the bin of a pair of views, and its position between two bins of likeness, at the first n places."""
    position, bins, same_order, windows = scratch.position, scratch.bins, scratch.work[2], views.windows
    add_pair_correlation(views, pair, moments, scratch, n)
    count_same_order(views, pair, n, same_order)
    pair_contrasts(views, pair, scratch, noise_variance, n)
    one, zero, last = np.float32(1.0), np.float32(0.0), np.float32(N_LIKENESS - 1.001)
    n_beside = np.float32((2 * windows[-1] + 1) ** 2 - 1)
    to_bin = np.float32(0.5 * (N_LIKENESS - 1))
    of_correlation = CORRELATION_SHARE * to_bin / np.float32(windows.shape[0])
    of_order, least = np.float32(2.0) * (one - CORRELATION_SHARE) * to_bin / n_beside, CORRELATION_SHARE * to_bin
    to_grey, per_factor = np.float32(N_GREY) / LARGEST_GREY_ROOT, one / views.grey_factor
    grey_a, grey_b, contrast_a, contrast_b = (
        views.greys[pair.a],
        views.greys[pair.b],
        scratch.contrast[0],
        scratch.contrast[1],
    )
    for j in range(n):
        both = contrast_a[j] + contrast_b[j] - LOWEST_CONTRAST
        both = min(max(both, zero), np.float32(N_CONTRAST - 1))
        apart = abs(contrast_a[j] - contrast_b[j])
        difference = np.int32(apart >= SOME_DIFFERENCE) + np.int32(apart >= LARGE_DIFFERENCE)
        grey = min(np.sqrt(abs(grey_a[j] - grey_b[j]) * per_factor) * to_grey, np.float32(N_GREY - 1))
        place = min(max(position[j] * of_correlation + same_order[j] * of_order + least, zero), last)
        lower = np.int32(place)
        position[j] = place - np.float32(lower)
        row = np.int32(both) * np.int32(N_CONTRAST_DIFFERENCE) + difference
        bins[j] = (row * np.int32(N_GREY) + np.int32(grey)) * np.int32(N_LIKENESS) + lower


# PairWindows, WindowMoments, PairScratch, i8, i4, TableAndCounts -> None
@kernel
def count_bins(views, moments, scratch, n, height, evidence):
    """Count the bins of all pairs of views at one height, at right and at wrong heights of the cells of a block."""
    learning = evidence.learning
    reference, right, wrong = learning.reference, learning.right, learning.wrong
    noise_variance, position, bins = evidence.table.noise_variance, scratch.position, scratch.bins
    for view in range(views.planes.shape[0]):
        mean_gradients(views.planes[view], views.windows[-1], views.width, n, scratch.gradients[view])
    rows, cols = reference.shape
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            pair_bins(views, ViewPair(np.uint64(a), np.uint64(b)), moments, scratch, noise_variance, n)
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
    for view in range(views.planes.shape[0]):
        mean_gradients(views.planes[view], views.windows[-1], views.width, n, scratch.gradients[view])
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            pair_bins(views, ViewPair(np.uint64(a), np.uint64(b)), moments, scratch, evidence.noise_variance, n)
            grey_a, grey_b = views.greys[a], views.greys[b]
            for j in range(n):
                at, share = np.uint64(bins[j]), position[j]
                ratio = table[at] * (one - share) + table[at + np.uint64(1)] * share
                is_seen = abs(grey_a[j]) < GREY_LIMIT and abs(grey_b[j]) < GREY_LIMIT
                total[j] += ratio if is_seen else np.float32(0.0)


# EvidenceTable, i8, i8 -> f4
@kernel
def cost_of_unit(evidence, n_views, n_sizes):
    """Cost of one natural unit of the mean evidence of all pairs of n_views that cover a block, compared in windows of
    n_sizes."""
    unit = evidence.unit if n_sizes > 1 else evidence.small_window_unit
    return unit * np.float32((n_views * (n_views - 1) / 2) ** evidence.pair_exponent)


# (p,) f4, (p,) f4, (p,) f4, EvidenceTable, f4, i8, (p,) u1 -> None
@kernel
def evidence_costs(total, pair_weight, n_covering, evidence, scale, n, out):
    """Write the costs of a block at one height, rounded, from the sums of evidence over the pairs of views.

    pair_weight : (p,), weight of a pair of views that see the cell; n_covering : (p,), views that cover the cell there;
    scale : see `cost_of_unit`. Heights that fewer than two views cover have no evidence.
    """
    highest = min(scale * evidence.highest, evidence.max_cost)
    without = highest - scale * evidence.neutral
    for j in range(n):
        cost = highest - scale * total[j] * pair_weight[j]
        total[j] = (cost if n_covering[j] > np.float32(1.5) else without) + np.float32(0.5)
    for j in range(n):
        out[j] = np.uint8(np.int32(min(max(total[j], np.float32(0.0)), np.float32(255.0))))
