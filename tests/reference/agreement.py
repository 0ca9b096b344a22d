"""Twins of the matching cost: windows cut out of planes, their correlation, grey differences, means over all pairs."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from reference.projection import along_slope, bilinear, cubic, positions

UNCOVERED_COST = 40.0


def windows(plane, half):
    """(r, c, m): the values of every window that lies inside a plane."""
    side = 2 * half + 1
    cut = sliding_window_view(np.asarray(plane, float), (side, side))
    return cut.reshape(*cut.shape[:2], side * side)


def ncc(a, b, variance=0.0):
    """Correlation of windows (..., m), with `variance` added to both variances; 0 where a window is constant."""
    a, b = a - a.mean(axis=-1, keepdims=True), b - b.mean(axis=-1, keepdims=True)
    va, vb = (a * a).sum(axis=-1), (b * b).sum(axis=-1)
    m = a.shape[-1]
    norm = np.sqrt((va + m * variance) * (vb + m * variance))
    constant = (va < 1e-9) | (vb < 1e-9)
    return np.where(constant, 0.0, (a * b).sum(axis=-1) / np.where(constant, 1.0, norm))


def over_pairs(total, visible, excluded):
    """Mean over all pairs of usable views of a sum over the visible pairs, (r, c).

    visible : (2, i, r, c) whether a view sees the cell at this height, and whether it covers it at any height (then its
    pairs count); excluded : power of the number of pairs that see the cell in the number that is divided by, the rest
    is that of all pairs.
    """
    n_here, n_anywhere = (np.maximum(n * (n - 1) / 2, 1) for n in (v.sum(axis=0) for v in visible))
    return total / (n_here**excluded * n_anywhere ** (1 - excluded))


def mean_ncc(planes, visible, half, variance=0.0, excluded=0.0, group=(0, 1)):
    """Mean over all pairs of the views that are usable, (r, c), see `over_pairs`.

    planes : one (r + 2 half, c + 2 half) each; group : number, and how many: the part of the pairs a + b of which is
    the number modulo how many.
    """
    here = visible[0]
    total = np.zeros(here.shape[1:])
    for a, b in combinations(range(len(planes)), 2):
        if (a + b) % group[1] != group[0]:
            continue
        agreement = ncc(windows(planes[a], half), windows(planes[b], half), variance)
        total += np.where(here[a] & here[b], agreement, 0.0)
    return over_pairs(total, visible, excluded)


def mean_closeness(greys, visible, max_difference, excluded=0.0):
    """Mean over all pairs of usable views of max(0, 1 - grey difference / max_difference), (r, c), see `over_pairs`.

    greys : one (r, c) each.
    """
    here = visible[0]
    total = np.zeros(here.shape[1:])
    for a, b in combinations(range(len(greys)), 2):
        close = np.maximum(0.0, 1.0 - np.abs(np.subtract(greys[a], greys[b], dtype=float)) / max_difference)
        total += np.where(here[a] & here[b], close, 0.0)
    return over_pairs(total, visible, excluded)


def best_of_reference(scores, is_seen, share):
    """Mean (r, c) of the best share of the pairs of the first view that see the cell, 0 where none does.

    scores : (k, r, c), of every pair; is_seen : (k, r, c) bool.
    """
    out = np.zeros(scores.shape[1:])
    for cell in np.ndindex(out.shape):
        left, total = share * is_seen[(slice(None), *cell)].sum(), 0.0
        for score in sorted(scores[(is_seen[(slice(None), *cell)], *cell)], reverse=True):
            total += min(1.0, left) * score
            left = max(left - 1.0, 0.0)
        out[cell] = total / max(share * is_seen[(slice(None), *cell)].sum(), 1e-9)
    return out


def cell_costs(images, nodes, heights, index, block, halves, visible, parameters, relief):
    """64 (1 - mean NCC + weight (1 - mean closeness)) of a block's cells at one height, (r, c), before rounding.

    Where fewer than two images cover that height, a fixed cost: see `block_costs`. parameters :
    `CostParameters`; relief : (r + 2 half, c + 2 half) steps.
    """
    half, p = max(halves), parameters
    low, high, free_from = visible
    weight = float(p.grey_weight_of_one_pair if (low <= high).any(axis=(1, 2)).sum() == 2 else p.grey_weight)
    variance, max_difference, excluded = (
        float(v) for v in (p.window_variance, p.max_grey_difference, p.occluded_pairs_excluded)
    )
    shape = low.shape[1:]
    t = heights[0] + index * heights[1]
    planes = [
        bilinear(image, along_slope(node, t, relief, heights[1], shape, block, half))
        for image, node in zip(images, nodes, strict=True)
    ]
    covered = (low <= index) & (index <= high)
    usable = np.stack([covered & (free_from <= index), low <= high])
    inner_planes = [
        [plane[half - w : plane.shape[0] - half + w, half - w : plane.shape[1] - half + w] for plane in planes]
        for w in halves
    ]
    greys = [plane[half:-half, half:-half] for plane in planes]
    # A view takes part in a block where some of its cells see the height from, and others below, what occludes them.
    takes_part = (np.maximum(low, free_from).min(axis=(1, 2)) <= index) & (index <= high.max(axis=(1, 2)))
    if p.best_share_of_reference > 0 and takes_part.sum() > 2 and takes_part[0]:
        scores = [
            np.mean([ncc(windows(inner[0], w), windows(inner[b], w), variance)
                     for w, inner in zip(halves, inner_planes, strict=True)], axis=0)
            + weight * np.maximum(0.0, 1.0 - np.abs(greys[0] - greys[b]) / max_difference)
            for b in range(1, len(planes))
        ]  # fmt: skip
        best = best_of_reference(np.stack(scores), usable[0][:1] & usable[0][1:], float(p.best_share_of_reference))
        return np.where(covered.sum(axis=0) > 1, 64.0 * (1.0 + weight - best), UNCOVERED_COST * (1.0 + weight))
    by_window = [mean_ncc(inner, usable, w, variance, excluded) for w, inner in zip(halves, inner_planes, strict=True)]
    apart = 1.0 - np.mean(by_window, axis=0) + weight * (1.0 - mean_closeness(greys, usable, max_difference, excluded))
    return np.where(covered.sum(axis=0) > 1, 64.0 * apart, UNCOVERED_COST * (1.0 + weight))


def profile(images, nodes, heights, surface, offset, block, half, visible, variance=0.0, group=(0, 1), bends=None):
    """Mean NCC, (r, c), in windows of a block that follow a surface (r + 2 half, c + 2 half), plus `offset`.

    Or the part of it that comes from a group of pairs, see `mean_ncc`.
    """
    low, high, free_from = visible
    shape = low.shape[1:]
    t = heights[0] + (surface + offset) * heights[1]
    bends = [None] * len(images) if bends is None else bends
    planes = [
        cubic(image, positions(node, t, shape, block, half, bend))
        for image, node, bend in zip(images, nodes, bends, strict=True)
    ]
    centre = surface[half : half + shape[0], half : half + shape[1]]
    is_seen = (low <= centre) & (centre <= high) & (free_from <= centre)
    return mean_ncc(planes, np.stack([is_seen, is_seen]), half, variance, group=group)
