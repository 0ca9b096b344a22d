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

from zlocus.core.options import ProductOptions
from zlocus.io.rasters import write_cog
from zlocus.products.hillshade import hillshade, write_hillshade
from zlocus.products.shade_kernel import horn_slopes

CELL_M = 0.5
SLOPE = 1e-9  # a ratio; rounding of float64 heights of 100 m over half a metre
RNG = np.random.default_rng(7)


def horn_twin(z, cell_m):
    """Slopes to east and to north (r, c), plainly: what `horn_slopes` does cell by cell."""
    ringed = np.pad(np.asarray(z, float), 1, constant_values=np.nan)
    rows, cols = z.shape

    def across(row, col):
        one = ringed[1 + row : 1 + row + rows, 1 + col : 1 + col + cols]
        other = ringed[1 - row : 1 - row + rows, 1 - col : 1 - col + cols]
        mirrored = np.where(np.isnan(one), 2.0 * z - other, one), np.where(np.isnan(other), 2.0 * z - one, other)
        return mirrored[0] - mirrored[1]

    def known(*values):
        return np.select([~np.isnan(value) for value in values], values, np.nan)

    e, n, ne, se = across(0, 1), across(-1, 0), across(-1, 1), across(1, 1)
    e, n = known(e, (ne + se) / 2, ne - n, se + n), known(n, (ne - se) / 2, ne - e, e - se)
    ne, se = known(ne, e + n), known(se, e - n)
    e, n, ne, se = (np.where(np.isnan(d), 0.0, d) for d in (e, n, ne, se))
    return (ne + 2 * e + se) / (8 * cell_m), (ne + 2 * n - se) / (8 * cell_m)


def horn_gradient(z, cell_m):
    """The kernel's slopes, NaN without height."""
    ringed = np.pad(np.asarray(z, float), 1, constant_values=np.nan)
    found = np.full((2, *z.shape), np.nan)
    slopes = np.empty(2)
    for r, c in np.argwhere(~np.isnan(z)):
        horn_slopes(ringed, r + 1, c + 1, slopes)
        found[:, r, c] = slopes
    return found / (8 * cell_m)


@given(st.integers(1, 9), st.integers(1, 9), st.floats(0, 0.9), st.integers(0, 2**32 - 1))
def test_slopes_of_the_kernel_are_those_of_its_twin(rows, cols, holes, seed):
    rng = np.random.default_rng(seed)
    z = rng.normal(100, 1, (rows, cols))
    z[rng.random(z.shape) < holes] = np.nan
    for one, other in zip(horn_gradient(z, CELL_M), horn_twin(z, CELL_M), strict=True):
        np.testing.assert_allclose(one, np.where(np.isnan(z), np.nan, other), rtol=0, atol=SLOPE)


@given(st.floats(0, 360), st.floats(1, 90), st.integers(0, 2**32 - 1))
def test_shade_is_that_of_its_twin(azimuth, altitude, seed):
    z = np.random.default_rng(seed).normal(100, 0.4, (12, 15))
    z[3:5, 2:9] = np.nan
    east, north = horn_twin(z, CELL_M)
    a, h = np.radians([azimuth, altitude])
    cosine = np.sin(h) - np.cos(h) * (east * np.sin(a) + north * np.cos(a))
    shade = 1 + 254 * np.maximum(cosine / np.sqrt(1 + east**2 + north**2), 0)
    found = hillshade(z, CELL_M, azimuth, altitude)
    assert (found[np.isnan(z)] == 0).all()
    assert np.nanmax(np.abs(found - shade)[~np.isnan(z)]) <= 0.5 + 1e-9


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
