"""More-global aggregation: every path cost draws on two neighbours, one along its direction and one across it.

Source: Facciolo, de Franchis, Meinhardt (2015), "MGM: a significantly more global matching for stereovision", the
recursion with two predecessors, in eight directions; penalties, ranges and sums as in `sgm.py`. Unlike there, the mean
of the two arrivals is rounded down, for path costs are uint16; and a cell with one of the two neighbours takes it
alone.

Four sweeps, each the first one turned by a quarter: its lines are rows (or columns), and a cell's neighbours are the
one before it on its line (W) and three on the line before (N, NW, NE). W and N make one path cost, NW and NE another;
only those of two lines are kept.
"""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel
from zlocus.kernels.sgm import FAR, PAD, shifted

FIRST, COUNT, SPOT, START = 0, 1, 2, 3
LINES, KINDS, NEIGHBOURS = 2, 2, 4
ONE = np.uint16(1)


# u2, u2, u2, u2, u2, u2 -> u2
@kernel
def arrival(same, down, up, p1, jump, least):
    """min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1, min L(q) + P2) - min L(q)."""
    return np.uint16(min(min(same, jump), np.uint16(min(down, up) + p1)) - least)


# (v,) u1, (v,) u2, i8, i8, (l,) u2, i8, (2,) i8, (2,) u2, (2,) u2, u2 -> u2
@kernel
def join(cost, total, start, count, paths, spot, spots, jump, least, p1):
    """Path costs of a cell from two neighbours, L = C + (arrival + arrival) / 2, added to `total`; returns the least.

    start : of the cell in `cost` and `total`; spot : in `paths`; spots : where the neighbours' path costs stand, by the
    heights of this cell; least, jump : the least of them, without and with P2.
    """
    n, one = np.uint64(count), np.uint64(1)
    s, to, a, b = np.uint64(start), np.uint64(spot), np.uint64(spots[0]), np.uint64(spots[1])
    jump_a, jump_b, least_a, least_b = jump[0], jump[1], least[0], least[1]
    lowest = np.uint16(65535)
    for k in range(n):
        u = arrival(paths[a + k], paths[a + k - one], paths[a + k + one], p1, jump_a, least_a)
        v = arrival(paths[b + k], paths[b + k - one], paths[b + k + one], p1, jump_b, least_b)
        here = np.uint16(np.uint16(np.uint16(u + v) >> ONE) + np.uint16(cost[s + k]))
        paths[to + k] = here
        total[s + k] = np.uint16(total[s + k] + here)
        lowest = min(lowest, here)
    paths[to - one] = FAR
    paths[to + n] = FAR
    return lowest


# (2,b,d) i8, (3,b,d) i8, i8, i8, b1, i8, (p,4) i8 -> None
@kernel
def line_cells(ranges, address, block, line, by_column, spot, cells):
    """FIRST, COUNT, SPOT and START of every cell of a line: its heights, its place in `paths` and in the volumes.

    spot : of the first cell.
    """
    for at in range(cells.shape[0]):
        r, c = (at, line) if by_column else (line, at)
        b, d = r // block, c // block
        count = ranges[1, b, d]
        cells[at, FIRST], cells[at, COUNT], cells[at, SPOT] = ranges[0, b, d], count, spot
        cells[at, START] = (
            address[0, b, d] + (r - b * block) * address[1, b, d] + address[2, b, d] + (c - d * block) * count
        )
        spot += count + PAD


# (4,r,c) u2, i8, b1, (4,) i8, (4,) i8, (4,p) u2 -> None
@kernel
def line_edges(p2, line, by_column, rows, cols, edge):
    """P2 of the steps from the neighbours (row and column offsets) into each cell of a line.

    `p2` has the steps from W, NW, N and NE; those from the other side are stored at the cell they come from. 0 where
    there is no neighbour.
    """
    n_rows, n_cols = p2.shape[1], p2.shape[2]
    for path in range(NEIGHBOURS):
        dr, dc = rows[path], cols[path]
        is_behind = dr < 0 or (dr == 0 and dc < 0)
        plane = 0 if dr == 0 else 2 + (dc if is_behind else -dc)
        for at in range(edge.shape[1]):
            r, c = (at, line) if by_column else (line, at)
            inside = 0 <= r + dr < n_rows and 0 <= c + dc < n_cols
            if not inside:
                edge[path, at] = 0
            else:
                edge[path, at] = p2[plane, r, c] if is_behind else p2[plane, r + dr, c + dc]


