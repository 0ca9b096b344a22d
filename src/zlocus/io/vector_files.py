"""Read polygons and lines from vector files: GeoPackage, GeoJSON, Shapefile and others that hold them themselves."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.io.open_raster import existing_file
from zlocus.io.stored_files import first_bytes, is_remote
from zlocus.io.virtual_rasters import ARCHIVES

# Largest longitude and latitude, degrees: some files count longitudes to 360.
MAX_LONGITUDE, MAX_LATITUDE = 360.0, 90.0
MAX_REASON_CHARACTERS = 300  # of the text of another library in a message
# What GDAL says, before advice about its drivers, of a file that is none of its formats.
UNKNOWN_FORMAT = "not recognized as being in a supported file format"
# Kinds of features: the types of shapely, with those of several parts.
POLYGONS, LINES = (3, 6), (1, 5)
# Vector formats that hold their features in the file itself.
VECTOR_DRIVERS = (
    "ESRI Shapefile", "FlatGeobuf", "GeoJSON", "GeoJSONSeq", "GML", "GPKG", "KML", "LIBKML", "MapInfo File",
    "OpenFileGDB", "SQLite", "TopoJSON",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class VectorPolygons:
    """The polygons (n,) of a vector file, shapely, none empty.

    crs : as the file writes it, None without one; numbers : (n,) int64, place of each in the file, from 1; values :
    (n,) of an attribute as the file holds it, None where none was asked for.
    """

    polygons: NDArray[np.object_]
    crs: str | None
    numbers: NDArray[np.int64]
    values: NDArray[Any] | None = None


def read_vector(path: Path, may_be_empty: bool = False, field: str | None = None) -> VectorPolygons:
    """Read the polygons of a vector file with one layer.

    may_be_empty : whether it may have no features; field : name of an attribute that is read too.

    Raises
    ------
    InputError
        The file is no vector file, refers to other files, is an archive, has several layers, or holds anything but
        polygons; or its polygons have no such attribute.
    """
    found = _read(path, "polygons", field, force_2d=True)
    if not len(found.features) and not may_be_empty:
        raise InputError(f"{path} holds no polygons. Give a file with polygons.")
    if not np.isin(shapely.get_type_id(found.features), POLYGONS).all():
        raise InputError(f"{path} holds {found.kind} features, not polygons. Give polygons.")
    return VectorPolygons(found.features, found.crs, found.numbers, found.values)


@dataclass(frozen=True, eq=False)
class VectorLines:
    """The lines (n,) of a vector file, shapely, none empty; those with heights have a third coordinate.

    crs : as the file writes it, None without one; numbers : (n,) int64, place of each in the file, from 1.
    """

    lines: NDArray[np.object_]
    crs: str | None
    numbers: NDArray[np.int64]


def read_lines(path: Path) -> VectorLines:
    """Read the lines of a vector file with one layer, with the heights of those that have some.

    Raises
    ------
    InputError
        See `read_vector`; or the file holds anything but lines, or none.
    """
    found = _read(path, "lines", None, force_2d=False)
    if not len(found.features):
        raise InputError(f"{path} holds no lines. Give a file with lines.")
    if not np.isin(shapely.get_type_id(found.features), LINES).all():
        raise InputError(f"{path} holds {found.kind} features, not lines. Give lines.")
    return VectorLines(found.features, found.crs, found.numbers)


@dataclass(frozen=True, eq=False)
class _Features:
    """Features (n,) of a vector file that are not empty. kind : of the geometries, as the file names it."""

    features: NDArray[np.object_]
    kind: str
    crs: str | None
    numbers: NDArray[np.int64]
    values: NDArray[Any] | None


def _read(path: Path, what: str, field: str | None, force_2d: bool) -> _Features:
    """The features of a vector file with one layer. what : kind that is wanted, for messages."""
    # Imported here, because it takes 0.1 to 0.3 s and only runs with polygons need it.
    import pyogrio.raw

    path = existing_file(path, "vector file")
    begins = b"" if is_remote(path) else first_bytes(path)
    if archive := next((name for start, name in ARCHIVES.items() if begins.startswith(start)), None):
        raise InputError(f"The vector file {path} is an archive ({archive}), which is not followed. Unpack it.")
    try:
        layers = pyogrio.list_layers(path)[:, 0]
        if len(layers) != 1:
            raise InputError(
                f"{path} has {len(layers)} layers ({', '.join(layers)}). Give a file with one layer of {what}."
            )
        if (kind := (info := pyogrio.read_info(path))["driver"]) not in VECTOR_DRIVERS:
            raise InputError(f"{path} is no vector file that is read ({kind}). Give GeoJSON, GeoPackage or Shapefile.")
        _check_field(path, field, [str(name) for name in info["fields"]])
        with warnings.catch_warnings():
            # The library warns of open rings and numbers that are not finite. Callers refuse both.
            warnings.simplefilter("ignore", RuntimeWarning)
            meta, _, wkb, columns = pyogrio.raw.read(path, columns=[] if field is None else [field], force_2d=force_2d)
            features = shapely.from_wkb(wkb)
    except (RuntimeError, ValueError, shapely.errors.GEOSException) as error:  # includes pyogrio's own
        raise InputError(
            f"{path} cannot be read as vector file: {_reason_of(error)}. Give GeoJSON, GeoPackage or Shapefile."
        ) from error
    is_there = ~shapely.is_empty(features) & ~shapely.is_missing(features)
    numbers = np.flatnonzero(is_there) + 1
    values = None if field is None else np.asarray(columns[0])[is_there]
    return _Features(features[is_there], str(meta["geometry_type"]), meta["crs"], numbers, values)


def _reason_of(error: Exception) -> str:
    """Why a file cannot be read, without a full stop and without advice for users of GDAL."""
    if isinstance(error, UnicodeError):
        return "some text in it is not UTF-8"
    text = " ".join(str(error).split())
    if UNKNOWN_FORMAT in text:
        return "its format is not known"
    return text[:MAX_REASON_CHARACTERS].rstrip(".")


def check_degrees(polygons: NDArray[np.object_], crs: CRS, path: Path) -> None:
    """Refuse polygons of a geographic CRS whose coordinates are no longitudes and latitudes.

    polygons : (n,), x before y; path : of their file, for messages. GeoJSON without a CRS counts as geographic.

    Raises
    ------
    InputError
        A coordinate is larger than any longitude or latitude.
    """
    if not crs.is_geographic or not len(polygons):
        return
    degrees_per_unit = math.degrees(crs.axis_info[0].unit_conversion_factor)
    x, y = np.abs(shapely.get_coordinates(polygons)).max(axis=0) * degrees_per_unit
    if x > MAX_LONGITUDE or y > MAX_LATITUDE:
        first_x, first_y = shapely.get_coordinates(polygons)[0]
        raise InputError(
            f"{path} has polygons at {first_x:.8g}, {first_y:.8g}, which are no longitudes and latitudes, and its CRS "
            f"is geographic ({crs.name}). GeoJSON without a CRS means WGS 84. Name the CRS of the coordinates in the "
            "file, or convert them."
        )


def _check_field(path: Path, field: str | None, known: list[str]) -> None:
    """Refuse an attribute that the features of a file do not have."""
    if field is not None and field not in known:
        held = f"has {', '.join(known)}" if known else "has no attributes"
        raise InputError(f"{path} {held}, and no attribute {field}. Check the name.")
