"""Heights with the least costs, or with the least sums of path costs, of a ragged volume."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

NO_MINIMUM, LOWER_16_BITS = np.uint32(0xFFFFFFFF), np.uint32(0xFFFF)


# (h,) u2 -> u4
@kernel
def least_sum(sums):
    """The minimum and, in the lower 16 bits, its first index: one minimum over both, which vectorises."""
    least = NO_MINIMUM
    for k in range(sums.shape[0]):
        least = min(least, np.uint32(np.uint32(np.uint32(sums[k]) << np.uint32(16)) | np.uint32(k)))
    return least


# (h,) u2, i8 -> u4
@kernel
def secondary_minimum(sums, where):
    """As `least_sum`, of the local minima more than two indices from `where`, both ends excluded; else NO_MINIMUM."""
    least = NO_MINIMUM
    inner = max(sums.shape[0] - 2, 0)
    before, here, after = sums[:inner], sums[1 : 1 + inner], sums[2 : 2 + inner]
    centre = np.int32(where - 1)
    for k in range(inner):
        key = np.uint32(np.uint32(np.uint32(here[k]) << np.uint32(16)) | np.uint32(k + 1))
        away = np.int32(np.int32(k) - centre)
        is_other = (here[k] <= before[k]) & (here[k] <= after[k]) & ((away < -2) | (away > 2))
        least = min(least, key if is_other else NO_MINIMUM)
    return least


# (v,) u2, VolumeLayout, (r,c) i4, (r,c) i4, (r,c) u2, (r,c) f4 -> None
@kernel
def winners(total, layout, best, second, uniqueness, vertex):
    """Height index of the least sum, and of the least other local minimum at least three indices away.

    best, second : (r, c) int32, second = best where there is no other minimum; uniqueness : (r, c) uint16, by how much
    the sum at `second` is larger (65535 where there is none); vertex : (r, c) float32, minimum of the parabola through
    the sums around `best`. All are written.
    """
    n_rows, n_cols = best.shape
    first_of, count_of, block = layout.first, layout.n_heights, layout.block
    block_row_start, row_length, block_start = layout.block_row_start, layout.row_length, layout.block_start
    for r in range(n_rows):
        b = r // block
        for c in range(n_cols):
            d = c // block
            first, count = first_of[b, d], count_of[b, d]
            row_start = block_row_start[b, d] + (r - b * block) * row_length[b, d]
            start = row_start + block_start[b, d] + (c - d * block) * count
            sums = total[start : start + count]
            least = least_sum(sums)
            low, where = np.uint16(least >> np.uint32(16)), np.int64(least & LOWER_16_BITS)
            other = secondary_minimum(sums, where)
            has_other = other != NO_MINIMUM
            best[r, c] = first + where
            second[r, c] = first + (np.int64(other & LOWER_16_BITS) if has_other else where)
            uniqueness[r, c] = np.uint16(np.uint16(other >> np.uint32(16)) - low) if has_other else np.uint16(65535)
            vertex[r, c] = first + where
            if 0 < where < count - 1:
                left, right = np.float32(sums[where - 1] - low), np.float32(sums[where + 1] - low)
                if left + right > 0:
                    vertex[r, c] += np.float32(0.5) * (left - right) / (left + right)


# (v,) u1, VolumeLayout, (r,c) i4, (r,c) i4 -> None
@kernel
def winner_takes_all(cost, layout, preferred, best):
    """Height index of the least cost of each cell, written to `best`; of equal costs that of `preferred`, else the
    first. preferred, best : (r, c) int32."""
    n_rows, n_cols = best.shape
    first_of, count_of, block = layout.first, layout.n_heights, layout.block
    block_row_start, row_length, block_start = layout.block_row_start, layout.row_length, layout.block_start
    for r in range(n_rows):
        b = r // block
        for c in range(n_cols):
            d = c // block
            first, count = first_of[b, d], count_of[b, d]
            row_start = block_row_start[b, d] + (r - b * block) * row_length[b, d]
            start = row_start + block_start[b, d] + (c - d * block) * count
            costs = cost[start : start + count]
            least = np.uint8(255)
            for k in range(count):
                least = min(least, costs[k])
            where = np.int64(preferred[r, c] - first)
            if costs[where] != least:
                where = np.int64(0)
                while costs[where] != least:
                    where += 1
            best[r, c] = first + where
