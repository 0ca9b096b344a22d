"""Coordinate reference systems: which ones a grid may have, its default, and the CRS of a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import rasterio
from pyproj import CRS, Proj
from pyproj.exceptions import CRSError, ProjError

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.quoting import quoted
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_MAGNITUDE
from zlocus.sensors.earth_frame import WGS84, between

LOCAL = (
    'ENGCRS["Local Cartesian frame, z up",EDATUM["Local"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],'
    'LENGTHUNIT["metre",1]]'
)
# Semi-major axis of the Earth, and the largest difference from it of ellipsoids and spheres in use.
EARTH_MAJOR_M, MAX_MAJOR_DIFFERENCE_M = 6378137.0, 3e4
MAX_CRS_NAME_CHARACTERS = 80
# Names of positive and negative longitudes and latitudes.
EAST_WEST, NORTH_SOUTH = ("east", "west"), ("north", "south")
# A metre of a CRS may differ from one on the ground by this share. National grids and UTM zones differ by less than
# half of it, also in the neighbouring zone.
MOST_SCALE_ERROR = 0.02


def local_frame() -> CRS:
    """The CRS of a local frame: Cartesian axes in metres, z up, with no known position on the Earth."""
    return CRS.from_wkt(LOCAL)


def crs_label(crs: CRS) -> str:
    """A CRS for messages: its EPSG code, or its name where it has none."""
    code = crs.to_2d().to_epsg()
    return crs.name if code is None else f"EPSG:{code}"


def is_on_earth(crs: CRS) -> bool:
    """Whether a CRS is one of the Earth: its ellipsoid has the right size, and PROJ can convert its coordinates."""
    ellipsoid = crs.ellipsoid
    if ellipsoid is None or abs(ellipsoid.semi_major_metre - EARTH_MAJOR_M) > MAX_MAJOR_DIFFERENCE_M:
        return False
    try:
        between(crs.to_2d(), WGS84)
    except ProjError:
        return False
    return True


def is_in_metres(crs: CRS) -> bool:
    """Whether all axes of a CRS are in metres."""
    return all(abs(axis.unit_conversion_factor - 1.0) <= 1e-9 for axis in crs.axis_info)


def checked_crs(crs: CRS) -> CRS:
    """The horizontal part of a projected CRS in metres.

    Raises
    ------
    ConfigError
        The CRS is not projected in metres; the message says what to use instead.
    """
    flat = crs.to_2d()
    advice = "Use a projected one in metres, for example the UTM zone EPSG:326nn (north) or EPSG:327nn (south)"
    named = f"The CRS {quoted(crs.to_string())} ({crs.name[:MAX_CRS_NAME_CHARACTERS]})"
    if not flat.is_projected:
        kind = "geographic (degrees)" if flat.is_geographic else "not projected"
        raise ConfigError(f"{named} is {kind}. {advice}, or leave --crs out.")
    if not is_in_metres(flat):
        raise ConfigError(f"{named} is in {flat.axis_info[0].unit_name}. {advice}.")
    if not is_on_earth(flat):
        raise ConfigError(f"The CRS {quoted(crs.to_string())} cannot be converted to places on the Earth. {advice}.")
    return flat


def utm_zone(lon: float, lat: float) -> CRS:
    """The WGS84 UTM zone of a place (degrees), without the exceptions for Norway and Svalbard."""
    zone = int((lon + 180.0) % 360.0 // 6.0) + 1
    return CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)


def check_fits(crs: CRS, lon: float, lat: float) -> None:
    """Refuse a projected CRS whose metres are none at a place (degrees): it is made for another part of the Earth.

    Raises
    ------
    ConfigError
        Its scale differs from one by more than `MOST_SCALE_ERROR`.
    """
    if not crs.is_projected:
        return
    factors = Proj(crs).get_factors(lon, lat)
    scales = factors.meridional_scale, factors.parallel_scale
    if all(abs(scale - 1.0) <= MOST_SCALE_ERROR for scale in scales):
        return
    area = crs.area_of_use
    made_for = "" if area is None else f" is made for {_degrees(area.bounds)}, and"
    zone = utm_zone(lon, lat)
    raise ConfigError(
        f"The CRS {quoted(crs.to_string())} ({crs.name[:MAX_CRS_NAME_CHARACTERS]}){made_for} is not true to scale "
        f"where the images lie, at {_degree(lon, EAST_WEST)}, {_degree(lat, NORTH_SOUTH)}. Use {zone.to_string()}, or "
        "leave --crs out."
    )


def _degrees(bounds: tuple[float, float, float, float]) -> str:
    """Bounds in degrees, in words."""
    west, south, east, north = bounds
    return f"{_span(west, east, EAST_WEST)}, {_span(south, north, NORTH_SOUTH)}"


def _span(low: float, high: float, names: tuple[str, str]) -> str:
    """Two angles, degrees, in words: 0 to 6 degrees east, 80 to 0 degrees south. names : of positive and negative."""
    if low >= 0:
        return f"{low:g} to {high:g} degrees {names[0]}"
    if high <= 0:
        return f"{abs(low):g} to {abs(high):g} degrees {names[1]}"
    return f"{abs(low):g} degrees {names[1]} to {high:g} degrees {names[0]}"


def _degree(angle: float, names: tuple[str, str]) -> str:
    """An angle, degrees, in words. names : of positive and negative ones."""
    return f"{abs(angle):.2f} degrees {names[angle < 0]}"


def raster_crs(source: rasterio.DatasetReader, path: Path) -> CRS:
    """The CRS of an open raster, whose transform is checked too.

    Raises
    ------
    InputError
        The raster has no CRS or one that is not of the Earth, or its transform is not usable.
    """
    transform = source.transform
    steps = (*transform[:6], *(~transform)[:6]) if transform.determinant else (math.nan,)
    if not all(abs(step) <= MAX_MAGNITUDE for step in steps):
        raise InputError(f"The cells of {path} lie nowhere: its transform is {tuple(transform)[:6]}. {EXPORT_AGAIN}")
    if source.crs is None:
        raise InputError(f"{path} has no CRS, so its place on the ground is unknown. Assign one (gdal_edit -a_srs).")
    return file_crs(source.crs, path)


def file_crs(given: Any, path: Path) -> CRS:
    """The CRS of a file. given : in any form that pyproj understands.

    Raises
    ------
    InputError
        PROJ does not know the CRS, or it is not of the Earth.
    """
    try:
        crs = CRS.from_user_input(given)
    except CRSError as error:
        raise InputError(
            f"{path} has a CRS that PROJ does not know: {error}. Assign one (gdal_edit -a_srs)."
        ) from error
    if not is_on_earth(crs):
        raise InputError(
            f"{path} has the CRS {quoted(crs.name)}, which cannot be converted to places on the Earth. Assign another."
        )
    return crs
