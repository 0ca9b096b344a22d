"""Planes through plain segments, whose cells say nothing alone: their grey values are fitted in all views at once.

Least squares matching of a whole segment (Grün 1985) with a plane of heights: inside, a plain roof fits at any height,
but where a view's outline of the segment does not lie where the plane puts it, cells show what lies beside.
"""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# Cells per unit of a plane's slopes: a slope then moves heights about as much as its height does.
SPAN = 10.0
ROUNDS_TO_START, ROUNDS = 8, 6
NEAR_STEPS = 0.3  # a surface's noise: nearer cells all weigh the same at the start
DAMPING, MOST_MOVED = 1e-2, 1.0


# (3,3) f8, (3,) f8, f8, (3,) f8 -> None
@kernel
def solve_damped(normal, right, damping, out):
    """Solve three normal equations, with a share of their mean diagonal added to it (Cramer); 0 where singular."""
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
    """Heights of a plane (height in the middle, then slopes per SPAN cells) at the cells of a segment."""
    for p in range(row.shape[0]):
        out[p] = plane[0] + plane[1] * ((row[p] - middle[0]) / SPAN) + plane[2] * ((col[p] - middle[1]) / SPAN)


# (n,) i8, (n,) i8, (2,) f8, (n,) f8, (n,) f8, (3,3) f8, (3,) f8 -> None
@kernel
def normal_equations(row, col, middle, weight, value, normal, right):
    """Sums of weight x x' and of value x over a segment, x = 1 and the two places in SPAN cells."""
    normal[:] = 0.0
    right[:] = 0.0
    for p in range(row.shape[0]):
        y, x, w, v = (row[p] - middle[0]) / SPAN, (col[p] - middle[1]) / SPAN, weight[p], value[p]
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
    """The plane nearly through most heights of a segment: least squares, weights 1 / distance, again and again."""
    normal, right, at = np.empty((3, 3)), np.empty(3), np.empty(row.shape[0])
    weight[:] = 1.0
    for _ in range(ROUNDS_TO_START):
        for p in range(row.shape[0]):
            value[p] = weight[p] * height[p]
        normal_equations(row, col, middle, weight, value, normal, right)
        solve_damped(normal, right, 0.0, plane)
        plane_heights(row, col, middle, plane, at)
        for p in range(row.shape[0]):
            weight[p] = 1.0 / max(abs(height[p] - at[p]), NEAR_STEPS)


