"""More-global aggregation: every path cost draws on two neighbours, one along its direction and one across it.

Source: Facciolo, de Franchis, Meinhardt (2015), "MGM: a significantly more global matching for stereovision", the
recursion with two predecessors, in eight directions; penalties, ranges and sums as in `sgm.py`. Unlike there, the mean
of the two arrivals is rounded down, for path costs are uint16; and a cell with one of the two neighbours takes it
alone.

Four sweeps, each the first one turned by a quarter: its lines are rows (or columns), and a cell's neighbours are the
one before it on its line (W) and three on the line before (N, NW, NE). W and N make one path cost, NW and NE another.
Everything is counted in the order of the sweep: `position` is a cell's place in its line, segments are the blocks of a
line.

Why it is fast: what a neighbour offers is worked out once, when its own path costs are known,

    offer(q, k) = min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1) - min L(q),

and each of the cells that draw on it needs no more than min(offer, P2). Offers of a line stand cell after cell; each
segment has a place more at both ends, for its neighbours in other segments by its own heights, so that all cells of a
segment are alike. Heights are padded to whole vectors (costs there are FAR), so that no loop has a remainder. Costs are
copied to a sheet in the order of the sweep, sums replace them there: addresses grow evenly and upwards from cell to
cell, so that the compiler checks once a segment that what is read and what is written are apart; and a sheet of the
columns of a block reads the volume row by row, not a few bytes here and there.
"""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.sgm import FAR

LANE_BITS = 4
LANES = 1 << LANE_BITS
ALONG, ACROSS, KINDS, NEIGHBOURS = 0, 1, 2, 4
W, N, NW, NE = 0, 1, 2, 3
# Of a sweep: whether its lines are columns, their order, and that of the cells on a line; how many there are.
BY_COLUMN, LINE_SIGN, SIGN, N_LINES, N_CELLS = 0, 1, 2, 3, 4
# Of a segment: heights, padded ones, first position and the one after the last; offset of the place before its first
# cell among the offers of a line, and of its first cell in a line of a sheet.
FIRST, COUNT, WIDE, LEFT, END, PLACE, SHEET = 0, 1, 2, 3, 4, 5, 6
# Of the cells of a segment on a sheet: where they start in the volume and on the sheet; steps from row to row and from
# cell to cell there; how many there are.
SOURCE, SOURCE_ROW, TARGET, TARGET_ROW, TARGET_CELL, ROWS, CELLS = 0, 1, 2, 3, 4, 5, 6
NOTHING, ONE = np.uint16(0), np.uint16(1)


# i8, i8, i8 -> i8
@kernel
def in_order(at, n, sign):
    """Place in one order of what has the place `at` of n in the other; sign < 0 turns round."""
    return at if sign > 0 else n - 1 - at


# u2, u2, u2, u2, u2 -> u2
@kernel
def joined(offer, other, jump, other_jump, cost):
    """L(p, k) = C + (arrival + arrival) / 2, where arrival = min(offer, P2)."""
    return np.uint16(np.uint16(np.uint16(min(offer, jump) + min(other, other_jump)) >> ONE) + cost)


# u2, u2, u2, u2, u2 -> u2
@kernel
def offered(same, down, up, p1, least):
    """min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1) - min L(q)."""
    return np.uint16(min(same, np.uint16(min(down, up) + p1)) - least)


