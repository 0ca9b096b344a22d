"""A raster of heights: interpolation between cells is that of the plain formula."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rasterio.transform import from_origin

from zlocus.evaluation.heights import HeightRaster


def plainly_between(raster, x, y):
    """Height between four cell centres, or that of the cell where one of the four has none, at one place."""
    col, row = ~raster.transform * (x, y)
    rows, cols = raster.z.shape
    top, left = int(np.floor(row - 0.5)), int(np.floor(col - 0.5))
    between = np.nan
    if 0 <= top < rows - 1 and 0 <= left < cols - 1:
        down, right = row - 0.5 - top, col - 0.5 - left
        (a, b), (c, d) = raster.z[top : top + 2, left : left + 2]
        between = (a * (1 - right) + b * right) * (1 - down) + (c * (1 - right) + d * right) * down
    if np.isfinite(between):
        return between
    row, col = int(np.floor(row)), int(np.floor(col))
    return raster.z[row, col] if 0 <= row < rows and 0 <= col < cols else np.nan


def test_interpolated_heights_are_those_of_the_plain_formula():
    rng = np.random.default_rng(2)
    z = rng.normal(100, 10, (13, 17))
    z[rng.random(z.shape) < 0.1] = np.nan
    raster = HeightRaster(Path("z.tif"), z, from_origin(0, 13, 1, 1), None)
    xy = np.column_stack([rng.uniform(-2, 19, 3000), rng.uniform(-2, 15, 3000)])
    np.testing.assert_allclose(raster.bilinear(xy), [plainly_between(raster, *at) for at in xy], rtol=1e-12)


def test_the_filled_cells_are_the_rows_and_columns_with_heights():
    z = np.full((5, 7), np.nan)
    assert HeightRaster(Path("z.tif"), z.copy(), from_origin(0, 5, 1, 1), None).filled_cells is None
    z[1, 2] = z[3, 5] = 1.0
    assert HeightRaster(Path("z.tif"), z, from_origin(0, 5, 1, 1), None).filled_cells == ((1, 3), (2, 5))
