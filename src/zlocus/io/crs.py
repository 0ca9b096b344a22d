"""Which coordinate reference systems a grid may have, and the one it has by default."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import rasterio
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError

from zlocus.core.errors import ConfigError, InputError
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_MAGNITUDE, quoted
from zlocus.sensors.earth_frame import WGS84, between

LOCAL = (
    'ENGCRS["Local Cartesian frame, z up",EDATUM["Local"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],'
    'LENGTHUNIT["metre",1]]'
)
# Semi-major axis, and by how much those of ellipsoids and spheres in use differ.
EARTH_MAJOR_M, MAX_MAJOR_DIFFERENCE_M = 6378137.0, 3e4
MAX_CRS_NAME_CHARACTERS = 80


def local_frame() -> CRS:
    """Cartesian axes in metres, z up, at no known place of the Earth."""
    return CRS.from_wkt(LOCAL)


def crs_label(crs: CRS) -> str:
    """A CRS for messages: its code, or else its name."""
    code = crs.to_2d().to_epsg()
    return crs.name if code is None else f"EPSG:{code}"


def is_on_earth(crs: CRS) -> bool:
    """Whether coordinates in a CRS are places on the Earth: it has its size, and PROJ can convert them."""
    ellipsoid = crs.ellipsoid
    if ellipsoid is None or abs(ellipsoid.semi_major_metre - EARTH_MAJOR_M) > MAX_MAJOR_DIFFERENCE_M:
        return False
    try:
        between(crs.to_2d(), WGS84)
    except ProjError:
        return False
    return True


def checked_crs(crs: CRS) -> CRS:
    """The horizontal part of a projected CRS in metres.

    Raises
    ------
    ConfigError
        For any other CRS, saying what to use instead.
    """
    flat = crs.to_2d()
    advice = "Use a projected one in metres, for example the UTM zone EPSG:326nn (north) or EPSG:327nn (south)"
    named = f"The CRS {quoted(crs.to_string())} ({crs.name[:MAX_CRS_NAME_CHARACTERS]})"
    if not flat.is_projected:
        kind = "geographic (degrees)" if flat.is_geographic else "not projected"
        raise ConfigError(f"{named} is {kind}. {advice}, or leave --crs out.")
    if any(abs(axis.unit_conversion_factor - 1.0) > 1e-9 for axis in flat.axis_info):
        raise ConfigError(f"{named} is in {flat.axis_info[0].unit_name}. {advice}.")
    if not is_on_earth(flat):
        raise ConfigError(f"The CRS {quoted(crs.to_string())} cannot be converted to places on the Earth. {advice}.")
    return flat


def utm_zone(lon: float, lat: float) -> CRS:
    """The WGS84 UTM zone of a place (degrees), the 6-degree bands without the exceptions of Norway and Svalbard."""
    zone = int((lon + 180.0) % 360.0 // 6.0) + 1
    return CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)


def raster_crs(source: rasterio.DatasetReader, path: Path) -> CRS:
    """The CRS of an open raster, whose cells lie somewhere in it.

    Raises
    ------
    InputError
        Where it has none, or one that is no place on the Earth, or cells have no place or no size.
    """
    transform = source.transform
    steps = (*transform[:6], *(~transform)[:6]) if transform.determinant else (math.nan,)
    if not all(abs(step) <= MAX_MAGNITUDE for step in steps):
        raise InputError(f"The cells of {path} lie nowhere: its transform is {tuple(transform)[:6]}. {EXPORT_AGAIN}")
    if source.crs is None:
        raise InputError(f"{path} has no CRS, so its place on the ground is unknown. Assign one (gdal_edit -a_srs).")
    return file_crs(source.crs, path)


def file_crs(given: Any, path: Path) -> CRS:
    """A file's CRS, in whatever form pyproj understands; see `raster_crs`."""
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
