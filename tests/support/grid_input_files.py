"""Small rasters and polygon files as inputs of a run beside its images."""

from __future__ import annotations

import numpy as np
import rasterio
import shapely
from pyogrio.raw import write as write_vector


def write_raster(path, cells, transform, crs, **profile):
    with rasterio.open(
        path, "w", driver="GTiff", height=cells.shape[0], width=cells.shape[1], count=1, dtype=cells.dtype,
        transform=transform, crs=crs, **profile,
    ) as file:  # fmt: skip
        file.write(cells, 1)
    return path


def write_polygons(path, polygons, crs="EPSG:32631", geometry_type="Polygon", **options):
    write_vector(path, shapely.to_wkb(np.atleast_1d(polygons)), [], [], geometry_type=geometry_type, crs=crs, **options)
    return path


def write_water(path, polygons, crs="EPSG:32632", **attributes):
    """Polygons with attributes: of each a list with a value for every polygon, None where it is empty."""
    values, masks = [], []
    for column in attributes.values():
        is_text = any(isinstance(value, str) for value in column)
        masks.append(np.array([value is None for value in column]))
        values.append(np.array(["" if v is None else str(v) for v in column], object) if is_text
                      else np.array([np.nan if v is None else v for v in column], np.float64))  # fmt: skip
    kind = "MultiPolygon" if any(polygon.geom_type == "MultiPolygon" for polygon in polygons) else "Polygon"
    write_vector(
        path, shapely.to_wkb(np.array(polygons, object)), values, list(attributes), field_mask=masks or None,
        geometry_type=kind, crs=crs,
    )  # fmt: skip
    return path
