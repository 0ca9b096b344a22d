"""hillshade.tif: how bright the surface is under a sun."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zlocus.io.raster import RasterSink
from zlocus.options import ProductOptions
from zlocus.products.strips import STRIP_ROWS, ReadBand, strips_of
from zlocus.sensors.model import FloatArray

NO_SHADE = 0
DARKEST, BRIGHTEST = 1.0, 255.0


def write_hillshade(dsm: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """The hillshade of a raster of heights: uint8, 1 (in shade) to 255 (facing the sun), 0 without height.

    strip_rows : rows worked on at a time; they change no byte.

    Raises
    ------
    InputError
        The raster of heights is missing or damaged.
    OutputError
        The hillshade cannot be written.
    """
    with (
        ReadBand(dsm) as heights,
        RasterSink(
            path, heights.flat_geobox, "uint8", nodata=NO_SHADE, descriptions=("hillshade",), average=True
        ) as sink,
    ):
        for strip in strips_of(heights.geobox.shape[0], 1, strip_rows):
            z = heights.read(strip)
            shade = hillshade(z, heights.cell_m, options.sun_azimuth_deg, options.sun_altitude_deg)
            sink.write(strip.row, 0, shade[strip.own])


def hillshade(z: NDArray[np.float32], cell_m: float, azimuth_deg: float, altitude_deg: float) -> NDArray[np.uint8]:
    """Brightness of a surface that scatters light evenly, (r, c): 1 + 254 cos of the angle between normal and sun, 1
    where it is turned away, 0 without height; as gdaldem writes it.

    z : (r, c) m, NaN where empty. Source: Horn (1981), Proc. IEEE 69(1), Lambertian shading of section V.
    """
    east, north = horn_gradient(z, cell_m)
    azimuth, altitude = math.radians(azimuth_deg), math.radians(altitude_deg)
    sun_east, sun_north = math.sin(azimuth) * math.cos(altitude), math.cos(azimuth) * math.cos(altitude)
    # The normal is (-east, -north, 1), not yet of length 1.
    cosine = (math.sin(altitude) - east * sun_east - north * sun_north) / np.sqrt(1.0 + east**2 + north**2)
    with np.errstate(invalid="ignore"):
        shade = np.rint(DARKEST + (BRIGHTEST - DARKEST) * np.maximum(cosine, 0.0))
    return np.where(np.isfinite(z), shade, NO_SHADE).astype(np.uint8)


def horn_gradient(z: NDArray[np.floating], cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Slopes to east and to north, (r, c) each, from the eight neighbours; rows go south. NaN where z is.

    Source: Horn (1981), the weighted differences of section III (weights 1, 2, 1 over 8 cells). Beside holes and at the
    rim, where he has no value: a missing neighbour is mirrored through the centre, and a pair that is missing
    altogether is told by the other pairs. On planes both are exact wherever two directions are known.
    """
    ringed = np.full((z.shape[0] + 2, z.shape[1] + 2), np.nan)
    ringed[1:-1, 1:-1] = z
    centre = ringed[1:-1, 1:-1]

    def across(row: int, col: int) -> FloatArray:
        """Height at a neighbour less that opposite to it."""
        rows, cols = z.shape
        one = ringed[1 + row : 1 + row + rows, 1 + col : 1 + col + cols]
        other = ringed[1 - row : 1 - row + rows, 1 - col : 1 - col + cols]
        one, other = (
            np.where(np.isnan(a), 2.0 * centre - b, a) for a, b in ((one, other), (other, one))
        )  # fmt: skip
        return np.where(np.isfinite(centre), one - other, np.nan)

    east, north, north_east, south_east = across(0, 1), across(-1, 0), across(-1, 1), across(1, 1)
    east, north = (
        _known(east, (north_east + south_east) / 2.0, north_east - north, south_east + north),
        _known(north, (north_east - south_east) / 2.0, north_east - east, east - south_east),
    )
    north_east, south_east = _known(north_east, east + north), _known(south_east, east - north)
    # What no pair tells is even.
    east, north, north_east, south_east = (
        np.where(np.isnan(d) & np.isfinite(centre), 0.0, d) for d in (east, north, north_east, south_east)
    )
    scale = 8.0 * cell_m
    return (north_east + 2.0 * east + south_east) / scale, (north_east + 2.0 * north - south_east) / scale


def _known(first: FloatArray, *others: FloatArray) -> FloatArray:
    """The first of several values that is known."""
    for other in others:
        first = np.where(np.isnan(first), other, first)
    return first
