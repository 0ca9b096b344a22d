"""Semi-global aggregation over a volume whose cells have ranges of their own.

Source: Hirschmueller (2008), eq. 13, along 8 paths, neighbours compared by height (an integer shift of their ranges).
Two sweeps: down (paths from W, NW, N, NE), then up (from E, SE, S, SW). Inside a sweep everything is counted in its
own order: `position` is a cell's place in its row as the sweep meets it, segments are the blocks of a row as it meets
them, W ... NE are the neighbours behind; only the previous row of path costs is kept.

Why it is fast: every sum and minimum is cast back to uint16 (Numba widens integers to 64 bits and the lanes would be
lost), and all addresses in `run_cells` grow evenly and upwards from cell to cell, so that the compiler checks once a
run, not in every cell, that what is read and what is written are apart. Hence the copies: the up sweep turns its rows
round, and a neighbour with another range is copied by the heights of the cell.
"""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel

PAD = 2
FAR = np.uint16(16000)
FIRST, COUNT, LEFT, PLACE = 0, 1, 2, 3
NOBODY = -1
NONE, LOWER = np.uint32(0xFFFFFFFF), np.uint32(0xFFFF)


# u2, u2, u2, u2, u2, u2, u2 -> u2
@kernel
def path_cost(same, down, up, p1, jump, least, cost):
    """L(p, k) = C + min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1, min L(q) + P2) - min L(q)."""
    best = min(same, np.uint16(min(down, up) + p1))
    return np.uint16(np.uint16(min(best, jump) - least) + cost)


# (v,) u1, (v,) u2, i8, (2,) i8, (l,) u2, (2,4) i8, (4,c) u2, (4,c) u2, (4,c) u2, i8, u2 -> None
@kernel
def run_cells(cost, sums, start, size, paths, spots, behind, ahead, edge, position, p1):
    """Path costs of neighbouring cells of one range, whose neighbours all share it; their sums are written to `sums`.

    start : of the first cell in `cost` and `sums`; size : heights and cells; spots : where the first cell's path costs
    are read and written in `paths`, those of W swap from cell to cell; behind, ahead : (4, c + 2) uint16, least path
    costs of the previous and of this row, cell i at i + 1; edge : (4, c) uint16, P2.
    """
    n_heights, n_cells = size[0], size[1]
    n, one = np.uint64(n_heights), np.uint64(1)
    w_behind, nw_behind, n_behind, ne_behind = spots[0, 0], spots[0, 1], spots[0, 2], spots[0, 3]
    w_ahead, nw_ahead, n_ahead, ne_ahead = spots[1, 0], spots[1, 1], spots[1, 2], spots[1, 3]
    l0 = ahead[0, position]
    for cell in range(n_cells):
        i, away = position + cell, cell * (n_heights + PAD)
        s = np.uint64(start + cell * n_heights)
        r0, r1 = np.uint64(w_behind), np.uint64(nw_behind + away)
        r2, r3 = np.uint64(n_behind + away), np.uint64(ne_behind + away)
        a0, a1 = np.uint64(w_ahead), np.uint64(nw_ahead + away)
        a2, a3 = np.uint64(n_ahead + away), np.uint64(ne_ahead + away)
        w_behind, w_ahead = w_ahead, w_behind
        l1, l2, l3 = behind[1, i], behind[2, i + 1], behind[3, i + 2]
        j0, j1 = np.uint16(l0 + edge[0, i]), np.uint16(l1 + edge[1, i])
        j2, j3 = np.uint16(l2 + edge[2, i]), np.uint16(l3 + edge[3, i])
        m0 = m1 = m2 = m3 = np.uint16(65535)
        for k in range(n):
            c = np.uint16(cost[s + k])
            v0 = path_cost(paths[r0 + k], paths[r0 + k - one], paths[r0 + k + one], p1, j0, l0, c)
            v1 = path_cost(paths[r1 + k], paths[r1 + k - one], paths[r1 + k + one], p1, j1, l1, c)
            v2 = path_cost(paths[r2 + k], paths[r2 + k - one], paths[r2 + k + one], p1, j2, l2, c)
            v3 = path_cost(paths[r3 + k], paths[r3 + k - one], paths[r3 + k + one], p1, j3, l3, c)
            paths[a0 + k] = v0
            paths[a1 + k] = v1
            paths[a2 + k] = v2
            paths[a3 + k] = v3
            m0, m1, m2, m3 = min(m0, v0), min(m1, v1), min(m2, v2), min(m3, v3)
            sums[s + k] = np.uint16(np.uint16(v0 + v1) + np.uint16(v2 + v3))
        paths[a0 + n] = FAR
        ahead[0, i + 1], ahead[1, i + 1], ahead[2, i + 1], ahead[3, i + 1] = m0, m1, m2, m3
        l0 = m0


