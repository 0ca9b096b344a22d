"""Planes through segments without texture, by least squares matching of their grey values in all views at once.

A whole segment is matched with one plane of heights (Grün 1985). The inside of a plain roof fits at any height, but
where the outline of the segment in a view does not lie where the plane puts it, the cells there show what lies beside
the segment.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# Unit of the slopes of a plane: over so many cells a change of a slope moves the heights as much as an equal change of
# the plane's height does.
SLOPE_SPAN_CELLS = 10.0
# Iterations of the robust plane through the heights, and of the least squares matching that follows.
START_ROUNDS, MATCHING_ROUNDS = 8, 6
# Noise of the heights: in the robust plane all cells nearer than this weigh the same.
HEIGHT_NOISE_STEPS = 0.3
# The core of a segment has to be plain in this share of the views that see it. Two of eight views may be hazy, or of a
# day when a shadow crossed the roof. Were two thirds enough, planes would replace better heights where six views match.
MIN_SHARE_OF_PLAIN_VIEWS = 0.75
# Share of the mean diagonal that is added to the normal equations, and the largest change of a parameter in a round.
DAMPING, MAX_CHANGE_STEPS = 1e-2, 1.0


class PlaneCells(NamedTuple):
    """Cells of plain segments, one segment after the other."""

    row: np.ndarray  # (n,) i8: row in the tile
    col: np.ndarray  # (n,) i8: column in the tile
    height: np.ndarray  # (n,) f8: height index
    is_core: np.ndarray  # (n,) b1: whether the cell is plain itself, not one of the rim around the plain cells
    is_visible: np.ndarray  # (i,n) b1: views that see the cell


class PlaneLimits(NamedTuple):
    """What counts as noise."""

    noise: float  # f8: grey difference between views that is noise
    max_cost: float  # f8: cost of the core of a plain segment, in units of the noise squared


class FittedPlanes(NamedTuple):
    """Results for all segments, written."""

    is_plain: np.ndarray  # (s,) b1: whether the core of a segment is plain in the views
    planes: np.ndarray  # (s,k) f8: height in the middle, then slopes along rows and columns
    costs: np.ndarray  # (s,k,k) f8: before and after the fit, each of all cells and of the core
    heights: np.ndarray  # (n,) f8: height index of the plane at each cell


# (3,3) f8, (3,) f8, f8, (3,) f8 -> None
@kernel
def solve_damped(normal, right, damping, out):
    """Solve three normal equations by Cramer's rule, with a share of the mean diagonal added to the diagonal; 0 where
    they are singular."""
    more = damping * (normal[0, 0] + normal[1, 1] + normal[2, 2]) / 3.0 + 1e-9
    a, b, c = normal[0, 0] + more, normal[0, 1], normal[0, 2]
    d, e, f = normal[1, 1] + more, normal[1, 2], normal[2, 2] + more
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    whole = a * ca + b * cb + c * cc
    scale = 0.0 if whole == 0.0 else 1.0 / whole
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    out[0] = scale * (ca * right[0] + cb * right[1] + cc * right[2])
    out[1] = scale * (cb * right[0] + cd * right[1] + ce * right[2])
    out[2] = scale * (cc * right[0] + ce * right[1] + cf * right[2])


# (n,) i8, (n,) i8, (2,) f8, (3,) f8, (n,) f8 -> None
@kernel
def plane_heights(row, col, middle, plane, out):
    """Heights of a plane (height in the middle, then slopes per SLOPE_SPAN_CELLS cells) at the cells of a segment."""
    for p in range(row.shape[0]):
        out[p] = (
            plane[0]
            + plane[1] * ((row[p] - middle[0]) / SLOPE_SPAN_CELLS)
            + plane[2] * ((col[p] - middle[1]) / SLOPE_SPAN_CELLS)
        )


# (n,) i8, (n,) i8, (2,) f8, (n,) f8, (n,) f8, (3,3) f8, (3,) f8 -> None
@kernel
def normal_equations(row, col, middle, weight, value, normal, right):
    """Sums of weight x x' and of value x over a segment, x = 1 and the two places in SLOPE_SPAN_CELLS cells."""
    normal[:] = 0.0
    right[:] = 0.0
    for p in range(row.shape[0]):
        y, x, w, v = (
            (row[p] - middle[0]) / SLOPE_SPAN_CELLS,
            (col[p] - middle[1]) / SLOPE_SPAN_CELLS,
            weight[p],
            value[p],
        )
        normal[0, 0] += w
        normal[0, 1] += w * y
        normal[0, 2] += w * x
        normal[1, 1] += w * y * y
        normal[1, 2] += w * y * x
        normal[2, 2] += w * x * x
        right[0] += v
        right[1] += v * y
        right[2] += v * x


