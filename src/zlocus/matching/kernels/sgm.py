"""Semi-global aggregation over a volume whose cells have ranges of their own.

Source: Hirschmueller (2008), eq. 13, along 8 paths, neighbours compared by height (an integer shift of their ranges).
Two sweeps: down (paths from W, NW, N, NE), then up (from E, SE, S, SW). Inside a sweep everything is counted in its
own order: `position` is a cell's place in its row as the sweep meets it, segments are the blocks of a row as it meets
them, W ... NE are the neighbours behind; only the previous row of path costs is kept.

Why it is fast: every sum and minimum is cast back to uint16 (Numba widens integers to 64 bits and the lanes would be
lost), and all addresses in `run_cells` grow evenly and upwards from cell to cell, so that the compiler checks once a
run, not in every cell, that what is read and what is written are apart. Hence the copies: the up sweep turns its rows
round, and a neighbour with another range is copied by the heights of the cell. A path from W cannot begin a cell
before the one behind it is stored, and with few heights that wait is longer than the work; so the paths from W of some
rows go side by side, ahead of the three others.
"""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

PAD = 2
FAR = np.uint16(16000)
FIRST, COUNT, LEFT, PLACE, SHEET = 0, 1, 2, 3, 4
NW, N, NE, BEHIND = 0, 1, 2, 3
# Rows whose paths from W go side by side. Of their cells: two planes that swap, and one for copies of those behind.
BESIDE, COPY = 4, 2
NOBODY = -1
NONE, LOWER = np.uint32(0xFFFFFFFF), np.uint32(0xFFFF)


# u2, u2, u2, u2, u2, u2, u2 -> u2
@kernel
def path_cost(same, down, up, p1, jump, least, cost):
    """L(p, k) = C + min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1, min L(q) + P2) - min L(q)."""
    best = min(same, np.uint16(min(down, up) + p1))
    return np.uint16(np.uint16(min(best, jump) - least) + cost)


# (v,) u1, (v,) u2, (2,) i8, (3,) i8, (3,r,l) u2, (2,) i8, (r,) u2, (r,4,c) u2, i8, u2 -> None
@kernel
def run_west(cost, sums, start, size, paths, spots, least, edges, position, p1):
    """Path costs from W of neighbouring cells of one range, in some rows at once; they are written to `sums`.

    start : of the first cell in `cost` and `sums`, and the step to the next row; size : heights, cells and rows;
    spots : planes of `paths` where the first cell reads and where it writes (0 or 1, from cell to cell in turns);
    least : of the cells before; edges : P2.

    Rows lie inside the planes: the compiler compares what all rows read with what all of them write.
    """
    n, n_rows, step, one = np.uint64(size[0]), np.uint64(size[2]), np.uint64(start[1]), np.uint64(1)
    pad = np.uint64(PAD)
    behind, ahead = np.uint64(spots[0]), np.uint64(spots[1])
    for cell in range(np.uint64(size[1])):
        s0, i = np.uint64(start[0]) + cell * n, np.uint64(position) + cell
        for row in range(n_rows):
            s, low = s0 + row * step, np.uint16(65535)
            before = least[row]
            jump = np.uint16(before + edges[row, 0, i])
            for k in range(n):
                down, up = paths[behind, row, pad + k - one], paths[behind, row, pad + k + one]
                here = path_cost(paths[behind, row, pad + k], down, up, p1, jump, before, np.uint16(cost[s + k]))
                paths[ahead, row, pad + k] = here
                sums[s + k] = here
                low = min(low, here)
            least[row] = low
        behind, ahead = ahead, one - ahead


