"""Smoothing of a surface that keeps its jumps."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel

# Binomial weights of five taps, as the a-trous scheme uses them.
TAPS = (1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0)


# (c,) f4, (c,) f4, f4, f4, (c,) f4, (c,) f4 -> None
@kernel
def add_tap(centre, other, near, inverse, total, weight):
    """Add one neighbour of every cell of a row: weight near (1 - (dz / jump)^2)^2, none beyond the jump."""
    for c in range(centre.shape[0]):
        step = other[c] - centre[c]
        away = step * inverse
        kept = max(np.float32(1.0) - away * away, np.float32(0.0))
        w = near * kept * kept
        total[c] += w * step
        weight[c] += w


# (r,c) f4, i8, f4, (r,c) f4 -> None
@kernel
def smooth_surface(surface, spacing, jump, out):
    """Weighted mean over 5 x 5 cells `spacing` apart; cells further than `jump` in height have no weight.

    surface : (r, c) float32, any unit of height; jump : the same unit; out : (r, c), written. Passes with growing
    spacings make a wide smoothing of few taps. Source: Tomasi and Manduchi (1998), with Tukey's weight in height and
    the taps of Starck et al. (2007).
    """
    n_rows, n_cols = surface.shape
    taps = np.array(TAPS, np.float32)
    inverse = np.float32(1.0) / jump
    total, weight = np.empty(n_cols, np.float32), np.empty(n_cols, np.float32)
    for r in range(n_rows):
        total[:] = 0.0
        weight[:] = 0.0
        for i in range(5):
            row = r + (i - 2) * spacing
            if row < 0 or row >= n_rows:
                continue
            for j in range(5):
                shift = (j - 2) * spacing
                c0, c1 = max(-shift, 0), min(n_cols - shift, n_cols)
                if c1 > c0:
                    add_tap(
                        surface[r, c0:c1], surface[row, c0 + shift : c1 + shift], taps[i] * taps[j], inverse,
                        total[c0:c1], weight[c0:c1],
                    )  # fmt: skip
        for c in range(n_cols):
            out[r, c] = surface[r, c] + total[c] / weight[c]
