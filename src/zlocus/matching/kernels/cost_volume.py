"""The cost volume: every view resampled at every height of a block of cells, and how well they agree there."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.ncc import SLACK, add_closeness, add_pairs, window_moments
from zlocus.matching.kernels.resample import resample_plane

COST_SCALE = np.float32(64.0)
UNSEEN_COST = np.float32(40.0)
HIDDEN = np.int32(2**30)
# Grey value of a view where it shows nothing, times its number: as far from any grey as from another view's.
NOWHERE = np.float32(1e6)
NOTHING, PART, WHOLE = 0, 1, 2


# (n,) f8, f8 -> f8
@kernel
def polynomial(coefficients, t):
    """Value of a polynomial at t; coefficients of 1, t, t^2, ..."""
    value = 0.0
    for power in range(coefficients.shape[0] - 1, -1, -1):
        value = value * t + coefficients[power]
    return value


# (i,2,2,2,4) f8, i8, f8, i8, i8, (8,) f8 -> None
@kernel
def plane_grid(nodes, view, t, block, half, grid):
    """Positions of one view over a block at one height, border included.

    nodes : (i, 2, 2, 2, n) float64: view, corner row, corner column, (x, y), polynomial in t; t : height in the table's
    normalised unit; block : cells between the corners; grid : (8,), see `resample_plane`.
    """
    for axis in range(2):
        origin, right = polynomial(nodes[view, 0, 0, axis], t), polynomial(nodes[view, 0, 1, axis], t)
        below, diagonal = polynomial(nodes[view, 1, 0, axis], t), polynomial(nodes[view, 1, 1, axis], t)
        by_col = (right - origin) / block
        by_row = (below - origin) / block
        mixed = (diagonal - below - right + origin) / (block * block)
        grid[axis] = origin - half * by_col - half * by_row + half * half * mixed
        grid[2 + axis] = by_col - half * mixed
        grid[4 + axis] = by_row - half * mixed
        grid[6 + axis] = mixed


# (3,i,r,c) i4, i8, (i,3,p) i4, (p,) f4 -> None
@kernel
def flat_visibility(seen, half, flat, pairs):
    """`seen` of a block on the flat layout (never beyond it); 2 / (n (n - 1)), n the views that see the cell."""
    n_views, rows, cols = seen.shape[1], seen.shape[2], seen.shape[3]
    width = cols + 2 * half
    flat[:, 0] = HIDDEN
    flat[:, 1] = -1
    flat[:, 2] = HIDDEN
    pairs[:] = 0.0
    for i in range(n_views):
        for bound in range(3):
            for r in range(rows):
                for c in range(cols):
                    flat[i, bound, r * width + c] = seen[bound, i, r, c]
        for j in range(pairs.shape[0]):
            pairs[j] += np.float32(flat[i, 0, j] <= flat[i, 1, j])
    for j in range(pairs.shape[0]):
        usable = pairs[j]
        ordered = usable * (usable - np.float32(1.0))
        pairs[j] = np.float32(2.0) / ordered if usable > np.float32(1.5) else np.float32(0.0)


# (3,i,r,c) i4 -> (i,5) i4
@kernel
def height_ranges(seen):
    """Of every view, lowest and highest height index at which it covers any cell of a block, and at which it covers and
    sees every cell, and the lowest at which it sees any. seen : see `block_costs`."""
    ranges = np.empty((seen.shape[1], 5), np.int32)
    for i in range(seen.shape[1]):
        low, high, from_, to, any_from = HIDDEN, np.int32(-HIDDEN), np.int32(-HIDDEN), HIDDEN, HIDDEN
        for r in range(seen.shape[2]):
            for c in range(seen.shape[3]):
                visible = max(seen[0, i, r, c], seen[2, i, r, c])
                low, high = min(low, seen[0, i, r, c]), max(high, seen[1, i, r, c])
                from_, any_from = max(from_, visible), min(any_from, visible)
                to = min(to, seen[1, i, r, c])
        ranges[i, 0], ranges[i, 1], ranges[i, 2], ranges[i, 3], ranges[i, 4] = low, high, from_, to, any_from
    return ranges


# (i,5) i4, i8, i4 -> i8
@kernel
def extent_at(ranges, view, height):
    """What a view shows of a block at a height: NOTHING, PART or WHOLE. ranges : see `height_ranges`."""
    if ranges[view, 2] <= height <= ranges[view, 3]:
        return WHOLE
    return PART if ranges[view, 4] <= height <= ranges[view, 1] else NOTHING


# (i,5) i4, (i,) i8, i4 -> i8
@kernel
def whole_views(ranges, takes, height):
    """How many views show the whole block at a height."""
    n = 0
    for view in takes:
        n += 1 if extent_at(ranges, view, height) == WHOLE else 0
    return n


# (i,5) i4, (2,) i8 -> (i,) i8
@kernel
def taking_part(ranges, span):
    """The views that cover any cell of a block at any height of its range. ranges : see `height_ranges`."""
    takes = np.empty(ranges.shape[0], np.int64)
    n = 0
    for i in range(ranges.shape[0]):
        if ranges[i, 1] >= span[0] and ranges[i, 0] < span[0] + span[1]:
            takes[n] = i
            n += 1
    return takes[:n]


# (2,) i8 -> (2,p) f4
@kernel
def flat_cells(shape):
    """Rows and columns of cells on the flat layout."""
    cells = np.empty((2, shape[0] * shape[1]), np.float32)
    for r in range(shape[0]):
        for c in range(shape[1]):
            cells[0, r * shape[1] + c], cells[1, r * shape[1] + c] = r, c
    return cells


# (i,2,2,2,4) f8, i8, f8, f8, (2,) f4 -> None
@kernel
def plane_velocity(nodes, view, t, per_index, velocity):
    """Pixels (x, y) that a cell at the middle of a block moves per height index. per_index : t per index."""
    for axis in range(2):
        total = 0.0
        for corner in range(4):
            k = nodes[view, corner // 2, corner % 2, axis]
            slope = 0.0
            for power in range(k.shape[0] - 1, 0, -1):
                slope = slope * t + power * k[power]
            total += slope
        velocity[axis] = np.float32(0.25 * total * per_index)


# (r,c) f4, (2,2) f8, i8, i8, (r,c) f4 -> None
@kernel
def block_relief(surface, corners, block, half, relief):
    """Base surface of a block and its border, less the bilinear surface through its corners, which its nodes follow."""
    for r in range(surface.shape[0]):
        u = (r - half) / block
        left = corners[0, 0] + u * (corners[1, 0] - corners[0, 0])
        rise = corners[0, 1] + u * (corners[1, 1] - corners[0, 1]) - left
        for c in range(surface.shape[1]):
            relief[r, c] = np.float32(surface[r, c] - left - (c - half) / block * rise)


# (i,3,p) i4, i8, i4, i8, (p,) f4, (2,p) f4 -> None
@kernel
def shown_at(bounds, view, height, n, shown, counts):
    """Where a view covers and sees the cells at a height (1 or 0); counts the views that cover, and that see, a cell.

    bounds : see `flat_visibility`.
    """
    low, high, visible = bounds[view, 0], bounds[view, 1], bounds[view, 2]
    for j in range(n):
        covered = np.float32(low[j] <= height and height <= high[j])
        shown[j] = covered * np.float32(visible[j] <= height)
        counts[0, j] += covered
        counts[1, j] += shown[j]


# (p,) f4, i8, (w,p) f4, (p,) f4, f4 -> None
@kernel
def hide(shown, n, scale, grey, nowhere):
    """Take a view out of all pairs where it is not shown."""
    for w in range(scale.shape[0]):
        unit = scale[w]
        for j in range(n):
            unit[j] *= shown[j]
    for j in range(n):
        grey[j] = grey[j] if shown[j] > np.float32(0.0) else nowhere


# (p,) f4, (2,p) f4, f4, i8, (p,) f4 -> None
@kernel
def excuse(pairs, counts, excused, n, out):
    """Weights of pairs, part of that of those with a hidden view passed on to the visible ones. counts : (2, p), views
    that cover and that see each cell.

    A pair with a hidden view counts as uncorrelated (NCC 0), but for the excused share, which agrees as the visible
    pairs do: without it the ground beside a wall would rather be roof, which all views see; excusing all would favour
    heights that few views see, where chance agreement is larger.
    """
    n_seeing, one = counts[1], np.float32(1.0)
    for j in range(n):
        m = n_seeing[j]
        visible = np.float32(2.0) / max(m * (m - one), one)
        out[j] = pairs[j] + excused * (visible - pairs[j])


# (p,) f4, (p,) f4, (p,) f4, f4, i8, i8, (p,) u1 -> None
@kernel
def whole_costs(total, pairs, n_covering, weight, n_sizes, n, out):
    """Costs of a block at one height, rounded, from the sums over pairs of views; see `block_costs`.

    pairs : (p,), weight of a visible pair. Heights that fewer than two images cover cost UNSEEN_COST, less than chance
    agreement and more than a match: so a cell whose true height is outside the images is not matched elsewhere.
    """
    highest = COST_SCALE * (np.float32(1.0) + weight)
    unseen = UNSEEN_COST * (np.float32(1.0) + weight)
    factor = COST_SCALE / np.float32(n_sizes)
    for j in range(n):
        cost = highest - factor * total[j] * pairs[j]
        total[j] = (cost if n_covering[j] > np.float32(1.5) else unseen) + np.float32(0.5)
    for j in range(n):
        out[j] = np.uint8(np.int32(min(max(total[j], np.float32(0.0)), np.float32(255.0))))


# (h,p) u1, i8, (r,d) u1 -> None
@kernel
def heights_last(codes, width, out):
    """Costs, one flat plane a height, as rows of cells with all their heights."""
    count = codes.shape[0]
    for r in range(out.shape[0]):
        for c in range(out.shape[1] // count):
            for k in range(count):
                out[r, c * count + k] = codes[k, r * width + c]


# (p,) f4, i8, f4, i8, f4, i8, (p,) f4 -> None
@kernel
def centred(plane, size, centre, start, by_reach, n, grey):
    """Take `centre` from a plane's `size` values; grey : those of the cells themselves, from `start` on, times
    `by_reach`, unless that is 0."""
    for j in range(size):
        plane[j] -= centre
    if by_reach > np.float32(0.0):
        inner = plane[start:]
        for j in range(n):
            grey[j] = inner[j] * by_reach


# (p,) f4, (i,3) i8, (i,2,2,2,4) f8, (2,) f8, (r,c) f4, (2,) i8, (w,) i8, (3,i,r,c) i4, i8, (6,) f4, (r,d) u1 -> None
@kernel
def block_costs(pixels, layout, nodes, heights, relief, span, windows, seen, block, measure, out):
    """Costs of one block: 64 (1 - mean NCC over all pairs of usable views, averaged over window sizes), and as much,
    weighted, for their grey differences.

    pixels, layout : see `resample_plane`; nodes : see `plane_grid`; heights : t of height index 0, t per index;
    relief : (r + 2 half, c + 2 half) float32, steps, see `block_relief`; span : first height index and count; windows :
    half widths of the windows, ascending; seen : (3, i, r, c) int32, lowest and highest height index at which an image
    covers a cell (HIDDEN, -1 where it never does), and the lowest at which nothing hides it; measure : (6,) float32,
    variance added to every window, weight and reach of grey differences, share of hidden pairs that is excused, what
    `tile_costs` takes, the weight where two views take part; out : (r, c * count) uint8.
    Views that show nothing of the block at a height are left out there.
    """
    ranges = height_ranges(seen)
    takes = taking_part(ranges, span)
    floor, weight = measure[0], measure[5] if takes.shape[0] == 2 else measure[1]
    if takes.shape[0] < 2:
        out[:] = np.uint8(UNSEEN_COST * (np.float32(1.0) + weight))
        return
    n_views, n_sizes, half, width = takes.shape[0], windows.shape[0], windows[-1], relief.shape[1]
    n, start, steps, cells = seen.shape[2] * width, half * (width + 1), relief.ravel(), flat_cells(relief.shape)
    size = steps.shape[0] + SLACK
    planes, greys = np.zeros((n_views, size), np.float32), np.zeros((n_views, size), np.float32)
    mean, scale = np.empty((n_views, n_sizes, size), np.float32), np.empty((n_views, n_sizes, size), np.float32)
    flat, codes = np.empty((seen.shape[1], 3, size), np.int32), np.empty((span[1], n), np.uint8)
    pairs, shown, total = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    counts, sides = np.empty((2, size), np.float32), np.empty((2, size), np.complex64)
    work, grid, velocity = np.empty((4, size), np.float32), np.empty(8), np.empty(2, np.float32)
    index, fraction, totals = np.empty(size, np.uint32), np.empty((2, size), np.float32), total.reshape((1, 1, size))
    flat_visibility(seen, half, flat, pairs)
    top, centre = weight * np.float32(n_sizes), np.float32(0.0)
    by_reach = top / measure[2]
    for k in range(span[1]):
        height, m = np.int32(span[0] + k), 0
        t, n_whole = heights[0] + height * heights[1], whole_views(ranges, takes, height)
        total[:n], counts[:, :n] = 0.0, n_whole
        for i in range(n_views):
            view, plane, grey = takes[i], planes[m], greys[m]
            extent = extent_at(ranges, view, height)
            if extent < WHOLE:
                shown_at(flat, view, height, n, shown, counts)
            if extent == NOTHING and i > 0:
                continue
            plane_grid(nodes, view, t, block, half, grid)
            plane_velocity(nodes, view, t, heights[1], velocity)
            resample_plane(pixels, layout[view], grid, cells, steps, velocity, index, fraction, sides, plane)
            centre = plane[start] if i == 0 else centre
            if extent == NOTHING:
                continue
            centred(plane, steps.shape[0], centre, start, by_reach, n, grey)
            window_moments(plane, windows, width, n, floor, work, mean[m], scale[m])
            if extent < WHOLE:
                hide(shown, n, scale[m], grey, NOWHERE * np.float32(m + 1))
            m += 1
        if weight > 0.0:
            add_closeness(greys[:m], top, n, total)
        add_pairs(planes[:m], windows, mean[:m], scale[:m], width, n, work, totals)
        if n_whole < n_views:
            excuse(pairs, counts, measure[3], n, shown)
        whole_costs(total, shown if n_whole < n_views else pairs, counts[0], weight, n_sizes, n, codes[k])
    heights_last(codes, width, out)


# (3,i,r,c) i4, (2,) i8, (w,) i8, i8 -> (w,) i8
@kernel
def windows_for(seen, span, windows, few):
    """The windows of a block: all where at most `few` views take part, else the smallest, for many pairs of views
    average noise as well, and their windows do not reach beyond a small crown."""
    return windows if taking_part(height_ranges(seen), span).shape[0] <= few else windows[:1]


# as block_costs, with (r,c) f4, (b,d) f8 for its relief, (2,b,d) i8, (3,b,d) i8 for its span and (v,) u1 -> None
@kernel
def tile_costs(
    pixels, layout, nodes, heights, base, base_nodes, ranges, address, windows, seen, block, measure, volume
):  # fmt: skip
    """`block_costs` of every block of a tile.

    base : (r + 2 half, c + 2 half) float32 base surface, border included, in height indices; base_nodes : (b + 1,
    d + 1) float64, the base surface at the corners of blocks, which `nodes` follow; ranges : (2, b, d) int64, first
    index and count of each block; address : (3, b, d) int64, see `HeightLattice.address`; measure : (6,) float32, the
    fifth is the most views of a block that takes all windows, see `windows_for`; volume : (v,) uint8, written.
    """
    n_rows, n_cols = seen.shape[2], seen.shape[3]
    span, few = np.empty(2, np.int64), np.int64(measure[4])
    for br in range(ranges.shape[1]):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        first, length = address[0, br, 0], address[1, br, 0]
        rows = volume[first : first + (r1 - r0) * length].reshape((r1 - r0, length))
        for bc in range(ranges.shape[2]):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            span[0], span[1] = ranges[0, br, bc], ranges[1, br, bc]
            start = address[2, br, bc]
            sizes = windows_for(seen[:, :, r0:r1, c0:c1], span, windows, few)
            half, beside = sizes[-1], windows[-1] - sizes[-1]
            relief = np.empty((r1 - r0 + 2 * half, c1 - c0 + 2 * half), np.float32)
            corners, r, c = base_nodes[br : br + 2, bc : bc + 2], r0 + beside, c0 + beside
            around = base[r : r + relief.shape[0], c : c + relief.shape[1]]
            block_relief(around, corners, block, half, relief)
            block_costs(
                pixels, layout, nodes[:, br : br + 2, bc : bc + 2], heights, relief, span, sizes,
                seen[:, :, r0:r1, c0:c1], block, measure, rows[:, start : start + (c1 - c0) * span[1]],
            )  # fmt: skip