# (v,) u1, (v,) u2, i8, (2,) i8, (l,) u2, (2,3) i8, (3,c) u2, (3,c) u2, (4,c) u2, i8, u2 -> None
@kernel
def run_cells(cost, sums, start, size, paths, spots, behind, ahead, edge, position, p1):
    """Path costs from NW, N and NE of neighbouring cells of one range, whose neighbours all share it, added to `sums`.

    start : of the first cell in `cost` and `sums`; size : heights and cells; spots : where the first cell's path costs
    are read and written in `paths`; behind, ahead : (3, c + 2) uint16, least path costs of the previous and of this
    row, cell i at i + 1; edge : (4, c) uint16, P2.
    """
    n, one, two = np.uint64(size[0]), np.uint64(1), np.uint64(2)
    wide = n + np.uint64(PAD)
    nw_behind, n_behind, ne_behind = np.uint64(spots[0, NW]), np.uint64(spots[0, N]), np.uint64(spots[0, NE])
    nw_ahead, n_ahead, ne_ahead = np.uint64(spots[1, NW]), np.uint64(spots[1, N]), np.uint64(spots[1, NE])
    for cell in range(np.uint64(size[1])):
        i, away, s = np.uint64(position) + cell, cell * wide, np.uint64(start) + cell * n
        r1, r2, r3 = nw_behind + away, n_behind + away, ne_behind + away
        a1, a2, a3 = nw_ahead + away, n_ahead + away, ne_ahead + away
        l1, l2, l3 = behind[NW, i], behind[N, i + one], behind[NE, i + two]
        j1, j2, j3 = np.uint16(l1 + edge[1, i]), np.uint16(l2 + edge[2, i]), np.uint16(l3 + edge[3, i])
        m1 = m2 = m3 = np.uint16(65535)
        for k in range(n):
            c = np.uint16(cost[s + k])
            v1 = path_cost(paths[r1 + k], paths[r1 + k - one], paths[r1 + k + one], p1, j1, l1, c)
            v2 = path_cost(paths[r2 + k], paths[r2 + k - one], paths[r2 + k + one], p1, j2, l2, c)
            v3 = path_cost(paths[r3 + k], paths[r3 + k - one], paths[r3 + k + one], p1, j3, l3, c)
            paths[a1 + k] = v1
            paths[a2 + k] = v2
            paths[a3 + k] = v3
            m1, m2, m3 = min(m1, v1), min(m2, v2), min(m3, v3)
            sums[s + k] = np.uint16(np.uint16(sums[s + k] + v1) + np.uint16(v2 + v3))
        ahead[NW, i + one], ahead[N, i + one], ahead[NE, i + one] = m1, m2, m3


# (l,) u2, i8, i8, (l,) u2, i8 -> None
@kernel
def shifted(behind, n_behind, shift, here, count):
    """Copy a neighbour's path costs by the heights of this cell and one more at both ends; both begin at PAD.

    shift = first index here less the neighbour's. Heights that it did not search are FAR: only a jump (P2) leads from
    there. n_behind < 0: no neighbour, zeros (L = C).
    """
    nothing = FAR if n_behind >= 0 else np.uint16(0)
    for k in range(PAD - 1, PAD + count + 1):
        here[k] = nothing
    low, high = max(-1, -shift), min(count + 1, n_behind - shift)
    if low < high:
        source, target = behind[PAD + shift + low : PAD + shift + high], here[PAD + low : PAD + high]
        for k in range(source.shape[0]):
            target[k] = source[k]


# (2,b,d) i8, i8, i8, i8, i8, (5,d) i8 -> None
@kernel
def row_segments(ranges, block_row, block, n_cols, sign, segments):
    """Segments of a row: FIRST, COUNT of heights, LEFT position, PLACE of its first cell among path costs, on a SHEET.

    segments : (5, d + 2) int64, segment e at e + 1; the count NOBODY stands where there is none.
    """
    n_d = ranges.shape[2]
    segments[COUNT] = NOBODY
    left, place, sheet = 0, PAD, 0
    for e in range(n_d):
        d = e if sign > 0 else n_d - 1 - e
        count = ranges[1, block_row, d]
        segments[FIRST, e + 1], segments[COUNT, e + 1] = ranges[0, block_row, d], count
        segments[LEFT, e + 1], segments[PLACE, e + 1], segments[SHEET, e + 1] = left, place, sheet
        n_cells = min(block, n_cols - d * block)
        left += n_cells
        place += n_cells * (count + PAD)
        sheet += n_cells * count
    segments[LEFT, n_d + 1], segments[SHEET, n_d + 1] = left, sheet


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


# (2,5,d) i8, i8, i8, i8, i8 -> b1
@kernel
def alike(segments, row, e, other, f):
    """Whether two segments of two rows, even (0) or odd, search the same heights."""
    same_count = segments[row, COUNT, e] == segments[other, COUNT, f]
    return same_count and segments[row, FIRST, e] == segments[other, FIRST, f]


