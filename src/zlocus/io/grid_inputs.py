"""Read the inputs of a run other than images: the grid of another raster, a DEM, polygons of an area."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from rasterio.features import rasterize
from rasterio.features import shapes as features_of
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window

from zlocus.core.errors import ConfigError, InputError
from zlocus.io.crs import checked_crs, file_crs, raster_crs
from zlocus.io.height_values import check_unit, is_fill
from zlocus.io.open_raster import open_raster
from zlocus.io.vector_files import check_degrees, read_vector
from zlocus.io.vertical import (
    ELLIPSOIDAL_DESCRIPTION,
    VerticalDatum,
    check_heights,
    declared_vertical_datum,
    grid_crs,
    named_vertical_datum,
    vertical_part,
)

# Polygon edges are straight in the CRS of their file. Before a conversion each is cut into pieces of at most this
# fraction of the extent, so that they keep their course.
MIN_PIECES_PER_EXTENT = 200
# Largest extent on the Earth, in any unit of a CRS.
MAX_EXTENT = 1e9


def read_geobox(path: Path) -> GeoBox:
    """The grid of a raster (for `--like`): CRS, transform and shape, never heights.

    Raises
    ------
    InputError
        The raster has no CRS, or is not north-up.
    ConfigError
        Its CRS is not projected in metres.
    """
    with open_raster(path, "raster") as source:
        crs = raster_crs(source, path)
        transform = source.transform
        if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
            raise InputError(f"{path} is rotated or not north-up, so it cannot be the grid. Warp it first (gdalwarp).")
        try:
            return GeoBox(source.shape, transform, checked_crs(crs).to_string())
        except ConfigError as error:
            raise ConfigError(f"No surface lies on the grid of {path}. {error}") from error


def read_dem(
    path: Path, geobox: GeoBox, vertical_datum: VerticalDatum | None = None, may_miss: bool = False
) -> NDArray[np.float32]:
    """Ellipsoidal heights of a DEM at the cell centres of a grid, bilinear. (r, c) float32 m, NaN where it has none.

    vertical_datum : datum of the DEM's heights; None: the one that its CRS declares, see `dem_datum`. may_miss : the
    DEM may have no height anywhere on the grid.

    Raises
    ------
    InputError
        The file is no DEM (no CRS, heights not in metres), it covers no cell of the grid, its vertical datum is not
        known, or the geoid does not cover the DEM's part of the grid.
    ConfigError
        PROJ's grid of the geoid is not installed.
    """
    with open_raster(path, "DEM") as source:
        crs = raster_crs(source, path)
        check_heights(crs, path)
        check_unit(source.units[0], path)
        heights = _resampled(source, crs.to_2d(), geobox)
    if not (np.isfinite(heights).any() or may_miss):
        raise InputError(
            f"The DEM {path} has no height anywhere on the grid ({_extent(geobox)}). Give one that covers it."
        )
    return (vertical_datum or dem_datum(path)).ellipsoidal_from_heights(heights, geobox)


def dem_datum(path: Path, given: str | None = None) -> VerticalDatum:
    """The vertical datum of a DEM: the one that `given` names (see `named_vertical_datum`), else that of its CRS.

    Raises
    ------
    InputError, ConfigError
        See `named_vertical_datum` and `declared_vertical_datum`.
    """
    if given is not None:
        return named_vertical_datum(given, "--dem-vertical")
    with open_raster(path, "DEM") as source:
        return declared_vertical_datum(raster_crs(source, path), path, "--dem-vertical")


def lacks_vertical_datum(path: Path) -> bool:
    """Whether a DEM declares no vertical datum: neither in its CRS nor, as surfaces of zlocus do, in its band."""
    with open_raster(path, "DEM") as source:
        crs, description = raster_crs(source, path), source.descriptions[0]
    return vertical_part(crs) is None and len(crs.axis_info) < 3 and description != ELLIPSOIDAL_DESCRIPTION


@dataclass(frozen=True)
class PolygonFeatures:
    """Polygons of a vector file with one of their attributes.

    polygons : (n,) shapely polygons and multipolygons in a CRS; numbers : (n,) int64, place of each in the file, from
    1; values : (n,) of the attribute as the file holds it; None where none was asked for.
    """

    polygons: NDArray[Any]
    numbers: NDArray[np.int64]
    values: NDArray[Any] | None


def read_polygons(path: Path, crs: CRS) -> NDArray[Any]:
    """The polygons of a vector file (GeoJSON, GeoPackage, Shapefile...), converted to a CRS. (n,) shapely polygons.

    Raises
    ------
    InputError
        See `read_features`.
    """
    return read_features(path, crs).polygons


def read_features(path: Path, crs: CRS, field: str | None = None) -> PolygonFeatures:
    """The polygons of a vector file (GeoJSON, GeoPackage, Shapefile...), converted to a CRS, with one attribute.

    field : name of the attribute; None: of none.

    Raises
    ------
    InputError
        The file is no vector file, refers to other files, is an archive, has several layers or no CRS, or holds
        anything but polygons; or its polygons have no such attribute.
    """
    found = read_vector(path, field=field)
    if found.crs is None:
        raise InputError(f"{path} has no CRS. Add it (a .prj file for a Shapefile).")
    converted = _converted(found.polygons, path, file_crs(found.crs, path), crs)
    return PolygonFeatures(converted, found.numbers, found.values)


def _converted(polygons: NDArray[Any], path: Path, own_crs: CRS, crs: CRS) -> NDArray[Any]:
    """Polygons (n,) of a file in another CRS, whose edges keep their course. own_crs : of the file.

    Raises
    ------
    InputError
        A coordinate is not finite, is no longitude or latitude in a geographic CRS, or cannot be converted; or the
        polygons have no area.
    """
    with np.errstate(invalid="ignore"):  # coordinates that are not finite are refused below
        west, south, east, north = shapely.total_bounds(polygons)
    largest = max(east - west, north - south)
    if not (0 < largest < MAX_EXTENT and np.isfinite(shapely.get_coordinates(polygons)).all()):
        raise InputError(
            f"{path} has polygons from {west:g}, {south:g} to {east:g}, {north:g}, or without an end, which is no area."
        )
    check_degrees(polygons, own_crs, path)
    polygons = shapely.segmentize(polygons, largest / MIN_PIECES_PER_EXTENT)
    transformer = Transformer.from_crs(own_crs.to_2d(), crs.to_2d(), always_xy=True)
    converted = np.asarray(shapely.transform(polygons, lambda xy: np.column_stack(transformer.transform(*xy.T))))
    if not np.isfinite(shapely.get_coordinates(converted)).all():
        raise InputError(
            f"{path} has polygons from {west:g}, {south:g} to {east:g}, {north:g}, which {own_crs.name} does not "
            "reach. Check its CRS."
        )
    return converted


def cells_inside(polygons: NDArray[Any], geobox: GeoBox) -> NDArray[np.bool_]:
    """Which cells have their centre inside a polygon, (r, c) bool. polygons : (n,) in the grid's CRS."""
    inside = rasterize(polygons, out_shape=tuple(geobox.shape), transform=geobox.transform, dtype="uint8")
    return np.asarray(inside, bool)


