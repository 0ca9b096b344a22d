"""Twins of the evidence: bins of a pair of views from windows cut out of planes, sums of a table, and counts."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from reference.agreement import ncc, over_pairs, windows
from reference.projection import along_slope, bilinear

N_CONTRAST, N_DIFFERENCE, N_GREY, N_CORRELATION = 14, 3, 14, 20


def planes_at(images, nodes, heights, index, block, half, shape, relief):
    """Each view resampled on the plane of a block and `half` cells around it at one height index."""
    t = heights[0] + index * heights[1]
    return [
        bilinear(image, along_slope(node, t, relief, heights[1], shape, block, half))
        for image, node in zip(images, nodes, strict=True)
    ]


def pair_bins(a, b, halves, noise):
    """Contrast, difference, grey and correlation bin (r, c) of two planes; the last with its fraction."""
    half, correlation = max(halves), []
    for small in halves:
        trim = half - small
        inner = [plane[trim : plane.shape[0] - trim, trim : plane.shape[1] - trim] for plane in (a, b)]
        correlation.append(ncc(windows(inner[0], small), windows(inner[1], small)))
    contrast = [np.log2(windows(plane, half).var(axis=-1) / noise + 0.25) for plane in (a, b)]
    apart = np.abs(contrast[0] - contrast[1])
    grey = np.abs(a - b)[half:-half, half:-half]
    return (
        np.clip(contrast[0] + contrast[1] + 4, 0, N_CONTRAST - 1).astype(int),
        (apart >= 1.2).astype(int) + (apart >= 2.5),
        np.minimum(np.sqrt(grey) * N_GREY / 1.2, N_GREY - 1).astype(int),
        np.clip((np.mean(correlation, axis=0) + 1) / 2 * (N_CORRELATION - 1), 0, N_CORRELATION - 1.001),
    )


def from_table(table, bins):
    """Entries of a table (14, 3, 14, 20), interpolated along the correlation."""
    contrast, difference, grey, place = bins
    lower = place.astype(int)
    share = place - lower
    return (1 - share) * table[contrast, difference, grey, lower] + share * table[contrast, difference, grey, lower + 1]


def cell_evidence(planes, halves, noise, table, visible, excluded):
    """Mean evidence over the pairs of views, (r, c), see `reference.agreement.over_pairs`."""
    here = visible[0]
    total = np.zeros(here.shape[1:])
    for a, b in combinations(range(len(planes)), 2):
        total += np.where(here[a] & here[b], from_table(table, pair_bins(planes[a], planes[b], halves, noise)), 0.0)
    return over_pairs(total, visible, excluded)


def counted(planes, halves, noise, is_counted, here):
    """Counts (14, 3, 14, 20) of the nearest bins of all pairs that see a cell, where `is_counted` (r, c)."""
    counts = np.zeros((N_CONTRAST, N_DIFFERENCE, N_GREY, N_CORRELATION), int)
    for a, b in combinations(range(len(planes)), 2):
        contrast, difference, grey, place = pair_bins(planes[a], planes[b], halves, noise)
        nearest = place.astype(int) + (place - place.astype(int) > 0.5)
        which = is_counted & here[a] & here[b]
        np.add.at(counts, (contrast[which], difference[which], grey[which], nearest[which]), 1)
    return counts