# (l,) u2, i8, i8, i8, i8, i8 -> None
@kernel
def shifted(paths, behind, n_behind, shift, spot, count):
    """Copy a neighbour's path costs to `spot` - 1 ... `spot` + count, by the heights of this cell.

    shift = first index here less the neighbour's. Heights that it did not search are FAR: only a jump (P2) leads from
    there. n_behind < 0: no neighbour, zeros (L = C).
    """
    nothing = FAR if n_behind >= 0 else np.uint16(0)
    for k in range(spot - 1, spot + count + 1):
        paths[k] = nothing
    low, high = max(-1, -shift), min(count + 1, n_behind - shift)
    if low < high:
        source, target = paths[behind + shift + low : behind + shift + high], paths[spot + low : spot + high]
        for k in range(source.shape[0]):
            target[k] = source[k]


# (2,b,d) i8, i8, i8, i8, i8, (4,d) i8 -> None
@kernel
def row_segments(ranges, block_row, block, n_cols, sign, segments):
    """Segments of a row: FIRST and COUNT of its heights, LEFT position, PLACE of its first cell in a row of path costs.

    segments : (4, d + 2) int64, segment e at e + 1; the count NOBODY stands where there is none.
    """
    n_d = ranges.shape[2]
    segments[COUNT] = NOBODY
    left, place = 0, PAD
    for e in range(n_d):
        d = e if sign > 0 else n_d - 1 - e
        count = ranges[1, block_row, d]
        segments[FIRST, e + 1], segments[COUNT, e + 1] = ranges[0, block_row, d], count
        segments[LEFT, e + 1], segments[PLACE, e + 1] = left, place
        n_cells = min(block, n_cols - d * block)
        left += n_cells
        place += n_cells * (count + PAD)
    segments[LEFT, n_d + 1] = left


# (4,r,c) u2, i8, i8, (4,c) u2 -> None
@kernel
def row_edges(p2, row, sign, edge):
    """P2 of the steps into each cell of a row, by position; the up sweep takes the steps of `p2` the other way."""
    rows, cols = p2.shape[1], p2.shape[2]
    if sign > 0:
        # Plain loops: Numba takes five seconds to compile the shape check of an array assigned to a slice.
        for path in range(4):
            for c in range(cols):
                edge[path, c] = p2[path, row, c]
        return
    behind = min(row + 1, rows - 1)
    for i in range(cols):
        c = cols - 1 - i
        edge[0, i] = p2[0, row, min(c + 1, cols - 1)]
        edge[1, i] = p2[1, behind, min(c + 1, cols - 1)]
        edge[2, i] = p2[2, behind, c]
        edge[3, i] = p2[3, behind, max(c - 1, 0)]


# (4,d) i8, i8, (4,d) i8, i8 -> b1
@kernel
def alike(segments, e, others, f):
    """Whether two segments search the same heights."""
    return segments[COUNT, e] == others[COUNT, f] and segments[FIRST, e] == others[FIRST, f]


# (l,) u2, (3,4) i8, (2,4,d) i8, i8, i8, i8, i8, (2,4) i8 -> None
@kernel
def find_neighbours(paths, planes, segments, now, turn, e, position, spots):
    """Where a cell reads and writes its four paths; neighbours of another range are copied to a place of their own.

    planes : (3, 4) int64, start of the path costs of even and odd rows (for W of even and odd cells), and of copies.
    """
    here = segments[now]
    count = here[COUNT, e]
    for path in range(4):
        across = position - 1 if path < 2 else position + path - 2
        row = now if path == 0 else 1 - now
        there = segments[row]
        f = e - 1 if across < here[LEFT, e] else (e + 1 if across >= here[LEFT, e + 1] else e)
        if path == 0:
            spots[0, 0], spots[1, 0] = planes[turn, 0], planes[1 - turn, 0]
        else:
            spots[0, path] = planes[row, path] + there[PLACE, f] + (across - there[LEFT, f]) * (there[COUNT, f] + PAD)
            spots[1, path] = planes[now, path] + here[PLACE, e] + (position - here[LEFT, e]) * (count + PAD)
        if not alike(here, e, there, f):
            shift = here[FIRST, e] - there[FIRST, f]
            shifted(paths, spots[0, path], there[COUNT, f], shift, planes[2, path], count)
            spots[0, path] = planes[2, path]


