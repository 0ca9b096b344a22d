"""The cost volume: every view resampled at every height of a block of cells, and how well they agree there."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel
from zlocus.kernels.agreement import pair_sum, window_moments
from zlocus.kernels.resample import resample_plane

COST_SCALE = np.float32(64.0)
UNSEEN_COST = np.float32(40.0)
HIDDEN = np.int32(2**30)


# (i,2,2,2,4) f8, i8, f8, i8, i8, (8,) f8 -> None
@kernel
def plane_grid(nodes, view, t, block, half, grid):
    """Positions of one view over a block at one height, border included.

    nodes : (i, 2, 2, 2, 4) float64: view, corner row, corner column, (x, y), cubic in t; t : height in the table's
    normalised unit; block : cells between the corners; grid : (8,), see `resample_plane`.
    """
    for axis in range(2):
        k = nodes[view, 0, 0, axis]
        origin = ((k[3] * t + k[2]) * t + k[1]) * t + k[0]
        k = nodes[view, 0, 1, axis]
        right = ((k[3] * t + k[2]) * t + k[1]) * t + k[0]
        k = nodes[view, 1, 0, axis]
        below = ((k[3] * t + k[2]) * t + k[1]) * t + k[0]
        k = nodes[view, 1, 1, axis]
        diagonal = ((k[3] * t + k[2]) * t + k[1]) * t + k[0]
        by_col = (right - origin) / block
        by_row = (below - origin) / block
        mixed = (diagonal - below - right + origin) / (block * block)
        grid[axis] = origin - half * by_col - half * by_row + half * half * mixed
        grid[2 + axis] = by_col - half * mixed
        grid[4 + axis] = by_row - half * mixed
        grid[6 + axis] = mixed


# (3,i,r,c) i4, i8, (3,i,p) i4, (p,) f4 -> i8
@kernel
def flat_visibility(seen, half, flat, pairs):
    """`seen` of a block on the flat layout (never beyond it); 1 / (n (n - 1)), n the views that see the cell."""
    n_views, rows, cols = seen.shape[1], seen.shape[2], seen.shape[3]
    width = cols + 2 * half
    flat[0] = HIDDEN
    flat[1] = -1
    flat[2] = HIDDEN
    pairs[:] = 0.0
    for r in range(rows):
        for c in range(cols):
            usable = np.float32(0.0)
            for i in range(n_views):
                for bound in range(3):
                    flat[bound, i, r * width + c] = seen[bound, i, r, c]
                if seen[0, i, r, c] <= seen[1, i, r, c]:
                    usable += np.float32(1.0)
            if usable > 1.0:
                pairs[r * width + c] = np.float32(1.0) / (usable * (usable - np.float32(1.0)))
    return rows * width - 2 * half


# (3,i,p) i4, (2,) i8 -> (i,) b1
@kernel
def taking_part(flat, span):
    """Which views cover any cell of a block at any height of its range. flat : see `flat_visibility`."""
    first, end = span[0], span[0] + span[1]
    takes = np.empty(flat.shape[1], np.bool_)
    for i in range(flat.shape[1]):
        takes[i] = flat[1, i].max() >= first and flat[0, i].min() < end
    return takes


# (p,) f4, (i,3) i8, (i,2,2,2,4) f8, (2,) f8, (2,) i8, (w,) i8, (3,i,r,c) i4, i8, f4, (r,d) u1 -> None
@kernel
def block_costs(pixels, layout, nodes, heights, span, windows, seen, block, floor, out):
    """Costs of one block: 64 (1 - mean NCC over all pairs of usable views, averaged over window sizes), rounded.

    pixels, layout : see `resample_plane`; nodes : see `plane_grid`; heights : t of height index 0, t per index;
    span : first height index and count; windows : half widths of the windows; seen : (3, i, r, c) int32, lowest and
    highest height index at which an image covers a cell (HIDDEN, -1 where it never does), and the lowest at which
    nothing hides it; out : (r, c * count) uint8.
    A pair with a hidden view counts as uncorrelated (NCC 0): dropping it would favour heights that few views see,
    where chance agreement is larger. Heights that fewer than two images cover cost UNSEEN_COST, less than chance
    agreement and more than a match: so a cell whose true height is outside the images is not matched elsewhere.
    """
    n_views, rows, cols = seen.shape[1], seen.shape[2], seen.shape[3]
    half = windows.max()
    width = cols + 2 * half
    size = (rows + 2 * half) * width
    planes = np.zeros((n_views, size), np.float32)
    mean, scale = np.zeros((n_views, size), np.float32), np.zeros((n_views, size), np.float32)
    flat = np.empty((3, n_views, size), np.int32)
    pairs, total, agreed = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    scratch, n_covering = np.empty((2, size), np.float32), np.empty(size, np.float32)
    index, fraction, grid = np.empty(width, np.uint32), np.empty((2, width), np.float32), np.empty(8)
    n = flat_visibility(seen, half, flat, pairs)
    first, count = span[0], span[1]
    share = np.float32(1.0 / windows.shape[0])
    takes_part = taking_part(flat, span)
    if takes_part.sum() < 2:
        out[:] = np.uint8(UNSEEN_COST)
        return
    for k in range(count):
        height = np.int32(first + k)
        for i in range(n_views):
            if not takes_part[i]:
                continue
            plane_grid(nodes, i, heights[0] + height * heights[1], block, half, grid)
            resample_plane(pixels, layout[i], grid, index, fraction, planes[i].reshape((rows + 2 * half, width)))
            centre = planes[i, half * width + half]
            for j in range(size):
                planes[i, j] -= centre
        total[:n] = 0.0
        n_covering[:n] = 0.0
        for w in range(windows.shape[0]):
            trim = (half - windows[w]) * (width + 1)
            for i in range(n_views):
                if not takes_part[i]:
                    continue
                window_moments(planes[i], trim, windows[w], width, n, floor, scratch[0], mean[i], scale[i])
                for j in range(n):
                    covered = np.float32(flat[0, i, j] <= height and height <= flat[1, i, j])
                    scale[i, j] *= covered * np.float32(flat[2, i, j] <= height)
                    n_covering[j] += covered
            pair_sum(planes, trim, mean, scale, windows[w], width, n, scratch, agreed)
            for j in range(n):
                total[j] += share * agreed[j]
        for j in range(n):
            cost = COST_SCALE - COST_SCALE * total[j] * pairs[j]
            is_seen = n_covering[j] > np.float32(1.5 * windows.shape[0])
            total[j] = (cost if is_seen else UNSEEN_COST) + np.float32(0.5)
        for r in range(rows):
            for c in range(cols):
                out[r, c * count + k] = np.uint8(min(max(total[r * width + c], np.float32(0.0)), np.float32(255.0)))


# as block_costs, with (2,b,d) i8, (3,b,d) i8 for its span and (v,) u1 -> None
@kernel
def tile_costs(pixels, layout, nodes, heights, ranges, address, windows, seen, block, floor, volume):
    """`block_costs` of every block of a tile.

    ranges : (2, b, d) int64, first index and count of each block; address : (3, b, d) int64, see
    `HeightLattice.address`; volume : (v,) uint8, written.
    """
    n_rows, n_cols = seen.shape[2], seen.shape[3]
    span = np.empty(2, np.int64)
    for br in range(ranges.shape[1]):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        base, length = address[0, br, 0], address[1, br, 0]
        rows = volume[base : base + (r1 - r0) * length].reshape((r1 - r0, length))
        for bc in range(ranges.shape[2]):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            span[0], span[1] = ranges[0, br, bc], ranges[1, br, bc]
            start = address[2, br, bc]
            block_costs(
                pixels, layout, nodes[:, br : br + 2, bc : bc + 2], heights, span, windows, seen[:, :, r0:r1, c0:c1],
                block, floor, rows[:, start : start + (c1 - c0) * span[1]],
            )  # fmt: skip
