"""Which pairs of views a block is compared in, and how much each of them counts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# So many pairs for each of the first views are compared, and one for each view more, those that are worth most: the
# time grows like the number of views, and not like its square.
PAIRS_PER_VIEW, N_FIRST_VIEWS = 2, 12


class PairsOfBlock(NamedTuple):
    """The pairs of the views of a block."""

    weights: np.ndarray  # (i,i) f4: weight of a pair by the places of its views in the block; their mean is 1
    n_effective: np.float32  # f4: number of equally good pairs that say as much, (sum of weights)^2 / sum of squares


# (i,i) f4, (i,) i8 -> PairsOfBlock
@kernel
def pairs_of_block(worth, views):
    """The pairs of a block's views, each with the weight of what it is worth; 0 for those that are not compared.

    worth : of every pair of views of the tile, see `zlocus.matching.evidence.worth_of_pairs`; views : numbers of the
    views of the block. Without anything worth (no elements) there are no weights.
    """
    n = views.shape[0]
    n_pairs = n * (n - 1) // 2
    weights = np.zeros((n, n), np.float32)
    if worth.shape[0] == 0 or n_pairs == 0:
        return PairsOfBlock(weights, np.float32(n_pairs))
    of_pairs = np.empty(n_pairs, np.float32)
    k = 0
    for a in range(n):
        for b in range(a + 1, n):
            of_pairs[k] = worth[views[a], views[b]]
            k += 1
    n_compared = min(n + (PAIRS_PER_VIEW - 1) * min(n, N_FIRST_VIEWS), n_pairs)
    least = np.sort(of_pairs)[n_pairs - n_compared]
    total, squares = np.float32(0.0), np.float32(0.0)
    for value in of_pairs:
        if value >= least:
            total += value
            squares += value * value
    for a in range(n):
        for b in range(a + 1, n):
            value = worth[views[a], views[b]]
            if value >= least:
                weights[a, b] = value * np.float32(n_pairs) / total
                weights[b, a] = weights[a, b]
    return PairsOfBlock(weights, total * total / squares)


# FlatVisibility, (w,) i8, (i,i) f4, (p,) f4 -> None
@kernel
def weights_of_covering(flat, takes, weights, out):
    """Write the weight of a pair of views that see the cell, where the pairs of the block's views have weights of their
    own: 1 over the sum of the weights of those views that cover the cell at any height.

    takes : numbers of the block's views; weights : see `PairsOfBlock`.
    """
    out[:] = 0.0
    for a in range(takes.shape[0]):
        for b in range(a + 1, takes.shape[0]):
            first, second, weight = takes[a], takes[b], weights[a, b]
            for j in range(out.shape[0]):
                covers_first = flat.lowest_covered[first, j] <= flat.highest_covered[first, j]
                covers_second = flat.lowest_covered[second, j] <= flat.highest_covered[second, j]
                out[j] += weight if covers_first and covers_second else np.float32(0.0)
    for j in range(out.shape[0]):
        out[j] = np.float32(1.0) / max(out[j], np.float32(1.0))


# (p,) f4, i8, (p,) f4 -> None
@kernel
def count_seeing_pairs(n_seeing, n, out):
    """Write the number of pairs of the views that see each cell. n_seeing : (p,), number of these views."""
    for j in range(n):
        out[j] = np.float32(0.5) * n_seeing[j] * (n_seeing[j] - np.float32(1.0))


# (p,) f4, f4, i8, (p,) f4 -> None
@kernel
def weights_with_occlusion(of_covering, excluded, n, out):
    """Write the weight of a pair of views that see the cell, where some pairs contain an occluded view.

    of_covering : (p,), the weight where all views that cover the cell see it; excluded : how far pairs with an occluded
    view are left out of the mean; out : (p,), the number of the pairs that see each cell, or the sum of their weights,
    replaced by the result. Less than one pair counts as one.

    The weight is (1 / seeing pairs) ** excluded * of_covering ** (1 - excluded). If no pair was left out (0), the
    ground beside a wall would rather be roof, which all views see; if all were (1), heights that few views see would be
    favoured, where chance agreement is larger. Their mean is the geometric one because the evidence of n pairs does not
    count n times that of one: where one pair of eighteen sees a cell, the arithmetic mean would have it count 9 times.
    """
    one = np.float32(1.0)
    for j in range(n):
        fewer = one / (of_covering[j] * max(out[j], one))
        out[j] = of_covering[j] * fewer**excluded
