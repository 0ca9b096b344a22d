"""Tables of points: text with a header, vector files and Parquet, each row a point."""

from __future__ import annotations

import csv
import json
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.quoting import first_names, quoted
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import file_crs
from zlocus.io.open_raster import existing_file
from zlocus.io.points.columns import NEEDED, ROLES, are_degrees, columns_of
from zlocus.io.points.ground_points import (
    MAX_HEIGHT_M,
    MIN_HEIGHT_M,
    NO_HEIGHT,
    KnownPoints,
    PointFile,
    PointOptions,
)
from zlocus.io.points.land_cover import cover_name
from zlocus.io.safe_text import decimal, is_decimal, text_lines
from zlocus.sensors.earth_frame import WGS84

WHAT = "table of points"
SEPARATORS = (",", ";", "\t")
VECTOR_FORMATS = ("GPKG", "GeoJSON", "GeoJSONSeq", "ESRI Shapefile", "FlatGeobuf")
REPEATED = "given twice"
ROWS_AT_A_TIME = 500_000
MISSING = ("", "nan", "null", "none", "na", "n/a")
PARQUET_ADVICE = (
    "Install it (pip install pyarrow), or convert the file: ogr2ogr points.gpkg FILE, or pandas.read_parquet(FILE)"
    ".to_csv('points.csv')."
)


def text_table(path: Path, options: PointOptions) -> PointFile:
    """The points of a table of text: a header of names, then a row for each point.

    Columns are separated by commas, semicolons, tabs or blanks. Lines that are empty or begin with # are skipped; other
    columns than those of `ROLES` are left alone. A row without a height (empty, NaN, or a number that no height has) is
    left out, and counted.

    Raises
    ------
    InputError
        The file is missing or no text, has no header or no points; a needed column is missing; a place is no number.
    """
    lines = [line for line in text_lines(existing_file(path, WHAT)) if line[1].strip() and line[1].lstrip()[0] != "#"]
    if not lines:
        raise InputError(f"The {WHAT} {path} is empty. Give one with a header (x,y,z) and a row for each point.")
    separator = next((mark for mark in SEPARATORS if mark in lines[0][1]), None)
    names = [name.strip() for name in _cells(lines[0][1], separator)]
    if all(is_decimal(name) for name in names):
        raise InputError(
            f"The {WHAT} {path} begins with numbers, and its first line must name the columns. Write x,y,z above them."
        )
    roles = columns_of(path, names, options.columns)
    at = {role: names.index(name) for role, name in roles.items()}
    taken: dict[str, list[str]] = {role: [] for role in roles}
    for number, line in lines[1:]:
        cells = _cells(line, separator)
        if len(cells) != len(names):
            raise InputError(
                f"The {WHAT} {path}, line {number}: {len(cells)} values, but {len(names)} columns "
                f"({first_names(names, 8)}). Mend the line, or copy the file again where it is cut off."
            )
        for role, index in at.items():
            taken[role].append(cells[index].strip())
    numbers = [number for number, _ in lines[1:]]
    return _point_file(path, options, roles, taken, lambda row: f"line {numbers[row]}", None)


def _cells(line: str, separator: str | None) -> list[str]:
    """The cells of a line. separator : None: blanks."""
    if '"' in line:
        return next(csv.reader([line.strip()], delimiter=separator or " ", skipinitialspace=True))
    return line.split(separator)


def vector_table(path: Path, options: PointOptions) -> PointFile:
    """The points of a vector file with one layer of points; z is that of the points, or in an attribute.

    Raises
    ------
    InputError
        The file cannot be read, has several layers, or holds anything but points; a height is missing everywhere.
    """
    import pyogrio.raw

    existing_file(path, WHAT)
    try:
        with warnings.catch_warnings():
            # The library warns of what is odd in a file, and fails where that matters.
            warnings.simplefilter("ignore", RuntimeWarning)
            layers = pyogrio.list_layers(path)[:, 0]
            if len(layers) != 1:
                raise InputError(
                    f"{path} has {len(layers)} layers ({first_names(list(layers), 8)}). Give a file with one layer of "
                    "points."
                )
            if (kind := pyogrio.read_info(path)["driver"]) not in VECTOR_FORMATS:
                raise InputError(f"{path} is no file of points that is read ({kind}). Give GeoPackage, GeoJSON or CSV.")
            meta, _, wkb, values = pyogrio.raw.read(path)
            geometry = shapely.from_wkb(wkb)
    except (RuntimeError, ValueError, shapely.errors.GEOSException) as error:
        reason = " ".join(str(error).split())[:300].rstrip(".")
        raise InputError(f"{path} cannot be read as a file of points: {reason}. Give GeoPackage or CSV.") from error
    crs = None if meta["crs"] is None else file_crs(meta["crs"], path)
    columns = {str(name): np.asarray(column) for name, column in zip(meta["fields"], values, strict=True)}
    return _with_geometry(path, options, geometry, columns, crs)


