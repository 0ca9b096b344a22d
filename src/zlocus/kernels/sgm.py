"""Semi-global aggregation over a volume whose cells have ranges of their own.

Source: Hirschmueller (2008), eq. 13, along 8 paths, neighbours compared by height (an integer shift of their ranges).
Two sweeps: down (paths from W, NW, N, NE), then up (from E, SE, S, SW); only the previous row of path costs is kept.
Every sum and minimum is cast back to uint16: Numba widens integers to 64 bits and the vector lanes would be lost.
"""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel

PAD = 2
FAR = np.uint16(16000)


# u2, u2, u2, u2, u2, u2, u2 -> u2
@kernel
def path_cost(same, down, up, p1, jump, least, cost):
    """L(p, k) = C + min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1, min L(q) + P2) - min L(q)."""
    best = min(same, np.uint16(min(down, up) + p1))
    return np.uint16(np.uint16(min(best, jump) - least) + cost)


# (v,) u1, (v,) u2, i8, i8, (l,) u2, (4,) i8, (4,) i8, (4,) u2, (4,) u2, u2 -> None
@kernel
def four_paths(cost, total, start, count, paths, behind, ahead, least, p2, p1):
    """One cell, four paths whose neighbours share its range; path costs are read at `behind`, written at `ahead`.

    least : (4,) uint16, min of the neighbours' path costs, replaced by this cell's. The four sums are added to `total`.
    """
    l0, l1, l2, l3 = least[0], least[1], least[2], least[3]
    j0, j1 = np.uint16(l0 + p2[0]), np.uint16(l1 + p2[1])
    j2, j3 = np.uint16(l2 + p2[2]), np.uint16(l3 + p2[3])
    m0 = m1 = m2 = m3 = np.uint16(65535)
    here = cost[start : start + count]
    sums = total[start : start + count]
    a0 = paths[behind[0] - 1 : behind[0] + count + 1]
    a1 = paths[behind[1] - 1 : behind[1] + count + 1]
    a2 = paths[behind[2] - 1 : behind[2] + count + 1]
    a3 = paths[behind[3] - 1 : behind[3] + count + 1]
    b0 = paths[ahead[0] : ahead[0] + count]
    b1 = paths[ahead[1] : ahead[1] + count]
    b2 = paths[ahead[2] : ahead[2] + count]
    b3 = paths[ahead[3] : ahead[3] + count]
    for k in range(count):
        c = np.uint16(here[k])
        v0 = path_cost(a0[k + 1], a0[k], a0[k + 2], p1, j0, l0, c)
        v1 = path_cost(a1[k + 1], a1[k], a1[k + 2], p1, j1, l1, c)
        v2 = path_cost(a2[k + 1], a2[k], a2[k + 2], p1, j2, l2, c)
        v3 = path_cost(a3[k + 1], a3[k], a3[k + 2], p1, j3, l3, c)
        b0[k] = v0
        b1[k] = v1
        b2[k] = v2
        b3[k] = v3
        m0, m1, m2, m3 = min(m0, v0), min(m1, v1), min(m2, v2), min(m3, v3)
        sums[k] = np.uint16(sums[k] + np.uint16(np.uint16(v0 + v1) + np.uint16(v2 + v3)))
    least[0], least[1], least[2], least[3] = m0, m1, m2, m3


# (v,) u1, (v,) u2, i8, i8, (l,) u2, i8, i8, i8, i8, u2, u2, u2 -> u2
@kernel
def one_path(cost, total, start, count, paths, behind, n_behind, shift, ahead, least, p2, p1):
    """One cell, one path, neighbour with another range; shift = first index here less the neighbour's first index.

    Heights the neighbour did not search are reached by a jump (P2) only. n_behind < 0: no neighbour, L = C.
    """
    smallest = np.uint16(65535)
    jump = np.uint16(least + p2)
    for k in range(count):
        value = np.uint16(cost[start + k])
        if n_behind >= 0:
            j = k + shift
            best = jump
            if -1 <= j <= n_behind:
                p = behind + j
                best = min(best, min(paths[p], np.uint16(min(paths[p - 1], paths[p + 1]) + p1)))
            value = np.uint16(np.uint16(best - least) + value)
        paths[ahead + k] = value
        total[start + k] = np.uint16(total[start + k] + value)
        smallest = min(smallest, value)
    return smallest


# (2,b,d) i8, (3,b,d) i8, i8, i8, i8, (c,) i8, (c,) i8, (c,) i8, (c,) i8 -> None
@kernel
def row_layout(ranges, address, block, row, n_cols, first, count, start, place):
    """Range and addresses of every cell of a row: first index, count, start in the volume, place in the path buffer."""
    br = row // block
    base = address[0, br, 0] + (row - br * block) * address[1, br, 0]
    spot = PAD
    for c in range(n_cols):
        bc = c // block
        n = ranges[1, br, bc]
        first[c] = ranges[0, br, bc]
        count[c] = n
        start[c] = base + address[2, br, bc] + (c - bc * block) * n
        place[c] = spot
        spot += n + PAD


