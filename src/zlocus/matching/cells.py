"""Rectangles on the scene's lattice of cells."""

from __future__ import annotations

from dataclasses import dataclass


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

    def slices_in(self, other: CellWindow) -> tuple[slice, slice]:
        """Where this window lies in an array of another one of the same level."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.rows), slice(col, col + self.cols)
