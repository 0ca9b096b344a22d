"""Costs that are added to a volume for what is known of the surface, and how well a surface fits a volume."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.shared_records import CellBox, HeightSpan

MAX_COST = np.int32(255)
# A height index above all others.
MAX_HEIGHT = 1 << 30


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


# (n,) i4 -> None
@kernel
def spread_distances(distance):
    """Replace distances of heights by the least sum of a distance and the steps from there."""
    one = np.int32(1)
    for k in range(1, distance.shape[0]):
        distance[k] = min(distance[k], distance[k - 1] + one)
    for k in range(distance.shape[0] - 2, -1, -1):
        distance[k] = min(distance[k], distance[k + 1] + one)


# VolumeLayout, i8, i8, f4 -> i8
@kernel
def lowest_height(layout, r, c, slope):
    """Level index of the lowest height that a cell searches, to the nearest whole one. slope : of the cell."""
    return layout.first[r // layout.block, c // layout.block] + np.int64(np.rint(slope))


# VolumeLayout, (r,c) f4, CellBox -> HeightSpan
@kernel
def span_of_cells(layout, slope_cells, box):
    """The heights that any cell of a rectangle searches, level indices."""
    low, high = MAX_HEIGHT, -MAX_HEIGHT
    for r in range(box.first_row, box.end_row):
        for c in range(box.first_col, box.end_col):
            lowest = lowest_height(layout, r, c, slope_cells[r, c])
            low = min(low, lowest)
            high = max(high, lowest + layout.n_heights[r // layout.block, c // layout.block])
    return HeightSpan(low, high - low)


# (m,e,f) i4, i8, i8, i8, HeightSpan, DistanceCost, (n,) i4, (n,) i4 -> None
@kernel
def costs_around(candidates, row, col, reach, span, by_distance, distance, out):
    """Write the cost of every height of a span by its distance from the candidates around a coarser cell.

    A candidate beyond the span counts as the nearest of its heights. distance : scratch.
    """
    n_candidates, n_rows, n_cols = candidates.shape
    n, last = span.n_heights, span.n_heights - 1
    distance[:n] = MAX_HEIGHT
    for e in range(max(row - reach, 0), min(row + reach + 1, n_rows)):
        for f in range(max(col - reach, 0), min(col + reach + 1, n_cols)):
            for m in range(n_candidates):
                distance[min(max(2 * np.int64(candidates[m, e, f]) - span.first, 0), last)] = 0
    spread_distances(distance[:n])
    for k in range(n):
        out[k] = np.int32(cost_of_distance(np.float32(distance[k]), by_distance) + np.float32(0.5))


# (v,) u1, VolumeLayout, (r,c) f4, (m,e,f) i4, CoarserCells, DistanceCost -> None
@kernel
def add_costs_of_candidates(cost, layout, slope_cells, candidates, coarser, by_distance):
    """Add the cost of the distance to the nearest candidate of the coarser cells around each cell.

    slope_cells : (r, c), height index of the slanted support surface; candidates : (m, e, f), height indices of the
    coarser level. The costs are those of all finer cells of a coarser one, whose heights are counted together.
    """
    (rows, cols), reach, block = slope_cells.shape, coarser.reach, layout.block
    of_tile = span_of_cells(layout, slope_cells, CellBox(0, rows, 0, cols))
    distance, added = np.empty(of_tile.n_heights, np.int32), np.empty(of_tile.n_heights, np.int32)
    for row in range(coarser.row // 2, (coarser.row + rows - 1) // 2 + 1):
        for col in range(coarser.col // 2, (coarser.col + cols - 1) // 2 + 1):
            box = CellBox(
                max(2 * row - coarser.row, 0), min(2 * row + 2 - coarser.row, rows),
                max(2 * col - coarser.col, 0), min(2 * col + 2 - coarser.col, cols),
            )  # fmt: skip
            span = span_of_cells(layout, slope_cells, box)
            costs_around(candidates, row, col, reach, span, by_distance, distance, added)
            for r in range(box.first_row, box.end_row):
                for c in range(box.first_col, box.end_col):
                    n, start = layout.n_heights[r // block, c // block], np.uint64(cell_start(layout, r, c))
                    first = np.uint64(lowest_height(layout, r, c, slope_cells[r, c]) - span.first)
                    for k in range(np.uint64(n)):
                        total = np.int32(cost[start + k]) + added[first + k]
                        cost[start + k] = np.uint8(min(total, MAX_COST))


# (v,) u1, VolumeLayout, (r,c) f4, (r,c) f4, (r,c) f4, DistanceCost -> None
@kernel
def add_costs_beyond(cost, layout, slope_cells, low, high, by_distance):
    """Add the cost of the distance below `low` or above `high`, (r, c) height indices, to every height."""
    half, none, free = np.float32(0.5), np.float32(0.0), by_distance.free_steps
    for r in range(slope_cells.shape[0]):
        for c in range(slope_cells.shape[1]):
            b, d = r // layout.block, c // layout.block
            n, lowest = layout.n_heights[b, d], slope_cells[r, c] + np.float32(layout.first[b, d])
            below, above, start = low[r, c], high[r, c], np.uint64(cell_start(layout, r, c))
            if max(below - lowest, lowest + np.float32(n) - above) <= free:
                continue
            for k in range(np.uint64(n)):
                height = lowest + np.float32(np.int32(k))
                beyond = max(max(below - height, height - above) - free, none)
                added = np.int32(min(by_distance.cost_per_step * beyond, by_distance.max_cost) + half)
                cost[start + k] = np.uint8(min(np.int32(cost[start + k]) + added, MAX_COST))


# (v,) u1, VolumeLayout, (r,c) i4, (r,c) b1, (r,c) f4 -> None
@kernel
def write_misfit(cost, layout, height, is_wanted, misfit):
    """Write by how much the cost of each cell at its height, (r, c) slope index, is above its least cost; 0 where it is
    not wanted."""
    for r in range(height.shape[0]):
        for c in range(height.shape[1]):
            misfit[r, c] = np.float32(0.0)
            if not is_wanted[r, c]:
                continue
            b, d = r // layout.block, c // layout.block
            start, n, least = np.uint64(cell_start(layout, r, c)), layout.n_heights[b, d], np.uint8(255)
            for k in range(np.uint64(n)):
                here = cost[start + k]
                least = here if here < least else least
            at = min(max(np.int64(height[r, c]) - layout.first[b, d], 0), n - 1)
            misfit[r, c] = np.float32(np.int32(cost[start + np.uint64(at)]) - np.int32(least))
