"""The scene's candidate heights: one lattice of equal steps, and the part of it that each block of cells searches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

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
