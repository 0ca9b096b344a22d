"""A raster of heights, sampled at ground points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyproj
from affine import Affine
from pyproj.exceptions import CRSError
from rasterio import DatasetReader
from rasterio.crs import CRS
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.height_values import check_unit, is_fill
from zlocus.io.open_raster import open_raster

# Values outside this range are not heights, whatever they mean.
MIN_HEIGHT_M, MAX_HEIGHT_M = -1e4, 1e5
# Row and column given to points without finite coordinates.
OUTSIDE = -10.0


@dataclass(frozen=True)
class HeightRaster:
    """Heights on a grid. z : (r, c) float64, m, NaN where there is no height; description : of the band."""

    path: Path
    z: FloatArray
    transform: Affine
    crs: CRS | None
    description: str = ""

    @cached_property
    def spatial(self) -> pyproj.CRS | None:
        """The CRS of the file, which may have a vertical part.

        Raises
        ------
        InputError
            PROJ does not know the CRS.
        """
        if not self.crs:
            return None
        try:
            return pyproj.CRS.from_wkt(self.crs.to_wkt())
        except CRSError as error:
            raise InputError(
                f"{self.path} has a CRS that PROJ does not know. Assign one (gdal_edit -a_srs)."
            ) from error

    @cached_property
    def horizontal(self) -> pyproj.CRS | None:
        """The CRS of x and y."""
        return None if self.spatial is None else self.spatial.to_2d()

    @property
    def centre(self) -> tuple[float, float]:
        """x and y of the centre of the raster."""
        rows, cols = self.z.shape
        x, y = self.transform * (cols / 2, rows / 2)
        return float(x), float(y)

    def nearest(self, xy: FloatArray) -> FloatArray:
        """Height (n,) m of the cell that contains each point; NaN outside. xy : (n, 2) in the raster's CRS."""
        return self._in_cells(*self._row_col(xy))

    def bilinear(self, xy: FloatArray) -> FloatArray:
        """Height (n,) m interpolated between four cell centres; as `nearest` where one of the four has no height."""
        row, col = self._row_col(xy)
        z = self._between(row, col)
        missing = np.isnan(z)
        if missing.any():
            z[missing] = self._in_cells(row[missing], col[missing])
        return z

    def between_cells(self, xy: FloatArray) -> FloatArray:
        """Height (n,) m interpolated between four cell centres; NaN where one of the four has no height."""
        return self._between(*self._row_col(xy))

    def cells(self, xy: FloatArray) -> FloatArray:
        """Fractional row and column (n, 2) of points (n, 2), from the outer corner of the first cell.

        Points that are not finite get a place outside the raster.
        """
        return np.column_stack(self._row_col(xy))

    @cached_property
    def filled_cells(self) -> tuple[tuple[int, int], tuple[int, int]] | None:
        """First and last row, first and last column with a height; None where there is no height."""
        is_filled = np.isfinite(self.z)
        if not is_filled.any():
            return None
        rows, cols = (np.flatnonzero(is_filled.any(axis=axis)) for axis in (1, 0))
        return (int(rows[0]), int(rows[-1])), (int(cols[0]), int(cols[-1]))

    def _row_col(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fractional rows and columns (n,) of points, see `cells`."""
        inverse = ~self.transform
        x, y = xy[:, 0], xy[:, 1]
        col = inverse.a * x + inverse.b * y + inverse.c
        row = inverse.d * x + inverse.e * y + inverse.f
        unknown = ~(np.isfinite(row) & np.isfinite(col))
        if unknown.any():
            row, col = (np.where(np.isfinite(place), place, OUTSIDE) for place in (row, col))
        return row, col

    def _in_cells(self, row: FloatArray, col: FloatArray) -> FloatArray:
        """Heights (n,) m of the cells that contain fractional rows and columns; NaN outside."""
        rows, cols = self.z.shape
        row, col = np.floor(row), np.floor(col)
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        z = np.full(len(row), np.nan)
        z[inside] = self.z[row[inside].astype(np.int64), col[inside].astype(np.int64)]
        return z

    def _between(self, row: FloatArray, col: FloatArray) -> FloatArray:
        """Heights (n,) m between four cell centres, at fractional rows and columns; see `between_cells`."""
        row, col = row - 0.5, col - 0.5
        top, left = np.floor(row), np.floor(col)
        down, right = row - top, col - left
        rows, cols = self.z.shape
        inside = (top >= 0) & (top < rows - 1) & (left >= 0) & (left < cols - 1)
        all_inside, z = bool(inside.all()), self.z.ravel()
        first = top * cols + left
        first = (first if all_inside else np.where(inside, first, 0)).astype(np.int64)
        left_share = 1 - right
        upper = z.take(first) * left_share + z.take(first + 1) * right
        lower = z.take(first + cols) * left_share + z.take(first + (cols + 1)) * right
        between = upper * (1 - down) + lower * down
        return between if all_inside else np.where(inside, between, np.nan)


def read_heights(path: Path) -> HeightRaster:
    """Heights from the first band of a raster.

    Raises
    ------
    InputError
        The file is missing or cannot be read, is too small for a surface, or its unit is not the metre.
    """
    with open_raster(path, "raster of heights") as source:
        check_unit(source.units[0], path)
        z = read_window(source, path)
        transform, crs, description = source.transform, source.crs, source.descriptions[0] or ""
    if min(z.shape) < 2:
        raise InputError(f"{path} has {z.shape[0]} x {z.shape[1]} cells, too few for a surface. Check the file.")
    return HeightRaster(path, z, transform, crs, description)


def read_window(source: DatasetReader, path: Path, window: Window | None = None) -> FloatArray:
    """Heights (r, c) m of the first band of an open raster, or of a window of it; NaN where there is none.

    Raises
    ------
    InputError
        The band holds complex numbers.
    """
    if np.dtype(source.dtypes[0] if "complex_int" not in source.dtypes[0] else "complex64").kind == "c":
        raise InputError(f"{path} holds complex numbers, which are no heights. Check the file.")
    with np.errstate(invalid="ignore"):  # signalling NaN
        z = source.read(1, window=window).astype(np.float64)
    if source.nodata is not None:
        z[z == source.nodata] = np.nan
    z[is_fill(z)] = np.nan
    if (source.scales[0], source.offsets[0]) != (1.0, 0.0):
        z = z * source.scales[0] + source.offsets[0]
    z[(z < MIN_HEIGHT_M) | (z > MAX_HEIGHT_M)] = np.nan
    return np.asarray(z)
