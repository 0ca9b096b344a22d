"""Smoothing of a surface that keeps its jumps."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel


# (r,c) f4, i8, f4, f4, (r,c) f4 -> None
@kernel
def smooth_surface(surface, radius, spread, jump, out):
    """Weighted mean over a square of cells; cells further than `jump` in height have no weight.

    surface : (r, c) float32, any unit of height; radius : cells; spread : sigma of the weights by distance, cells;
    jump : same unit as the surface, weights fall as (1 - (dz / jump)^2)^2; out : (r, c), written.
    Source: Tomasi and Manduchi (1998), with Tukey's weight in height.
    """
    n_rows, n_cols = surface.shape
    near = np.empty(2 * radius + 1, np.float32)
    for d in range(2 * radius + 1):
        near[d] = np.exp(-0.5 * ((d - radius) / spread) ** 2)
    inverse = np.float32(1.0) / jump
    for r in range(n_rows):
        for c in range(n_cols):
            centre = surface[r, c]
            total = weight = np.float32(0.0)
            for i in range(max(r - radius, 0), min(r + radius + 1, n_rows)):
                by_row = near[i - r + radius]
                for j in range(max(c - radius, 0), min(c + radius + 1, n_cols)):
                    away = (surface[i, j] - centre) * inverse
                    kept = max(np.float32(1.0) - away * away, np.float32(0.0))
                    w = kept * kept * by_row * near[j - c + radius]
                    total += w * (surface[i, j] - centre)
                    weight += w
            out[r, c] = centre + total / weight
