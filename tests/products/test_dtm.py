"""dtm.tif: the height of the surface where it is ground, interpolated elsewhere, nothing beyond."""

from __future__ import annotations

import os

import numpy as np
import pytest
import rasterio
from affine import Affine
from odc.geo.geobox import GeoBox
from rio_cogeo.cogeo import cog_validate

from zlocus.core.errors import InputError
from zlocus.core.options import ProductOptions
from zlocus.io.rasters import write_cog
from zlocus.matching.quality import Quality
from zlocus.products import dtm
from zlocus.products.dtm import write_dtm

CELL_M = 0.5
OPTIONS = ProductOptions(ground_window_m=12.0)
# Under a house of 12 m on ground tilted by 0.1, from blocks of 1 m.
UNDER_A_HOUSE_M = 0.15
ROWS, COLS = 301, 187
HOUSE, RIM_HOUSE, HOLE, DARK = np.s_[100:124, 60:84], np.s_[200:220, 170:], np.s_[40:52, 90:101], np.s_[:20, 120:]
DOUBTED, UNSEEN = np.s_[250:253, 40:45], np.s_[270:280, 100:110]


def grid(rows=ROWS):
    return GeoBox((rows, COLS), Affine(CELL_M, 0, 500000, 0, -CELL_M, 4000000), "EPSG:32632")


@pytest.fixture
def town(tmp_path):
    row, col = np.mgrid[:ROWS, :COLS]
    ground = (50 + 0.1 * CELL_M * col + 0.02 * CELL_M * row).astype(np.float32)
    z, quality = ground.copy(), np.zeros(z_shape := ground.shape, np.uint16)
    assert z_shape == (ROWS, COLS)
    z[HOUSE] += 9
    z[RIM_HOUSE] += 6
    z[DOUBTED] += 0.4
    quality[DOUBTED] = Quality.JUMP
    z[HOLE] = np.nan
    quality[HOLE] = Quality.NO_MATCH
    for place in (DARK, UNSEEN):
        z[place] = np.nan
        quality[place] = Quality.UNSEEN
    write_cog(tmp_path / "dsm.tif", z, grid(), nodata=np.nan)
    write_cog(tmp_path / "quality.tif", quality, grid())
    return tmp_path, ground, z


def made(folder, options=OPTIONS, **more):
    write_dtm(folder / "dsm.tif", folder / "quality.tif", folder / "dtm.tif", options, **more)
    with rasterio.open(folder / "dtm.tif") as file:
        return file.read(1)


def test_houses_go_and_ground_stays(town):
    folder, ground, z = town
    found = made(folder)
    off = np.abs(found - ground)
    for gone in (HOUSE, RIM_HOUSE, HOLE, DOUBTED):
        assert np.isfinite(found[gone]).all()
    for gone in (HOUSE, HOLE, DOUBTED):
        assert off[gone].max() < UNDER_A_HOUSE_M
    # Ground on one side only goes on level.
    assert off[RIM_HOUSE].max() < 1.0
    assert np.isnan(found[DARK]).all()
    assert np.isnan(found[UNSEEN]).all()
    kept = np.ones(found.shape, bool)
    for place in (HOUSE, RIM_HOUSE, HOLE, DOUBTED, DARK, UNSEEN):
        kept[place] = False
    np.testing.assert_array_equal(found[kept], z[kept])


def test_it_is_a_cog_that_says_what_it_holds(town):
    folder, *_ = town
    made(folder)
    assert cog_validate(folder / "dtm.tif", strict=True) == (True, [], [])
    with rasterio.open(folder / "dtm.tif") as file:
        assert (file.dtypes, file.units, file.descriptions) == (("float32",), ("m",), ("height of the ground",))
        assert np.isnan(file.nodata)
        assert file.crs == "EPSG:32632"
        assert "STATISTICS_MEAN" in file.tags(1)
    assert sorted(os.listdir(folder)) == ["dsm.tif", "dtm.tif", "quality.tif"]


@pytest.mark.parametrize("rows", [1, 50, 1000])
def test_strips_leave_no_seam(town, rows):
    folder, *_ = town
    made(folder)
    expected = (folder / "dtm.tif").read_bytes()
    made(folder, strip_rows=rows)
    assert (folder / "dtm.tif").read_bytes() == expected


def test_far_from_all_ground_there_is_none(town):
    folder, _, z = town
    z[60:260, 20:] = np.nan
    z[-20:] = 50
    write_cog(folder / "dsm.tif", np.where(np.arange(COLS) < 183, z, 50).astype(np.float32), grid(), nodata=np.nan)
    write_cog(folder / "quality.tif", np.zeros(z.shape, np.uint16), grid())
    found = made(folder)
    assert np.isfinite(found[160, 20 : 20 + 22]).all()  # within 12 m, less a block
    assert np.isnan(found[160, 20 + 26 : 100]).all()


def test_large_grids_are_filtered_on_larger_blocks(town, monkeypatch):
    folder, ground, _ = town
    monkeypatch.setattr(dtm, "MAX_BLOCKS", 2500)
    found = made(folder)
    assert np.abs(found - ground)[HOUSE].max() < 2 * UNDER_A_HOUSE_M


def test_a_surface_without_heights(tmp_path):
    write_cog(tmp_path / "dsm.tif", np.full((9, COLS), np.nan, np.float32), grid(9), nodata=np.nan)
    write_cog(tmp_path / "quality.tif", np.zeros((9, COLS), np.uint16), grid(9))
    assert np.isnan(made(tmp_path)).all()


def test_reasons_of_another_grid_are_refused(town):
    folder, *_ = town
    write_cog(folder / "quality.tif", np.zeros((9, COLS), np.uint16), grid(9))
    with pytest.raises(InputError, match=r"quality.tif is not on the grid of .*dsm.tif"):
        made(folder)
    assert not (folder / "dtm.tif").exists()


def test_levelled_water_is_ground_at_its_level(town):
    """Below the ground around it, and flagged as only water is; filled cells beside it are no ground."""
    folder, ground, z = town
    lake, filled = np.s_[150:180, 20:60], np.s_[150:180, 60:63]
    with rasterio.open(folder / "quality.tif") as file:
        quality = file.read(1)
    z[lake], quality[lake] = 45.5, Quality.WATER
    z[filled], quality[filled] = 90.0, Quality.FILLED | Quality.NO_MATCH
    quality[lake][:3] |= np.uint16(Quality.UNSEEN)
    write_cog(folder / "dsm.tif", z, grid(), nodata=np.nan)
    write_cog(folder / "quality.tif", quality, grid())
    terrain = made(folder)
    np.testing.assert_array_equal(terrain[lake], np.float32(45.5))
    assert np.nanmax(terrain[filled]) < ground[filled].max() + 0.5