# (l,) u2, (2,p,4) i8, (2,2,p) u2, (4,p) u2, i8, i8, i8, (3,) i8, (4,) i8, (4,) u2, (4,) u2 -> None
@kernel
def gather(paths, cells, least, edge, now, at, sign, layout, spots, jump, behind):
    """Where the path costs of a cell's neighbours stand, and their least ones, without (`behind`) and with P2 (`jump`).

    layout : between the two kinds in `paths`, start of copies of a neighbour with another range, and their length; a
    neighbour that is missing is replaced by its partner, both by zeros.
    """
    n_cells, first, count = cells.shape[1], cells[now, at, FIRST], cells[now, at, COUNT]
    for path in range(NEIGHBOURS):
        of = now if path == 0 else 1 - now
        q = at + sign * (-1 if path in (0, 2) else (1 if path == 3 else 0))
        kind = path // 2
        spots[path] = -1
        if not 0 <= q < n_cells or cells[of, q, COUNT] == 0:
            continue
        spot, n_behind = cells[of, q, SPOT] + kind * layout[0], cells[of, q, COUNT]
        if cells[of, q, FIRST] != first or n_behind != count:
            copy = layout[1] + path * layout[2]
            shifted(paths, spot, n_behind, first - cells[of, q, FIRST], copy, count)
            spot = copy
        spots[path], behind[path] = spot, least[of, kind, q]
        jump[path] = np.uint16(behind[path] + edge[path, at])
    for path in range(NEIGHBOURS):
        partner = path ^ 1
        if spots[path] < 0 and spots[partner] >= 0:
            spots[path], behind[path], jump[path] = spots[partner], behind[partner], jump[partner]
    for path in range(NEIGHBOURS):
        if spots[path] < 0:
            spots[path], behind[path], jump[path] = layout[1] + NEIGHBOURS * layout[2], 0, 0


# (v,) u1, (2,b,d) i8, (3,b,d) i8, i8, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep_quarter(cost, ranges, address, block, p2, p1, turn, total):
    """Add the path costs of two directions to `total`. turn : quarter turns clockwise from (W, N) and (NW, NE).

    p2 : (4, r, c) uint16, penalty of the jump into a cell from W, NW, N, NE.
    """
    n_rows, n_cols = p2.shape[1], p2.shape[2]
    by_column = turn % 2 == 1
    rows, cols = np.array([0, -1, -1, -1]), np.array([-1, 0, -1, 1])
    for _ in range(turn):
        for path in range(NEIGHBOURS):
            rows[path], cols[path] = cols[path], -rows[path]
    n_lines, n_cells = (n_cols, n_rows) if by_column else (n_rows, n_cols)
    line_sign = -cols[1] if by_column else -rows[1]
    sign = -rows[0] if by_column else -cols[0]
    longest = ranges[1].max() + 2 * PAD
    width = PAD + n_cells * longest
    layout = np.array([LINES * width, LINES * KINDS * width + PAD, longest])
    paths = np.full(layout[1] + (NEIGHBOURS + 1) * longest, FAR, np.uint16)
    paths[layout[1] + NEIGHBOURS * longest - 1 :] = 0
    cells, least = np.zeros((LINES, n_cells, 4), np.int64), np.zeros((LINES, KINDS, n_cells), np.uint16)
    edge = np.empty((NEIGHBOURS, n_cells), np.uint16)
    spots = np.empty(NEIGHBOURS, np.int64)
    jump, behind = np.zeros(NEIGHBOURS, np.uint16), np.zeros(NEIGHBOURS, np.uint16)
    for i in range(n_lines):
        line, now = i if line_sign > 0 else n_lines - 1 - i, i % LINES
        line_cells(ranges, address, block, line, by_column, now * width + PAD, cells[now])
        line_edges(p2, line, by_column, rows, cols, edge)
        for j in range(n_cells):
            at = j if sign > 0 else n_cells - 1 - j
            gather(paths, cells, least, edge, now, at, sign, layout, spots, jump, behind)
            start, count = cells[now, at, START], cells[now, at, COUNT]
            for kind in range(KINDS):
                spot, two = cells[now, at, SPOT] + kind * layout[0], 2 * kind
                least[now, kind, at] = join(
                    cost, total, start, count, paths, spot, spots[two : two + 2], jump[two : two + 2],
                    behind[two : two + 2], p1,
                )  # fmt: skip
