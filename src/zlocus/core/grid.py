"""The ground grid of a run: CRS, cell size and extent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import ConfigError, GeometryError

SQUARE = 1e-6


@dataclass(frozen=True)
class Grid:
    """Cells asked for.

    geobox : of the products; anchor : ground position of a corner of the lattice's cell (0, 0), such that every grid of
    the same cell size and phase shares the lattice; window : the products' cells on that lattice.
    """

    geobox: GeoBox
    anchor: tuple[float, float]
    window: CellWindow

    @property
    def cell_m(self) -> float:
        """Side of a cell."""
        return float(self.geobox.transform.a)


def grid_from_geobox(geobox: GeoBox, name: str) -> Grid:
    """The grid of another raster, which need not lie on multiples of its cell size."""
    t = geobox.transform
    if not (t.b == t.d == 0 and t.a > 0 and t.e < 0 and abs(t.a + t.e) < SQUARE * t.a):
        raise ConfigError(
            f"The grid of {name} is not north up with square cells. Use --resolution and --bounds instead."
        )
    side = float(t.a)
    anchor = (_phase(float(t.c), side), _phase(float(t.f), side))
    rows, cols = geobox.shape
    window = CellWindow(round((anchor[1] - t.f) / side), round((t.c - anchor[0]) / side), rows, cols)
    return Grid(geobox, anchor, window)


def _phase(edge: float, side: float) -> float:
    """How far an edge lies above a multiple of the cell size, m; exactly 0 where it is on one but for rounding."""
    cells = edge / side
    return 0.0 if abs(cells - round(cells)) < SQUARE else float(edge - np.floor(cells) * side)


def grid_from_bounds(bounds: tuple[float, float, float, float], cell_m: float, crs: CRS) -> Grid:
    """The cells whose edges lie on multiples of the cell size and that hold the bounds (xmin, ymin, xmax, ymax)."""
    col0, row0 = np.floor(bounds[0] / cell_m + SQUARE), np.ceil(bounds[3] / cell_m - SQUARE)
    cols = int(np.ceil(bounds[2] / cell_m - SQUARE) - col0)
    rows = int(row0 - np.floor(bounds[1] / cell_m + SQUARE))
    if rows < 1 or cols < 1:
        raise GeometryError(f"The area {bounds} holds no cell of {cell_m:g} m. Give a larger area or smaller cells.")
    geobox = GeoBox((rows, cols), Affine(cell_m, 0, col0 * cell_m, 0, -cell_m, row0 * cell_m), crs)
    return Grid(geobox, (0.0, 0.0), CellWindow(int(-row0), int(col0), rows, cols))


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
