"""Twins of the NCC kernels: windows cut out of planes, their plain correlation, its mean over all pairs of views."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from reference.projection import bilinear, cubic, positions

UNSEEN_COST = 40.0


def windows(plane, half):
    """(r, c, m): the values of every window that lies inside a plane."""
    side = 2 * half + 1
    cut = sliding_window_view(np.asarray(plane, float), (side, side))
    return cut.reshape(*cut.shape[:2], side * side)


def ncc(a, b, floor=0.0):
    """Correlation of windows (..., m), with `floor` added to both variances; 0 where a window is constant."""
    a, b = a - a.mean(axis=-1, keepdims=True), b - b.mean(axis=-1, keepdims=True)
    va, vb = (a * a).sum(axis=-1), (b * b).sum(axis=-1)
    m = a.shape[-1]
    norm = np.sqrt((va + m * floor) * (vb + m * floor))
    constant = (va < 1e-9) | (vb < 1e-9)
    return np.where(constant, 0.0, (a * b).sum(axis=-1) / np.where(constant, 1.0, norm))


def mean_ncc(planes, visible, half, floor=0.0):
    """Mean over all pairs of the views that are usable, (r, c); a pair of which one is hidden counts as 0.

    planes : one (r + 2 half, c + 2 half) each; visible : (2, i, r, c) whether a view sees the cell at this height, and
    whether it does at any height (then its pairs count).
    """
    here, anywhere = visible
    total = np.zeros(here.shape[1:])
    for a, b in combinations(range(len(planes)), 2):
        agreement = ncc(windows(planes[a], half), windows(planes[b], half), floor)
        total += np.where(here[a] & here[b], agreement, 0.0)
    n = anywhere.sum(axis=0)
    return np.where(n > 1, total / np.maximum(n * (n - 1) / 2, 1), 0.0)


def cell_costs(images, nodes, heights, index, block, halves, seen, floor):
    """64 (1 - mean NCC) of every cell of a block at one height index, (r, c) float, before rounding.

    Where fewer than two images cover that height, a fixed cost: see `block_costs`.
    """
    half = max(halves)
    shape = seen.shape[2:]
    t = heights[0] + index * heights[1]
    planes = [
        bilinear(image, positions(node, t, shape, block, half)) for image, node in zip(images, nodes, strict=True)
    ]
    covered = (seen[0] <= index) & (index <= seen[1])
    visible = np.stack([covered & (seen[2] <= index), seen[0] <= seen[1]])
    by_window = []
    for small in halves:
        trim = half - small
        inner = [plane[trim : plane.shape[0] - trim, trim : plane.shape[1] - trim] for plane in planes]
        by_window.append(mean_ncc(inner, visible, small, floor))
    return np.where(covered.sum(axis=0) > 1, 64.0 - 64.0 * np.mean(by_window, axis=0), UNSEEN_COST)


def profile(images, nodes, heights, surface, offset, block, half, seen, floor=0.0):
    """Mean NCC, (r, c), in windows of a block that follow a surface (r + 2 half, c + 2 half), plus `offset`."""
    shape = seen.shape[2:]
    t = heights[0] + (surface + offset) * heights[1]
    planes = [cubic(image, positions(node, t, shape, block, half)) for image, node in zip(images, nodes, strict=True)]
    centre = surface[half : half + shape[0], half : half + shape[1]]
    visible = (seen[0] <= centre) & (centre <= seen[1]) & (seen[2] <= centre)
    return mean_ncc(planes, np.stack([visible, visible]), half, floor)