# (v,) u1, (v,) u2, i8, (l,) u2, (3,4) i8, (2,4,d) i8, i8, i8, i8, (2,4,c) u2, (4,c) u2, u2 -> i8
@kernel
def sweep_segment(cost, sums, start, paths, planes, segments, now, turn, e, least, edge, p1):
    """All cells of a segment: those at its ends and under another range one by one, the others in one run.

    Returns the next cell's `turn`.
    """
    here, there = segments[now], segments[1 - now]
    left, right, count = here[LEFT, e], here[LEFT, e + 1], here[COUNT, e]
    run, end = left, right
    if not alike(here, e, there, e):
        run = right
    elif not (alike(here, e, here, e - 1) and alike(here, e, there, e - 1)):
        run = left + 1
    if not alike(here, e, there, e + 1):
        end = right - 1
    spots, size = np.empty((2, 4), np.int64), np.empty(2, np.int64)
    i = left
    while i < right:
        size[0], size[1] = count, (end - i if run <= i < end else 1)
        find_neighbours(paths, planes, segments, now, turn, e, i, spots)
        run_cells(
            cost, sums, start + (i - left) * count, size, paths, spots, least[1 - now], least[now], edge, i, p1
        )  # fmt: skip
        i += size[1]
        turn = (turn + size[1]) % 2
    return turn


# (v,) u1, i8, i8, i8, (s,) u1 -> None
@kernel
def reverse_cells(source, start, count, n_cells, target):
    """Copy cells of a volume in reverse order, the heights of each in their own."""
    for cell in range(n_cells):
        at = start + (n_cells - 1 - cell) * count
        a, b = source[at : at + count], target[cell * count : (cell + 1) * count]
        for k in range(count):
            b[k] = a[k]


# (s,) u2, i8, i8, i8, (v,) u2 -> None
@kernel
def add_reversed(source, start, count, n_cells, total):
    """Add what `reverse_cells` put in reverse order."""
    for cell in range(n_cells):
        at = start + (n_cells - 1 - cell) * count
        a, b = source[cell * count : (cell + 1) * count], total[at : at + count]
        for k in range(count):
            b[k] = np.uint16(b[k] + a[k])


# (v,) u1, (2,b,d) i8, (3,b,d) i8, i8, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep(cost, ranges, address, block, p2, p1, sign, total):
    """Sums of four paths: sign = 1 sweeps down and writes `total`, -1 sweeps up and adds to it.

    p2 : (4, r, c) uint16, penalty of the jump into a cell from W, NW, N, NE.
    """
    n_rows, n_cols, n_d = p2.shape[1], p2.shape[2], ranges.shape[2]
    width = address[1].max() + PAD * (n_cols + 2)
    longest = ranges[1].max() + 2 * PAD
    planes = np.empty((3, 4), np.int64)
    for row in range(3):
        planes[row, 0] = 6 * width + row * longest + PAD
        for path in range(1, 4):
            planes[row, path] = (3 * row + path - 1) * width if row < 2 else 6 * width + (2 + path) * longest + PAD
    paths = np.full(6 * width + 6 * longest, FAR, np.uint16)
    least, edge = np.zeros((2, 4, n_cols + 2), np.uint16), np.empty((4, n_cols), np.uint16)
    segments = np.full((2, 4, n_d + 2), NOBODY, np.int64)
    row_cost, row_sums = np.empty(block * longest, np.uint8), np.empty(block * longest, np.uint16)
    turn, row_start = np.int64(0), np.int64(0)
    for step in range(n_rows):
        r = step if sign > 0 else n_rows - 1 - step
        now, br = step % 2, r // block
        row_segments(ranges, br, block, n_cols, sign, segments[now])
        row_edges(p2, r, sign, edge)
        if step < 2 or br != (r - 2 * sign) // block:
            paths[planes[now, 1] : planes[now, 1] + 3 * width] = FAR
        for e in range(1, n_d + 1):
            d = e - 1 if sign > 0 else n_d - e
            start = address[0, br, 0] + (r - br * block) * address[1, br, 0] + address[2, br, d]
            if sign > 0:
                turn = sweep_segment(cost, total, start, paths, planes, segments, now, turn, e, least, edge, p1)
                continue
            count, n_cells = segments[now, COUNT, e], segments[now, LEFT, e + 1] - segments[now, LEFT, e]
            reverse_cells(cost, start, count, n_cells, row_cost)
            turn = sweep_segment(row_cost, row_sums, row_start, paths, planes, segments, now, turn, e, least, edge, p1)
            add_reversed(row_sums, start, count, n_cells, total)


