"""Which heights a view can see in each cell, given a surface that may hide them."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel


# (r,c) f4, f8, f8, (r,c) f4 -> None
@kernel
def lowest_visible(surface, by_col, by_row, out):
    """Lowest height that a view sees in each cell: max over h > 0 of surface(cell + h v) - h.

    surface : (r, c) float32, in any unit of height (NaN nowhere); by_col, by_row : v, cells the point seen by a fixed
    pixel moves per unit of height; out : (r, c) float32, -1e30 where nothing stands in the way.

    One sweep against the direction of v, a cell at a time along its longer component: what hides a cell is what hides
    the next one on the ray, or that next cell itself, less the height the ray gains on the way. The value between two
    cells is interpolated.
    """
    n_rows, n_cols = surface.shape
    out[:] = np.float32(-1e30)
    along_cols = abs(by_col) >= abs(by_row)
    major = by_col if along_cols else by_row
    if abs(major) < 1e-6:
        return
    gain = np.float32(1.0 / abs(major))
    slant = (by_row if along_cols else by_col) / abs(major)
    sign = 1 if major > 0 else -1
    n_major, n_minor = (n_cols, n_rows) if along_cols else (n_rows, n_cols)
    for step in range(1, n_major):
        m = n_major - 1 - step if sign > 0 else step
        for j in range(n_minor):
            place = j + slant
            first = int(np.floor(place))
            fraction = np.float32(place - first)
            if first < 0 or first > n_minor - 1 or (first + 1 > n_minor - 1 and fraction > 0.0):
                continue
            second = min(first + 1, n_minor - 1)
            if along_cols:
                a = max(out[first, m + sign], surface[first, m + sign])
                b = max(out[second, m + sign], surface[second, m + sign])
                out[j, m] = a + fraction * (b - a) - gain
            else:
                a = max(out[m + sign, first], surface[m + sign, first])
                b = max(out[m + sign, second], surface[m + sign, second])
                out[m, j] = a + fraction * (b - a) - gain
