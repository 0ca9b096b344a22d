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


# f4, f4, b1, PenaltyOptions -> u2
@kernel
def jump_penalty(here, other, has_two_views, options):
    """P2 / (1 + grey difference / unit), not below the least penalty; a difference that is not known counts as 0."""
    away = abs(here - other)
    away = away if away == away else np.float32(0.0)
    unit = options.unit_two_views if has_two_views else options.unit
    return np.uint16(np.int32(max(options.p2 / (np.float32(1.0) + away / unit), options.min_p2)))


# (n,) f4, (n,) f4, (n,) b1, PenaltyOptions, (n,) u2 -> None
@kernel
def penalties_between(here, other, has_two_views, options, out):
    """`jump_penalty` of neighbours, cell by cell."""
    for c in range(out.shape[0]):
        out[c] = jump_penalty(here[c], other[c], has_two_views[c], options)


# (r,c) f4, (r,c) b1, PenaltyOptions, (4,r,c) u2 -> None
@kernel
def image_penalties(ortho, has_two_views, options, out):
    """P2 of the steps from W, NW, N and NE into each cell of an image; beyond its edges its values are repeated.

    ortho : (r, c) float32, NaN where the grey value is not known; has_two_views : (r, c) bool, cells that only two
    views cover; out : (4, r, c) uint16, written.
    """
    last = ortho.shape[1] - 1
    for r in range(ortho.shape[0]):
        here, above, two = ortho[r], ortho[max(r - 1, 0)], has_two_views[r]
        penalties_between(here[1:], here[:last], two[1:], options, out[0, r, 1:])
        penalties_between(here[1:], above[:last], two[1:], options, out[1, r, 1:])
        penalties_between(here, above, two, options, out[2, r])
        penalties_between(here[:last], above[1:], two[:last], options, out[3, r, :last])
        out[0, r, 0] = jump_penalty(here[0], here[0], two[0], options)
        out[1, r, 0] = jump_penalty(here[0], above[0], two[0], options)
        out[3, r, last] = jump_penalty(here[last], above[last], two[last], options)
