"""The ground grid of a run: CRS, cell size and extent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.errors import ConfigError, GeometryError
from zlocus.matching.cells import CellWindow

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
