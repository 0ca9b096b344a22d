"""A raster of heights, looked up at ground points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyproj
from affine import Affine
from pyproj.exceptions import CRSError
from rasterio.crs import CRS

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.height_values import check_unit, is_fill
from zlocus.io.open_raster import open_raster

# What lies beyond is no height, whatever it means.
LOWEST_M, HIGHEST_M = -1e4, 1e5
# Row and column of a point that a map cannot show.
OUTSIDE = -10.0


@dataclass(frozen=True)
class HeightRaster:
    """Heights on a grid. z : (r, c) float64, m, NaN where there is none; description : of the band."""

    path: Path
    z: FloatArray
    transform: Affine
    crs: CRS | None
    description: str = ""

    @cached_property
    def spatial(self) -> pyproj.CRS | None:
        """The CRS with its heights, where it says what they are above.

        Raises
        ------
        InputError
            It is none that PROJ knows.
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
        """x and y of the middle of the raster."""
        rows, cols = self.z.shape
        x, y = self.transform * (cols / 2, rows / 2)
        return float(x), float(y)

    def nearest(self, xy: FloatArray) -> FloatArray:
        """Height of the cell that holds each point. xy : (n, 2) in the raster's CRS -> (n,) m, NaN outside."""
        cell = np.floor(self.cells(xy)).astype(int)
        inside = np.all((cell >= 0) & (cell < self.z.shape), axis=1)
        z = np.full(len(xy), np.nan)
        z[inside] = self.z[cell[inside, 0], cell[inside, 1]]
        return z

    def bilinear(self, xy: FloatArray) -> FloatArray:
        """Height between the four cell centres around each point; as `nearest` where one of the four is missing."""
        z = self.between_cells(xy)
        return np.where(np.isfinite(z), z, self.nearest(xy))

    def between_cells(self, xy: FloatArray) -> FloatArray:
        """Height between the four cell centres around each point, NaN where one of the four is missing."""
        cell = self.cells(xy) - 0.5
        corner = np.floor(cell).astype(int)
        down, right = (cell - corner).T
        inside = np.all((corner >= 0) & (corner < np.array(self.z.shape) - 1), axis=1)
        row, col = np.where(inside[:, None], corner, 0).T
        upper = self.z[row, col] * (1 - right) + self.z[row, col + 1] * right
        lower = self.z[row + 1, col] * (1 - right) + self.z[row + 1, col + 1] * right
        return np.where(inside, upper * (1 - down) + lower * down, np.nan)

    def cells(self, xy: FloatArray) -> FloatArray:
        """(row, col) with (0, 0) at the outer corner of the first cell, outside for what is not finite.

        (n, 2) -> (n, 2).
        """
        inverse = ~self.transform
        x, y = xy[:, 0], xy[:, 1]
        col = inverse.a * x + inverse.b * y + inverse.c
        row = inverse.d * x + inverse.e * y + inverse.f
        return np.asarray(np.nan_to_num(np.column_stack([row, col]), nan=OUTSIDE, posinf=OUTSIDE, neginf=OUTSIDE))


def read_heights(path: Path) -> HeightRaster:
    """The first band of a raster as heights.

    Raises
    ------
    InputError
        The file is missing, cannot be read, is too small to hold a surface, or its unit is not the metre.
    """
    with open_raster(path, "raster of heights") as source:
        stored, nodata, transform, crs = source.read(1), source.nodata, source.transform, source.crs
        scale, offset, description = source.scales[0], source.offsets[0], source.descriptions[0] or ""
        check_unit(source.units[0], path)
    if stored.dtype.kind == "c":
        raise InputError(f"{path} holds complex numbers, which are no heights. Check the file.")
    with np.errstate(invalid="ignore"):  # some kinds of NaN
        z = stored.astype(np.float64)
    if min(z.shape) < 2:
        raise InputError(f"{path} has {z.shape[0]} x {z.shape[1]} cells, too few for a surface. Check the file.")
    if nodata is not None:
        z[z == nodata] = np.nan
    z[is_fill(z)] = np.nan
    if (scale, offset) != (1.0, 0.0):
        z = z * scale + offset
    z[(z < LOWEST_M) | (z > HIGHEST_M)] = np.nan
    return HeightRaster(path, z, transform, crs, description)
