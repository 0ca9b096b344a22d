"""Slopes and brightness of a surface with holes."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

DARKEST, BRIGHTEST = 1.0, 255.0


# f8, f8, f8 -> f8
@kernel
def across(centre, one, other):
    """Height of a neighbour less that of the opposite one; a missing one is mirrored through the centre."""
    if np.isnan(one):
        one = 2.0 * centre - other
    elif np.isnan(other):
        other = 2.0 * centre - one
    return one - other


# f8, f8, f8, f8 -> f8
@kernel
def known(first, second, third, fourth):
    """The first value that is known."""
    if not np.isnan(first):
        return first
    if not np.isnan(second):
        return second
    return third if not np.isnan(third) else fourth


# (r,c) f8, i8, i8, (2) f8 -> None
@kernel
def horn_slopes(z, r, c, out):
    """Write the differences of height to east and north over eight cells to `out`, from a cell's eight neighbours.

    The height of the cell is known; rows go south. Source: Horn (1981), the weighted differences of section III
    (weights 1, 2, 1 over 8 cells). He has no value beside holes. Here a missing neighbour is mirrored through the
    centre; a pair of which both are missing is computed from the other pairs, or counts as level. On planes this is
    exact wherever two directions are known.
    """
    here = z[r, c]
    e, n = across(here, z[r, c + 1], z[r, c - 1]), across(here, z[r - 1, c], z[r + 1, c])
    ne, se = across(here, z[r - 1, c + 1], z[r + 1, c - 1]), across(here, z[r + 1, c + 1], z[r - 1, c - 1])
    if np.isnan(e) or np.isnan(n):
        e, n = known(e, (ne + se) / 2.0, ne - n, se + n), known(n, (ne - se) / 2.0, ne - e, e - se)
    if np.isnan(ne) or np.isnan(se):
        ne, se = known(ne, e + n, ne, ne), known(se, e - n, se, se)
    e, n, ne, se = known(e, 0.0, e, e), known(n, 0.0, n, n), known(ne, 0.0, ne, ne), known(se, 0.0, se, se)
    out[0], out[1] = ne + 2.0 * e + se, ne + 2.0 * n - se


# (r,c) f8, f8, (3) f8, (a,b) u1 -> None
@kernel
def shade_cells(ringed, cell_m, sun, out):
    """Write the brightness: 1 + 254 cos of the angle between normal and sun, 1 in shade, 0 without height.

    ringed : (r + 2, c + 2) m, heights with a ring of NaN; sun : east, north and up, of length 1; out : (r, c).
    """
    slopes = np.empty(2)
    scale = 8.0 * cell_m
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            if not np.isfinite(ringed[r + 1, c + 1]):
                out[r, c] = 0
                continue
            horn_slopes(ringed, r + 1, c + 1, slopes)
            east, north = slopes[0] / scale, slopes[1] / scale
            # The normal is (-east, -north, 1), not yet of length 1.
            cosine = (sun[2] - east * sun[0] - north * sun[1]) / np.sqrt(1.0 + east * east + north * north)
            out[r, c] = np.uint8(np.rint(DARKEST + (BRIGHTEST - DARKEST) * max(cosine, 0.0)))
