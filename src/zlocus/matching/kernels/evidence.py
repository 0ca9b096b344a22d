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
from zlocus.matching.kernels.best_pairs import RATIO_OF_UNSEEN, PairRatios, add_best_pairs, empty_pair_ratios
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
# Rows of scratch that the features of a pair are made in.
SUMS, BEYOND, POSITION, CONTRAST_A, CONTRAST_B = range(5)


class EvidenceTable(NamedTuple):
    """The table, and how costs follow from it. Without a table (no elements) the cost is that of correlation."""

    log_ratios: np.ndarray  # (e,) f4: log-likelihood ratios by bin, less their mean at wrong heights
    noise_variance: np.float32  # f4: variance of the noise of the images, grey values squared
    unit: np.float32  # f4: cost of one natural unit of mean evidence of one pair
    small_window_unit: np.float32  # f4: the same where only the smallest window is used
    highest: np.float32  # f4: largest log ratio
    neutral: np.float32  # f4: log ratio of no evidence
    pair_exponent: np.float32  # f4: the mean over n pairs that say equally much counts n ** pair_exponent times
    max_cost: np.float32  # f4: cost of a height without evidence for or against it, at most
    grey_unit: np.ndarray  # (i,i) f4: usual grey difference of each pair of views, as a multiple of that of all pairs
    worth: np.ndarray  # (i,i) f4: what each pair of views is worth, see `zlocus.matching.evidence.worth_of_pairs`
    best_share: np.float32  # f4: of the pairs that see a height only the best count, by this share of their weight


class Learning(NamedTuple):
    """Counts that a table is learned from. Without counts (no elements) nothing is counted."""

    reference: np.ndarray  # (r,c) f4: height index that counts as right in each cell, NaN where no cell is counted
    wrong_every: np.int64  # i8: wrong heights are counted at one of so many height indices, at none where it is 0
    right: np.ndarray  # (e,) i8: how often each bin occurs at right heights
    wrong: np.ndarray  # (e,) i8: how often at wrong heights
    right_of_pair: np.ndarray  # (i,i,k) i8: how often each likeness occurs at right heights in each pair of views
    wrong_of_pair: np.ndarray  # (i,i,k) i8: how often at wrong heights
    grey_roots: np.ndarray  # (i,i) f8: sum of the roots of the grey differences of each pair at right heights


# No height costs so much that it would not be compared.
NO_COST_IS_FAR = np.uint8(255)


class TableAndCounts(NamedTuple):
    """The table of a tile, and the counts of one that is being learned; at most one of the two is in use."""

    table: EvidenceTable  # EvidenceTable: the table
    learning: Learning  # Learning: the counts
    far_cost: np.uint8 = NO_COST_IS_FAR  # u1: heights that cost as much already in all cells are not compared


class PairScratch(NamedTuple):
    """Arrays that the pairs of a block use one after the other."""

    work: np.ndarray  # (4,p) f4: sums of correlation without evidence
    gradients: np.ndarray  # (i,3,p) f4: mean products of the grey differences of every view, see `write_gradients`
    census: np.ndarray  # (i,k,p) u1: which neighbours of each cell are brighter than it, in every view
    movement: np.ndarray  # (i,2) f4: rows and columns that every view moves per step, see `put_movement`
    rows: np.ndarray  # (5,p) f4: sums, contrasts and positions between two bins of likeness, see SUMS and others
    bits: np.ndarray  # (5,p) i4: the bits of `rows`
    bins: np.ndarray  # (p,) i4: index of the lower bin
    ratios: PairRatios  # PairRatios: log ratios of the pairs


class PairWindows(NamedTuple):
    """The views of a block at one height, on flat planes."""

    planes: np.ndarray  # (i,p) f4: grey values less that of one cell
    windows: np.ndarray  # (w,) i8: half widths of the windows, ascending
    greys: np.ndarray  # (i,p) f4: grey values of the cells, times grey_factor
    grey_factor: np.float32  # f4: see greys
    width: int  # i8: floats from a row to the next
    in_block: np.ndarray  # (i,) i8: place of each of these views among all views of the block
    in_tile: np.ndarray  # (i,) i8: and among all views of the tile


