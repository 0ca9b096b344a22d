"""A raster of heights that is read by windows, so that it may be of any size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyproj
from affine import Affine
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.heights import HeightRaster, read_window
from zlocus.io.height_values import check_unit
from zlocus.io.open_raster import cached_raster, check_complete, open_raster

# Heights are looked up block by block, each with a rim for those between cells.
BLOCK, RIM = 512, 1


@dataclass(frozen=True)
class HeightFile:
    """A raster of heights that is not read yet. shape : rows and columns; description : of its band."""

    path: Path
    shape: tuple[int, int]
    transform: Affine
    crs: CRS | None
    description: str

    @classmethod
    def open(cls, path: Path) -> HeightFile:
        """Open a raster of heights.

        Raises
        ------
        InputError
            The file is missing or cannot be read, is too small for a surface, or its unit is not the metre.
        """
        with open_raster(path, "raster of heights") as source:
            check_unit(source.units[0], path)
            check_complete(source, path)
            if min(source.shape) < 2:
                raise InputError(
                    f"{path} has {source.height} x {source.width} cells, too few for a surface. Check the file."
                )
            return cls(
                Path(path), (source.height, source.width), source.transform, source.crs, source.descriptions[0] or ""
            )

    @cached_property
    def spatial(self) -> pyproj.CRS | None:
        """The CRS of the file, which may have a vertical part; see `HeightRaster.spatial`."""
        return self._frame.spatial

    @property
    def horizontal(self) -> pyproj.CRS | None:
        """The CRS of x and y."""
        return self._frame.horizontal

    @property
    def cell(self) -> float:
        """Side of a cell, in units of the CRS: the root of its area."""
        return float(abs(self.transform.determinant) ** 0.5)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """xmin, ymin, xmax, ymax of the raster."""
        rows, cols = self.shape
        corners = np.array([self.transform * corner for corner in ((0, 0), (cols, 0), (0, rows), (cols, rows))])
        (xmin, ymin), (xmax, ymax) = corners.min(axis=0), corners.max(axis=0)
        return float(xmin), float(ymin), float(xmax), float(ymax)

    @property
    def _frame(self) -> HeightRaster:
        return HeightRaster(self.path, np.empty((0, 0)), self.transform, self.crs, self.description)

    def row_col(self, xy: FloatArray) -> FloatArray:
        """Fractional rows and columns (n, 2) of points (n, 2), from the outer corner of the first cell."""
        return self._frame.cells(xy)

    def inside(self, xy: FloatArray) -> NDArray[np.bool_]:
        """Whether points (n, 2) lie in the raster."""
        cell = self.row_col(xy)
        return np.asarray(((cell >= 0) & (cell < self.shape)).all(axis=1))

    def window(self, row: int, col: int, rows: int, cols: int) -> HeightRaster:
        """The heights of a window, as far as it lies in the raster."""
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + rows, self.shape[0]), min(col + cols, self.shape[1])
        with cached_raster(self.path) as source:
            z = read_window(source, self.path, Window(left, top, max(right - left, 0), max(bottom - top, 0)))
        return HeightRaster(self.path, z, self.transform * Affine.translation(left, top), self.crs, self.description)

    def blocks_of(self, xy: FloatArray) -> dict[tuple[int, int], NDArray[np.int64]]:
        """Numbers of the points in each block of `BLOCK` x `BLOCK` cells, by its row and column. All lie inside."""
        block = np.floor(self.row_col(xy) / BLOCK).astype(np.int64)
        across = -(-self.shape[1] // BLOCK)
        key = block[:, 0] * across + block[:, 1]
        order = np.argsort(key, kind="stable")
        keys, first = np.unique(key[order], return_index=True)
        parts = np.split(order, first[1:])
        return {(int(one) // across, int(one) % across): part for one, part in zip(keys, parts, strict=True)}

    def bilinear(self, xy: FloatArray) -> FloatArray:
        """Heights (n,) m at points, see `HeightRaster.bilinear`; NaN outside."""
        return self._looked_up(xy, HeightRaster.bilinear)

    def has_four(self, xy: FloatArray) -> NDArray[np.bool_]:
        """Whether points (n, 2) lie between four cells that all have a height."""
        return np.isfinite(self._looked_up(xy, HeightRaster.between_cells))

    def _looked_up(self, xy: FloatArray, look_up: Callable[[HeightRaster, FloatArray], FloatArray]) -> FloatArray:
        """Heights (n,) m at points, block by block; NaN outside."""
        z, inside = np.full(len(xy), np.nan), np.flatnonzero(self.inside(xy))
        if not len(inside):
            return z
        for (row, col), part in self.blocks_of(xy[inside]).items():
            side = BLOCK + 2 * RIM
            window = self.window(row * BLOCK - RIM, col * BLOCK - RIM, side, side)
            z[inside[part]] = look_up(window, xy[inside[part]])
        return z