# (v,) u1, (v,) u2, (d,) i8, i8, (2,5,d) i8, i8, i8, (3,r,l) u2, (r,4,c) u2, u2 -> None
@kernel
def sweep_west(cost, sums, starts, step, segments, now, n_rows, paths, edges, p1):
    """Path costs from W of the cells of some rows, which have the same segments; they are written to `sums`.

    starts : of the segments of the first row; step : to the next row; paths : (3, r, l) uint16, of the last two cells
    of each row, and copies.
    """
    turn = 0
    start, size, spots = np.empty(2, np.int64), np.empty(3, np.int64), np.empty(2, np.int64)
    least = np.zeros(n_rows, np.uint16)
    for e in range(1, starts.shape[0] - 1):
        count, n_cells = segments[now, COUNT, e], segments[now, LEFT, e + 1] - segments[now, LEFT, e]
        behind = turn
        if not alike(segments, now, e, now, e - 1):
            behind, shift = COPY, segments[now, FIRST, e] - segments[now, FIRST, e - 1]
            for row in range(n_rows):
                shifted(paths[turn, row], segments[now, COUNT, e - 1], shift, paths[COPY, row], count)
                paths[0, row, PAD + count] = paths[1, row, PAD + count] = FAR
        start[0], start[1] = starts[e], step
        size[0], size[1], size[2] = count, n_cells, n_rows
        spots[0], spots[1] = behind, 1 - turn
        run_west(cost, sums, start, size, paths, spots, least, edges, segments[now, LEFT, e], p1)
        turn = (turn + n_cells) % 2


# (l,) u2, (3,3) i8, (2,5,d) i8, i8, i8, i8, (2,3) i8 -> None
@kernel
def find_neighbours(paths, planes, segments, now, e, position, spots):
    """Where a cell reads and writes its path costs; neighbours of another range are copied to a place of their own.

    planes : (3, 3) int64, start of the path costs of even and odd rows, and of copies.
    """
    count, left, right = segments[now, COUNT, e], segments[now, LEFT, e], segments[now, LEFT, e + 1]
    place, before = segments[now, PLACE, e] + (position - left) * (count + PAD), 1 - now
    for path in range(BEHIND):
        across = position + path - 1
        f = e - 1 if across < left else (e + 1 if across >= right else e)
        from_left = (across - segments[before, LEFT, f]) * (segments[before, COUNT, f] + PAD)
        spots[0, path] = planes[before, path] + segments[before, PLACE, f] + from_left
        spots[1, path] = planes[now, path] + place
        if not alike(segments, now, e, before, f):
            shift = segments[now, FIRST, e] - segments[before, FIRST, f]
            here, there = paths[planes[2, path] - PAD :], paths[spots[0, path] - PAD :]
            shifted(there, segments[before, COUNT, f], shift, here, count)
            spots[0, path] = planes[2, path]


# (v,) u1, (v,) u2, i8, (l,) u2, (3,3) i8, (2,5,d) i8, i8, i8, (2,3,c) u2, (4,c) u2, u2, (2,3) i8, (2,) i8 -> None
@kernel
def sweep_segment(cost, sums, start, paths, planes, segments, now, e, least, edge, p1, spots, size):
    """All cells of a segment: those at its ends and under another range one by one, the others in one run.

    spots, size : where `run_cells` gets them.
    """
    left, right, count = segments[now, LEFT, e], segments[now, LEFT, e + 1], segments[now, COUNT, e]
    run, end, before = left, right, 1 - now
    if not alike(segments, now, e, before, e):
        run = right
    elif not alike(segments, now, e, before, e - 1):
        run = left + 1
    if not alike(segments, now, e, before, e + 1):
        end = right - 1
    behind, ahead = least[before], least[now]
    i = left
    while i < right:
        size[0], size[1] = count, (end - i if run <= i < end else 1)
        find_neighbours(paths, planes, segments, now, e, i, spots)
        run_cells(cost, sums, start + (i - left) * count, size, paths, spots, behind, ahead, edge, i, p1)
        i += size[1]


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


# (v,) u1, (v,) u2, (d,) i8, i8, (5,d) i8, i8, b1, (s,) u1, (s,) u2 -> None
@kernel
def turn_rows(cost, total, starts, step, segments, n_rows, is_done, sheet_cost, sheet_sums):
    """Lay the costs of some rows on a sheet, their cells in reverse order, or add the sums of the sheet to theirs."""
    length = segments[SHEET, starts.shape[0] - 1]
    for row in range(n_rows):
        for e in range(1, starts.shape[0] - 1):
            start, n_cells = starts[e] + row * step, segments[LEFT, e + 1] - segments[LEFT, e]
            at, end = row * length + segments[SHEET, e], row * length + segments[SHEET, e + 1]
            if is_done:
                add_reversed(sheet_sums[at:end], start, segments[COUNT, e], n_cells, total)
            else:
                reverse_cells(cost, start, segments[COUNT, e], n_cells, sheet_cost[at:end])