def parquet_table(path: Path, options: PointOptions) -> PointFile:
    """The points of a Parquet file, with the geometry of GeoParquet 1 or with columns of coordinates.

    Raises
    ------
    InputError
        The library that reads Parquet is not installed; the file cannot be read; see `vector_table` and `text_table`.
    """
    existing_file(path, WHAT)
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(
            f"{path} is a Parquet file, and pyarrow, which reads it, is not installed. {PARQUET_ADVICE}"
        ) from (error)
    try:
        table = pyarrow.parquet.read_table(path)
        geo = json.loads((table.schema.metadata or {}).get(b"geo", b"{}"))
        held = {name: table.column(name).to_numpy() for name in table.column_names}
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        reason = " ".join(str(error).split())[:300].rstrip(".")
        raise InputError(f"{path} cannot be read as Parquet: {reason}. Copy it again, or give CSV.") from error
    name = geo.get("primary_column")
    if name not in held:
        return _of_columns(path, options, held, None)
    about = geo["columns"][name]
    if about.get("encoding") != "WKB":
        raise InputError(
            f"{path} stores its geometry as {quoted(about.get('encoding'))}, and WKB is read. Write it again as "
            "GeoParquet with WKB, or give GeoPackage."
        )
    # GeoParquet 1.1: no entry means longitude and latitude of WGS 84.
    given = about.get("crs", "OGC:CRS84")
    crs = None if given is None else file_crs(json.dumps(given) if isinstance(given, dict) else given, path)
    return _with_geometry(path, options, shapely.from_wkb(held.pop(name)), held, crs)


def _with_geometry(
    path: Path, options: PointOptions, geometry: NDArray[np.object_], columns: dict[str, NDArray[Any]], crs: CRS | None
) -> PointFile:
    """The points of features. columns : their attributes by name."""
    is_there = ~shapely.is_empty(geometry) & ~shapely.is_missing(geometry)
    if not is_there.any():
        raise InputError(f"{path} holds no points. Give a file with points.")
    if not (shapely.get_type_id(geometry[is_there]) == 0).all():
        kind = shapely.from_wkb(shapely.to_wkb(geometry[is_there][0])).geom_type
        raise InputError(f"{path} holds features of the kind {kind}, not points. Give points.")
    xyz = np.full((len(geometry), 3), np.nan)
    xyz[is_there] = shapely.get_coordinates(geometry[is_there], include_z=True)
    held = {name: column for name, column in columns.items() if name.lower() not in ("x", "y")}
    has_z = bool(np.isfinite(xyz[:, 2]).any()) and "z" not in options.columns
    if has_z:
        held = {name: column for name, column in held.items() if not _may_be_height(name)}
        held["z"] = xyz[:, 2]
    held |= {"x": xyz[:, 0], "y": xyz[:, 1]}
    asked = PointOptions(
        **{**vars(options), "columns": {k: v for k, v in options.columns.items() if k not in ("x", "y")}}
    )
    return _of_columns(path, asked, held, crs)


def _may_be_height(name: str) -> bool:
    return name.strip().lower() in ROLES["z"]


def _of_columns(path: Path, options: PointOptions, held: dict[str, NDArray[Any]], crs: CRS | None) -> PointFile:
    roles = columns_of(path, list(held), options.columns)
    taken = {role: held[name] for role, name in roles.items()}
    return _point_file(path, options, roles, taken, lambda row: f"feature {row + 1}", crs)


