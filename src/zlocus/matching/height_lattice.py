"""Lattice of heights: equal steps for the whole scene, and the part of them that each block of cells searches.

Five ways of indexing a height
------------------------------

A height is counted in five ways. Names of variables, fields and arguments, or else their docstrings, say which one it
is.

lattice index
    Steps of the finest level above the origin of the scene: ``height = height_origin + lattice_index * height_step``
    with the step of the match scene. The index of tie points and of match curves at points. Fractions are allowed.
level index
    The same with the step of a level, which is ``2**level`` times as high: ``lattice_index = level_index * 2**level``.
    One level finer it doubles. What levels hand to each other: search ranges of the prior, heights, visible height
    ranges of a `LevelResult`. At the finest level it is the lattice index.
slope index
    Steps of a level above its slanted support surface: ``level_index = slope_index + slope_surface.cells[r, c]``
    (`SlopeSurface.slope_index`, and back by `SlopeSurface.cells`). While a level is matched, heights are counted in it:
    `HeightLattice.first`, the cost volume, visible height ranges before they are handed on. On level ground, where the
    slanted support surface is 0 everywhere, it is the level index.
block step
    Position of a height in the search range of its block, from 0 to ``count - 1``: ``slope_index = first[b, d] +
    block_step``. The last axis of the cost volume.
parameter t
    Argument of the projection polynomials of `TileViews`, from -1 to 1: ``t = t_0 + index * t_step``, where the index
    is a level index, or a slope index after `SlopeSurface.along`.
"""

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
# Where a height step is higher than this many cells, the base-to-height ratio is small for the size of the cells.
NARROW_BASE_STEP_CELLS = 2.0


@dataclass(frozen=True)
class HeightLattice:
    """Heights of one level of a tile, and the search range of each block.

    height_origin, height_step : height of level index 0, and step of the level, the same in all tiles of a scene; shape
    : (r, c) cells of the tile; block : cells along the side of a block; first, count : (b, d) int64, lowest slope index
    and number of heights that block row b, block column d searches.
    """

    height_origin: float
    height_step: float
    shape: tuple[int, int]
    block: int
    first: IntArray
    count: IntArray

    @cached_property
    def ranges(self) -> IntArray:
        """`first` and `count` as one array, (2, b, d) int64, for the kernels."""
        return np.ascontiguousarray(np.stack([self.first, self.count]))

    @cached_property
    def address(self) -> IntArray:
        """Where the costs of each cell begin in the ragged cost volume, (3, b, d) int64.

        Cells are stored row after row, each with all its heights. Cell (r, c) of block (b, d) begins at
        ``address[0, b, d] + (r - b * block) * address[1, b, d] + address[2, b, d] + (c - d * block) * count[b, d]``.
        """
        rows, cols = self.shape
        n_b, n_d = self.count.shape
        heights = np.minimum(self.block, rows - self.block * np.arange(n_b))
        widths = np.minimum(self.block, cols - self.block * np.arange(n_d))
        by_block = self.count * widths
        length = by_block.sum(axis=1)
        row_start = np.concatenate([[0], np.cumsum(length * heights)])[:-1]
        start = np.cumsum(by_block, axis=1) - by_block
        wide = (n_b, n_d)
        return np.stack(
            [np.broadcast_to(row_start[:, None], wide), np.broadcast_to(length[:, None], wide), start]
        ).astype(np.int64)

    @cached_property
    def layout(self) -> VolumeLayout:
        """The search ranges and the address of every cell, as the kernels take them."""
        block_row_start, row_length, block_start = self.address
        first, count = self.ranges
        return VolumeLayout(first, count, block_row_start, row_length, block_start, self.block)

    @cached_property
    def size(self) -> int:
        """Number of costs in the ragged cost volume: all heights of all cells."""
        rows, cols = self.shape
        n_b, n_d = self.count.shape
        heights = np.minimum(self.block, rows - self.block * np.arange(n_b))
        widths = np.minimum(self.block, cols - self.block * np.arange(n_d))
        return int((self.count * heights[:, None] * widths).sum())

    def cell_ranges(self) -> tuple[IntArray, IntArray]:
        """Lowest slope index and number of heights of every cell, each (r, c) int64."""
        rows, cols = self.shape
        b, d = np.arange(rows) // self.block, np.arange(cols) // self.block
        return self.first[np.ix_(b, d)], self.count[np.ix_(b, d)]

    def metres(self, level_index: NDArray[np.float32]) -> NDArray[np.float32]:
        """Heights (m) of level indices, which may have fractions."""
        return (self.height_origin + level_index.astype(np.float64) * self.height_step).astype(np.float32)