# (s,) u2, i8, (o,) u2, (4,) i8, (3,) i8, (l,) u2, (2,b) u2, (4,c) u2, u2 -> None
@kernel
def run_along(sheet, at, offers, spots, size, paths, least, edge, p1):
    """Path costs of the cells of a segment, and the offers of those from W and N, which take the place of N's.

    at : of the first cell on the sheet; spots : of its neighbours' offers; size : vectors of heights, cells, and the
    position of the first one; paths : both path costs, cell after cell, each kind in a half; least : their minima.
    """
    wide, one = np.uint64(size[0]) << np.uint64(LANE_BITS), np.uint64(1)
    w0, n0, nw0, ne0 = np.uint64(spots[W]), np.uint64(spots[N]), np.uint64(spots[NW]), np.uint64(spots[NE])
    s0, to0, half, position = np.uint64(at), w0 + wide, np.uint64(paths.shape[0] // KINDS), np.uint64(size[2])
    for cell in range(np.uint64(size[1])):
        i = position + cell
        x, y = cell * wide, one + cell * (wide + one)
        s, w, n, nw, ne, to, z = s0 + x, w0 + x, n0 + x, nw0 + x, ne0 + x, to0 + x, half + y
        jump_w, jump_n, jump_nw, jump_ne = edge[W, i], edge[N, i], edge[NW, i], edge[NE, i]
        low = low_across = np.uint16(65535)
        for k in range(wide):
            cost = sheet[s + k]
            here = joined(offers[w + k], offers[n + k], jump_w, jump_n, cost)
            across = joined(offers[nw + k], offers[ne + k], jump_nw, jump_ne, cost)
            paths[y + k] = here
            paths[z + k] = across
            low, low_across = min(low, here), min(low_across, across)
        least[ALONG, cell], least[ACROSS, cell] = low, low_across
        for k in range(wide):
            offers[to + k] = offered(paths[y + k], paths[y + k - one], paths[y + k + one], p1, low)


# (s,) u2, i8, (o,) u2, i8, (3,) i8, (l,) u2, (2,b) u2, u2 -> None
@kernel
def run_across(sheet, at, offers, spot, size, paths, least, p1):
    """Offers of the cells of a segment to the next line, from `spot` on; sums of both path costs to the sheet."""
    wide, one = np.uint64(size[0]) << np.uint64(LANE_BITS), np.uint64(1)
    s0, to0, half = np.uint64(at), np.uint64(spot), np.uint64(paths.shape[0] // KINDS)
    for cell in range(np.uint64(size[1])):
        x, y = cell * wide, one + cell * (wide + one)
        s, to, z, low = s0 + x, to0 + x, half + y, least[ACROSS, cell]
        for k in range(wide):
            offers[to + k] = offered(paths[z + k], paths[z + k - one], paths[z + k + one], p1, low)
            sheet[s + k] = np.uint16(paths[y + k] + paths[z + k])


# (l,) u2, i8, i8, i8, i8, i8, i8, (2,b) u2, u2, (2,2,c) u2 -> None
@kernel
def keep_ends(paths, count, wide, left, first, step, n_cells, least, p1, ends):
    """What cells first, first + step, ... of a segment offer one height below theirs and one above."""
    for kind in range(KINDS):
        for cell in range(first, n_cells, step):
            at = kind * (paths.shape[0] // KINDS) + 1 + cell * (wide + 1)
            ends[kind, 0, left + cell] = np.uint16(np.uint16(paths[at] + p1) - least[kind, cell])
            ends[kind, 1, left + cell] = np.uint16(np.uint16(paths[at + count - 1] + p1) - least[kind, cell])


# (o,) u2, i8, (7,t) i8, i8, (2,2,c) u2, i8, i8, i8, (7,t) i8, i8 -> None
@kernel
def restate(offers, source, segments, e, ends, kind, position, target, others, f):
    """Copy what the cell at `position` of segment e offers to `target`, by the heights of segment f of another line.

    source, target : of the line's offers of this kind; heights out of reach are FAR, only a jump (P2) leads there.
    The copy goes to the place of that position on a line, which is one more at both ends of a segment.
    """
    shift, wide = others[FIRST, f] - segments[FIRST, e], others[WIDE, f]
    count, last = segments[COUNT, e], segments[COUNT, e] - shift
    here = source + segments[PLACE, e] + (1 + position - segments[LEFT, e]) * segments[WIDE, e] + shift
    there = target + others[PLACE, f] + (1 + position - others[LEFT, f]) * wide
    for k in range(wide):
        offers[there + k] = FAR
    for k in range(max(0, -shift), min(wide, count - shift)):
        offers[there + k] = offers[here + k]
    if 0 <= -1 - shift < wide:
        offers[there - 1 - shift] = ends[kind, 0, position]
    if 0 <= last < wide:
        offers[there + last] = ends[kind, 1, position]


# (2,b,d) i8, i8, (5,) i8, i8, (7,t) i8, (t,v) u2 -> None
@kernel
def line_segments(ranges, b, way, block, segments, pads):
    """Segments of the lines of block row (or column) b, and what is added to costs at each: FAR above the last height.

    The last but one of t has only the length of a line, as PLACE of its offers and on a SHEET.
    """
    n = segments.shape[1] - 1
    left, place, sheet = 0, 0, 0
    for e in range(n):
        d = in_order(e, n, way[SIGN])
        br, bc = (d, b) if way[BY_COLUMN] else (b, d)
        count, n_cells = ranges[1, br, bc], min(block, way[N_CELLS] - d * block)
        wide = -(-count // LANES) * LANES
        segments[FIRST, e], segments[COUNT, e], segments[WIDE, e] = ranges[0, br, bc], count, wide
        segments[LEFT, e], segments[END, e] = left, left + n_cells
        segments[PLACE, e], segments[SHEET, e] = place, sheet
        left, place, sheet = left + n_cells, place + (n_cells + 2) * wide, sheet + n_cells * wide
        for k in range(pads.shape[1]):
            pads[e, k] = 0 if k < count else FAR
    segments[PLACE, n], segments[SHEET, n] = place, sheet


# (4,r,c) u2, i8, (5,) i8, b1, (4,) i8, (4,) i8, (4,p) u2 -> None
@kernel
def line_edges(p2, line, way, is_first, rows, cols, edge):
    """P2 of the steps from the neighbours (row and column offsets) into each cell of a line, in the order of the sweep.

    `p2` has the steps from W, NW, N and NE; those from the other side are stored at the cell they come from. A
    neighbour that is missing has the P2 of its partner, two have 0: nothing is added to the costs.
    """
    n, flat = edge.shape[1], p2.ravel()
    for path in range(NEIGHBOURS):
        dr, dc = rows[path], cols[path]
        is_behind = dr < 0 or (dr == 0 and dc < 0)
        plane = 0 if dr == 0 else 2 + (dc if is_behind else -dc)
        from_r, from_c = (0, 0) if is_behind else (dr, dc)
        low, high = 1 if path in (W, NW) else 0, n - 1 if path == NE else n
        if is_first and path != W:
            low, high = 0, 0
        at = in_order(0, n, way[SIGN])
        r, c = (at, line) if way[BY_COLUMN] else (line, at)
        start = (plane * p2.shape[1] + r + from_r) * p2.shape[2] + c + from_c
        step = way[SIGN] * (p2.shape[2] if way[BY_COLUMN] else 1)
        for i in range(n):
            edge[path, i] = 0
        for i in range(low, high):
            edge[path, i] = flat[np.uint64(start + i * step)]
    edge[W, 0], edge[NW, 0], edge[NE, n - 1] = edge[N, 0], edge[NE, 0], edge[NW, n - 1]
    if is_first:
        for i in range(n):
            edge[N, i] = edge[W, i]


# (3,b,d) i8, i8, i8, (5,) i8, (2,) i8, (7,t) i8, (7,t) i8 -> None
@kernel
def find_patches(address, block, line, way, shape, segments, patches):
    """The cells of each segment, and of all lines of its block where lines are columns, in the volume and on a sheet.

    shape : rows and columns of the volume.
    """
    n = segments.shape[1] - 1
    for e in range(n):
        d, b = in_order(e, n, way[SIGN]), line // block
        br, bc = (d, b) if way[BY_COLUMN] else (b, d)
        top, wide = br * block if way[BY_COLUMN] else line, way[SIGN] * segments[WIDE, e]
        n_rows, n_cells = min(block, shape[0] - top) if way[BY_COLUMN] else 1, min(block, shape[1] - bc * block)
        by_row, by_cell = (wide, way[LINE_SIGN] * segments[SHEET, n]) if way[BY_COLUMN] else (0, wide)
        patches[SOURCE, e] = address[0, br, bc] + (top - br * block) * address[1, br, bc] + address[2, br, bc]
        patches[SOURCE_ROW, e] = address[1, br, bc]
        patches[TARGET, e] = segments[SHEET, e] - min(0, by_row) * (n_rows - 1) - min(0, by_cell) * (n_cells - 1)
        patches[TARGET_ROW, e], patches[TARGET_CELL, e] = by_row, by_cell
        patches[ROWS, e], patches[CELLS, e] = n_rows, n_cells


# (v,) u1, (7,t) i8, i8, i8, (v,) u2, (b,) i8, (s,) u2 -> None
@kernel
def lay_costs(cost, patches, e, count, pad, steps, sheet):
    """Copy the costs of cells to a sheet, with FAR above the last height; steps : from the first cell of a row to each.

    Steps are read from a table: were they computed, the compiler would take height after height where they may lead
    downwards.
    """
    wide = np.uint64(pad.shape[0] >> LANE_BITS) << np.uint64(LANE_BITS)
    for row in range(patches[ROWS, e]):
        source = patches[SOURCE, e] + row * patches[SOURCE_ROW, e]
        target = patches[TARGET, e] + row * patches[TARGET_ROW, e]
        for cell in range(patches[CELLS, e]):
            s, to = np.uint64(source + cell * count), np.uint64(target + steps[cell])
            if source + cell * count + pad.shape[0] <= cost.shape[0]:
                for k in range(wide):
                    sheet[to + k] = np.uint16(np.uint16(cost[s + k]) + pad[k])
            else:
                for k in range(wide):
                    sheet[to + k] = np.uint16(cost[s + k]) if k < np.uint64(count) else FAR


# (s,) u2, (7,t) i8, i8, i8, (v,) u2, (b,) i8, (v,) u2 -> None
@kernel
def add_sums(sheet, patches, e, count, pad, steps, total):
    """Add the sums of cells on a sheet, as `lay_costs` laid it; nothing is added to the next cell's heights."""
    wide = np.uint64(pad.shape[0] >> LANE_BITS) << np.uint64(LANE_BITS)
    for row in range(patches[ROWS, e]):
        source = patches[SOURCE, e] + row * patches[SOURCE_ROW, e]
        target = patches[TARGET, e] + row * patches[TARGET_ROW, e]
        for cell in range(patches[CELLS, e]):
            s, to = np.uint64(source + cell * count), np.uint64(target + steps[cell])
            if source + cell * count + pad.shape[0] <= total.shape[0]:
                for k in range(wide):
                    here = sheet[to + k]
                    total[s + k] = np.uint16(total[s + k] + (here if pad[k] == NOTHING else NOTHING))
            else:
                for k in range(np.uint64(count)):
                    total[s + k] = np.uint16(total[s + k] + sheet[to + k])


# (v,) u1, (v,) u2, (7,t) i8, (7,t) i8, (t,v) u2, b1, (s,) u2 -> None
@kernel
def exchange(cost, total, patches, segments, pads, is_done, sheet):
    """Lay the costs of all segments on a sheet, or add what the sweep has made of them."""
    steps = np.empty(patches[CELLS].max(), np.int64)
    for e in range(patches.shape[1] - 1):
        for cell in range(patches[CELLS, e]):
            steps[cell] = cell * patches[TARGET_CELL, e]
        pad = pads[e, : segments[WIDE, e]]
        if is_done:
            add_sums(sheet, patches, e, segments[COUNT, e], pad, steps, total)
        else:
            lay_costs(cost, patches, e, segments[COUNT, e], pad, steps, sheet)


# (o,) u2, (2,) i8, (7,t) i8, (2,) i8, (7,t) i8, (2,2,c) u2, b1 -> None
@kernel
def meet_line(offers, before, others, now, segments, ends, is_new):
    """What the cells of the line before offer, by the heights of the segments of this one.

    before, now : where the offers of a line start, by kind. If this line has other segments (`is_new`) all are copied,
    else those at the borders of the segments. Offers of a missing neighbour are those of its partner.
    """
    n = segments.shape[1] - 1
    for e in range(n):
        if is_new:
            for kind in range(KINDS):
                for position in range(others[LEFT, e], others[END, e]):
                    restate(offers, before[kind], others, e, ends, kind, position, now[kind], segments, e)
        if e > 0:
            restate(offers, before[ACROSS], others, e, ends, ACROSS, others[LEFT, e], now[ACROSS], segments, e - 1)
        if e < n - 1:
            restate(offers, before[ACROSS], others, e, ends, ACROSS, others[END, e] - 1, now[ACROSS], segments, e + 1)
    for k in range(segments[WIDE, 0]):
        offers[now[ALONG] + k] = offers[now[ALONG] + segments[WIDE, 0] + k]
        offers[now[ACROSS] + k] = offers[now[ACROSS] + 2 * segments[WIDE, 0] + k]
    after, wide = now[ACROSS] + segments[PLACE, n] - segments[WIDE, n - 1], segments[WIDE, n - 1]
    for k in range(wide):
        offers[after + k] = offers[after - 2 * wide + k]


# (s,) u2, i8, (o,) u2, (2,) i8, (7,t) i8, b1, b1, (l,) u2, (2,b) u2, (4,c) u2, u2, (2,2,c) u2 -> None
@kernel
def run_line(sheet, at, offers, now, segments, is_first, is_last, paths, least, edge, p1, ends):
    """Path costs and offers of a line, whose costs start at `at` of the sheet; their sums take the place of the costs.

    is_first : no line is before it; is_last : the next one may have other segments.
    """
    spots, size = np.empty(NEIGHBOURS, np.int64), np.empty(3, np.int64)
    half = paths.shape[0] // KINDS
    for e in range(segments.shape[1] - 1):
        left, count, wide = segments[LEFT, e], segments[COUNT, e], segments[WIDE, e]
        n_cells = segments[END, e] - left
        if e > 0:
            restate(offers, now[ALONG], segments, e - 1, ends, ALONG, left - 1, now[ALONG], segments, e)
        for cell in range(n_cells + 1):
            paths[cell * (wide + 1)], paths[half + cell * (wide + 1)] = FAR, FAR
        spots[W], spots[NW] = now[ALONG] + segments[PLACE, e], now[ACROSS] + segments[PLACE, e]
        spots[N], spots[NE] = spots[W] + (0 if is_first else wide), spots[NW] + 2 * wide
        size[0], size[1], size[2] = wide >> LANE_BITS, n_cells, left
        start = at + segments[SHEET, e]
        run_along(sheet, start, offers, spots, size, paths, least, edge, p1)
        run_across(sheet, start, offers, spots[NW] + wide, size, paths, least, p1)
        keep_ends(paths, count, wide, left, 0, 1 if is_last else max(1, n_cells - 1), n_cells, least, p1, ends)


# i8, i8, i8, (4,) i8, (4,) i8 -> (5,) i8
@kernel
def turned(turn, n_rows, n_cols, rows, cols):
    """The sweep after some quarter turns; row and column offsets of the neighbours are turned with it."""
    by_column = turn % 2 == 1
    for _ in range(turn):
        for path in range(NEIGHBOURS):
            rows[path], cols[path] = cols[path], -rows[path]
    way = np.empty(5, np.int64)
    way[BY_COLUMN] = 1 if by_column else 0
    way[LINE_SIGN] = -cols[N] if by_column else -rows[N]
    way[SIGN] = -rows[W] if by_column else -cols[W]
    way[N_LINES], way[N_CELLS] = (n_cols, n_rows) if by_column else (n_rows, n_cols)
    return way


# (v,) u1, (2,b,d) i8, (3,b,d) i8, i8, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep_quarter(cost, ranges, address, block, p2, p1, turn, total):
    """Add the path costs of two directions to `total`. turn : quarter turns clockwise from (W, N) and (NW, NE).

    p2 : (4, r, c) uint16, penalty of the jump into a cell from W, NW, N, NE.
    """
    rows, cols, shape = np.array([0, -1, -1, -1]), np.array([-1, 0, -1, 1]), np.array(p2.shape[1:])
    way = turned(turn, shape[0], shape[1], rows, cols)
    n_lines, n_cells = way[N_LINES], way[N_CELLS]
    n_segments, widest = -(-n_cells // block), -(-ranges[1].max() // LANES) * LANES
    length = (n_cells + 2 * n_segments) * widest
    offers, starts = np.zeros(2 * KINDS * length, np.uint16), (np.arange(2 * KINDS) * length).reshape((2, KINDS))
    paths = np.full(KINDS * (1 + block * (widest + 1)), FAR, np.uint16)
    least, ends = np.zeros((KINDS, block), np.uint16), np.zeros((KINDS, 2, n_cells), np.uint16)
    edge, pads = np.zeros((NEIGHBOURS, n_cells), np.uint16), np.zeros((n_segments, widest), np.uint16)
    segments, patches = np.zeros((2, 7, n_segments + 1), np.int64), np.zeros((7, n_segments + 1), np.int64)
    sheet = np.empty((block if way[BY_COLUMN] else 1) * n_cells * widest, np.uint16)
    now = at = np.int64(0)
    for i in range(n_lines):
        line, before = in_order(i, n_lines, way[LINE_SIGN]), now
        is_new = i == 0 or line // block != (line - way[LINE_SIGN]) // block
        is_last = i == n_lines - 1 or line // block != (line + way[LINE_SIGN]) // block
        if is_new:
            now = 1 - now
            line_segments(ranges, line // block, way, block, segments[now], pads)
        if is_new or not way[BY_COLUMN]:
            at = np.int64(0)
            find_patches(address, block, line, way, shape, segments[now], patches)
            exchange(cost, total, patches, segments[now], pads, False, sheet)
        line_edges(p2, line, way, i == 0, rows, cols, edge)
        if i > 0:
            meet_line(offers, starts[before], segments[before], starts[now], segments[now], ends, is_new)
        run_line(
            sheet, at, offers, starts[now], segments[now], i == 0, is_last, paths, least, edge, p1, ends
        )  # fmt: skip
        at += segments[now, SHEET, n_segments]
        if is_last or not way[BY_COLUMN]:
            exchange(cost, total, patches, segments[now], pads, True, sheet)