def _point_file(
    path: Path,
    options: PointOptions,
    roles: dict[str, str],
    taken: dict[str, Any],
    place: Callable[[int], str],
    crs: CRS | None,
) -> PointFile:
    """The points of columns. taken : values by role; place : of a row in the file, for messages."""
    if not len(taken["x"]):
        raise InputError(f"The {WHAT} {path} has a header and no points below it. Give one with points.")
    if crs is None and are_degrees(roles):
        crs = WGS84
    values = {
        role: _numbers(path, role, column, place) for role, column in taken.items() if role not in ("cover", "time")
    }
    xyz = np.column_stack([values[role] for role in NEEDED])
    n, unknown = len(xyz), np.full(len(xyz), np.nan)
    cover, cover_names = np.zeros(n, np.int64), dict[int, str]()
    if "cover" in taken:
        names, cover = np.unique(
            [cover_name(_text(value), roles["cover"]) for value in taken["cover"]], return_inverse=True
        )
        cover_names = dict(enumerate(map(str, names)))
    times = _times(path, taken["time"], place) if "time" in taken else unknown
    measured = np.column_stack([values.get(f"measured_{axis}", unknown) for axis in "xy"])
    sigma = values.get("sigma", unknown)
    points = KnownPoints(
        xyz, np.where(sigma > 0, sigma, np.nan), values.get("sigma_xy", unknown), times, measured, cover.ravel()
    )
    has_height = (xyz[:, 2] > MIN_HEIGHT_M) & (xyz[:, 2] < MAX_HEIGHT_M)
    # Tables of control points have a row for each image of a point.
    is_first = np.zeros(n, bool)
    is_first[np.unique(xyz, axis=0, return_index=True)[1]] = True
    if not has_height.any():
        raise InputError(f"None of the {n} points of {path} has a height in the column {roles['z']}. Check the file.")
    point_file = PointFile(
        path, options.given_crs() or crs, lambda _: _parts(points.where(has_height & is_first)), cover_names
    )
    point_file.leave_out(NO_HEIGHT, int(np.count_nonzero(~has_height)))
    point_file.leave_out(REPEATED, int(np.count_nonzero(has_height & ~is_first)))
    return point_file


def _parts(points: KnownPoints) -> Iterator[KnownPoints]:
    for first in range(0, len(points), ROWS_AT_A_TIME):
        yield points.where(np.arange(first, min(first + ROWS_AT_A_TIME, len(points))))


def _text(value: Any) -> str:
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) else str(value)


def _numbers(path: Path, role: str, column: Sequence[Any], place: Callable[[int], str]) -> FloatArray:
    """The numbers of a column, NaN where there is none; a place must have one."""
    if isinstance(column, np.ndarray) and column.dtype.kind in "iuf":
        numbers = column.astype(np.float64)
    else:
        numbers = np.empty(len(column))
        for row, value in enumerate(column):
            text = _text(value).strip()
            is_missing = text.lower() in MISSING
            numbers[row] = math.nan if is_missing else decimal(text)
            if not is_missing and math.isnan(numbers[row]):
                comma = " Write decimal points, not commas." if "," in text else ""
                raise InputError(
                    f"The {WHAT} {path}, {place(row)}: {role} is {quoted(text)}, which is no number. Mend it there."
                    f"{comma}"
                )
    if role in ("x", "y") and not np.isfinite(numbers).all():
        row = int(np.argmin(np.isfinite(numbers)))
        raise InputError(f"The {WHAT} {path}, {place(row)}: {role} is missing or not finite. Mend it there.")
    return numbers


def _times(path: Path, column: Sequence[Any], place: Callable[[int], str]) -> FloatArray:
    """Seconds (n,) since some time: numbers are seconds already, other texts are dates of ISO 8601."""
    if isinstance(column, np.ndarray) and column.dtype.kind == "M":
        return column.astype("datetime64[ms]").astype(np.float64) / 1e3
    if isinstance(column, np.ndarray) and column.dtype.kind in "iuf":
        return column.astype(np.float64)
    seconds = np.full(len(column), np.nan)
    for row, value in enumerate(column):
        text = _text(value).strip()
        if text.lower() in MISSING:
            continue
        try:
            when = datetime.fromisoformat(text) if not is_decimal(text) else None
        except ValueError as error:
            raise InputError(
                f"The {WHAT} {path}, {place(row)}: {quoted(text)} is no time. Write it as 2023-05-31T12:30:00, or as "
                "seconds."
            ) from error
        # A time without a zone is taken as UTC: only differences matter.
        seconds[row] = (
            decimal(text) if when is None else (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
        )
    return seconds
