"""Resampling between grids of one frame: planes stay planes, means of larger cells, and missing values."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from odc.geo.geobox import GeoBox
from rasterio.warp import Resampling, reproject

from zlocus.io.axis_resampling import resampled

SOURCE = Affine(1.0, 0.0, 100.0, 0.0, -1.0, 200.0)


def plane(shape=(30, 40)):
    row, col = np.indices(shape) + 0.5
    return (3.0 + 0.5 * (100.0 + col) - 0.25 * (200.0 - row)).astype(np.float32)


@pytest.mark.parametrize("cell", [0.3, 1.0, 2.5])
def test_a_plane_stays_a_plane(cell):
    geobox = GeoBox((8, 9), Affine(cell, 0.0, 103.17, 0.0, -cell, 196.3), "EPSG:32632")
    row, col = np.indices((8, 9)) + 0.5
    expected = 3.0 + 0.5 * (103.17 + cell * col) - 0.25 * (196.3 - cell * row)
    assert resampled(plane(), SOURCE, geobox) == pytest.approx(expected, abs=0.004)


@pytest.mark.parametrize("cell", [0.7, 1.0, 3.0])
def test_gdal_says_the_same(cell):
    rough = np.random.default_rng(2).normal(size=(60, 60)).astype(np.float32)
    geobox = GeoBox((10, 10), Affine(cell, 0.0, 112.4, 0.0, -cell, 187.8), "EPSG:32632")
    expected = np.full((10, 10), np.nan, np.float32)
    reproject(
        rough, expected, src_transform=SOURCE, src_crs="EPSG:32632", dst_transform=geobox.transform,
        dst_crs="EPSG:32632", src_nodata=np.nan, dst_nodata=np.nan, resampling=Resampling.bilinear,
    )  # fmt: skip
    assert resampled(rough, SOURCE, geobox) == pytest.approx(expected, abs=2e-3)


def test_missing_values_spread_by_less_than_a_cell():
    values = plane()
    values[10:20, 10:20] = np.nan
    same = GeoBox(values.shape, SOURCE, "EPSG:32632")
    found = resampled(values, SOURCE, same)
    assert (np.isnan(found) == np.isnan(values)).all()
    assert found[0, 0] == pytest.approx(values[0, 0])


def test_beyond_the_grid_there_is_nothing():
    beside = GeoBox((4, 4), Affine(1.0, 0.0, 50.0, 0.0, -1.0, 200.0), "EPSG:32632")
    assert np.isnan(resampled(plane(), SOURCE, beside)).all()