# (i,b,d,2,k) f8, (2,) f8, i8, (n,) i8, (n,) i8, (n,) f8, (i,n,4) f8 -> None
@kernel
def segment_loci(nodes, heights, block, row, col, height, locus):
    """Where each view shows the cells of a segment, px, and by how much that moves per step, written to `locus`."""
    for p in range(row.shape[0]):
        b, d = row[p] // block, col[p] // block
        fr, fc = (row[p] - b * block) / block, (col[p] - d * block) / block
        w0, w1, w2, w3 = (1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc
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
                locus[i, p, axis] = place
                locus[i, p, 2 + axis] = moves * heights[1]


# (p,) f4, (i,3) i8, (i,n,4) f8, (n,) f8, (n,) f8, (i,n) f8, (i,n) f8 -> None
@kernel
def segment_greys(pixels, layout, locus, start, height, grey, slope):
    """Grey value of every view at the cells of a segment, bilinear, and its change per step. start : (n,) heights that
    `locus` was made for; height : (n,) those asked for; grey, slope : (i, n), written."""
    for i in range(layout.shape[0]):
        offset, n_rows, n_cols = layout[i, 0], layout[i, 1], layout[i, 2]
        for p in range(height.shape[0]):
            away = height[p] - start[p]
            # Beyond the image its border goes on; where a table does not hold (NaN), what is read does not count.
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
    """Median of the first n values, which are sorted."""
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
    """How far the views' greys lie from their median, cell by cell, and what a step would change.

    weight, value : (n,) float64, of the normal equations; cost : (i, 2), mean Huber loss of each view in units of noise
    squared over all cells and over the core, infinite where it sees none; views that do not see a cell do not count.
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
    """Take off each view's grey what it is brighter over the core than the median of the views, on average."""
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
def leave_out(visible, cost, most_cost):
    """Leave out the views in whose eyes a segment's core is not plain (another day's, say); how many are left, 0 where
    they are fewer than four of five."""
    left, seeing = 0, 0
    for i in range(visible.shape[0]):
        if not np.isfinite(cost[i, 1]):
            continue
        seeing += 1
        if cost[i, 1] < most_cost:
            left += 1
        else:
            visible[i] = False
    return left if 5 * left >= 4 * seeing else 0


# (i,2) f8, i8 -> f8
@kernel
def mean_cost(cost, part):
    """Mean of the costs of the views that see a segment."""
    total, n = 0.0, 0
    for i in range(cost.shape[0]):
        if np.isfinite(cost[i, part]):
            total += cost[i, part]
            n += 1
    return total / n if n else np.inf


# (i,n) b1,(n) b1,(n) i8,(n) i8,(n) f8,(p) f4,(i,3) i8,(i,b,d,2,k) f8,(2) f8,i8,f8,f8,(3) f8,(2,2) f8,(n) f8 -> b1
@kernel
def fit_segment(
    visible, is_core, row, col, height, pixels, layout, nodes, heights, block, noise, most_cost, plane, costs, out
):
    """Plane of one segment on which the views agree best, from the plane through its heights; False where the core is
    not plain. plane : (3,), costs : (2, 2), before and after, all and core, and out : (n,) its heights, are written."""
    n, n_views = row.shape[0], layout.shape[0]
    middle = np.array([row.mean(), col.mean()])
    locus, grey, slope = np.empty((n_views, n, 4)), np.empty((n_views, n)), np.empty((n_views, n))
    weight, value, cost, moved = np.empty(n), np.empty(n), np.empty((n_views, 2)), np.empty(3)
    normal, right = np.empty((3, 3)), np.empty(3)
    segment_loci(nodes, heights, block, row, col, height, locus)
    segment_greys(pixels, layout, locus, height, height, grey, slope)
    level_greys(grey, visible, is_core)
    disagreement(grey, slope, visible, is_core, noise, weight, value, cost)
    if not mean_cost(cost, 1) < most_cost:
        if leave_out(visible, cost, most_cost) < 2:
            return False
        disagreement(grey, slope, visible, is_core, noise, weight, value, cost)
    costs[0] = mean_cost(cost, 0), mean_cost(cost, 1)
    now = np.empty(3)
    plane_through(row, col, middle, height, weight, value, now)
    costs[1] = np.inf
    for _ in range(ROUNDS):
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
            now[k] += min(max(moved[k], -MOST_MOVED), MOST_MOVED)
    plane_heights(row, col, middle, plane, out)
    return True


# as fit_segment, with (s+1,) i8 first and (s,) b1, (s,3) f8, (s,2,2) f8, (n,) f8 last
@kernel
def fit_segments(
    start, visible, is_core, row, col, height, pixels, layout, nodes, heights, block, noise, most_cost, is_plain,
    planes, costs, out,
):  # fmt: skip
    """`fit_segment` of every segment. start : (s + 1,), where the cells of each begin among n; row, col : of the tile;
    height : (n,) float64 indices; visible : (i, n), views that see a cell; is_core : (n,), cells that are not of the
    rim; noise : grey difference that says little; most_cost : of the core of a plain segment, in noise squared."""
    for s in range(start.shape[0] - 1):
        a, b = start[s], start[s + 1]
        is_plain[s] = fit_segment(
            visible[:, a:b].copy(), is_core[a:b], row[a:b], col[a:b], height[a:b], pixels, layout, nodes,
            heights, block, noise, most_cost, planes[s], costs[s], out[a:b],
        )  # fmt: skip
