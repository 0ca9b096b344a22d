"""What a jump of the height costs between two cells, by how much they differ in an image."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel


# f4, f4, b1, (2,) f4, f4, f4 -> u2
@kernel
def eased(here, other, by_two, units, p2, least):
    """P2 / (1 + grey difference / unit), not below `least`; a difference that is not known is none.

    units : (2,) float32, of cells that two views cover (`by_two`) the second.
    """
    away = abs(here - other)
    away = away if away == away else np.float32(0.0)
    unit = units[1] if by_two else units[0]
    return np.uint16(np.int32(max(p2 / (np.float32(1.0) + away / unit), least)))


# (n,) f4, (n,) f4, (n,) b1, (2,) f4, f4, f4, (n,) u2 -> None
@kernel
def penalties_between(here, other, by_two, units, p2, least, out):
    """`eased` of neighbours."""
    for c in range(out.shape[0]):
        out[c] = eased(here[c], other[c], by_two[c], units, p2, least)


# (r,c) f4, (r,c) b1, (2,) f4, f4, f4, (4,r,c) u2 -> None
@kernel
def jump_penalties(ortho, by_two, units, p2, least, out):
    """P2 of the steps from W, NW, N and NE into each cell of an image; beyond its border lie the same values again.

    ortho : (r, c) float32, NaN where nothing is known; by_two, units : see `eased`; out : (4, r, c) uint16, written.
    """
    last = ortho.shape[1] - 1
    for r in range(ortho.shape[0]):
        here, above, two = ortho[r], ortho[max(r - 1, 0)], by_two[r]
        penalties_between(here[1:], here[:last], two[1:], units, p2, least, out[0, r, 1:])
        penalties_between(here[1:], above[:last], two[1:], units, p2, least, out[1, r, 1:])
        penalties_between(here, above, two, units, p2, least, out[2, r])
        penalties_between(here[:last], above[1:], two[:last], units, p2, least, out[3, r, :last])
        out[0, r, 0] = eased(here[0], here[0], two[0], units, p2, least)
        out[1, r, 0] = eased(here[0], above[0], two[0], units, p2, least)
        out[3, r, last] = eased(here[last], above[last], two[last], units, p2, least)
