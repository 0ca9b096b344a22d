"""Polynomials in height whose heights are counted from a slanted surface instead of a level one."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel


# (n,) f8, f8 -> None
@kernel
def shift_polynomial(coefficients, delta):
    """Replace a polynomial p(t) by p(t + delta), by repeated division by Horner's scheme."""
    n = coefficients.shape[0]
    for first in range(n - 1):
        for k in range(n - 2, first - 1, -1):
            coefficients[k] += delta * coefficients[k + 1]


# (i,b,d,2,n) f8, (b,d) f8 -> None
@kernel
def shift_nodes(nodes, delta):
    """Replace the polynomials p(t) at the corners of blocks by p(t + delta). delta : of each corner."""
    for i in range(nodes.shape[0]):
        for b in range(nodes.shape[1]):
            for d in range(nodes.shape[2]):
                for axis in range(2):
                    shift_polynomial(nodes[i, b, d, axis], delta[b, d])


# (i,b,d,2,n) f8, (b,d) f8, i8, (i,e,f,2,2,n) f8 -> None
@kernel
def shift_bends(nodes, delta, block, bends):
    """Replace the bends of blocks (see `AxisGrid`) by those along a surface that is `delta` above the level one.

    nodes : before they are shifted; delta : at the corners, bilinear between them. Where the surface rises along a
    block and points move with height by other amounts at its two ends, a straight row of cells becomes bent.
    """
    n = nodes.shape[4]
    middle, sides, bend = np.empty(n), np.empty((2, n)), np.empty(n)
    for i in range(bends.shape[0]):
        for b in range(bends.shape[1]):
            for d in range(bends.shape[2]):
                at = 0.25 * (delta[b, d] + delta[b, d + 1] + delta[b + 1, d] + delta[b + 1, d + 1])
                for axis in range(2):
                    p, q = nodes[i, b, d, axis], nodes[i, b, d + 1, axis]
                    r, s = nodes[i, b + 1, d, axis], nodes[i, b + 1, d + 1, axis]
                    middle[:] = 0.25 * (p + q + r + s)
                    shift_polynomial(middle, at)
                    for along in range(2):
                        if along == 0:
                            sides[0], sides[1] = 0.5 * (p + q), 0.5 * (r + s)
                            first = 0.5 * (delta[b, d] + delta[b, d + 1])
                        else:
                            sides[0], sides[1] = 0.5 * (p + r), 0.5 * (q + s)
                            first = 0.5 * (delta[b, d] + delta[b + 1, d])
                        shift_polynomial(sides[0], first)
                        shift_polynomial(sides[1], 2.0 * at - first)
                        bend[:] = bends[i, b, d, along, axis]
                        shift_polynomial(bend, at)
                        bends[i, b, d, along, axis] = bend - 4.0 / (block * block) * (
                            middle - 0.5 * (sides[0] + sides[1])
                        )