# i8, i8 -> (3,3) i8
@kernel
def path_planes(width, longest):
    """Where the path costs of even and odd rows and copies of neighbours start, for NW, N, NE."""
    planes = np.empty((3, BEHIND), np.int64)
    for path in range(BEHIND):
        planes[0, path], planes[1, path] = path * width, (BEHIND + path) * width
        planes[2, path] = 2 * BEHIND * width + path * longest + PAD
    return planes


# (v,) u1, (v,) u2, (d,) i8, i8, (l,) u2, (3,3) i8, (2,5,d) i8, i8, b1, (2,3,c) u2, (4,c) u2, u2 -> None
@kernel
def sweep_row(cost, sums, starts, shift, paths, planes, segments, now, is_new, least, edge, p1):
    """Paths from NW, N and NE of a row, whose segments start `shift` after `starts`.

    is_new : with segments unlike those of the row before the last.
    """
    if is_new:
        width = planes[0, 1]
        paths[planes[now, 0] : planes[now, 0] + BEHIND * width] = FAR
    spots, size = np.empty((2, BEHIND), np.int64), np.empty(2, np.int64)
    for e in range(1, starts.shape[0] - 1):
        sweep_segment(cost, sums, starts[e] + shift, paths, planes, segments, now, e, least, edge, p1, spots, size)


# (v,) u1, (2,b,d) i8, (3,b,d) i8, i8, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep(cost, ranges, address, block, p2, p1, sign, total):
    """Sums of four paths: sign = 1 sweeps down and writes `total`, -1 sweeps up and adds to it.

    p2 : (4, r, c) uint16, penalty of the jump into a cell from W, NW, N, NE.
    """
    n_rows, n_cols, n_d = p2.shape[1], p2.shape[2], ranges.shape[2]
    width, longest = address[1].max() + PAD * (n_cols + 2), ranges[1].max() + 2 * PAD
    planes, paths = path_planes(width, longest), np.full(2 * BEHIND * width + BEHIND * longest, FAR, np.uint16)
    west = np.full((3, BESIDE, longest), FAR, np.uint16)
    least, edges = np.zeros((2, BEHIND, n_cols + 2), np.uint16), np.empty((BESIDE, 4, n_cols), np.uint16)
    segments, starts = np.full((2, 5, n_d + 2), NOBODY, np.int64), np.empty(n_d + 2, np.int64)
    n_sheet = 0 if sign > 0 else BESIDE * address[1].max()
    sheet_cost, sheet_sums = np.empty(n_sheet, np.uint8), np.empty(n_sheet, np.uint16)
    done = 0
    while done < n_rows:
        r = done if sign > 0 else n_rows - 1 - done
        br = r // block
        n_beside = min(BESIDE, min((br + 1) * block, n_rows) - r if sign > 0 else r - br * block + 1)
        here = segments[done % 2]
        row_segments(ranges, br, block, n_cols, sign, here)
        for row in range(n_beside):
            row_edges(p2, r + sign * row, sign, edges[row])
        for e in range(1, n_d + 1):
            d, first = (e - 1 if sign > 0 else n_d - e), address[0, br, 0] + (r - br * block) * address[1, br, 0]
            starts[e] = first + address[2, br, d]
        step, source, sums = address[1, br, 0], cost, total
        if sign < 0:
            turn_rows(cost, total, starts, -step, here, n_beside, False, sheet_cost, sheet_sums)
            source, sums = sheet_cost, sheet_sums
            volume = starts.copy()
            starts[:] = here[SHEET]
        sweep_west(source, sums, starts, step, segments, done % 2, n_beside, west, edges, p1)
        for row in range(n_beside):
            now = (done + row) % 2
            if row == 1:
                # From here on the row before has the same segments.
                row_segments(ranges, br, block, n_cols, sign, segments[now])
            is_new = done + row < 2 or br != (r - sign * (2 - row)) // block
            sweep_row(source, sums, starts, row * step, paths, planes, segments, now, is_new, least, edges[row], p1)
        if sign < 0:
            turn_rows(cost, total, volume, -step, here, n_beside, True, sheet_cost, sheet_sums)
        done += n_beside


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
