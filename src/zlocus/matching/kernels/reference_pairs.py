"""Agreement of the reference image with the images that match it best: the cost of correlation in image space."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.best_pairs import add_best_pairs
from zlocus.matching.kernels.evidence import add_seen_weights, put_unseen
from zlocus.matching.kernels.ncc import SLACK, ColumnSums, ViewPair, add_correlation, column_products


# PairWindows, ViewPair, WindowMoments, f4, i8, (4,p) f4, (p,) f4 -> None
@kernel
def write_score(views, pair, moments, weight, n, work, out):
    """Write the correlation of a pair of views, added up over the windows, and the closeness of their grey values, at
    the first n places.

    weight : of closeness, times the number of windows; work : scratch. The grey values are in units of that weight over
    the grey difference at which two views do not agree at all, see `add_closeness`.
    """
    greys, windows, columns, beyond = views.greys, views.windows, work[0], work[1]
    half, done = windows[-1], 0
    for j in range(np.uint64(n)):
        out[j] = max(weight - abs(greys[pair.a, j] - greys[pair.b, j]), np.float32(0.0))
    for w in range(windows.shape[0]):
        window = windows[w]
        column_products(views.planes, pair, ColumnSums(half, done, window, views.width, n + SLACK), columns)
        add_correlation(columns[half - window :], window, n, pair, w, moments, beyond, out)
        done = window


# PairWindows, WindowMoments, PairScratch, f4, f4, i8, (p,) f4 -> None
@kernel
def write_best_of_reference(views, moments, scratch, grey_weight, share, n, total):
    """Write the mean score of the best pairs of the first view with another one, at the first n places; 0 where no such
    pair sees the cell.

    grey_weight : of the closeness of grey values beside the correlation; share : of the pairs that see the cell, which
    the best are; total : (p,), a sum over the windows, see `write_score`.
    """
    n_sizes, ratios, one = np.float32(views.windows.shape[0]), scratch.ratios, np.float32(1.0)
    ratios.seen[:n], total[:n] = np.float32(0.0), np.float32(0.0)
    for b in range(1, views.planes.shape[0]):
        k = np.uint64(b - 1)
        score, pair = ratios.of_pairs[k], ViewPair(np.uint64(0), np.uint64(b))
        write_score(views, pair, moments, grey_weight * n_sizes, n, scratch.work, score)
        put_unseen(views.greys, pair, n, score)
        add_seen_weights(score, one, n, ratios.seen)
        ratios.weights[k] = one
    n_pairs, highest = np.uint64(views.planes.shape[0] - 1), n_sizes * (one + grey_weight)
    add_best_pairs(ratios, n_pairs, share, highest, n, total)
    for j in range(np.uint64(n)):
        total[j] = total[j] / max(ratios.seen[j], one)
