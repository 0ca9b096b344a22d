"""Slow twins of the kernels of free rays and of the agreement of pairs of images."""

from __future__ import annotations

import numpy as np

MIN_SHARE_OF_RAY = 0.25


def lowest_free_ray(surface, supported, by_col, by_row):
    """Rays marched from every supported cell, a cell at a time along the longer component of the direction.

    A ray that passes between two cells counts for each that it is at least a quarter of a cell near to; from there it
    continues in the same direction, as the kernel's sweep does.
    """
    rows, cols = surface.shape
    longest = max(abs(by_col), abs(by_row))
    out = np.full(surface.shape, np.inf)
    if longest < 1e-6:
        return out
    along_cols = abs(by_col) >= abs(by_row)
    sign = 1 if (by_col if along_cols else by_row) > 0 else -1
    drift = (by_row if along_cols else by_col) / longest
    best = {}
    stack = [(r, c, float(surface[r, c])) for r, c in np.ndindex(surface.shape) if supported[r, c]]
    while stack:
        r, c, height = stack.pop()
        major, minor = (c, r) if along_cols else (r, c)
        major += sign
        if not 0 <= major < (cols if along_cols else rows):
            continue
        height += 1 / longest
        for target in range(rows if along_cols else cols):
            # The cell looks back to `target - drift`, between two cells, of which this may be one.
            share = 1 - abs(target - drift - minor)
            if share < MIN_SHARE_OF_RAY:
                continue
            cell = (target, major) if along_cols else (major, target)
            if height < best.get(cell, np.inf) - 1e-9:
                best[cell] = height
                stack.append((*cell, height))
    for cell, height in best.items():
        out[cell] = height
    return out


def with_ray_costs(rays, slope_cells, lattice, ray_cost, max_cost, cost):
    """The volume with the costs of all rays below each height, cell by cell and height by height."""
    cost = cost.astype(int).copy()
    address = lattice.address
    for r, c in np.ndindex(slope_cells.shape):
        b, d = r // lattice.block, c // lattice.block
        first, count = int(lattice.first[b, d]), int(lattice.count[b, d])
        start = address[0, b, 0] + (r - b * lattice.block) * address[1, b, 0]
        start += address[2, b, d] + (c - d * lattice.block) * count
        for k in range(count):
            n_rays = sum(first + k + slope_cells[r, c] > ray for ray in rays[:, r, c])
            cost[start + k] = min(cost[start + k] + min(n_rays * ray_cost, max_cost), 255)
    return cost


def agreeing_images(grey, covers, window, min_ncc, max_difference, max_plain):
    """Number of others with which each image agrees on each cell, textured and not, from windows cut out one by one."""
    n, rows, cols = grey.shape
    half = window // 2
    padded = np.pad(grey.astype(float), ((0, 0), (half, half), (half, half)), mode="symmetric")
    textured, plain = np.zeros(grey.shape, int), np.zeros(grey.shape, int)
    for i in range(n):
        for j in range(n):
            if i == j:
                continue
            for r, c in np.ndindex(rows, cols):
                if not (covers[i, r, c] and covers[j, r, c]):
                    continue
                a, b = (padded[k, r : r + window, c : c + window].ravel() for k in (i, j))
                apart = abs(float(grey[i, r, c]) - float(grey[j, r, c]))
                deviations = np.std(a) * np.std(b)
                ncc = np.mean((a - a.mean()) * (b - b.mean())) / deviations if deviations > 1e-9 else 0.0
                textured[i, r, c] += ncc > min_ncc and apart < max_difference
                plain[i, r, c] += max(np.std(a), np.std(b), apart) < max_plain
    return textured, plain
