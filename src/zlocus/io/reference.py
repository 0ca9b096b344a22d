"""What a run is given besides images: the grid of another raster, a DEM, polygons of an area."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from rasterio.enums import Resampling
from rasterio.features import rasterize
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window

from zlocus.errors import InputError, ZlocusWarning
from zlocus.io.crs import checked_crs, is_on_earth
from zlocus.io.opening import existing_file, open_raster
from zlocus.io.text import shown

# Polygon edges are straight in the CRS of their file: this many pieces per extent keep them so in another one.
EDGE_PIECES = 200
# No extent on the Earth, in any unit, is larger.
FARTHEST = 1e9


def read_geobox(path: Path) -> GeoBox:
    """The grid of a raster (for `--like`): CRS, transform and shape, never heights.

    Raises
    ------
    InputError
        For a raster without CRS, or one that is not north-up.
    ConfigError
        For a CRS that is not projected in metres.
    """
    with open_raster(path, "raster") as source:
        crs = _crs(source, path)
        transform = source.transform
        if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
            raise InputError(f"{path} is rotated or not north-up, so it cannot be the grid. Warp it first (gdalwarp).")
        return GeoBox(source.shape, transform, checked_crs(crs).to_string())


def read_dem(path: Path, geobox: GeoBox, geoid: Path | None = None) -> NDArray[np.float32]:
    """Heights of a DEM at the cell centres of a grid, bilinear. (r, c) float32 m, NaN where the DEM has none.

    The DEM's heights are taken as ellipsoidal. geoid : a raster of undulations (m) that is added to them, for a DEM
    above a geoid.

    Raises
    ------
    InputError
        For a file that is no DEM (no CRS, heights not in metres) or covers no cell of the grid.
    """
    with open_raster(path, "DEM") as source:
        crs = _crs(source, path)
        _check_vertical(crs, path, geoid)
        heights = _resampled(source, geobox)
    if not np.isfinite(heights).any():
        raise InputError(
            f"The DEM {path} has no height anywhere on the grid ({_extent(geobox)}). Give one that covers it."
        )
    return heights if geoid is None else heights + read_dem(geoid, geobox)


def read_polygons(path: Path, crs: CRS) -> NDArray[Any]:
    """The polygons of a vector file (GeoJSON, GeoPackage, Shapefile...) in another CRS. (n,) of shapely's.

    Raises
    ------
    InputError
        For a file that is no vector file, has several layers, no CRS, or anything but polygons.
    """
    # pyogrio brings pandas, a third of a second that only runs with polygons need.
    import pyogrio.raw

    path = existing_file(path, "vector file")
    try:
        layers = pyogrio.list_layers(path)[:, 0]
        if len(layers) != 1:
            raise InputError(
                f"{path} has {len(layers)} layers ({', '.join(layers)}). Give a file with one layer of polygons."
            )
        with warnings.catch_warnings():
            # What they warn of, rings that are not closed or numbers that are not finite, is refused.
            warnings.simplefilter("ignore", RuntimeWarning)
            meta, _, wkb, _ = pyogrio.raw.read(path, columns=[], force_2d=True)
            polygons = shapely.from_wkb(wkb)
    except (RuntimeError, ValueError, shapely.errors.GEOSException) as error:  # pyogrio's own are of these kinds
        why = "some text in it is not UTF-8" if isinstance(error, UnicodeError) else " ".join(str(error).split())
        raise InputError(
            f"{path} cannot be read as vector file: {why}. Give GeoJSON, GeoPackage or Shapefile."
        ) from error
    polygons = polygons[~shapely.is_empty(polygons) & ~shapely.is_missing(polygons)]
    if not len(polygons) or not np.isin(shapely.get_type_id(polygons), (3, 6)).all():
        raise InputError(f"{path} holds {meta['geometry_type']} features, not polygons. Give polygons.")
    if meta["crs"] is None:
        raise InputError(f"{path} has no CRS. Add it (a .prj file for a Shapefile).")
    west, south, east, north = shapely.total_bounds(polygons)
    largest = max(east - west, north - south)
    if not (0 < largest < FARTHEST and np.isfinite(shapely.get_coordinates(polygons)).all()):
        raise InputError(
            f"{path} has polygons from {west:g}, {south:g} to {east:g}, {north:g}, or without an end, which is no area."
        )
    polygons = shapely.segmentize(polygons, largest / EDGE_PIECES)
    transformer = Transformer.from_crs(_known_crs(meta["crs"], path).to_2d(), crs.to_2d(), always_xy=True)
    return np.asarray(shapely.transform(polygons, lambda xy: np.column_stack(transformer.transform(*xy.T))))


def cells_inside(polygons: NDArray[Any], geobox: GeoBox) -> NDArray[np.bool_]:
    """Which cells have their centre inside a polygon. (n,) polygons in the grid's CRS -> (r, c) bool."""
    inside = rasterize(polygons, out_shape=tuple(geobox.shape), transform=geobox.transform, dtype="uint8")
    return np.asarray(inside, bool)


