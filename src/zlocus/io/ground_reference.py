"""An ortho-image and heights of the same ground, read by window in the frame of a scene, for images to be compared
with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS
from rasterio.enums import Resampling
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.footprints import Bounds
from zlocus.io.axis_resampling import resampled
from zlocus.io.crs import raster_crs
from zlocus.io.grid_inputs import read_dem
from zlocus.io.images import RasterImage, open_image
from zlocus.io.open_raster import cached_raster, open_raster
from zlocus.io.vertical import VerticalDatum

# Cells around a window that are read too, for interpolation.
MARGIN_CELLS = 4


class HeightSource(Protocol):
    """Heights that are read by window."""

    def read(self, geobox: GeoBox) -> NDArray[np.float32]:
        """Ellipsoidal heights (r, c) m on a grid in the frame of the scene; NaN where there are none."""
        ...


@dataclass(frozen=True)
class TerrainModel:
    """A terrain model in any CRS. vertical_datum : of its heights."""

    path: Path
    vertical_datum: VerticalDatum

    def read(self, geobox: GeoBox) -> NDArray[np.float32]:
        """See `HeightSource`.

        Raises
        ------
        InputError, ConfigError
            See `read_dem`.
        """
        return read_dem(self.path, geobox, self.vertical_datum, may_miss=True)


@dataclass(frozen=True)
class OrthoReference:
    """An ortho-image with heights.

    image : of the ortho-image; crs : its own; frame : of the scene; area : its bounds there, m; cell_m : side of its
    cells there; height_source : of the same ground.
    """

    image: RasterImage
    crs: CRS
    frame: CRS
    area: Bounds
    cell_m: float
    height_source: HeightSource

    @property
    def is_in_frame(self) -> bool:
        """Whether the ortho-image is in the frame of the scene. GDAL warps another one, in one thread only: it changes
        the filters of warnings, which threads share."""
        return self.crs == self.frame

    def heights(self, geobox: GeoBox) -> NDArray[np.float32]:
        """Ellipsoidal heights (r, c) m on a grid; NaN where there are none."""
        return self.height_source.read(geobox)

    def grey(self, geobox: GeoBox) -> NDArray[np.float32]:
        """Grey values (r, c) on a grid in the frame of the scene; NaN where there are none. Larger cells get means.

        Raises
        ------
        InputError
            The file can no longer be read.
        """
        out, (rows, cols) = np.full(tuple(geobox.shape), np.nan, np.float32), self.image.shape
        bounds = geobox.boundingbox.bbox
        if not self.is_in_frame:
            bounds = transform_bounds(self.frame.to_wkt(), self.crs.to_wkt(), *bounds)
        if not np.isfinite(bounds).all():
            return out
        with cached_raster(self.image.path) as source:
            t = source.transform
            corners = [~t * (x, y) for x in bounds[::2] for y in bounds[1::2]]
            reduction = max(int(float(geobox.transform.a) / self.cell_m), 1)
            margin = MARGIN_CELLS * reduction
            low = np.clip(np.floor(np.min(corners, axis=0)).astype(int) - margin, 0, (cols, rows))
            high = np.clip(np.ceil(np.max(corners, axis=0)).astype(int) + margin, 0, (cols, rows))
            if (high <= low).any():
                return out
            size = high - low
            window, shape = Window(*low, *size), tuple(int(n) for n in -(-size[::-1] // reduction))
            grey = np.zeros(shape, np.float32)
            for band, weight in zip(self.image.bands, self.image.weights, strict=True):
                read = source.read(
                    band, window=window, out_shape=shape, masked=True, resampling=Resampling.average,
                    out_dtype=np.float32,
                )  # fmt: skip
                grey += np.float32(weight) * read.filled(np.nan)
            scale = t.scale(size[0] / shape[1], size[1] / shape[0])
            window_transform = t * t.translation(*low.tolist()) * scale
        if self.is_in_frame:
            return resampled(grey, window_transform, geobox)
        reproject(
            grey, out, src_transform=window_transform, src_crs=self.crs.to_wkt(), src_nodata=np.nan,
            dst_transform=geobox.transform, dst_crs=self.frame.to_wkt(), dst_nodata=np.nan,
            resampling=Resampling.cubic,
        )  # fmt: skip
        return out


def open_reference(path: Path, frame: CRS, height_source: HeightSource) -> OrthoReference:
    """Open an ortho-image. frame : of the scene; height_source : heights of the same ground.

    Raises
    ------
    InputError
        The file is no image, has no CRS, is rotated, or lies where the frame does not reach.
    """
    image = open_image(path)
    with open_raster(path) as source:
        crs, t = raster_crs(source, path).to_2d(), source.transform
        if t.b or t.d or t.a <= 0 or t.e >= 0:
            raise InputError(f"{path} is rotated or not north-up. Warp it first (gdalwarp).")
        bounds = tuple(source.bounds)
    flat = frame.to_2d()
    if crs != flat:
        bounds = transform_bounds(crs.to_wkt(), flat.to_wkt(), *bounds)
    if not np.isfinite(bounds).all():
        raise InputError(f"{path} lies where {flat.name} does not reach. Check its CRS, and that of the images.")
    west, south, east, north = (float(at) for at in bounds)
    rows, cols = image.shape
    cell_m = float(np.sqrt((east - west) * (north - south) / (rows * cols)))
    return OrthoReference(image, crs, flat, (west, south, east, north), cell_m, height_source)
