"""Free rays: how high above each cell a view looks at a surface behind it, and what heights that obstruct it cost."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.occlusion import ray_sweep

# A ray that passes between two cells counts for each of them that has at least this share of it.
MIN_SHARE_OF_RAY = 0.25


# (r,c) f4, (r,c) b1, f8, f8, (r,c) f4 -> None
@kernel
def lowest_free_ray(surface, supported, by_col, by_row, out):
    """Write the height of the lowest ray above each cell that a view has to a supported cell of the surface behind it.

    surface : (r, c) float32, in any unit of height; supported : (r, c) bool, cells that the view clearly sees; by_col,
    by_row : v, cells that the point seen by a fixed pixel moves per unit of height; out : (r, c) float32, min over
    h > 0 of surface(cell - h v) + h, where that cell is supported; infinite where no such ray passes.

    The dual of `lowest_visible`, in one sweep along v: the rays above a cell are those above the cell before it, and
    the one that ends there, each higher by what a ray gains on the way.
    """
    sweep = ray_sweep(surface.shape[0], surface.shape[1], by_col, by_row)
    along_cols, sign, n_across = sweep.along_cols, sweep.sign, sweep.n_across
    out[:] = np.float32(np.inf)
    if sweep.is_vertical:
        return
    for step in range(1, sweep.n_along):
        m = step if sign > 0 else sweep.n_along - 1 - step
        for j in range(n_across):
            place = j - sweep.drift
            first = int(np.floor(place))
            fraction = place - first
            lowest = np.float32(np.inf)
            for neighbour in range(2):
                k = first + neighbour
                share = fraction if neighbour == 1 else 1.0 - fraction
                if share < MIN_SHARE_OF_RAY or k < 0 or k >= n_across:
                    continue
                row, col = (k, m - sign) if along_cols else (m - sign, k)
                lowest = min(lowest, out[row, col])
                if supported[row, col]:
                    lowest = min(lowest, surface[row, col])
            row, col = (j, m) if along_cols else (m, j)
            out[row, col] = lowest + sweep.gain


# (i,r,c) f4, (r,c) f4, VolumeLayout, i8, i8, (v,) u1 -> None
@kernel
def add_ray_costs(rays, slope_cells, layout, ray_cost, max_cost, cost):
    """Add the cost of the free rays below it to every height of a volume.

    rays : (i, r, c) float32, height index above which a height obstructs the lowest free ray of each view, infinite
    where there is none; slope_cells : (r, c) float32, the surface from which the height indices of the volume are
    counted; ray_cost, max_cost : cost of one ray, and of all together; cost : (v,) uint8, changed, at most 255.
    """
    n_rows, n_cols = slope_cells.shape
    for r in range(n_rows):
        b = r // layout.block
        for c in range(n_cols):
            d = c // layout.block
            first, count = layout.first[b, d], layout.n_heights[b, d]
            start = layout.block_row_start[b, 0] + (r - b * layout.block) * layout.row_length[b, 0]
            start += layout.block_start[b, d] + (c - d * layout.block) * count
            lowest = np.float32(np.inf)
            for i in range(rays.shape[0]):
                lowest = min(lowest, rays[i, r, c])
            if not lowest < np.float32(first + count - 1) + slope_cells[r, c]:
                continue
            for k in range(count):
                height, added = np.float32(first + k) + slope_cells[r, c], np.int64(0)
                if height > lowest:
                    for i in range(rays.shape[0]):
                        added += ray_cost if height > rays[i, r, c] else 0
                    cost[start + k] = np.uint8(min(np.int64(cost[start + k]) + min(added, max_cost), 255))
