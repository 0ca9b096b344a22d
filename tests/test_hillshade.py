"""hillshade.tif of planes and cones, worked out by hand, and of surfaces with holes."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox
from rio_cogeo.cogeo import cog_validate

from zlocus.io.raster import write_cog
from zlocus.options import ProductOptions
from zlocus.products.hillshade import hillshade, horn_gradient, write_hillshade

CELL_M = 0.5
SLOPE = 1e-9  # a ratio; rounding of float64 heights of 100 m over half a metre
RNG = np.random.default_rng(7)


def plane(rows, cols, east, north):
    row, col = np.mgrid[:rows, :cols]
    return 100.0 + CELL_M * (east * col - north * row)


def test_level_ground():
    # 1 + 254 sin 45 degrees = 180.6
    assert (hillshade(np.full((5, 6), 7, np.float32), CELL_M, 315, 45) == 181).all()


@pytest.mark.parametrize(
    ("east", "north", "shade"),
    [
        (1.0, 0.0, 218),  # turned west by 45 degrees: cos = (sin 45 + 0.5) / sqrt 2 = 0.85355
        (-1.0, 0.0, 38),  # turned east: (sin 45 - 0.5) / sqrt 2 = 0.14645
        (0.0, -1.0, 218),  # turned north
        (0.0, 1.0, 38),  # turned south
        (math.sqrt(0.5), -math.sqrt(0.5), 255),  # straight at the sun
        (-3.0, 3.0, 1),  # steeply away from it
    ],
)
def test_planes_by_hand(east, north, shade):
    assert (hillshade(plane(6, 7, east, north), CELL_M, 315, 45) == shade).all()


def test_the_sun_of_the_options():
    west = plane(6, 7, 0.5, 0.0)
    # The normal is (-0.5, 0, 1) / sqrt 1.25; the sun in the west at 30 degrees is (-cos 30, 0, sin 30).
    cosine = (0.5 * math.cos(math.radians(30)) + 0.5) / math.sqrt(1.25)
    assert (hillshade(west, CELL_M, 270, 30) == round(1 + 254 * cosine)).all()
    assert (hillshade(west, CELL_M, 0, 90) == round(1 + 254 / math.sqrt(1.25))).all()


def test_a_cone_is_brightest_towards_the_sun():
    row, col = np.mgrid[-40:41, -40:41]
    cone = -np.hypot(row, col) * CELL_M
    shade = hillshade(cone, CELL_M, 315, 45).astype(int)
    # Slope 1 everywhere: straight at the sun at 45 degrees north-west, straight away in the south-east, and across.
    assert shade[10, 10] == 255
    assert shade[70, 70] == 1
    assert abs(shade[10, 70] - (1 + 254 * 0.5)) <= 1
    # At the tip the eight neighbours cancel.
    assert shade[40, 40] == 181


@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 2**32 - 1))
def test_planes_keep_their_slope_beside_holes(east, north, seed):
    z = plane(9, 11, east, north)
    holes = np.random.default_rng(seed).random(z.shape) < 0.3
    found = horn_gradient(np.where(holes, np.nan, z), CELL_M)
    known = np.pad(~holes, 1)
    pairs = [
        known[1 + r : 10 + r, 1 + c : 12 + c] | known[1 - r : 10 - r, 1 - c : 12 - c]
        for r, c in ((0, 1), (1, 0), (1, 1), (-1, 1))
    ]
    told = ~holes & (np.sum(pairs, axis=0) >= 2)
    assert told.any()
    np.testing.assert_allclose(found[0][told], east, atol=SLOPE)
    np.testing.assert_allclose(found[1][told], north, atol=SLOPE)
    assert np.isnan(found[0][holes]).all()


def test_a_lone_cell_is_level():
    z = np.full((3, 3), np.nan)
    z[1, 1] = 5.0
    assert hillshade(z, CELL_M, 315, 45)[1, 1] == 181


@pytest.fixture
def dsm(tmp_path):
    rows, cols = 700, 90
    z = RNG.normal(100, 0.3, (rows, cols)).astype(np.float32)
    z[RNG.random(z.shape) < 0.1] = np.nan
    z[500:530, 20:60] = np.nan
    write_cog(tmp_path / "dsm.tif", z, GeoBox(z.shape, Affine(CELL_M, 0, 500000, 0, -CELL_M, 4000000), "EPSG:32632"),
              nodata=np.nan)  # fmt: skip
    return tmp_path / "dsm.tif", z


def test_strips_leave_no_seam(dsm):
    path, z = dsm
    folder = path.parent
    write_hillshade(path, folder / "hillshade.tif", ProductOptions())
    with rasterio.open(folder / "hillshade.tif") as file:
        np.testing.assert_array_equal(file.read(1), hillshade(z, CELL_M, 315, 45))
        assert (file.nodata, file.dtypes, file.descriptions) == (0, ("uint8",), ("hillshade",))
        np.testing.assert_array_equal(file.read(1) == 0, np.isnan(z))
        assert "STATISTICS_MEAN" in file.tags(1)
    for rows in (1, 77, 10000):
        write_hillshade(path, folder / "other.tif", ProductOptions(), rows)
        assert (folder / "other.tif").read_bytes() == (folder / "hillshade.tif").read_bytes()
    assert cog_validate(folder / "hillshade.tif", strict=True) == (True, [], [])
    assert sorted(os.listdir(folder)) == ["dsm.tif", "hillshade.tif", "other.tif"]
