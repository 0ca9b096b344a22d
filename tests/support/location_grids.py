"""Location grids of analytic sensors, and the files that they come in."""

from __future__ import annotations

import warnings

import numpy as np
import rasterio
from pyproj import CRS, Transformer
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from zlocus.sensors.location_grid import LocationGrid

WGS84 = CRS.from_epsg(4326)


def grid_of(sensor, crs, heights, first_node, step, shape):
    """The location grid of a sensor model in `crs`, in longitudes and latitudes. shape : rows and columns of nodes."""
    z, row, col = np.meshgrid(heights, np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    places = np.column_stack([col.ravel(), row.ravel()]) * step + first_node
    xyz = sensor.ground_from_image(places, z.ravel())
    lon, lat = Transformer.from_crs(crs, WGS84, always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    xy = np.stack([lon, lat], axis=-1).reshape(len(heights), *shape, 2)
    return LocationGrid(np.array(heights, float), xy, first_node, step, WGS84)


def written(path, location_grid, prefix="", status=None, leave_out=(), compress=None, **changed):
    """The GeoTIFF of a location grid, as shareloc has it.

    prefix : of the tags, "LG_" as libGEO writes them; status : (h, r, c) of the nodes; leave_out : tags; compress : of
    the file; changed : tags with other values.
    """
    fields = ("lon", "lat") if status is None else ("lon", "lat", "status")
    stacks = [location_grid.xy[..., 0], location_grid.xy[..., 1], *([] if status is None else [status])]
    values = np.stack(stacks, axis=1).reshape(-1, *location_grid.xy.shape[1:3])
    tags = {"REF": "EPSG:4326"}
    for band in range(len(values)):
        tags[f"ALTITUDE_B{band}"] = f"{location_grid.heights[band // len(fields)]:g}"
        tags |= {f"FIELD_B{band}": fields[band % len(fields)]} if prefix else {}
    tags = {f"{prefix}{key}": value for key, value in (tags | changed).items() if key not in leave_out}
    (column, row), (across, down) = location_grid.first_node, location_grid.step
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path, "w", driver="GTiff", compress=compress, dtype=values.dtype, count=len(values), height=values.shape[1],
            width=values.shape[2], transform=Affine(across, 0, column + 0.5, 0, down, row + 0.5),
        ) as file:  # fmt: skip
            file.write(values)
            file.update_tags(ns="GTiff" if prefix else None, **tags)
    return path
