"""Where cameras lie whose coordinates are taken as they are: an offset, and places that cannot be meant."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from pyproj import CRS

from zlocus.core.errors import ZlocusWarning
from zlocus.core.requests import ImportRequest
from zlocus.core.sensor_model import FloatArray
from zlocus.io.importers.base import ImportedCameras
from zlocus.io.importers.earth import parsed_crs
from zlocus.sensors.earth_frame import MAJOR_M, MINOR_M, WGS84, between

# Local models begin near their origin. Coordinates of a map lie further from it than this, and further than so many
# times the extent of the cameras.
MIN_MAP_DISTANCE, MIN_EXTENTS = 20_000.0, 20.0
# Geocentric coordinates lie so near to the ellipsoid; a northing of a map may be as long, but then z is a height.
MAX_HEIGHT_M = 20_000.0
# Maps are used a little beyond the area for which they were made.
BEYOND_DEG = 1.0


def placed_cameras(cameras: ImportedCameras, request: ImportRequest) -> ImportedCameras:
    """The cameras with the offset of the request added to their centres.

    Warns (`ZlocusWarning`) where the centres look like coordinates of the Earth without a CRS, or where the CRS that is
    given is not used in the place in which they lie.
    """
    if request.offset is not None:
        offset = np.array(request.offset)
        exposures = tuple(replace(each, centre=each.centre + offset) for each in cameras.exposures)
        cameras = replace(cameras, exposures=exposures)
    if not cameras.exposures:
        return cameras
    centres = np.array([each.centre for each in cameras.exposures])
    if request.crs is not None:
        found = _outside(centres, parsed_crs(request.crs), has_offset=request.offset is not None)
    else:
        found = None if request.up is not None else _on_earth(centres)
    if found is not None:
        x, y, z = np.median(centres, axis=0)
        where = f"The camera centres of {cameras.path} lie around X = {x:.0f}, Y = {y:.0f}, Z = {z:.0f}, {found}"
        warnings.warn(where, ZlocusWarning, stacklevel=2)
    return cameras


def _on_earth(centres: FloatArray) -> str | None:
    """What centres (n, 3) look like that have no CRS, and what to do; None where they may be local."""
    middle = np.median(centres, axis=0)
    extent = float(np.linalg.norm(centres - middle, axis=1).max())
    if not np.linalg.norm(middle) > max(MIN_MAP_DISTANCE, MIN_EXTENTS * extent):
        return None
    is_near_ellipsoid = MINOR_M - MAX_HEIGHT_M < np.linalg.norm(middle) < MAJOR_M + MAX_HEIGHT_M
    if is_near_ellipsoid and abs(middle[2]) > MAX_HEIGHT_M:
        return (
            "as geocentric coordinates do, in which no axis points up. Align the model to a map or to a frame of east, "
            "north and up (in COLMAP model_aligner with --alignment_type enu), or give --up."
        )
    return (
        "as coordinates of a map do, and without --crs they are taken as local, with no place on the Earth. Give the "
        "CRS of the map with --crs EPSG:n."
    )


def _outside(centres: FloatArray, crs: CRS, has_offset: bool) -> str | None:
    """That centres (n, 3) lie outside the area in which their CRS is used, and what to do; None where they do not."""
    area = crs.area_of_use
    if area is None:
        return None
    x, y, _ = np.median(centres, axis=0)
    lon, lat = between(crs.to_2d(), WGS84.to_2d()).transform(x, y)
    # An area may reach across the meridian of 180 degrees: then its east is less than its west.
    width = area.east - area.west + (360.0 if area.east < area.west else 0.0)
    is_along = (lon - area.west + BEYOND_DEG) % 360.0 <= width + 2 * BEYOND_DEG
    if is_along and area.south - BEYOND_DEG <= lat <= area.north + BEYOND_DEG:
        return None
    advice = "Give what was subtracted from the coordinates of the map with --offset"
    if has_offset:
        advice = "Check --offset and --crs"
    return f"which is outside the area in which {crs.to_string()} is used. {advice}."
