"""Rasters that evaluations are tested on: rolling ground whose height is known everywhere."""

from __future__ import annotations

import numpy as np
import rasterio
from rasterio.transform import from_origin

CRS = "EPSG:32632"
WEST, NORTH = 500000.0, 5200000.0
CELL_M = 0.5


def write(path, z, transform=None, crs=CRS, nodata=None):
    """A one-band raster, of half-metre cells unless said."""
    transform = transform or from_origin(WEST, NORTH, CELL_M, CELL_M)
    profile = {"driver": "GTiff", "height": z.shape[0], "width": z.shape[1], "count": 1, "dtype": z.dtype}
    with rasterio.open(path, "w", crs=crs, transform=transform, nodata=nodata, **profile) as sink:
        sink.write(z, 1)
    return path


def grid(n, step=CELL_M):
    """x, y of n x n cell centres, m east and south of the corner."""
    at = (np.arange(n) + 0.5) * step
    return np.meshgrid(at, at)


def rolling(x, y):
    """Ground of slopes up to some 40 degrees in all directions, m, at x east and y south of the corner, m."""
    return 100 + 6 * np.sin(x / 17) + 5 * np.cos(y / 15) + 3 * np.sin((x + 2 * y) / 40)


def moved(path, n, shift, z_of=rolling, change=lambda z: z):
    """The ground n x n cells wide, laid `shift` (east, north, up) m beside where it is; `change` may spoil it."""
    east, north, up = shift
    z = change(z_of(*grid(n)) + up).astype(np.float32)
    return write(path, z, from_origin(WEST + east, NORTH + north, CELL_M, CELL_M))
