"""Open a file of points by the end of its name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.io.points.ground_points import PointFile, PointOptions

TEXTS = (".csv", ".txt", ".tsv")
VECTORS = (".gpkg", ".geojson", ".json", ".shp", ".fgb")
PARQUETS = (".parquet", ".geoparquet", ".pq")
CLOUDS = (".las", ".laz")  # COPC ends in .copc.laz
SUFFIXES = (*TEXTS, *VECTORS, *PARQUETS, *CLOUDS)


def are_points(paths: Sequence[Path]) -> bool:
    """Whether files hold points rather than a raster, by the end of their names.

    Raises
    ------
    ConfigError
        Several files are given, and one of them is a raster.
    """
    raster = next((path for path in paths if path.suffix.lower() not in SUFFIXES), None)
    if raster is not None and len(paths) > 1:
        raise ConfigError(
            f"{len(paths)} references are given, and {raster} is a raster. Give one raster, or clouds only."
        )
    return raster is None


def open_points(paths: Sequence[Path], options: PointOptions) -> PointFile:
    """Open a table of points, or one or more clouds.

    Raises
    ------
    InputError
        A file is missing, damaged, or is not understood.
    ConfigError
        A column that was named is not there, or there are several files that are not all clouds.
    """
    # Each is imported where it is needed: the libraries take up to 0.3 s.
    if all(path.suffix.lower() in CLOUDS for path in paths):
        from zlocus.io.points.laser_points import laser_points

        return laser_points(paths, options)
    if len(paths) > 1:
        table = next(path for path in paths if path.suffix.lower() not in CLOUDS)
        raise ConfigError(f"{len(paths)} references are given, and {table} is a table. Give one table, or clouds only.")
    (path,) = paths
    suffix = path.suffix.lower()
    from zlocus.io.points import point_tables

    if suffix in VECTORS:
        return point_tables.vector_table(path, options)
    if suffix in PARQUETS:
        return point_tables.parquet_table(path, options)
    return point_tables.text_table(path, options)
