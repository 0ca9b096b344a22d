"""The ground grid of a run, and windows of cells on the scene's lattice.

The lattice of cells covers the whole plane of the scene's frame: cell (0, 0) begins at the anchor, rows count
southwards and columns eastwards. A coarser level has cells of twice the size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import ConfigError, GeometryError

# Share of a cell by which a cell may differ from a square, and an edge from a multiple of the cell size.
CELL_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Grid:
    """The grid of the products.

    geobox : CRS, origin, cell size and shape; anchor : easting and northing (m) of the north-west corner of the
    lattice's cell (0, 0), equal for all grids of the same cell size and phase; window : the cells of the products on
    that lattice.
    """

    geobox: GeoBox
    anchor: tuple[float, float]
    window: CellWindow

    @property
    def cell_m(self) -> float:
        """Side of a cell, m."""
        return float(self.geobox.transform.a)

    def bounds(self, window: CellWindow) -> tuple[float, float, float, float]:
        """Bounds (xmin, ymin, xmax, ymax), m, of a window of the lattice."""
        transform = window_transform(window, self.anchor, self.cell_m)
        (west, north), (east, south) = transform * (0, 0), transform * (window.cols, window.rows)
        return west, south, east, north


def window_transform(window: CellWindow, anchor: tuple[float, float], cell_m: float) -> Affine:
    """From cell corners (column, row) of a window to the ground. anchor : see `Grid`; cell_m : side of a cell."""
    west, north = anchor[0] + window.col * cell_m, anchor[1] - window.row * cell_m
    return Affine(cell_m, 0.0, west, 0.0, -cell_m, north)


def grid_from_geobox(geobox: GeoBox, name: str) -> Grid:
    """The grid of another raster, whose cells need not lie on multiples of their size. name : of the file, for
    messages.

    Raises
    ------
    ConfigError
        The raster is not north up, or its cells are not square.
    """
    t = geobox.transform
    if not (t.b == t.d == 0 and t.a > 0 and t.e < 0 and abs(t.a + t.e) < CELL_TOLERANCE * t.a):
        raise ConfigError(
            f"The grid of {name} is not north up with square cells. Use --resolution and --bounds instead."
        )
    side = float(t.a)
    anchor = (_phase(float(t.c), side), _phase(float(t.f), side))
    rows, cols = geobox.shape
    window = CellWindow(round((anchor[1] - t.f) / side), round((t.c - anchor[0]) / side), rows, cols)
    return Grid(geobox, anchor, window)


def _phase(edge: float, side: float) -> float:
    """Distance (m) of an edge above a multiple of the cell size; exactly 0 where only rounding separates them."""
    cells = edge / side
    return 0.0 if abs(cells - round(cells)) < CELL_TOLERANCE else float(edge - np.floor(cells) * side)


def grid_from_bounds(bounds: tuple[float, float, float, float], cell_m: float, crs: CRS) -> Grid:
    """The smallest grid that contains bounds (xmin, ymin, xmax, ymax), m, with edges on multiples of the cell size.

    Raises
    ------
    GeometryError
        The bounds contain no cell.
    """
    col0, row0 = np.floor(bounds[0] / cell_m + CELL_TOLERANCE), np.ceil(bounds[3] / cell_m - CELL_TOLERANCE)
    cols = int(np.ceil(bounds[2] / cell_m - CELL_TOLERANCE) - col0)
    rows = int(row0 - np.floor(bounds[1] / cell_m + CELL_TOLERANCE))
    if rows < 1 or cols < 1:
        raise GeometryError(f"The area {bounds} holds no cell of {cell_m:g} m. Give a larger area or smaller cells.")
    geobox = GeoBox((rows, cols), Affine(cell_m, 0, col0 * cell_m, 0, -cell_m, row0 * cell_m), crs)
    return Grid(geobox, (0.0, 0.0), CellWindow(int(-row0), int(col0), rows, cols))


def cells_of_bounds(
    bounds: tuple[float, float, float, float], anchor: tuple[float, float], cell_m: float, levels: int
) -> CellWindow:
    """Finest cells that cover bounds (xmin, ymin, xmax, ymax), m, extended to whole cells of the coarsest level.

    levels : of the pyramid.
    """
    unit = 2 ** (levels - 1)
    side = cell_m * unit
    col0, col1 = np.floor((bounds[0] - anchor[0]) / side), np.ceil((bounds[2] - anchor[0]) / side)
    row0, row1 = np.floor((anchor[1] - bounds[3]) / side), np.ceil((anchor[1] - bounds[1]) / side)
    return CellWindow(int(row0) * unit, int(col0) * unit, int(row1 - row0) * unit, int(col1 - col0) * unit)


def cell_centres(geobox: GeoBox) -> NDArray[np.float64]:
    """Easting and northing of the centres of all cells of a north-up grid, (r, c, 2) m."""
    t, (rows, cols) = geobox.transform, geobox.shape
    x, y = t.c + t.a * (np.arange(cols) + 0.5), t.f + t.e * (np.arange(rows) + 0.5)
    return np.stack(np.meshgrid(x, y), axis=-1)


Value = TypeVar("Value", np.float32, np.bool_)


@dataclass(frozen=True)
class CellWindow:
    """A window of the scene's lattice of cells at one level.

    row, col : of its first cell, which may be negative; rows, cols : its size.
    """

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
        """The same ground, `levels` levels finer."""
        size = 2**levels
        return CellWindow(self.row * size, self.col * size, self.rows * size, self.cols * size)

    def within(self, other: CellWindow) -> CellWindow:
        """The part inside another window of the same level; it may be empty."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        row1 = min(self.row + self.rows, other.row + other.rows)
        col1 = min(self.col + self.cols, other.col + other.cols)
        return CellWindow(row, col, max(row1 - row, 0), max(col1 - col, 0))

    def meets(self, other: CellWindow) -> bool:
        """Whether it shares cells with another window of the same level."""
        shared = self.within(other)
        return bool(shared.rows and shared.cols)

    def around(self, other: CellWindow) -> CellWindow:
        """The smallest window that contains this one and another of the same level."""
        row, col = min(self.row, other.row), min(self.col, other.col)
        row1 = max(self.row + self.rows, other.row + other.rows)
        col1 = max(self.col + self.cols, other.col + other.cols)
        return CellWindow(row, col, row1 - row, col1 - col)

    def slices_in(self, other: CellWindow) -> tuple[slice, slice]:
        """Rows and columns of this window in an array over another window of the same level."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.rows), slice(col, col + self.cols)


def on_cells(
    values: NDArray[Value], values_window: CellWindow, cells_window: CellWindow, levels: int = 1
) -> NDArray[Value]:
    """Values (r, c) of a coarser level on the cells of a window that is `levels` levels finer.

    Every cell takes the value of the coarser cell that contains it; outside `values_window` that of the nearest one.
    """
    rows = np.clip(
        ((np.arange(cells_window.rows) + cells_window.row) >> levels) - values_window.row, 0, values_window.rows - 1
    )
    cols = np.clip(
        ((np.arange(cells_window.cols) + cells_window.col) >> levels) - values_window.col, 0, values_window.cols - 1
    )
    return np.ascontiguousarray(values[np.ix_(rows, cols)])