# i8, i8, i8, (4,p) f4 -> PairScratch
@kernel
def pair_scratch(n_views, half, size, work):
    """Arrays for the pairs of views of a block on flat planes of a size, not filled. half : of the largest window."""
    gradients, movement = np.empty((n_views, 3, size), np.float32), np.empty((n_views, 2), np.float32)
    census, bins = np.empty((n_views, n_beside(half) // 8, size), np.uint8), np.empty(size, np.int32)
    rows, ratios = np.empty((5, size), np.float32), empty_pair_ratios(n_views * (n_views - 1) // 2, size)
    return PairScratch(work, gradients, census, movement, rows, rows.view(np.int32), bins, ratios)


# BlockGrid, PixelVelocity, (2,) f4 -> None
@kernel
def put_movement(grid, velocity, movement):
    """Write the rows and columns of cells by which a view resampled on a block moves when the height rises by one
    step."""
    x, y = grid.x, grid.y
    area = x.by_col * y.by_row - x.by_row * y.by_col
    movement[0] = np.float32((x.by_col * velocity.y - y.by_col * velocity.x) / area)
    movement[1] = np.float32((velocity.x * y.by_row - velocity.y * x.by_row) / area)


# i8 -> i8
@kernel
def n_beside(half):
    """Neighbours of a cell in a window of a half width."""
    return (2 * half + 1) ** 2 - 1


# (5,p) f4, i8, i8, i8, i8, (i,3,p) f4, u8, u8 -> None
@kernel
def write_window_means(rows, half_rows, half_cols, width, n, out, view, product):
    """Write the means of the first scratch row in the window of which each place is the first, at the first n places.

    The window has 2 half_rows + 1 rows and 2 half_cols + 1 columns; out : see `write_gradients`.
    """
    values, sums, n_sums = np.uint64(SUMS), np.uint64(BEYOND), np.uint64(n + 2 * half_cols)
    for j in range(n_sums):
        rows[sums, j] = rows[values, j]
    for r in range(1, 2 * half_rows + 1):
        first = np.uint64(r * width)
        for j in range(n_sums):
            rows[sums, j] += rows[values, first + j]
    per_cell = np.float32(1.0) / np.float32((2 * half_rows + 1) * (2 * half_cols + 1))
    for j in range(np.uint64(n)):
        out[view, product, j] = rows[sums, j] * per_cell
    for c in range(1, 2 * half_cols + 1):
        first = np.uint64(c)
        for j in range(np.uint64(n)):
            out[view, product, j] += rows[sums, first + j] * per_cell


# (i,p) f4, u8, i8, i8, i8, (5,p) f4, (i,3,p) f4 -> None
@kernel
def write_gradients(planes, view, half, width, n, rows, out):
    """Write the mean products of the grey differences of a view in the window of each cell, at the first n places.

    Differences are those of the cells on both sides. out : (i, 3, p), means of their squares along the columns, along
    the rows, and of their products, over the part of the window in which both cells lie inside it; rows : scratch.
    """
    values, one, two, inner = np.uint64(SUMS), np.uint64(1), np.uint64(2), half - 1
    row, end = np.uint64(width), np.uint64(n + 2 * half * width + 2 * half)
    for j in range(end - two * row):
        along_col = planes[view, j + two * row] - planes[view, j]
        rows[values, j] = along_col * along_col
    write_window_means(rows, inner, half, width, n, out, view, np.uint64(0))
    for j in range(end - two):
        along_row = planes[view, j + two] - planes[view, j]
        rows[values, j] = along_row * along_row
    write_window_means(rows, half, inner, width, n, out, view, one)
    for j in range(end - two * row - two):
        along_col = planes[view, j + one + two * row] - planes[view, j + one]
        rows[values, j] = along_col * (planes[view, j + row + two] - planes[view, j + row])
    write_window_means(rows, inner, inner, width, n, out, view, two)


# i8, i8, i8 -> u8
@kernel
def place_of_neighbour(number, half, width):
    """Place on a flat plane of the neighbour with a number of the cell in the middle of its first window."""
    after_middle = number + np.int64(number >= n_beside(half) // 2)
    side = 2 * half + 1
    return np.uint64(after_middle // side * width + after_middle % side)


# (i,p) f4, u8, i8, i8, i8, (i,k,p) u1 -> None
@kernel
def write_census(planes, view, half, width, n, out):
    """Write which neighbours of each cell are brighter than it in a view, one bit each, at the first n places.

    Each byte holds eight neighbours; every window has a multiple of that.
    """
    middle, zero = np.uint64(half * (width + 1)), np.uint8(0)
    for word in range(np.uint64(out.shape[1])):
        number = 8 * np.int64(word)
        p, q = place_of_neighbour(number, half, width), place_of_neighbour(number + 1, half, width)
        r, s = place_of_neighbour(number + 2, half, width), place_of_neighbour(number + 3, half, width)
        t, u = place_of_neighbour(number + 4, half, width), place_of_neighbour(number + 5, half, width)
        v, w = place_of_neighbour(number + 6, half, width), place_of_neighbour(number + 7, half, width)
        for j in range(np.uint64(n)):
            here = planes[view, middle + j]
            a = np.uint8(1) if planes[view, p + j] > here else zero
            b = np.uint8(2) if planes[view, q + j] > here else zero
            c = np.uint8(4) if planes[view, r + j] > here else zero
            d = np.uint8(8) if planes[view, s + j] > here else zero
            e = np.uint8(16) if planes[view, t + j] > here else zero
            f = np.uint8(32) if planes[view, u + j] > here else zero
            g = np.uint8(64) if planes[view, v + j] > here else zero
            h = np.uint8(128) if planes[view, w + j] > here else zero
            out[view, word, j] = np.uint8(a | b | c | d | e | f | g | h)


# u1 -> u1
@kernel
def bit_count(byte):
    """How many bits of a byte are set."""
    pairs = np.uint8(byte - ((byte >> np.uint8(1)) & np.uint8(0x55)))
    fours = np.uint8((pairs & np.uint8(0x33)) + ((pairs >> np.uint8(2)) & np.uint8(0x33)))
    return np.uint8((fours + (fours >> np.uint8(4))) & np.uint8(0x0F))


# (i,p) f4, ViewPair, WindowMoments, i8, i8, i8, (5,p) f4 -> None
@kernel
def write_smallest_correlation(planes, pair, moments, half, width, n, rows):
    """Write a pair's correlation in the first windows, of 3 x 3 cells, to a scratch row, at the first n places.

    half : cells around the block.
    """
    a, b, mean, scale, first = pair.a, pair.b, moments.mean, moments.scale, np.uint64(half - 1)
    sums, total, zero, one, two = np.uint64(SUMS), np.uint64(POSITION), np.uint64(0), np.uint64(1), np.uint64(2)
    p, q, r = np.uint64((half - 1) * width), np.uint64(half * width), np.uint64((half + 1) * width)
    for j in range(np.uint64(n + SLACK)):
        upper, middle = planes[a, p + j] * planes[b, p + j], planes[a, q + j] * planes[b, q + j]
        rows[sums, j] = upper + middle + planes[a, r + j] * planes[b, r + j]
    for j in range(np.uint64(n)):
        cross = rows[sums, first + j] + rows[sums, first + one + j] + rows[sums, first + two + j]
        product = cross - mean[a, zero, j] * mean[b, zero, j]
        rows[total, j] = scale[a, zero, j] * scale[b, zero, j] * product


# PairWindows, ViewPair, WindowMoments, (5,p) f4, i8 -> None
@kernel
def write_pair_correlation(views, pair, moments, rows, n):
    """Write the sum of a pair's correlations over the windows to a scratch row, at the first n places."""
    windows, half, width, done = views.windows, views.windows[-1], views.width, 0
    if windows[0] == 1:
        write_smallest_correlation(views.planes, pair, moments, half, width, n, rows)
        done = 1
    else:
        rows[POSITION, :n] = 0.0
    for w in range(done, windows.shape[0]):
        window, columns = windows[w], rows[SUMS]
        column_products(views.planes, pair, ColumnSums(half, done, window, width, n + SLACK), columns)
        add_correlation(columns[half - window :], window, n, pair, w, moments, rows[BEYOND], rows[POSITION])
        done = window


# (i,3,p) f4, (i,2) f4, ViewPair, f4, i8, (5,p) f4 -> None
@kernel
def write_contrasts(gradients, movement, pair, noise_variance, n, rows):
    """Write the contrasts of a pair of views to scratch rows, before their logarithm, at the first n places.

    A contrast is the mean squared grey difference, along the direction in which the two views move against each other,
    over that of noise, and CONTRAST_FLOOR.
    """
    a, b, one, two, zero = pair.a, pair.b, np.uint64(1), np.uint64(2), np.uint64(0)
    by_row, by_col = movement[a, zero] - movement[b, zero], movement[a, one] - movement[b, one]
    length = max(np.sqrt(by_row * by_row + by_col * by_col), np.float32(1e-9))
    by_row, by_col = by_row / length, by_col / length
    per_noise, none = np.float32(1.0) / (NOISE_OF_DIFFERENCE * noise_variance), np.float32(0.0)
    squares_row, squares_col, both = by_row * by_row, by_col * by_col, np.float32(2.0) * by_row * by_col
    for j in range(np.uint64(n)):
        square = squares_row * gradients[a, zero, j] + squares_col * gradients[a, one, j] + both * gradients[a, two, j]
        rows[np.uint64(CONTRAST_A), j] = max(square, none) * per_noise + CONTRAST_FLOOR
    for j in range(np.uint64(n)):
        square = squares_row * gradients[b, zero, j] + squares_col * gradients[b, one, j] + both * gradients[b, two, j]
        rows[np.uint64(CONTRAST_B), j] = max(square, none) * per_noise + CONTRAST_FLOOR


# i4 -> f4
@kernel
def doublings(bits):
    """Logarithm to the base 2 of the float32 with these bits, see BITS_PER_DOUBLING."""
    return np.float32(bits) * (np.float32(1.0) / BITS_PER_DOUBLING) - EXPONENT_OF_ONE


# (5,p) i4, i8, (p,) i4 -> None
@kernel
def write_contrast_bins(bits, n, bins):
    """Write the bin of the contrasts of a pair of views and of their difference, at the first n places."""
    zero, last = np.float32(0.0), np.float32(N_CONTRAST - 1)
    for j in range(np.uint64(n)):
        of_a, of_b = doublings(bits[np.uint64(CONTRAST_A), j]), doublings(bits[np.uint64(CONTRAST_B), j])
        both = min(max(of_a + of_b - LOWEST_CONTRAST, zero), last)
        apart = abs(of_a - of_b)
        difference = np.int32(apart >= SOME_DIFFERENCE) + np.int32(apart >= LARGE_DIFFERENCE)
        bins[j] = np.int32(both) * np.int32(N_CONTRAST_DIFFERENCE) + difference


# (i,p) f4, f4, ViewPair, i8, (p,) i4 -> None
@kernel
def add_grey_bins(greys, unit, pair, n, bins):
    """Make bins of contrast those of contrast and grey difference, at the first n places. unit : of the differences."""
    to_grey, per_unit = np.float32(N_GREY) / LARGEST_GREY_ROOT, np.float32(1.0) / unit
    a, b, last = pair.a, pair.b, np.float32(N_GREY - 1)
    for j in range(np.uint64(n)):
        grey = min(np.sqrt(abs(greys[a, j] - greys[b, j]) * per_unit) * to_grey, last)
        bins[j] = bins[j] * np.int32(N_GREY) + np.int32(grey)


# (i,k,p) u1, ViewPair, i8, i8, i8, (5,p) f4, (p,) i4 -> None
@kernel
def add_likeness_bins(census, pair, half, n_sizes, n, rows, bins):
    """Make bins of contrast and grey difference those of all features, at the first n places.

    The sum of the correlations over n_sizes windows, in a scratch row, becomes the position between two bins of
    likeness. half : of the largest window, whose cells the census compares.
    """
    position, differing, zero = np.uint64(POSITION), np.uint64(SUMS), np.uint64(0)
    for j in range(np.uint64(n)):
        rows[differing, j] = np.float32(bit_count(np.uint8(census[pair.a, zero, j] ^ census[pair.b, zero, j])))
    for k in range(1, census.shape[1]):
        byte = np.uint64(k)
        for j in range(np.uint64(n)):
            other = np.uint8(census[pair.a, byte, j] ^ census[pair.b, byte, j])
            rows[differing, j] += np.float32(bit_count(other))
    to_bin, none, last = np.float32(0.5 * (N_LIKENESS - 1)), np.float32(0.0), np.float32(N_LIKENESS - 1.001)
    of_correlation, of_all = CORRELATION_SHARE * to_bin / np.float32(n_sizes), np.float32(n_beside(half))
    of_order = np.float32(2.0) * (np.float32(1.0) - CORRELATION_SHARE) * to_bin / of_all
    for j in range(np.uint64(n)):
        same_order = (of_all - rows[differing, j]) * of_order
        place = rows[position, j] * of_correlation + same_order + CORRELATION_SHARE * to_bin
        place = min(max(place, none), last)
        lower = np.int32(place)
        rows[position, j] = place - np.float32(lower)
        bins[j] = bins[j] * np.int32(N_LIKENESS) + lower


# PairWindows, ViewPair, WindowMoments, PairScratch, EvidenceTable, i8 -> None
@kernel
def write_pair_bins(views, pair, moments, scratch, table, n):
    """Write the bin of a pair of views, and its position between two bins of likeness, at the first n places.

    Each feature has loops of its own, because a loop over the arrays of all features is not vectorised. Arrays are
    indexed by unsigned numbers, without slices, whose references would be counted: this takes a third of the time.
    """
    windows, rows, bins = views.windows, scratch.rows, scratch.bins
    write_pair_correlation(views, pair, moments, rows, n)
    write_contrasts(scratch.gradients, scratch.movement, pair, table.noise_variance, n, rows)
    write_contrast_bins(scratch.bits, n, bins)
    grey_unit = table.grey_unit[views.in_tile[pair.a], views.in_tile[pair.b]]
    add_grey_bins(views.greys, views.grey_factor * grey_unit, pair, n, bins)
    add_likeness_bins(scratch.census, pair, windows[-1], windows.shape[0], n, rows, bins)


# PairWindows, PairScratch, i8 -> None
@kernel
def describe_views(views, scratch, n):
    """Write what the pairs need of each view: its gradients and its census."""
    half, width = views.windows[-1], views.width
    for view in range(np.uint64(views.planes.shape[0])):
        write_gradients(views.planes, view, half, width, n, scratch.rows, scratch.gradients)
        write_census(views.planes, view, half, width, n, scratch.census)


# (i,p) f4, ViewPair, i8, (p,) f4 -> None
@kernel
def put_unseen(greys, pair, n, out):
    """Write RATIO_OF_UNSEEN where one of a pair of views does not see the cell, at the first n places."""
    a, b = pair.a, pair.b
    for j in range(np.uint64(n)):
        is_seen = abs(greys[a, j]) < GREY_LIMIT and abs(greys[b, j]) < GREY_LIMIT
        out[j] = out[j] if is_seen else RATIO_OF_UNSEEN


# (e,) f4, (i,p) f4, ViewPair, i8, (5,p) f4, (p,) i4, (p,) f4 -> None
@kernel
def write_ratios(table, greys, pair, n, rows, bins, out):
    """Write the log-likelihood ratios of a pair of views, at the first n places."""
    one, next_bin, position = np.float32(1.0), np.uint64(1), np.uint64(POSITION)
    for j in range(np.uint64(n)):
        at, share = np.uint64(bins[j]), rows[position, j]
        out[j] = table[at] * (one - share) + table[at + next_bin] * share
    put_unseen(greys, pair, n, out)


# (p,) f4, f4, i8, (p,) f4 -> None
@kernel
def add_seen_weights(ratios, weight, n, seen):
    """Add the weight of a pair of views where both see the cell, at the first n places. ratios : of the pair."""
    none = np.float32(0.0)
    for j in range(np.uint64(n)):
        seen[j] += weight if ratios[j] > RATIO_OF_UNSEEN else none


# PairWindows, WindowMoments, PairScratch, i8, (i,i) f4, EvidenceTable, (p,) f4 -> None
@kernel
def add_evidence(views, moments, scratch, n, weights, evidence, total):
    """Add the log-likelihood ratios of the pairs of views that see the cell, at the first n places.

    They are added as the mean of the best of them, times the weights of all.

    weights : of the pairs of the block's views, see `PairsOfBlock`; pairs without weight are left out. The weights of
    the pairs that see each cell are in the scratch arrays afterwards.
    """
    describe_views(views, scratch, n)
    ratios, k = scratch.ratios, np.uint64(0)
    ratios.seen[:n] = np.float32(0.0)
    for a in range(views.planes.shape[0]):
        for b in range(a + 1, views.planes.shape[0]):
            weight = weights[views.in_block[a], views.in_block[b]]
            if weight > np.float32(0.0):
                pair = ViewPair(np.uint64(a), np.uint64(b))
                write_pair_bins(views, pair, moments, scratch, evidence, n)
                write_ratios(evidence.log_ratios, views.greys, pair, n, scratch.rows, scratch.bins, ratios.of_pairs[k])
                add_seen_weights(ratios.of_pairs[k], weight, n, ratios.seen)
                ratios.weights[k] = weight
                k += np.uint64(1)
    add_best_pairs(ratios, k, evidence.best_share, evidence.highest, n, total)


# EvidenceTable, f4, i8 -> f4
@kernel
def cost_of_unit(evidence, n_pairs, n_sizes):
    """Cost of one natural unit of the mean evidence of so many pairs, see `PairsOfBlock`, compared in windows of
    n_sizes."""
    unit = evidence.unit if n_sizes > 1 else evidence.small_window_unit
    return unit * n_pairs**evidence.pair_exponent


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