# (h,) u2 -> u4
@kernel
def least_sum(sums):
    """The least value and, in the lower 16 bits, its first index: one minimum over both, which vectorises."""
    least = NONE
    for k in range(sums.shape[0]):
        least = min(least, np.uint32(np.uint32(np.uint32(sums[k]) << np.uint32(16)) | np.uint32(k)))
    return least


# (h,) u2, i8 -> u4
@kernel
def other_minimum(sums, where):
    """As `least_sum`, over local minima more than two indices from `where`, ends left out; NONE where there is none."""
    least = NONE
    inner = max(sums.shape[0] - 2, 0)
    before, here, after = sums[:inner], sums[1 : 1 + inner], sums[2 : 2 + inner]
    centre = np.int32(where - 1)
    for k in range(inner):
        key = np.uint32(np.uint32(np.uint32(here[k]) << np.uint32(16)) | np.uint32(k + 1))
        away = np.int32(np.int32(k) - centre)
        is_other = (here[k] <= before[k]) & (here[k] <= after[k]) & ((away < -2) | (away > 2))
        least = min(least, key if is_other else NONE)
    return least


# (v,) u2, (2,b,d) i8, (3,b,d) i8, i8, (r,c) i4, (r,c) i4, (r,c) u2, (r,c) f4 -> None
@kernel
def winners(total, ranges, address, block, best, second, margin, vertex):
    """Height index of the least sum, and of the least other local minimum at least three indices away.

    best, second : (r, c) int32, second = best where there is no other minimum; margin : (r, c) uint16, how much larger
    the sum at `second` is (65535 where there is none); vertex : (r, c) float32, the parabola's minimum around `best`.
    """
    n_rows, n_cols = best.shape
    for r in range(n_rows):
        b = r // block
        for c in range(n_cols):
            d = c // block
            first, count = ranges[0, b, d], ranges[1, b, d]
            start = address[0, b, d] + (r - b * block) * address[1, b, d] + address[2, b, d] + (c - d * block) * count
            sums = total[start : start + count]
            least = least_sum(sums)
            low, where = np.uint16(least >> np.uint32(16)), np.int64(least & LOWER)
            other = other_minimum(sums, where)
            best[r, c] = first + where
            second[r, c] = first + (where if other == NONE else np.int64(other & LOWER))
            margin[r, c] = np.uint16(65535) if other == NONE else np.uint16(np.uint16(other >> np.uint32(16)) - low)
            vertex[r, c] = first + where
            if 0 < where < count - 1:
                left, right = np.float32(sums[where - 1] - low), np.float32(sums[where + 1] - low)
                if left + right > 0:
                    vertex[r, c] += np.float32(0.5) * (left - right) / (left + right)


# (v,) u1, (2,b,d) i8, (3,b,d) i8, i8, (r,c) i4, (r,c) i4 -> None
@kernel
def least_costs(cost, ranges, address, block, best, lone):
    """Height index of the least cost of each cell by itself: of equals that of `best`, else the first. (r, c) int32."""
    n_rows, n_cols = best.shape
    for r in range(n_rows):
        b = r // block
        for c in range(n_cols):
            d = c // block
            first, count = ranges[0, b, d], ranges[1, b, d]
            start = address[0, b, d] + (r - b * block) * address[1, b, d] + address[2, b, d] + (c - d * block) * count
            costs = cost[start : start + count]
            least = np.uint8(255)
            for k in range(count):
                least = min(least, costs[k])
            where = np.int64(best[r, c] - first)
            if costs[where] != least:
                where = np.int64(0)
                while costs[where] != least:
                    where += 1
            lone[r, c] = first + where
