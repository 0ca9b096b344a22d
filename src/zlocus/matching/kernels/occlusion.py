"""Which heights a view can see in each cell, given a surface that may hide them; how many views see it, which best."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel


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


# (s,t) f4, (2,) i8, (r,c) f4, f4, f4, (2,2) i8, (r,c) i4 -> None
@kernel
def hide_below(lowest, first, base, margin, least, ends, out):
    """Height index from which on nothing hides each cell: what lies at most `margin` below the lowest visible height is
    seen, and no height index is below `least`.

    lowest : (s, t) float32, see `lowest_visible`; first : row and column in it of the first cell; base : (r, c)
    float32, that height indices are counted from; ends : first row and the one after the last, and so for columns, of
    the cells that are written; out : (r, c) int32.
    """
    c0, c1 = ends[1, 0], ends[1, 1]
    for r in range(ends[0, 0], ends[0, 1]):
        found, ground, to = lowest[first[0] + r, first[1] + c0 : first[1] + c1], base[r, c0:c1], out[r, c0:c1]
        for c in range(c1 - c0):
            to[c] = np.int32(np.floor(max(found[c] - (ground[c] + margin), least)))


# (3,i,r,c) i4, (r,c) f4, (r,c) i4 -> None
@kernel
def count_seeing(seen, surface, out):
    """How many views see each cell at its height. seen : (3, i, r, c) int32, lowest and highest height index at which a
    view covers a cell, and the lowest at which nothing hides it; surface : (r, c) float32, height indices; out : (r, c)
    int32, written."""
    out[:] = 0
    for r in range(out.shape[0]):
        at, n = surface[r], out[r]
        for i in range(seen.shape[1]):
            low, high, visible = seen[0, i, r], seen[1, i, r], seen[2, i, r]
            for c in range(n.shape[0]):
                n[c] += np.int32((low[c] <= at[c]) & (at[c] <= high[c]) & (visible[c] <= at[c]))


# (i,b,d) f8, (3,i,r,c) i4, (r,c) f4, i8, (r,c) i4 -> None
@kernel
def finest_view(size, seen, surface, block, best):
    """Of the views that see each cell that with the largest size, the first of equals; cells that have one keep it.

    size : (i, b, d) float64, by blocks of so many cells, positive where a view counts; seen, surface : see
    `count_seeing`; best : (r, c) int32, written where it is below 0.
    """
    n_cols = best.shape[1]
    most = np.empty(n_cols)
    for r in range(best.shape[0]):
        found, z = best[r], surface[r]
        for c in range(n_cols):
            most[c] = np.inf if found[c] >= 0 else 0.0
        for i in range(size.shape[0]):
            low, high, visible = seen[0, i, r], seen[1, i, r], seen[2, i, r]
            for d in range(size.shape[2]):
                of_view = size[i, r // block, d]
                for c in range(d * block, min((d + 1) * block, n_cols)):
                    is_seen = (low[c] <= z[c]) & (z[c] <= high[c]) & (visible[c] <= z[c])
                    is_better = is_seen & (of_view > most[c])
                    found[c] = np.int32(i) if is_better else found[c]
                    most[c] = of_view if is_better else most[c]
