"""Which heights a view sees in each cell below a surface that may occlude it, how many views see it, and which best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# A view that moves by fewer cells than this per unit of height looks straight down.
MIN_SPEED = 1e-6


class RaySweep(NamedTuple):
    """How a tile is swept along the rays of one view: cell by cell along the longer component of their direction."""

    along_cols: bool  # b1: whether the sweep goes from column to column (else from row to row)
    sign: int  # i8: 1 where rays rise towards larger columns (rows), else -1
    gain: np.float32  # f4: height that a ray gains from one cell to the next
    drift: float  # f8: cells that a ray moves across the sweep from one cell to the next
    n_along: int  # i8: cells along the sweep
    n_across: int  # i8: cells across it
    is_vertical: bool  # b1: whether the view looks straight down, so that there is nothing to sweep


# i8, i8, f8, f8 -> RaySweep
@kernel
def ray_sweep(n_rows, n_cols, by_col, by_row):
    """The sweep of a tile along v = (by_col, by_row): cells that the point seen by a fixed pixel moves per height."""
    along_cols = abs(by_col) >= abs(by_row)
    major, minor = (by_col, by_row) if along_cols else (by_row, by_col)
    speed = max(abs(major), MIN_SPEED)
    n_along, n_across = (n_cols, n_rows) if along_cols else (n_rows, n_cols)
    sign = 1 if major > 0 else -1
    return RaySweep(along_cols, sign, np.float32(1.0 / speed), minor / speed, n_along, n_across, abs(major) < MIN_SPEED)


# (r,c) f4, f8, f8, (r,c) f4 -> None
@kernel
def lowest_visible(surface, by_col, by_row, out):
    """Write the lowest height that a view sees in each cell: max over h > 0 of surface(cell + h v) - h.

    surface : (r, c) float32, in any unit of height, without NaN; by_col, by_row : v, cells that the point seen by a
    fixed pixel moves per unit of height; out : (r, c) float32, -1e30 where nothing occludes the cell.

    One sweep against the direction of v: what occludes a cell also occludes the next cell on the ray, or that next cell
    itself does, less the height that the ray gains on the way. The value between two cells is interpolated.
    """
    sweep = ray_sweep(surface.shape[0], surface.shape[1], by_col, by_row)
    along_cols, sign, gain, n_across = sweep.along_cols, sweep.sign, sweep.gain, sweep.n_across
    out[:] = np.float32(-1e30)
    if sweep.is_vertical:
        return
    for step in range(1, sweep.n_along):
        m = sweep.n_along - 1 - step if sign > 0 else step
        for j in range(n_across):
            place = j + sweep.drift
            first = int(np.floor(place))
            fraction = np.float32(place - first)
            if first < 0 or first > n_across - 1 or (first + 1 > n_across - 1 and fraction > 0.0):
                continue
            second = min(first + 1, n_across - 1)
            if along_cols:
                a = max(out[first, m + sign], surface[first, m + sign])
                b = max(out[second, m + sign], surface[second, m + sign])
                out[j, m] = a + fraction * (b - a) - gain
            else:
                a = max(out[m + sign, first], surface[m + sign, first])
                b = max(out[m + sign, second], surface[m + sign, second])
                out[m, j] = a + fraction * (b - a) - gain


# (s,t) f4, (2,) i8, (r,c) f4, f4, f4, CellBox, (r,c) i4 -> None
@kernel
def write_lowest_unoccluded(lowest, first, slope_cells, margin, least, box, out):
    """Write the lowest height index at which nothing occludes each cell of a rectangle.

    A height counts as seen that lies at most `margin` below the lowest visible height. lowest : (s, t) float32, see
    `lowest_visible`; first : row and column, in `lowest`, of the first cell of the tile; slope_cells : (r, c) float32,
    the surface that height indices are counted from; least : no index is below it; out : (r, c) int32.
    """
    c0, c1 = box.first_col, box.end_col
    for r in range(box.first_row, box.end_row):
        found, ground, to = lowest[first[0] + r, first[1] + c0 : first[1] + c1], slope_cells[r, c0:c1], out[r, c0:c1]
        for c in range(c1 - c0):
            to[c] = np.int32(np.floor(max(found[c] - (ground[c] + margin), least)))


# VisibleHeights, (r,c) f4, (r,c) i4 -> None
@kernel
def count_seeing(visible, surface, out):
    """Write how many views see each cell at its height. surface : (r, c) float32 height indices; out : (r, c) int32."""
    out[:] = 0
    for r in range(out.shape[0]):
        at, n = surface[r], out[r]
        for i in range(visible.lowest_covered.shape[0]):
            low, high = visible.lowest_covered[i, r], visible.highest_covered[i, r]
            free_from = visible.lowest_unoccluded[i, r]
            for c in range(n.shape[0]):
                n[c] += np.int32((low[c] <= at[c]) & (at[c] <= high[c]) & (free_from[c] <= at[c]))


# VisibleHeights, i4 -> None
@kernel
def forget_most_occlusions(visible, never_occluded):
    """Remove occlusions from cells that would keep too few views, see `zlocus.matching.occlusion.keep_enough_views`.

    visible : whose `lowest_unoccluded` is changed; never_occluded : its value for a view that nothing occludes.
    """
    highest = np.int32(np.iinfo(np.int32).max)
    n_views, n_rows, n_cols = visible.lowest_covered.shape
    # The three lowest of each cell, in ascending order.
    first, second, third = np.empty(n_cols, np.int32), np.empty(n_cols, np.int32), np.empty(n_cols, np.int32)
    n_covering = np.empty(n_cols, np.int32)
    for r in range(n_rows):
        first[:], second[:], third[:], n_covering[:] = highest, highest, highest, 0
        for i in range(n_views):
            low, high = visible.lowest_covered[i, r], visible.highest_covered[i, r]
            free_from = visible.lowest_unoccluded[i, r]
            for c in range(n_cols):
                covers = low[c] <= high[c]
                n_covering[c] += np.int32(covers)
                of_view = free_from[c] if covers else highest
                third[c] = min(third[c], max(second[c], of_view))
                second[c] = min(second[c], max(first[c], of_view))
                first[c] = min(first[c], of_view)
        for i in range(n_views):
            low, high = visible.lowest_covered[i, r], visible.highest_covered[i, r]
            free_from = visible.lowest_unoccluded[i, r]
            for c in range(n_cols):
                is_lowest = (low[c] <= high[c]) & (free_from[c] <= third[c]) & (n_covering[c] > 3)
                free_from[c] = never_occluded if is_lowest | (n_covering[c] <= 2) else free_from[c]


# (i,b,d) f8, VisibleHeights, (r,c) f4, i8, (r,c) i4 -> None
@kernel
def finest_view(size, visible, surface, block, best):
    """Write, for each cell without a view, the view of the largest size that sees it, the first of equals.

    size : (i, b, d) float64, by blocks of `block` cells, positive where a view counts; surface : (r, c) float32, height
    indices; best : (r, c) int32, number of a view, below 0 where the cell has none yet.
    """
    n_cols = best.shape[1]
    most = np.empty(n_cols)
    for r in range(best.shape[0]):
        found, z = best[r], surface[r]
        for c in range(n_cols):
            most[c] = np.inf if found[c] >= 0 else 0.0
        for i in range(size.shape[0]):
            low, high = visible.lowest_covered[i, r], visible.highest_covered[i, r]
            free_from = visible.lowest_unoccluded[i, r]
            for d in range(size.shape[2]):
                of_view = size[i, r // block, d]
                for c in range(d * block, min((d + 1) * block, n_cols)):
                    is_seen = (low[c] <= z[c]) & (z[c] <= high[c]) & (free_from[c] <= z[c])
                    is_better = is_seen & (of_view > most[c])
                    found[c] = np.int32(i) if is_better else found[c]
                    most[c] = of_view if is_better else most[c]