# (v,) u1, (2,b,d) i8, (3,b,d) i8, i8, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep(cost, ranges, address, block, p2, p1, sign, total):
    """Add four paths to `total`: sign = 1 sweeps down, -1 up. p2 : (4, r, c) uint16 of the edge from W, NW, N, NE."""
    n_rows, n_cols = p2.shape[1], p2.shape[2]
    width = 0
    for br in range(ranges.shape[1]):
        width = max(width, address[1, br, 0])
    width += PAD * (n_cols + 2)
    paths = np.full(2 * 4 * width, FAR, np.uint16)
    least = np.zeros((2, 4, n_cols), np.uint16)
    first, count = np.zeros((2, n_cols), np.int64), np.zeros((2, n_cols), np.int64)
    start, place = np.zeros((2, n_cols), np.int64), np.zeros((2, n_cols), np.int64)
    behind, ahead = np.zeros(4, np.int64), np.zeros(4, np.int64)
    cell_least, cell_p2 = np.zeros(4, np.uint16), np.zeros(4, np.uint16)
    for step in range(n_rows):
        r = step if sign > 0 else n_rows - 1 - step
        now, then = step % 2, 1 - step % 2
        row_layout(ranges, address, block, r, n_cols, first[now], count[now], start[now], place[now])
        if step < 2 or r // block != (r - 2 * sign) // block:
            paths[now * 4 * width : (now + 1) * 4 * width] = FAR
        for i in range(n_cols):
            c = i if sign > 0 else n_cols - 1 - i
            n = count[now, c]
            alike = True
            for path in range(4):
                across = c - sign if path < 2 else (c if path == 2 else c + sign)
                along = now if path == 0 else then
                exists = 0 <= across < n_cols and (path == 0 or step > 0)
                ahead[path] = (now * 4 + path) * width + place[now, c]
                if not exists:
                    alike = False
                    behind[path] = -1
                    continue
                behind[path] = (along * 4 + path) * width + place[along, across]
                cell_least[path] = least[along, path, across]
                if sign > 0:
                    cell_p2[path] = p2[path, r, c]
                else:
                    cell_p2[path] = p2[path, r if path == 0 else r + 1, across]
                alike = alike and count[along, across] == n and first[along, across] == first[now, c]
            if alike:
                four_paths(cost, total, start[now, c], n, paths, behind, ahead, cell_least, cell_p2, p1)
            else:
                for path in range(4):
                    across = c - sign if path < 2 else (c if path == 2 else c + sign)
                    along = now if path == 0 else then
                    known = behind[path] >= 0
                    n_behind = count[along, across] if known else -1
                    shift = first[now, c] - first[along, across] if known else 0
                    cell_least[path] = one_path(
                        cost, total, start[now, c], n, paths, behind[path], n_behind, shift, ahead[path],
                        cell_least[path], cell_p2[path], p1,
                    )  # fmt: skip
            for path in range(4):
                least[now, path, c] = cell_least[path]


# (v,) u2, (2,b,d) i8, (3,b,d) i8, i8, (r,c) i4, (r,c) i4, (r,c) u2, (r,c) f4 -> None
@kernel
def winners(total, ranges, address, block, best, second, margin, vertex):
    """Height index of the least sum, and of the least other local minimum at least three indices away.

    best, second : (r, c) int32, second = best where there is no other minimum; margin : (r, c) uint16, how much larger
    the sum at `second` is (65535 where there is none); vertex : (r, c) float32, the parabola's minimum around `best`.
    """
    n_rows, n_cols = best.shape
    first, count = np.zeros(n_cols, np.int64), np.zeros(n_cols, np.int64)
    start, place = np.zeros(n_cols, np.int64), np.zeros(n_cols, np.int64)
    for r in range(n_rows):
        row_layout(ranges, address, block, r, n_cols, first, count, start, place)
        for c in range(n_cols):
            sums = total[start[c] : start[c] + count[c]]
            low = np.uint16(65535)
            for k in range(sums.shape[0]):
                low = min(low, sums[k])
            where = 0
            while sums[where] != low:
                where += 1
            other, other_at = np.uint16(65535), where
            for k in range(1, sums.shape[0] - 1):
                if sums[k] < other and sums[k] <= sums[k - 1] and sums[k] <= sums[k + 1] and abs(k - where) > 2:
                    other, other_at = sums[k], k
            best[r, c] = first[c] + where
            second[r, c] = first[c] + other_at
            margin[r, c] = np.uint16(65535) if other_at == where else np.uint16(other - low)
            vertex[r, c] = first[c] + where
            if 0 < where < sums.shape[0] - 1:
                left, right = (
                    np.float32(sums[where - 1]) - np.float32(low),
                    np.float32(sums[where + 1]) - np.float32(low),
                )
                if left + right > 0:
                    vertex[r, c] += np.float32(0.5) * (left - right) / (left + right)
