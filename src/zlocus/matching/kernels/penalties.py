"""Penalties of height jumps between neighbouring cells, by their grey difference in an image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel


class PenaltyOptions(NamedTuple):
    """Constants of the penalties, as the kernels take them."""

    p2: np.float32  # f4: penalty of a jump between cells of equal grey values
    min_p2: np.float32  # f4: least penalty
    unit: np.float32  # f4: grey difference that halves the penalty
    unit_two_views: np.float32  # f4: the same in cells that only two views cover


# f4, f4, f4, b1, PenaltyOptions -> u2
@kernel
def jump_penalty(here, other, edge_weight, has_two_views, options):
    """P2 / (1 + grey difference / unit), not below the least penalty; a difference that is not known counts as 0.

    edge_weight : from 0 to 1, how much of this decrease of P2 counts.
    """
    away = abs(here - other)
    away = away if away == away else np.float32(0.0)
    unit = options.unit_two_views if has_two_views else options.unit
    at_edge = max(options.p2 / (np.float32(1.0) + away / unit), options.min_p2)
    return np.uint16(np.int32(options.p2 - edge_weight * (options.p2 - at_edge)))


# (n,) f4, (n,) f4, (n,) f4, (n,) f4, (n,) b1, PenaltyOptions, (n,) u2 -> None
@kernel
def penalties_between(here, other, weight_here, weight_other, has_two_views, options, out):
    """`jump_penalty` of neighbours, cell by cell; an edge is worth what it is worth at both."""
    for c in range(out.shape[0]):
        edge_weight = min(weight_here[c], weight_other[c])
        out[c] = jump_penalty(here[c], other[c], edge_weight, has_two_views[c], options)


# (r,c) f4, (r,c) b1, (r,c) f4, PenaltyOptions, (4,r,c) u2 -> None
@kernel
def image_penalties(ortho, has_two_views, edge_weight, options, out):
    """P2 of the steps from W, NW, N and NE into each cell of an image; beyond its edges its values are repeated.

    ortho : (r, c) float32, NaN where the grey value is not known; has_two_views : (r, c) bool, cells that only two
    views cover; edge_weight : (r, c) float32 from 0 to 1; out : (4, r, c) uint16, written.
    """
    last = ortho.shape[1] - 1
    for r in range(ortho.shape[0]):
        up = max(r - 1, 0)
        here, above, two, edge, edge_above = ortho[r], ortho[up], has_two_views[r], edge_weight[r], edge_weight[up]
        penalties_between(here[1:], here[:last], edge[1:], edge[:last], two[1:], options, out[0, r, 1:])
        penalties_between(here[1:], above[:last], edge[1:], edge_above[:last], two[1:], options, out[1, r, 1:])
        penalties_between(here, above, edge, edge_above, two, options, out[2, r])
        penalties_between(here[:last], above[1:], edge[:last], edge_above[1:], two[:last], options, out[3, r, :last])
        out[0, r, 0] = jump_penalty(here[0], here[0], edge[0], two[0], options)
        out[1, r, 0] = jump_penalty(here[0], above[0], min(edge[0], edge_above[0]), two[0], options)
        out[3, r, last] = jump_penalty(
            here[last], above[last], min(edge[last], edge_above[last]), two[last], options
        )  # fmt: skip
