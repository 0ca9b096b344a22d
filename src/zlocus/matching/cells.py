"""Rectangles on the scene's lattice of cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", np.float32, np.bool_)


@dataclass(frozen=True)
class CellWindow:
    """Rows and columns of the scene's lattice of cells at one level; row and column may be negative."""

    row: int
    col: int
    rows: int
    cols: int

    def at_level(self, level: int, halo: int) -> CellWindow:
        """The same ground at a coarser level, with a halo of that level's cells."""
        size = 2**level
        row, col = self.row // size - halo, self.col // size - halo
        row1, col1 = -(-(self.row + self.rows) // size) + halo, -(-(self.col + self.cols) // size) + halo
        return CellWindow(row, col, row1 - row, col1 - col)

    def finer(self, levels: int) -> CellWindow:
        """The same ground so many levels finer."""
        size = 2**levels
        return CellWindow(self.row * size, self.col * size, self.rows * size, self.cols * size)

    def within(self, other: CellWindow) -> CellWindow:
        """The part inside another window of the same level (may be empty)."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        row1 = min(self.row + self.rows, other.row + other.rows)
        col1 = min(self.col + self.cols, other.col + other.cols)
        return CellWindow(row, col, max(row1 - row, 0), max(col1 - col, 0))

    def meets(self, other: CellWindow) -> bool:
        """Whether it has cells of another window of the same level."""
        common = self.within(other)
        return bool(common.rows and common.cols)

    def around(self, other: CellWindow) -> CellWindow:
        """The smallest window that holds this one and another of the same level."""
        row, col = min(self.row, other.row), min(self.col, other.col)
        row1 = max(self.row + self.rows, other.row + other.rows)
        col1 = max(self.col + self.cols, other.col + other.cols)
        return CellWindow(row, col, row1 - row, col1 - col)

    def slices_in(self, other: CellWindow) -> tuple[slice, slice]:
        """Where this window lies in an array of another one of the same level."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.rows), slice(col, col + self.cols)


def on_cells(values: NDArray[Value], source: CellWindow, target: CellWindow, levels: int = 1) -> NDArray[Value]:
    """Values (r, c) of a level on the cells of one so many levels finer, each of a coarse cell many times."""
    rows = np.clip(((np.arange(target.rows) + target.row) >> levels) - source.row, 0, source.rows - 1)
    cols = np.clip(((np.arange(target.cols) + target.col) >> levels) - source.col, 0, source.cols - 1)
    return np.ascontiguousarray(values[np.ix_(rows, cols)])