def cells_of_each(polygons: NDArray[Any], numbers: NDArray[np.int64], geobox: GeoBox) -> NDArray[np.int32]:
    """Number of the polygon that holds the centre of each cell, (r, c) int32; the last of several, 0 where none does.

    polygons : (n,) in the grid's CRS; numbers : (n,) from 1.
    """
    shape = tuple(geobox.shape)
    if not len(polygons):
        return np.zeros(shape, np.int32)
    shapes = zip(polygons, numbers.tolist(), strict=True)
    return np.asarray(rasterize(shapes, out_shape=shape, transform=geobox.transform, dtype="int32"))


def outline_of(is_inside: NDArray[np.bool_], geobox: GeoBox) -> Any:
    """The polygon around connected cells, in the CRS of the grid. is_inside : (r, c) bool, at least one; geobox : of
    these cells."""
    ((outline, _),) = features_of(is_inside.astype(np.uint8), mask=is_inside, transform=geobox.transform)
    return shapely.geometry.shape(outline)


def _resampled(source: rasterio.DatasetReader, crs: CRS, geobox: GeoBox) -> NDArray[np.float32]:
    """The first band, resampled to a grid, (r, c) float32; NaN where there is no value. Reads only the part it needs.

    crs : horizontal CRS of the raster, because GDAL would try to convert heights.
    """
    out = np.full(tuple(geobox.shape), np.nan, np.float32)
    bounds = transform_bounds(grid_crs(geobox).to_wkt(), crs.to_wkt(), *geobox.boundingbox.bbox)
    if not np.isfinite(bounds).all():
        return out
    corners = [~source.transform * (x, y) for x in bounds[::2] for y in bounds[1::2]]
    # Two more cells on each side are read, for bilinear interpolation.
    low = np.clip(np.floor(np.min(corners, axis=0)).astype(int) - 2, 0, (source.width, source.height))
    high = np.clip(np.ceil(np.max(corners, axis=0)).astype(int) + 2, 0, (source.width, source.height))
    if (high <= low).any():
        return out
    window = Window(low[0], low[1], high[0] - low[0], high[1] - low[1])
    stored = source.read(1, window=window, masked=True, out_dtype=np.float64).filled(np.nan)
    stored[is_fill(stored)] = np.nan
    heights = (stored * source.scales[0] + source.offsets[0]).astype(np.float32)
    reproject(
        heights, out, src_transform=source.window_transform(window), src_crs=crs.to_wkt(), src_nodata=np.nan,
        dst_transform=geobox.transform, dst_crs=grid_crs(geobox).to_wkt(), dst_nodata=np.nan,
        resampling=Resampling.bilinear,
    )  # fmt: skip
    return out


def _extent(geobox: GeoBox) -> str:
    xmin, ymin, xmax, ymax = geobox.boundingbox.bbox
    return f"E {xmin:.0f} to {xmax:.0f} m, N {ymin:.0f} to {ymax:.0f} m"
