"""Where a surface has heights: the outline of its cells, on the map and on the Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio import DatasetReader
from rasterio.features import shapes
from rasterio.warp import transform_geom
from shapely.geometry.polygon import orient

from zlocus.io.open_raster import open_raster
from zlocus.io.row_strips import STRIP_ROWS, BandReader, strips_of

WGS84 = "EPSG:4326"
# Cells are looked at in blocks, of which there are about as many along the longer side of the raster.
MIN_BLOCKS, MAX_BLOCKS = 512, 2048
# Shares of the longer side: gaps up to twice the first are closed, and corners up to the second are cut.
CLOSED_SHARE, CORNER_SHARE = 1 / 128, 1 / 256
# The longer side is cut into this many pieces, because straight sides on the map are curves in degrees.
PIECES_PER_SIDE = 64
# Coordinates are rounded to 1e-7 degrees, a centimetre on the ground.
DEGREE_DECIMALS = 7


class SurfaceFootprint(NamedTuple):
    """Outline of the cells that have a height.

    geometry : on the Earth, GeoJSON in degrees, counter-clockwise; bbox : its west, south, east and north, degrees; the
    west is larger than the east where it crosses the date line; on_map : GeoJSON in the horizontal CRS of the raster;
    map_bbox : smallest and largest easting and northing, as (xmin, ymin, xmax, ymax).
    """

    geometry: dict[str, Any]
    bbox: list[float]
    on_map: dict[str, Any]
    map_bbox: list[float]


def footprint_of(path: Path) -> SurfaceFootprint:
    """The outline of the cells of a raster that have a value, such as the heights of dsm.tif.

    All these cells lie inside; the outline is simplified, and narrow gaps are closed. Without any value it is that of
    the raster. An outline that crosses the date line is cut there. Source: RFC 7946, 3.1.6, 3.1.9 and 5.2.

    Raises
    ------
    InputError
        The raster is missing or damaged.
    """
    with open_raster(path, "raster") as file:
        factor = _overview_factor(file)
        if factor is not None:
            has_value = np.isfinite(_overview(file, factor))
        crs, transform, box = file.crs, file.transform, shapely.box(*file.bounds)
        rows, cols = file.shape
    if factor is None:
        factor = -(-max(rows, cols) // MAX_BLOCKS)
        has_value = _blocks_with_values(path, factor)
    outline = _outline(has_value, transform * Affine.scale(factor), box)
    long_m = max(outline.bounds[2] - outline.bounds[0], outline.bounds[3] - outline.bounds[1])
    pieces = shapely.segmentize(outline, long_m / PIECES_PER_SIDE)
    degrees = transform_geom(crs, WGS84, shapely.geometry.mapping(pieces), precision=DEGREE_DECIMALS)
    on_earth = _polygons(shapely.geometry.shape(degrees))
    return SurfaceFootprint(
        shapely.geometry.mapping(on_earth), _bbox(on_earth), shapely.geometry.mapping(outline), list(outline.bounds)
    )


def _overview_factor(file: DatasetReader) -> int | None:
    """Cells along a side of an overview's cell, of an overview of a useful size; None without one.

    Overviews of heights hold averages of the cells that have one, so none of these is lost.
    """
    side = max(file.shape)
    useful = [factor for factor in file.overviews(1) if MIN_BLOCKS <= side / factor <= MAX_BLOCKS]
    return max(useful, default=None)


def _overview(file: DatasetReader, factor: int) -> NDArray[np.float32]:
    shape = tuple(-(-size // factor) for size in file.shape)
    return np.asarray(file.read(1, out_shape=shape, masked=True).astype(np.float32).filled(np.nan))


def _blocks_with_values(path: Path, side: int) -> NDArray[np.bool_]:
    """Which blocks of cells have a value in one at least, (r, c) bool. side : of a block, in cells."""
    with BandReader(path) as reader:
        rows, cols = reader.geobox.shape
        has_value = np.zeros((-(-rows // side), -(-cols // side)), np.bool_)
        for strip in strips_of(rows, 0, max(STRIP_ROWS // side, 1) * side):
            found = np.isfinite(reader.read(strip))
            found = np.logical_or.reduceat(found, np.arange(0, cols, side), axis=1)
            found = np.logical_or.reduceat(found, np.arange(0, strip.rows, side), axis=0)
            has_value[strip.row // side : strip.row // side + len(found)] = found
    return has_value


def _outline(has_value: NDArray[np.bool_], transform: Affine, box: Any) -> Any:
    """Simplified outline of blocks, a shapely geometry. transform : of the blocks; box : of the raster."""
    if not has_value.any():
        return orient(box)
    side = max(has_value.shape)
    reach = round(side * CLOSED_SHARE)
    padded = np.pad(has_value.astype(np.uint8), reach)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    inner = closed[reach : reach + has_value.shape[0], reach : reach + has_value.shape[1]]
    parts = [shapely.geometry.shape(part) for part, _ in shapes(inner, mask=inner > 0, transform=transform)]
    # A margin as wide as what is cut off, so that no cell is.
    corner_m = side * CORNER_SHARE * transform.a
    wider = shapely.union_all(shapely.buffer(parts, corner_m, join_style="mitre"))
    return _polygons(shapely.intersection(shapely.simplify(wider, corner_m), box))


def _polygons(geometry: Any) -> Any:
    """The valid polygons of a geometry, each counter-clockwise: a polygon, or several."""
    valid = geometry if geometry.is_valid else shapely.make_valid(geometry)
    parts = [orient(part) for part in shapely.get_parts(valid).tolist() if part.geom_type == "Polygon"]
    for part in shapely.get_parts(valid).tolist():
        if part.geom_type == "MultiPolygon":
            parts += [orient(each) for each in part.geoms]
    return parts[0] if len(parts) == 1 else shapely.multipolygons(parts)


def _bbox(geometry: Any) -> list[float]:
    """West, south, east and north of polygons on the Earth, degrees: what lies between them is the smallest box."""
    bounds = shapely.bounds(shapely.get_parts(geometry))
    bounds = bounds[np.argsort(bounds[:, 0])]
    east_so_far = np.maximum.accumulate(bounds[:, 2])
    # The widest gap between parts, going east from each of them; behind the last one it reaches over the date line.
    gaps = np.append(bounds[1:, 0], bounds[0, 0] + 360.0) - east_so_far
    widest = int(np.argmax(gaps)) if gaps.max() > gaps[-1] else len(gaps) - 1
    west, east = bounds[(widest + 1) % len(bounds), 0], east_so_far[widest]
    return [float(west), float(bounds[:, 1].min()), float(east), float(bounds[:, 3].max())]
