"""An image whose lines are put back where its camera model says they are."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel


# (r,c) f4, (s) i8, (s,n) f4, (s) i8, (s,n) f4, (s,t) f4 -> None
@kernel
def straighten(pixels, first_row, row_weights, first_col, col_weights, out):
    """Write lines of an image, each interpolated at its own displacement.

    pixels : the lines with a margin; first_row, row_weights : first of the n lines that a line of `out` is interpolated
    from, and their weights; first_col, col_weights : the same for columns, counted for the first pixel of the line.
    """
    n_taps = row_weights.shape[1]
    line = np.empty(pixels.shape[1], np.float32)
    for r in range(out.shape[0]):
        line[:] = np.float32(0.0)
        for k in range(n_taps):
            weight, source = row_weights[r, k], pixels[first_row[r] + k]
            for c in range(line.shape[0]):
                line[c] += weight * source[c]
        out[r, :] = np.float32(0.0)
        for k in range(n_taps):
            weight, offset = col_weights[r, k], first_col[r] + k
            for c in range(out.shape[1]):
                out[r, c] += weight * line[c + offset]
