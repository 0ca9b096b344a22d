"""The scene's candidate heights: one lattice of equal steps, and the part of it that each block of cells searches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import PyramidOptions
from zlocus.matching.kernels.shared_records import VolumeLayout

IntArray = NDArray[np.int64]
# Where a height step is more cells high than this, the base is narrow for the size of the cells.
NARROW_BASE = 2.0


@dataclass(frozen=True)
class HeightLattice:
    """Height index k means origin_m + k step_m in every cell, tile and image of the scene.

    shape : cells of the tile (r, c); block : cells a block's side; first, count : (b, d) int64, the height indices that
    block row b, block column d searches.
    """

    origin_m: float
    step_m: float
    shape: tuple[int, int]
    block: int
    first: IntArray
    count: IntArray

    @cached_property
    def ranges(self) -> IntArray:
        """(2, b, d) int64: `first` and `count`, as the kernels take them."""
        return np.ascontiguousarray(np.stack([self.first, self.count]))

    @cached_property
    def address(self) -> IntArray:
        """(3, b, d) int64: where each cell of the ragged volume stands.

        Cells are stored row after row, each with all its heights: cell (r, c) of block (b, d) starts at
        address[0, b, 0] + (r - b block) address[1, b, 0] + address[2, b, d] + (c - d block) count[b, d].
        """
        rows, cols = self.shape
        n_b, n_d = self.count.shape
        heights = np.minimum(self.block, rows - self.block * np.arange(n_b))
        widths = np.minimum(self.block, cols - self.block * np.arange(n_d))
        by_block = self.count * widths
        length = by_block.sum(axis=1)
        base = np.concatenate([[0], np.cumsum(length * heights)])[:-1]
        start = np.cumsum(by_block, axis=1) - by_block
        wide = (n_b, n_d)
        return np.stack([np.broadcast_to(base[:, None], wide), np.broadcast_to(length[:, None], wide), start]).astype(
            np.int64
        )

    @cached_property
    def layout(self) -> VolumeLayout:
        """The search ranges and the address of every cell, as the kernels take them."""
        block_row_start, row_length, block_start = self.address
        first, count = self.ranges
        return VolumeLayout(first, count, block_row_start, row_length, block_start, self.block)

    @cached_property
    def size(self) -> int:
        """Cell-steps of the ragged volume."""
        rows, cols = self.shape
        n_b, n_d = self.count.shape
        heights = np.minimum(self.block, rows - self.block * np.arange(n_b))
        widths = np.minimum(self.block, cols - self.block * np.arange(n_d))
        return int((self.count * heights[:, None] * widths).sum())

    def cell_ranges(self) -> tuple[IntArray, IntArray]:
        """First index and count of every cell, each (r, c) int64."""
        rows, cols = self.shape
        b, d = np.arange(rows) // self.block, np.arange(cols) // self.block
        return self.first[np.ix_(b, d)], self.count[np.ix_(b, d)]

    def metres(self, index: NDArray[np.float32]) -> NDArray[np.float32]:
        """Heights of (fractional) indices."""
        return (self.origin_m + index.astype(np.float64) * self.step_m).astype(np.float32)


# Heights of a block come in multiples of this many, for the sake of vector loops.
LANES = 4
UNKNOWN = np.float32(1e9)
SPIKE = np.ones((3, 3), np.uint8)
# Equivalent disparity within which the winner-takes-all heights of neighbouring cells agree: tree crowns are round
# (docs/development/experiments/heights_of_single_cells.md).
ALIKE_PX = 4.0


def ranges_nearby(
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    origin_m: float,
    step_m: float,
    shape: tuple[int, int],
    options: PyramidOptions,
    block: int | None = None,
) -> HeightLattice:
    """The span of the heights found in and around each block, with a margin.

    low, high : (r, c) float32, lowest and highest candidate of every cell, in height indices of this level; NaN where
    there is none; block : cells, None is that of the options. A block with no candidate at all, which no two views saw
    at the coarser level, searches the least.
    """
    block = block or options.block
    grow = np.ones((4 * options.reach + 1,) * 2, np.uint8)
    lowest = by_block(cv2.erode(np.where(np.isnan(low), UNKNOWN, low), grow), block, np.minimum)
    highest = by_block(cv2.dilate(np.where(np.isnan(high), -UNKNOWN, high), grow), block, np.maximum)
    known = lowest <= highest
    first = np.where(known, np.floor(lowest) - options.margin_steps, 0)
    end = np.where(known, np.ceil(highest) + options.margin_steps, 0)
    count = -(-(end - first + 1).astype(np.int64) // LANES) * LANES
    return HeightLattice(origin_m, step_m, shape, block, first.astype(np.int64), count)


def by_block(values: NDArray[Any], block: int, reduce: np.ufunc) -> NDArray[Any]:
    """Reduce (r, c) to blocks (b, d)."""
    rows = np.arange(0, values.shape[0], block)
    cols = np.arange(0, values.shape[1], block)
    return np.asarray(reduce.reduceat(reduce.reduceat(values, rows, axis=0), cols, axis=1))


def shared_heights(
    lone: NDArray[np.int32], best: NDArray[np.int32], base: NDArray[np.float32], options: PyramidOptions
) -> NDArray[np.int32]:
    """Height indices (r, c) that cells found by themselves, where 3 x 3 of them, the cell among them, agree within
    ALIKE_PX above the base surface (r, c); else `best`. Where nothing tells heights apart each finds its own, and any
    range would be searched."""
    above = (lone - base).astype(np.float32)
    spread = cv2.dilate(above, SPIKE) - cv2.erode(above, SPIKE)
    agree = (spread <= ALIKE_PX / options.max_shift_px).astype(np.uint8)
    return np.where(cv2.dilate(agree, SPIKE) > 0, lone, best)


def without_spikes(
    low: NDArray[np.float32], high: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest candidates that 3 x 3 cells share (a closing and an opening), NaN where not `known`.

    A false height of a cell or two would widen the range of a whole block; a tower has more cells, and tie points are
    added later.
    """
    far = UNKNOWN
    top = cv2.erode(np.where(known, high, far), SPIKE)
    top = cv2.dilate(np.where(known, top, -far), SPIKE)
    floor = cv2.dilate(np.where(known, low, -far), SPIKE)
    floor = cv2.erode(np.where(known, floor, far), SPIKE)
    nothing = np.float32(np.nan)
    return np.where(known, np.minimum(floor, top), nothing), np.where(known, np.maximum(floor, top), nothing)
