"""Free rays: how high above each cell a view looks at a surface behind it, and what heights in its way cost."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# A ray that passes between two cells counts for each of them that it is at least this near to, as a share of a cell.
NEAR = 0.25


# (r,c) f4, (r,c) b1, f8, f8, (r,c) f4 -> None
@kernel
def lowest_free_ray(surface, supported, by_col, by_row, out):
    """Height of the lowest ray above each cell that a view has to a supported cell of the surface behind it.

    surface : (r, c) float32, in any unit of height; supported : (r, c) bool, cells that the view clearly sees; by_col,
    by_row : v, cells that the point seen by a fixed pixel moves per unit of height; out : (r, c) float32, min over
    h > 0 of surface(cell - h v) + h, where that cell is supported; infinite where no such ray passes.

    The dual of `lowest_visible`, in one sweep along v: the rays above a cell are those above the cell before it, and
    the one that ends there, each higher by what a ray gains on the way.
    """
    n_rows, n_cols = surface.shape
    out[:] = np.float32(np.inf)
    along_cols = abs(by_col) >= abs(by_row)
    major = by_col if along_cols else by_row
    if abs(major) < 1e-6:
        return
    gain = np.float32(1.0 / abs(major))
    slant = (by_row if along_cols else by_col) / abs(major)
    sign = 1 if major > 0 else -1
    n_major, n_minor = (n_cols, n_rows) if along_cols else (n_rows, n_cols)
    for step in range(1, n_major):
        m = step if sign > 0 else n_major - 1 - step
        for j in range(n_minor):
            place = j - slant
            first = int(np.floor(place))
            fraction = place - first
            lowest = np.float32(np.inf)
            for neighbour in range(2):
                k = first + neighbour
                share = fraction if neighbour == 1 else 1.0 - fraction
                if share < NEAR or k < 0 or k >= n_minor:
                    continue
                row, col = (k, m - sign) if along_cols else (m - sign, k)
                lowest = min(lowest, out[row, col])
                if supported[row, col]:
                    lowest = min(lowest, surface[row, col])
            row, col = (j, m) if along_cols else (m, j)
            out[row, col] = lowest + gain


# (i,r,c) f4, (r,c) f4, (2,b,d) i8, (3,b,d) i8, i8, i8, i8, (v,) u1 -> None
@kernel
def add_ray_costs(rays, base, ranges, address, block, per_ray, most, cost):
    """Add to the cost of every height what the free rays below it say.

    rays : (i, r, c) float32, height index above which a height stands in the lowest free ray of each view, infinite
    where there is none; base : (r, c) float32, the surface from which the volume's height indices are counted; ranges,
    address, block : of the volume, see `HeightLattice`; per_ray, most : cost of one ray, and of all together; cost :
    (v,) uint8, changed, no more than 255.
    """
    n_rows, n_cols = base.shape
    for r in range(n_rows):
        b = r // block
        for c in range(n_cols):
            d = c // block
            first, count = ranges[0, b, d], ranges[1, b, d]
            start = address[0, b, 0] + (r - b * block) * address[1, b, 0] + address[2, b, d] + (c - d * block) * count
            lowest = np.float32(np.inf)
            for i in range(rays.shape[0]):
                lowest = min(lowest, rays[i, r, c])
            if not lowest < np.float32(first + count - 1) + base[r, c]:
                continue
            for k in range(count):
                height, added = np.float32(first + k) + base[r, c], np.int64(0)
                if height > lowest:
                    for i in range(rays.shape[0]):
                        added += per_ray if height > rays[i, r, c] else 0
                    cost[start + k] = np.uint8(min(np.int64(cost[start + k]) + min(added, most), 255))
