"""Twins of the semi-global kernels, path by path on a dense volume."""

from __future__ import annotations

import numpy as np

# From which neighbour a path comes: W, NW, N, NE, as (row, column) offsets.
BEHIND = ((0, -1), (-1, -1), (-1, 0), (-1, 1))


def dense(ragged, lattice, outside):
    """(r, c, h) of a volume stored cell after cell; `outside` at the heights that a cell does not search."""
    first, count = lattice.cell_ranges()
    volume = np.full((*lattice.shape, int((first + count).max())), outside, float)
    place = lattice.address
    for r, c in np.ndindex(lattice.shape):
        b, d = r // lattice.block, c // lattice.block
        base, length, start = place[:, b, d]
        at = base + (r - b * lattice.block) * length + start + (c - d * lattice.block) * count[r, c]
        volume[r, c, first[r, c] : first[r, c] + count[r, c]] = ragged[at : at + count[r, c]]
    return volume


def path_sums(cost, p1, p2):
    """Hirschmueller (2008), eq. 13, summed over eight paths, (r, c, h).

    cost : (r, c, h), infinite where a cell does not search; p2 : (4, r, c) of the edge from W, NW, N, NE into a cell.
    """
    rows, cols, _ = cost.shape
    total = np.zeros_like(cost)
    for path, (dr, dc) in enumerate(BEHIND):
        for sign in (1, -1):
            along = np.zeros_like(cost)
            for r in range(rows)[::sign]:
                for c in range(cols)[::sign]:
                    q = (r + sign * dr, c + sign * dc)
                    if not (0 <= q[0] < rows and 0 <= q[1] < cols):
                        along[r, c] = cost[r, c]
                        continue
                    edge = p2[path, r, c] if sign > 0 else p2[path, q[0], q[1]]
                    along[r, c] = cost[r, c] + transition(along[q], p1, edge)
            total += along
    return total


def more_global_path_sums(cost, p1, p2):
    """Facciolo, de Franchis, Meinhardt (2015), two predecessors, means rounded down, summed over eight directions.

    As `path_sums`; each cell is asked for its two neighbours' path costs, whatever the order.
    """
    rows, cols, _ = cost.shape
    total = np.zeros_like(cost)
    for along in (*BEHIND, *((-dr, -dc) for dr, dc in BEHIND)):
        steps = (along, (along[1], -along[0]))
        done = np.full((rows, cols), False)
        paths = np.zeros_like(cost)
        while not done.all():
            for r, c in np.argwhere(~done):
                arrivals = []
                for dr, dc in steps:
                    q = (r + dr, c + dc)
                    if not (0 <= q[0] < rows and 0 <= q[1] < cols):
                        continue
                    if not done[q]:
                        break
                    forward = (dr, dc) in BEHIND
                    edge = p2[BEHIND.index((dr, dc)), r, c] if forward else p2[BEHIND.index((-dr, -dc)), q[0], q[1]]
                    arrivals.append(transition(paths[q], p1, edge))
                else:
                    paths[r, c] = cost[r, c] + (np.floor(np.mean(arrivals, axis=0)) if arrivals else 0)
                    done[r, c] = True
        total += paths
    return total


def transition(behind, p1, p2):
    """Least cost to arrive at each height (h,) from the neighbour's path costs (h,)."""
    least = behind.min()
    padded = np.concatenate([[np.inf], behind, [np.inf]])
    one_step = np.minimum(padded[:-2], padded[2:]) + p1
    return np.minimum(np.minimum(behind, one_step), least + p2) - least


def winner(sums):
    """Index of the least of sums (h,), of its least other local minimum three away or more, and the parabola's place.

    Only the searched heights; the second is the first one where there is no other minimum.
    """
    best = int(np.argmin(sums))
    others = [
        k for k in range(1, len(sums) - 1) if abs(k - best) > 2 and sums[k] <= sums[k - 1] and sums[k] <= sums[k + 1]
    ]
    second = min(others, key=lambda k: (sums[k], k), default=best)
    vertex = float(best)
    if 0 < best < len(sums) - 1:
        left, right = sums[best - 1] - sums[best], sums[best + 1] - sums[best]
        if left + right > 0:
            vertex += 0.5 * (left - right) / (left + right)
    return best, second, vertex
