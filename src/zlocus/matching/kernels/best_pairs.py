"""The mean evidence of those pairs of views of a cell that speak most for a height."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# Log ratio of a pair in which a view does not see the cell: below every log ratio of a table.
RATIO_OF_UNSEEN = np.float32(-1e6)
# The limit between the best pairs and the others is found by so many halvings of twice this span of log ratios, see
# `zlocus.matching.evidence.MAX_LOG_RATIO`: to 0.04. Then it is put to a log ratio of that interval.
N_HALVINGS, HALF_SPAN = 8, np.float32(5.0)


class PairRatios(NamedTuple):
    """The evidence of the pairs of views of a block at one height, as long as it is not added up."""

    of_pairs: np.ndarray  # (k,p) f4: log ratios of each pair, RATIO_OF_UNSEEN where a view does not see the cell
    weights: np.ndarray  # (k,) f4: weights of these pairs
    limit: np.ndarray  # (p,) f4: scratch; log ratio that separates the best pairs from the others
    above: np.ndarray  # (p,) f4: scratch; weight of the pairs above the limit, then largest log ratio below its bound
    seen: np.ndarray  # (p,) f4: sum of the weights of the pairs that see each cell


# i8, i8 -> PairRatios
@kernel
def empty_pair_ratios(n_pairs, size):
    """Arrays for so many pairs of the views of a block on flat planes of a size, not filled."""
    of_pairs, weights = np.empty((n_pairs, size), np.float32), np.empty(n_pairs, np.float32)
    limit, above, seen = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    return PairRatios(of_pairs, weights, limit, above, seen)


# PairRatios, u8, i8 -> None
@kernel
def weigh_above(ratios, n_pairs, n):
    """Write the weight of the pairs whose log ratio is above the limit, at the first n places."""
    above, zero = ratios.above, np.float32(0.0)
    above[:n] = zero
    for k in range(n_pairs):
        weight = ratios.weights[k]
        for j in range(np.uint64(n)):
            above[j] += weight if ratios.of_pairs[k, j] > ratios.limit[j] else zero


# PairRatios, u8, f4, f4, i8 -> None
@kernel
def write_limits(ratios, n_pairs, share, highest, n):
    """Write the log ratio that separates the best pairs from the others, at the first n places.

    See `add_best_pairs`.
    """
    limit, seen, largest, half = ratios.limit, ratios.seen, ratios.above, np.float32(0.5)
    limit[:n] = highest - HALF_SPAN
    span = HALF_SPAN
    for _ in range(N_HALVINGS):
        weigh_above(ratios, n_pairs, n)
        span *= half
        for j in range(np.uint64(n)):
            limit[j] += span if ratios.above[j] > share * seen[j] else -span
    largest[:n] = highest - np.float32(2.0) * HALF_SPAN
    for k in range(n_pairs):
        for j in range(np.uint64(n)):
            ratio = ratios.of_pairs[k, j]
            largest[j] = max(largest[j], ratio if ratio <= limit[j] + span else largest[j])
    limit[:n] = largest[:n]


# PairRatios, u8, f4, f4, i8, (p,) f4 -> None
@kernel
def add_best_pairs(ratios, n_pairs, share, highest, n, total):
    """Add the mean log ratio of the best pairs, times the weight of all, at the first n places.

    n_pairs : how many of the ratios are used; share : of the weight of the pairs that see the cell, that is to be taken
    by the best; highest : the largest log ratio there is.

    With w the weights, r the ratios and W the weight of the pairs that see the cell, the mean of the best share q is
    the least value of t + sum(w max(r - t, 0)) / (q W) over all limits t (Rockafellar, Uryasev 2000, theorem 1).
    """
    limit, seen, zero = ratios.limit, ratios.seen, np.float32(0.0)
    if n_pairs == 1:
        limit[:n] = ratios.of_pairs[0, :n]
    elif share == np.float32(1.0):
        limit[:n] = highest - np.float32(2.0) * HALF_SPAN
    else:
        write_limits(ratios, n_pairs, share, highest, n)
    for j in range(np.uint64(n)):
        total[j] += limit[j] * seen[j]
    for k in range(n_pairs):
        weight = ratios.weights[k] / share
        for j in range(np.uint64(n)):
            total[j] += weight * max(ratios.of_pairs[k, j] - limit[j], zero)