def read_area(path: Path, geobox: GeoBox) -> NDArray[np.bool_]:
    """Which cells of a grid have their centre inside the polygons of a vector file; may be none. (r, c) bool.

    Raises
    ------
    InputError
        See `read_polygons`.
    """
    return cells_inside(read_polygons(path, _grid_crs(geobox)), geobox)


def _crs(source: rasterio.DatasetReader, path: Path) -> CRS:
    if source.crs is None:
        raise InputError(f"{path} has no CRS, so its place on the ground is unknown. Assign one (gdal_edit -a_srs).")
    return _known_crs(source.crs, path)


def _known_crs(given: Any, path: Path) -> CRS:
    try:
        crs = CRS.from_user_input(given)
    except CRSError as error:
        raise InputError(
            f"{path} has a CRS that PROJ does not know: {error}. Assign one (gdal_edit -a_srs)."
        ) from error
    if not is_on_earth(crs):
        raise InputError(
            f"{path} has the CRS {shown(crs.name)}, which cannot be converted to places on the Earth. Assign another."
        )
    return crs


def _grid_crs(geobox: GeoBox) -> CRS:
    assert geobox.crs is not None, "the grid of a run has a CRS"
    return geobox.crs.proj


def _check_vertical(crs: CRS, path: Path, geoid: Path | None) -> None:
    """Refuse heights that are not in metres; warn where the file says that they are above a geoid and none is given."""
    vertical = [part for part in crs.sub_crs_list if part.is_vertical]
    if not vertical:
        return
    if abs(vertical[0].axis_info[0].unit_conversion_factor - 1.0) > 1e-9:
        raise InputError(f"The heights of {path} are in {vertical[0].axis_info[0].unit_name}. Convert them to metres.")
    if geoid is None:
        warnings.warn(
            f"{path} has {vertical[0].name} heights by its CRS, but they are taken as ellipsoidal. Give a geoid.",
            ZlocusWarning,
            stacklevel=3,
        )


def _resampled(source: rasterio.DatasetReader, geobox: GeoBox) -> NDArray[np.float32]:
    """The first band on a grid, reading only the part under it. (r, c) float32, NaN where there is nothing."""
    out = np.full(tuple(geobox.shape), np.nan, np.float32)
    bounds = transform_bounds(_grid_crs(geobox).to_wkt(), source.crs, *geobox.boundingbox.bbox)
    corners = [~source.transform * (x, y) for x in bounds[::2] for y in bounds[1::2]]
    # Two cells more on each side, for the bilinear neighbours.
    low = np.clip(np.floor(np.min(corners, axis=0)).astype(int) - 2, 0, (source.width, source.height))
    high = np.clip(np.ceil(np.max(corners, axis=0)).astype(int) + 2, 0, (source.width, source.height))
    if (high <= low).any():
        return out
    window = Window(low[0], low[1], high[0] - low[0], high[1] - low[1])
    heights = source.read(1, window=window, masked=True, out_dtype=np.float32).filled(np.nan)
    reproject(
        heights, out, src_transform=source.window_transform(window), src_crs=source.crs, src_nodata=np.nan,
        dst_transform=geobox.transform, dst_crs=_grid_crs(geobox).to_wkt(), dst_nodata=np.nan,
        resampling=Resampling.bilinear,
    )  # fmt: skip
    return out


def _extent(geobox: GeoBox) -> str:
    xmin, ymin, xmax, ymax = geobox.boundingbox.bbox
    return f"E {xmin:.0f} to {xmax:.0f} m, N {ymin:.0f} to {ymax:.0f} m"
