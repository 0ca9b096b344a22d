"""An RPC in plain NumPy, all points at once."""

from __future__ import annotations

import numpy as np

from zlocus.sensors.rpc import rpc_terms

MAX_ITERATIONS, MAX_STEP, TOLERANCE_PX = 30, 0.5, 1e-7


def position(rpc, sums):
    """Normalised (sample, line) (2, n) of the four polynomials (4, n); NaN beyond a pole."""
    line_num, line_den, samp_num, samp_den = sums
    with np.errstate(all="ignore"):
        found = np.stack([samp_num / samp_den, line_num / line_den])
        usable = (line_den * rpc.line_den[0] > 0) & (samp_den * rpc.samp_den[0] > 0)
    found[:, ~(usable & np.isfinite(found).all(axis=0))] = np.nan
    return found


def positions(rpc, lon, lat, height):
    """Normalised image positions (n, 2) of normalised ground coordinates."""
    with np.errstate(all="ignore"):
        return position(rpc, rpc.matrix @ rpc_terms(lon, lat, height)).T


def newton_step(rpc, terms, sums, residual):
    """Normalised step (2, n) that removes a residual (2, n). terms : (10, n), the quadratic ones."""
    line_num, line_den, samp_num, samp_den = sums
    with np.errstate(all="ignore"):
        sample, line, slopes = samp_num / samp_den, line_num / line_den, []
        for by_line_num, by_line_den, by_samp_num, by_samp_den in (rpc.slopes @ terms).reshape(2, 4, -1):
            slopes.append(
                [(by_samp_num - sample * by_samp_den) / samp_den, (by_line_num - line * by_line_den) / line_den]
            )
        inverse = np.linalg.inv(np.moveaxis(np.array(slopes), (0, 1, 2), (2, 1, 0)))
        step = np.einsum("nij,jn->in", inverse, residual)
    return np.clip(step, -MAX_STEP, MAX_STEP)


def ground_positions(rpc, target, height):
    """Normalised longitudes and latitudes (n, 2) of normalised image positions; NaN where they are not reached."""
    scale = np.array([[rpc.samp_scale], [rpc.line_scale]])
    ground, done = np.zeros((2, len(target))), np.zeros(len(target), bool)
    for _ in range(MAX_ITERATIONS):
        terms = rpc_terms(*ground, height)
        sums = rpc.matrix @ terms
        residual = target.T - position(rpc, sums)
        done |= (np.abs(residual * scale) < TOLERANCE_PX).all(axis=0)
        going = np.isfinite(residual).all(axis=0) & ~done
        ground[:, going] += newton_step(rpc, terms[:10, going], sums[:, going], residual[:, going])
    return np.where(done, ground, np.nan).T
