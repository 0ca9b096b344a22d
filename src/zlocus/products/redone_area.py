"""The area of a surface that is redone, on its grid: which cells it holds, and how far the new surface counts there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.io.grid_inputs import cells_of_each

# The ramp is this wide where nothing else is asked for, cells: about twice the reach of a correlation window.
RAMP_CELLS = 8.0
# Rows of cells that are looked at at a time.
STRIP_ROWS = 128


@dataclass(frozen=True, eq=False)
class RedoneArea:
    """Polygons to be redone, and the ramps inside their borders.

    polygons : (n,) shapely, which do not overlap; ramp_cells : (n,) width of the ramp of each; geobox : of the surface.
    """

    polygons: NDArray[Any]
    ramp_cells: NDArray[np.float64]
    geobox: GeoBox

    @classmethod
    def of(cls, polygons: NDArray[Any], geobox: GeoBox, margin_m: float | None) -> RedoneArea:
        """The area of polygons (n,) in the CRS of the grid, which may overlap.

        margin_m : width of the ramp, None for `RAMP_CELLS`. In a narrow polygon it is narrower, so that the new surface
        counts fully in its middle.
        """
        cell_m = float(geobox.transform.a)
        parts = shapely.get_parts(shapely.union_all(shapely.make_valid(polygons)))
        parts = parts[shapely.get_type_id(parts) == 3]
        wanted = RAMP_CELLS if margin_m is None else margin_m / cell_m
        # Area over outline is between one half and the whole of the radius of the largest circle inside.
        narrow = shapely.area(parts) / shapely.length(parts) / cell_m / 2
        return cls(parts, np.minimum(wanted, narrow), geobox)

    def weights(self, row: int, col: int, shape: tuple[int, int]) -> NDArray[np.float32]:
        """How far the new surface counts in cells, (r, c) from 0 outside the area to 1 beyond the ramp.

        row, col : the first cell; shape : rows and columns. The edge of the grid is no border of the area.
        """
        around = math.ceil(float(self.ramp_cells.max(initial=0.0))) + 2
        first_row, first_col = max(row - around, 0), max(col - around, 0)
        last_row, last_col = (
            min(start + n + around, whole) for start, n, whole in zip((row, col), shape, self.geobox.shape, strict=True)
        )
        part = slice(row - first_row, row - first_row + shape[0]), slice(col - first_col, col - first_col + shape[1])
        numbers = self._numbers(first_row, first_col, (last_row - first_row, last_col - first_col))
        if not numbers[part].any():
            return np.zeros(shape, np.float32)
        distance = cv2.distanceTransform((numbers > 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[part]
        numbers = numbers[part]
        ramp = np.concatenate([[1.0], self.ramp_cells])[numbers]
        # The first cell inside has a distance of 1, from centre to centre; the border is half of it away.
        share = np.clip((distance - 0.5) / np.maximum(ramp, 0.5), 0.0, 1.0)
        return np.where(numbers > 0, share * share * (3 - 2 * share), 0.0).astype(np.float32)

    def has_cells(self, row: int, col: int, shape: tuple[int, int]) -> bool:
        """Whether a block holds the centre of a cell inside the area; see `weights`."""
        return bool(self._numbers(row, col, shape).any())

    def _numbers(self, row: int, col: int, shape: tuple[int, int]) -> NDArray[np.int32]:
        """Number of the polygon of each cell, from 1; 0 outside."""
        west, north = self.geobox.transform * (col, row)
        east, south = self.geobox.transform * (col + shape[1], row + shape[0])
        near = shapely.intersects(self.polygons, shapely.box(west, south, east, north))
        if not near.any():
            return np.zeros(shape, np.int32)
        box = self.geobox[row : row + shape[0], col : col + shape[1]]
        return cells_of_each(self.polygons[near], np.flatnonzero(near) + 1, box)