# The number of heights of a block is a multiple of this, so that loops over heights fill vector registers.
LANES = 4
# Stands for an unknown height in minima and maxima.
UNKNOWN = np.float32(1e9)
# A height that fewer cells than this share is taken for an error.
SPIKE = np.ones((3, 3), np.uint8)
# Equivalent disparity within which the winner-takes-all heights of neighbouring cells agree: tree crowns are round
# (docs/development/experiments/heights_of_single_cells.md).
MAX_DIFFERENCE_OF_NEIGHBOURS_PX = 4.0


def search_lattice(
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    height_origin: float,
    height_step: float,
    options: PyramidOptions,
    block: int | None = None,
) -> HeightLattice:
    """Lattice whose blocks search the heights of their cells and of cells nearby, with a margin.

    low, high : (r, c) float32, search range of every cell in slope indices, NaN where none is known; block : cells
    along the side of a block, None is that of the options. A block without any known range, which no two views saw at
    the coarser level, searches the smallest possible number of heights.
    """
    shape, block = (low.shape[0], low.shape[1]), block or options.block
    nearby = np.ones((4 * options.neighbour_cells + 1,) * 2, np.uint8)
    lowest = by_block(cv2.erode(np.where(np.isnan(low), UNKNOWN, low), nearby), block, np.minimum)
    highest = by_block(cv2.dilate(np.where(np.isnan(high), -UNKNOWN, high), nearby), block, np.maximum)
    known = lowest <= highest
    first = np.where(known, np.floor(lowest) - options.margin_steps, 0)
    last = np.where(known, np.ceil(highest) + options.margin_steps, 0)
    count = -(-(last - first + 1).astype(np.int64) // LANES) * LANES
    return HeightLattice(height_origin, height_step, shape, block, first.astype(np.int64), count)


def by_block(values: NDArray[Any], block: int, reduce: np.ufunc) -> NDArray[Any]:
    """Values (r, c) reduced to blocks (b, d). reduce : such as `np.minimum`."""
    rows = np.arange(0, values.shape[0], block)
    cols = np.arange(0, values.shape[1], block)
    return np.asarray(reduce.reduceat(reduce.reduceat(values, rows, axis=0), cols, axis=1))


def shared_heights(
    winner_takes_all: NDArray[np.int32],
    best: NDArray[np.int32],
    slope_cells: NDArray[np.float32],
    options: PyramidOptions,
) -> NDArray[np.int32]:
    """Winner-takes-all heights (r, c) where neighbouring cells agree on them, else `best`; level indices.

    A cell agrees where it lies in some square of 3 x 3 cells whose heights above the slanted support surface differ by
    no more than `MAX_DIFFERENCE_OF_NEIGHBOURS_PX`. Where nothing distinguishes heights each cell finds another one;
    without this condition such cells would extend the search range without limit. slope_cells : (r, c), see
    `SlopeSurface.cells`.
    """
    slope_index = (winner_takes_all - slope_cells).astype(np.float32)
    spread = cv2.dilate(slope_index, SPIKE) - cv2.erode(slope_index, SPIKE)
    agree = (spread <= MAX_DIFFERENCE_OF_NEIGHBOURS_PX / options.max_shift_px).astype(np.uint8)
    return np.where(cv2.dilate(agree, SPIKE) > 0, winner_takes_all, best)


def without_spikes(
    low: NDArray[np.float32], high: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Search ranges (r, c) without the heights that fewer than 3 x 3 cells share; NaN where not `known`.

    A wrong height of one or two cells would extend the search range of a whole block; a tower has more cells, and tie
    points are added later. Lowest heights are closed and highest heights are opened (grey morphology).
    """
    far = UNKNOWN
    top = cv2.erode(np.where(known, high, far), SPIKE)
    top = cv2.dilate(np.where(known, top, -far), SPIKE)
    floor = cv2.dilate(np.where(known, low, -far), SPIKE)
    floor = cv2.erode(np.where(known, floor, far), SPIKE)
    nothing = np.float32(np.nan)
    return np.where(known, np.minimum(floor, top), nothing), np.where(known, np.maximum(floor, top), nothing)