# (n,) i8, (n,) i8, (2,) f8, (n,) f8, (n,) f8, (n,) f8, (3,) f8 -> None
@kernel
def plane_through(row, col, middle, height, weight, value, plane):
    """Robust plane through the heights of a segment: least squares, iterated with weights 1 / distance."""
    normal, right, at = np.empty((3, 3)), np.empty(3), np.empty(row.shape[0])
    weight[:] = 1.0
    for _ in range(START_ROUNDS):
        for p in range(row.shape[0]):
            value[p] = weight[p] * height[p]
        normal_equations(row, col, middle, weight, value, normal, right)
        solve_damped(normal, right, 0.0, plane)
        plane_heights(row, col, middle, plane, at)
        for p in range(row.shape[0]):
            weight[p] = 1.0 / max(abs(height[p] - at[p]), HEIGHT_NOISE_STEPS)


# ViewArrays, (n,) i8, (n,) i8, (n,) f8, (i,n,4) f8 -> None
@kernel
def segment_loci(views, row, col, height, locus):
    """Write to `locus` where each view shows the cells of a segment, px, and by how much that moves per height step."""
    nodes, bends, heights, block = views.nodes, views.bends, views.heights, views.block
    for p in range(row.shape[0]):
        b, d = row[p] // block, col[p] // block
        fr, fc = (row[p] - b * block) / block, (col[p] - d * block) / block
        w0, w1, w2, w3 = (1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc
        bend_row, bend_col = block * block * fr * (fr - 1), block * block * fc * (fc - 1)
        t = heights[0] + height[p] * heights[1]
        for i in range(nodes.shape[0]):
            for axis in range(2):
                place = moves = 0.0
                for k in range(nodes.shape[4] - 1, -1, -1):
                    moves = moves * t + place
                    place = place * t + (
                        w0 * nodes[i, b, d, axis, k] + w1 * nodes[i, b, d + 1, axis, k]
                        + w2 * nodes[i, b + 1, d, axis, k] + w3 * nodes[i, b + 1, d + 1, axis, k]
                    )  # fmt: skip
                bent = bends_more = 0.0
                for k in range(bends.shape[5] - 1, -1, -1):
                    bends_more = bends_more * t + bent
                    bent = bent * t + bend_row * bends[i, b, d, 0, axis, k] + bend_col * bends[i, b, d, 1, axis, k]
                locus[i, p, axis] = place + bent
                locus[i, p, 2 + axis] = (moves + bends_more) * heights[1]


# (p,) f4, (i,3) i8, (i,n,4) f8, (n,) f8, (n,) f8, (i,n) f8, (i,n) f8 -> None
@kernel
def segment_greys(pixels, layout, locus, start, height, grey, slope):
    """Write the grey value of every view at the cells of a segment, bilinear, and its change per height step.

    start : (n,) heights for which `locus` was computed; height : (n,) heights of the grey values; grey, slope : (i, n),
    written.
    """
    for i in range(layout.shape[0]):
        offset, n_rows, n_cols = layout[i, 0], layout[i, 1], layout[i, 2]
        for p in range(height.shape[0]):
            away = height[p] - start[p]
            # Beyond the image its outermost pixels are repeated. Where a projection table does not hold (NaN), what is
            # read here does not count.
            x, y = locus[i, p, 0] + away * locus[i, p, 2], locus[i, p, 1] + away * locus[i, p, 3]
            x = min(x, n_cols - 1.001) if x > 0.0 else 0.0
            y = min(y, n_rows - 1.001) if y > 0.0 else 0.0
            c, r = int(x), int(y)
            fx, fy = x - c, y - r
            at = offset + r * n_cols + c
            above, below = pixels[at + 1] - pixels[at], pixels[at + n_cols + 1] - pixels[at + n_cols]
            first, second = pixels[at] + fx * above, pixels[at + n_cols] + fx * below
            grey[i, p] = first + fy * (second - first)
            slope[i, p] = (above + fy * (below - above)) * locus[i, p, 2] + (second - first) * locus[i, p, 3]


# (n,) f8, i8 -> f8
@kernel
def median_of(values, n):
    """Median of the first n values; sorts them."""
    for j in range(1, n):
        value, k = values[j], j
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return 0.5 * (values[(n - 1) // 2] + values[n // 2])


# (i,n) f8, (i,n) f8, (i,n) b1, (n,) b1, f8, (n,) f8, (n,) f8, (i,2) f8 -> None
@kernel
def disagreement(grey, slope, visible, is_core, noise, weight, value, cost):
    """Compare the grey values of the views with their median, cell by cell.

    weight, value : (n,) float64, terms of the normal equations, written; cost : (i, 2), written, mean Huber loss of
    each view over all cells and over the core, in units of the noise squared, infinite where it sees none. Views that
    do not see a cell do not count there.
    """
    n_views, seen = grey.shape[0], np.empty(grey.shape[0])
    cost[:] = 0.0
    n = np.zeros((n_views, 2))
    for p in range(grey.shape[1]):
        m, mean_slope = 0, 0.0
        for i in range(n_views):
            if visible[i, p]:
                seen[m] = grey[i, p]
                m += 1
                mean_slope += slope[i, p]
        weight[p] = value[p] = 0.0
        if m < 2:
            continue
        middle = median_of(seen, m)
        mean_slope /= m
        for i in range(n_views):
            if visible[i, p]:
                q, s = grey[i, p] - middle, slope[i, p] - mean_slope
                size = abs(q) / noise
                w = 1.0 if size < 1.0 else 1.0 / size
                weight[p] += w * s * s
                value[p] -= w * s * q
                for part in range(2 if is_core[p] else 1):
                    cost[i, part] += 0.5 * size * size if size < 1.0 else size - 0.5
                    n[i, part] += 1.0
    for i in range(n_views):
        for part in range(2):
            cost[i, part] = cost[i, part] / n[i, part] if n[i, part] > 0.0 else np.inf


# (i,n) f8, (i,n) b1, (n,) b1 -> None
@kernel
def level_greys(grey, visible, is_core):
    """Subtract from the grey values of each view its mean difference from the median of the views over the core."""
    n_views, seen = grey.shape[0], np.empty(grey.shape[0])
    total, n = np.zeros(n_views), np.zeros(n_views)
    for p in range(grey.shape[1]):
        m = 0
        for i in range(n_views):
            if visible[i, p] and is_core[p]:
                seen[m] = grey[i, p]
                m += 1
        if m < 2:
            continue
        middle = median_of(seen, m)
        for i in range(n_views):
            if visible[i, p]:
                total[i] += grey[i, p] - middle
                n[i] += 1.0
    for i in range(n_views):
        if n[i] > 0.0:
            brighter = total[i] / n[i]
            for p in range(grey.shape[1]):
                grey[i, p] -= brighter


# (i,n) b1, (i,2) f8, f8 -> i8
@kernel
def exclude_views(visible, cost, max_cost):
    """Exclude the views in which the core of a segment is not plain (a view of another day, for example).

    Returns how many views are left, 0 where they are fewer than MIN_SHARE_OF_PLAIN_VIEWS.
    """
    left, seeing = 0, 0
    for i in range(visible.shape[0]):
        if not np.isfinite(cost[i, 1]):
            continue
        seeing += 1
        if cost[i, 1] < max_cost:
            left += 1
        else:
            visible[i] = False
    return left if left >= MIN_SHARE_OF_PLAIN_VIEWS * seeing else 0


# (i,2) f8, i8 -> f8
@kernel
def mean_cost(cost, part):
    """Mean cost of the views that see a segment. part : 0 for all cells, 1 for the core."""
    total, n = 0.0, 0
    for i in range(cost.shape[0]):
        if np.isfinite(cost[i, part]):
            total += cost[i, part]
            n += 1
    return total / n if n else np.inf


# PlaneCells, ViewArrays, PlaneLimits, (3,) f8, (2,2) f8, (n,) f8 -> b1
@kernel
def fit_segment(cells, views, limits, plane, costs, out):
    """Find the plane of one segment on which the views agree best, starting from the plane through its heights.

    Returns False where the core of the segment is not plain. cells : of the segment; views that are excluded are taken
    off `cells.is_visible`; plane, costs, out : see `FittedPlanes`, written.
    """
    row, col, height, is_core, visible = cells.row, cells.col, cells.height, cells.is_core, cells.is_visible
    pixels, layout, noise, max_cost = views.pixels, views.layout, limits.noise, limits.max_cost
    n, n_views = row.shape[0], layout.shape[0]
    middle = np.array([row.mean(), col.mean()])
    locus, grey, slope = np.empty((n_views, n, 4)), np.empty((n_views, n)), np.empty((n_views, n))
    weight, value, cost, moved = np.empty(n), np.empty(n), np.empty((n_views, 2)), np.empty(3)
    normal, right = np.empty((3, 3)), np.empty(3)
    segment_loci(views, row, col, height, locus)
    segment_greys(pixels, layout, locus, height, height, grey, slope)
    level_greys(grey, visible, is_core)
    disagreement(grey, slope, visible, is_core, noise, weight, value, cost)
    if not mean_cost(cost, 1) < max_cost:
        if exclude_views(visible, cost, max_cost) < 2:
            return False
        disagreement(grey, slope, visible, is_core, noise, weight, value, cost)
    costs[0] = mean_cost(cost, 0), mean_cost(cost, 1)
    now = np.empty(3)
    plane_through(row, col, middle, height, weight, value, now)
    costs[1] = np.inf
    for _ in range(MATCHING_ROUNDS):
        plane_heights(row, col, middle, now, out)
        segment_greys(pixels, layout, locus, height, out, grey, slope)
        level_greys(grey, visible, is_core)
        disagreement(grey, slope, visible, is_core, noise, weight, value, cost)
        if mean_cost(cost, 0) < costs[1, 0]:
            costs[1] = mean_cost(cost, 0), mean_cost(cost, 1)
            plane[:] = now
        normal_equations(row, col, middle, weight, value, normal, right)
        solve_damped(normal, right, DAMPING, moved)
        for k in range(3):
            now[k] += min(max(moved[k], -MAX_CHANGE_STEPS), MAX_CHANGE_STEPS)
    plane_heights(row, col, middle, plane, out)
    return True


# (s,) i8, PlaneCells, ViewArrays, PlaneLimits, FittedPlanes -> None
@kernel
def fit_segments(start, cells, views, limits, fitted):
    """`fit_segment` of every segment. start : (s + 1,), where the cells of each segment begin."""
    for s in range(start.shape[0] - 1):
        a, b = start[s], start[s + 1]
        of_segment = PlaneCells(
            cells.row[a:b], cells.col[a:b], cells.height[a:b], cells.is_core[a:b], cells.is_visible[:, a:b].copy()
        )  # fmt: skip
        fitted.is_plain[s] = fit_segment(
            of_segment, views, limits, fitted.planes[s], fitted.costs[s], fitted.heights[a:b]
        )  # fmt: skip
