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
