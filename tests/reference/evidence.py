"""Twins of the evidence: bins of a pair of views from windows cut out of planes, sums of a table, and counts."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from reference.agreement import ncc, windows
from reference.projection import along_slope, bilinear, derivative, position

N_CONTRAST, N_DIFFERENCE, N_GREY, N_LIKENESS = 14, 3, 14, 20


def planes_at(images, nodes, heights, index, block, half, shape, relief):
    """Each view resampled on the plane of a block and `half` cells around it at one height index."""
    t = heights[0] + index * heights[1]
    return [
        bilinear(image, along_slope(node, t, relief, heights[1], shape, block, half))
        for image, node in zip(images, nodes, strict=True)
    ]


def movements(nodes, heights, index, block, half):
    """Rows and columns (i, 2) that each view moves on a block when the height index rises by one."""
    t, found = np.float64(heights[0] + index * heights[1]), []
    for node in nodes:
        first = position(node, t, -half, -half, block)
        by_row, by_col = (position(node, t, -half + r, -half + c, block) - first for r, c in ((1, 0), (0, 1)))
        speed = position(derivative(node), t, block / 2, block / 2, block) * heights[1]
        found.append(np.linalg.solve(np.stack([by_row, by_col], axis=1), speed))
    return np.array(found)


def along_lines(x):
    """log2 at powers of two, and on straight lines between them."""
    mantissa, exponent = np.frexp(x)
    return exponent - 1 + (2 * mantissa - 1)


def mean_gradients(plane, half):
    """Mean squares of the differences along columns and rows, and mean of their products, (r, c) each."""
    shape = (plane.shape[0] - 2 * half, plane.shape[1] - 2 * half)
    found = np.zeros((3, *shape))
    for r in range(shape[0]):
        for c in range(shape[1]):
            window = plane[r : r + 2 * half + 1, c : c + 2 * half + 1]
            down, across = window[2:] - window[:-2], window[:, 2:] - window[:, :-2]
            found[:, r, c] = (down**2).mean(), (across**2).mean(), (down[:, 1:-1] * across[1:-1]).mean()
    return found


def contrast(plane, half, direction, noise):
    """Doublings (r, c) of the mean squared difference along a direction (row, column) over that of noise."""
    of_rows, of_cols, mixed = mean_gradients(plane, half)
    row, col = direction
    square = row**2 * of_rows + col**2 * of_cols + 2 * row * col * mixed
    return along_lines(np.maximum(square, 0) / (2 * noise) + 0.25)


def same_order(a, b, half):
    """Share (r, c) of the neighbours in a window that are brighter than its middle in both planes, or in neither."""
    brighter = []
    for plane in (a, b):
        around = windows(plane, half)
        brighter.append(np.delete(around > around[..., around.shape[-1] // 2, None], around.shape[-1] // 2, axis=-1))
    return (brighter[0] == brighter[1]).mean(axis=-1)


def pair_bins(a, b, direction, halves, noise, grey_unit):
    """Contrast, difference, grey and likeness bin (r, c) of two planes; the last with its fraction. grey_unit : of the
    grey differences."""
    half, correlation = max(halves), []
    for small in halves:
        trim = half - small
        inner = [plane[trim : plane.shape[0] - trim, trim : plane.shape[1] - trim] for plane in (a, b)]
        correlation.append(ncc(windows(inner[0], small), windows(inner[1], small)))
    contrasts = [contrast(plane, half, direction, noise) for plane in (a, b)]
    apart = np.abs(contrasts[0] - contrasts[1])
    grey = np.abs(a - b)[half:-half, half:-half] / grey_unit
    likeness = 0.35 * np.mean(correlation, axis=0) + 0.65 * (2 * same_order(a, b, half) - 1)
    return (
        np.clip(contrasts[0] + contrasts[1] + 4, 0, N_CONTRAST - 1).astype(int),
        (apart >= 1.2).astype(int) + (apart >= 2.5),
        np.minimum(np.sqrt(grey) * N_GREY / 1.2, N_GREY - 1).astype(int),
        np.clip((likeness + 1) / 2 * (N_LIKENESS - 1), 0, N_LIKENESS - 1.001),
    )


def bins_of_pair(planes, movement, a, b, halves, noise, grey_unit):
    """Bins of the views a and b of a block. grey_unit : (i, i)."""
    relative = movement[a] - movement[b]
    return pair_bins(planes[a], planes[b], relative / np.linalg.norm(relative), halves, noise, grey_unit[a, b])


def from_table(table, bins):
    """Entries of a table (14, 3, 14, 20), interpolated along the likeness."""
    contrast, difference, grey, place = bins
    lower = place.astype(int)
    share = place - lower
    return (1 - share) * table[contrast, difference, grey, lower] + share * table[contrast, difference, grey, lower + 1]


def mean_of_best(ratios, weights, share):
    """Mean of the largest ratios (k,), until their weights (k,) are a share of all weights; 0 without any weight."""
    order = np.argsort(-ratios)
    taken = np.minimum(np.cumsum(weights[order]), share * weights.sum())
    return float(np.diff(taken, prepend=0.0) @ ratios[order]) / max(share * weights.sum(), 1e-12)


def cell_evidence(planes, movement, halves, noise, grey_unit, table, visible, excluded, weights, best_share):
    """Weighted mean evidence over the best pairs of views, (r, c): see `mean_of_best`.

    visible : (2, i, r, c), see `reference.agreement.over_pairs`; weights : (i, i), of the pairs, whose mean over the
    pairs is 1. The mean is the geometric one, by `excluded`, of that over the pairs that see the cell and that over the
    pairs that cover it; few pairs are as many as one of mean weight.
    """
    here, covering = visible
    pairs = list(combinations(range(len(planes)), 2))
    of_pairs = np.array([weights[pair] for pair in pairs])[:, None, None]
    of_seen = of_pairs * np.array([here[a] & here[b] for a, b in pairs])
    of_seeing, of_covering = of_seen.sum(axis=0), sum(weights[a, b] * (covering[a] & covering[b]) for a, b in pairs)
    ratios = [from_table(table, bins_of_pair(planes, movement, a, b, halves, noise, grey_unit)) for a, b in pairs]
    total, ratios = np.zeros(here.shape[1:]), np.array(ratios)
    for r, c in np.ndindex(total.shape):
        total[r, c] = mean_of_best(ratios[:, r, c], of_seen[:, r, c], best_share) * of_seeing[r, c]
    return total / (np.maximum(of_seeing, 1) ** excluded * np.maximum(of_covering, 1) ** (1 - excluded))


def counted(planes, movement, halves, noise, grey_unit, is_counted, here):
    """Counts (14, 3, 14, 20) of the nearest bins of all pairs that see a cell, where `is_counted` (r, c)."""
    counts = np.zeros((N_CONTRAST, N_DIFFERENCE, N_GREY, N_LIKENESS), int)
    for a, b in combinations(range(len(planes)), 2):
        contrast, difference, grey, place = bins_of_pair(planes, movement, a, b, halves, noise, grey_unit)
        nearest = place.astype(int) + (place - place.astype(int) > 0.5)
        which = is_counted & here[a] & here[b]
        np.add.at(counts, (contrast[which], difference[which], grey[which], nearest[which]), 1)
    return counts


def grey_roots(planes, half, is_counted, here):
    """Sums (i, i) of the roots of the grey differences of all pairs that see a cell, where `is_counted` (r, c)."""
    sums, inner = np.zeros((len(planes), len(planes))), [plane[half:-half, half:-half] for plane in planes]
    for a, b in combinations(range(len(planes)), 2):
        which = is_counted & here[a] & here[b]
        sums[a, b] = np.sqrt(np.abs(inner[a] - inner[b]))[which].sum()
    return sums


def n_compared(n_views, per_view=2, n_first=12):
    """Number of pairs that are compared: so many for each of the first views, one for each view more."""
    return min(sum(per_view if k < n_first else 1 for k in range(n_views)), n_views * (n_views - 1) // 2)


def pair_weights(worth, views):
    """Weights (i, i) of the pairs of some views by what they are worth, and the number of equally good pairs."""
    pairs = list(combinations(range(len(views)), 2))
    ranked = sorted(pairs, key=lambda pair: -worth[views[pair[0]], views[pair[1]]])
    weights = np.zeros((len(views), len(views)))
    for a, b in ranked[: n_compared(len(views))]:
        weights[a, b] = weights[b, a] = worth[views[a], views[b]]
    n_effective = weights.sum() ** 2 / (weights**2).sum() / 2
    return weights * (2 * len(pairs) / weights.sum()), n_effective
