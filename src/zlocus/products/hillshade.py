"""hillshade.tif: the brightness of the surface under a sun."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import ProductOptions
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.row_strips import STRIP_ROWS, BandReader, strips_of
from zlocus.products.shade_kernel import shade_cells

NO_DATA = 0


def write_hillshade(dsm: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """Write the hillshade of a raster of heights: uint8, 1 (in shade) to 255 (facing the sun), 0 without height.

    strip_rows : rows that are processed at a time; they change no byte.

    Raises
    ------
    InputError
        The raster of heights is missing or damaged.
    OutputError
        The hillshade cannot be written.
    """
    with (
        BandReader(dsm) as reader,
        RasterSink(
            path, reader.horizontal_geobox, RasterBands("uint8", NO_DATA, ("hillshade",), average_overviews=True)
        ) as sink,
    ):
        for strip in strips_of(reader.geobox.shape[0], 1, strip_rows):
            z = reader.read(strip)
            shade = hillshade(z, reader.cell_m, options.sun_azimuth_deg, options.sun_altitude_deg)
            sink.write(strip.row, 0, shade[strip.own])


def hillshade(z: NDArray[np.float32], cell_m: float, azimuth_deg: float, altitude_deg: float) -> NDArray[np.uint8]:
    """Brightness (r, c) of a surface that scatters light evenly, as gdaldem computes it.

    It is 1 + 254 cos of the angle between normal and sun, 1 where the surface is turned away, and 0 without height.
    z : (r, c) m, NaN where empty. Source: Horn (1981), Proc. IEEE 69(1), Lambertian shading of section V; slopes are
    those of `horn_slopes`.
    """
    azimuth, altitude = math.radians(azimuth_deg), math.radians(altitude_deg)
    flat = math.cos(altitude)
    sun = np.array([math.sin(azimuth) * flat, math.cos(azimuth) * flat, math.sin(altitude)])
    ringed = np.full((z.shape[0] + 2, z.shape[1] + 2), np.nan)
    ringed[1:-1, 1:-1] = z
    out = np.empty(z.shape, np.uint8)
    shade_cells(ringed, float(cell_m), sun, out)
    return out
