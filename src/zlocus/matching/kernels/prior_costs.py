"""Costs that are added to a volume for what is known of the surface, and how well a surface fits a volume."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

MAX_COST = 255


class DistanceCost(NamedTuple):
    """Cost of a height by its distance from those known: cost_per_step for each step beyond free_steps."""

    free_steps: np.float32  # f4: distance that costs nothing, steps
    cost_per_step: np.float32  # f4: cost of each step beyond
    max_cost: np.float32  # f4: largest cost


class CoarserCells(NamedTuple):
    """Where the cells of a level lie in the next coarser level."""

    row: int  # i8: row of the first cell, counted in finer cells from the first row of the coarser level
    col: int  # i8: its column
    reach: int  # i8: coarser cells around that of a cell whose heights are known to it


# VolumeLayout, i8, i8 -> i8
@kernel
def cell_start(layout, r, c):
    """Where the costs of a cell begin in the volume."""
    block = layout.block
    b, d = r // block, c // block
    in_block_row = layout.block_row_start[b, d] + (r - b * block) * layout.row_length[b, d]
    return in_block_row + layout.block_start[b, d] + (c - d * block) * layout.n_heights[b, d]


# f4, DistanceCost -> f4
@kernel
def cost_of_distance(steps, by_distance):
    """Cost of a height so many steps from those known."""
    beyond = max(steps - by_distance.free_steps, np.float32(0.0))
    return min(by_distance.cost_per_step * beyond, by_distance.max_cost)


# (n,) f4 -> None
@kernel
def spread_distances(distance):
    """Replace distances of heights by the least sum of a distance and the steps from there."""
    one = np.float32(1.0)
    for k in range(1, distance.shape[0]):
        distance[k] = min(distance[k], distance[k - 1] + one)
    for k in range(distance.shape[0] - 2, -1, -1):
        distance[k] = min(distance[k], distance[k + 1] + one)


# (v,) u1, VolumeLayout, (r,c) f4, (m,e,f) f4, CoarserCells, DistanceCost -> None
@kernel
def add_costs_of_candidates(cost, layout, slope_cells, candidates, coarser, by_distance):
    """Add the cost of the distance to the nearest candidate of the coarser cells around each cell.

    slope_cells : (r, c), height index of the slanted support surface; candidates : (m, e, f) float32, heights of the
    coarser cells, height indices of the coarser level. A candidate beyond the heights searched counts as the nearest of
    them.
    """
    n_candidates, n_rows, n_cols = candidates.shape
    distance = np.empty(np.max(layout.n_heights), np.float32)
    far = by_distance.free_steps + by_distance.max_cost / by_distance.cost_per_step
    for r in range(slope_cells.shape[0]):
        for c in range(slope_cells.shape[1]):
            b, d = r // layout.block, c // layout.block
            n, start = layout.n_heights[b, d], cell_start(layout, r, c)
            lowest = slope_cells[r, c] + np.float32(layout.first[b, d])
            distance[:n] = far
            row, col = (coarser.row + r) // 2, (coarser.col + c) // 2
            for e in range(max(row - coarser.reach, 0), min(row + coarser.reach + 1, n_rows)):
                for f in range(max(col - coarser.reach, 0), min(col + coarser.reach + 1, n_cols)):
                    for m in range(n_candidates):
                        k = int(np.rint(np.float32(2.0) * candidates[m, e, f] - lowest))
                        distance[min(max(k, 0), n - 1)] = 0.0
            spread_distances(distance[:n])
            for k in range(n):
                added = int(cost_of_distance(distance[k], by_distance) + np.float32(0.5))
                cost[start + k] = np.uint8(min(int(cost[start + k]) + added, MAX_COST))


# (v,) u1, VolumeLayout, (r,c) f4, (r,c) f4, (r,c) f4, DistanceCost -> None
@kernel
def add_costs_beyond(cost, layout, slope_cells, low, high, by_distance):
    """Add the cost of the distance below `low` or above `high`, (r, c) height indices, to every height."""
    for r in range(slope_cells.shape[0]):
        for c in range(slope_cells.shape[1]):
            b, d = r // layout.block, c // layout.block
            start, lowest = cell_start(layout, r, c), slope_cells[r, c] + np.float32(layout.first[b, d])
            for k in range(layout.n_heights[b, d]):
                height = lowest + np.float32(k)
                distance = max(low[r, c] - height, height - high[r, c])
                added = int(cost_of_distance(distance, by_distance) + np.float32(0.5))
                cost[start + k] = np.uint8(min(int(cost[start + k]) + added, MAX_COST))


# (v,) u1, VolumeLayout, (r,c) i4, (r,c) f4 -> None
@kernel
def write_misfit(cost, layout, height, misfit):
    """Write by how much the cost of each cell at its height, (r, c) slope index, is above its least cost."""
    for r in range(height.shape[0]):
        for c in range(height.shape[1]):
            b, d = r // layout.block, c // layout.block
            start, n = cell_start(layout, r, c), layout.n_heights[b, d]
            least = MAX_COST
            for k in range(n):
                least = min(least, int(cost[start + k]))
            at = min(max(int(height[r, c]) - layout.first[b, d], 0), n - 1)
            misfit[r, c] = np.float32(int(cost[start + at]) - least)
