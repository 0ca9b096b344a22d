"""The rasters of a run and the surfaces they are written from."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from affine import Affine
from odc.geo.geobox import GeoBox

from zlocus.core.errors import OutputError
from zlocus.core.grid import CellWindow
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.products.rasters import SurfaceRasters, as_source

GRID = GeoBox((30, 40), Affine(0.5, 0, 1000, 0, -0.5, 2000), "EPSG:32632")


def surface(rows, cols):
    shape = (rows, cols)
    ramp = np.arange(rows * cols, dtype=np.float32).reshape(shape)
    return Surface(ramp, ramp / 8, np.full(shape, 256, np.uint16), np.full(shape, 3, np.uint8), ramp + 5)


def test_blocks_land_in_their_place(tmp_path):
    with SurfaceRasters(tmp_path, GRID, "uint16") as rasters:
        rasters.write(10, 20, surface(8, 12))
    names = ["dsm.tif", "ortho.tif", "quality.tif", "sigma.tif", "views.tif", "water.tif"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    with rasterio.open(tmp_path / "sigma.tif") as sigma:
        np.testing.assert_array_equal(sigma.read(1)[10:18, 20:32], surface(8, 12).sigma)
        assert sigma.units == ("m",)
    with rasterio.open(tmp_path / "dsm.tif") as dsm, rasterio.open(tmp_path / "ortho.tif") as ortho:
        height = dsm.read(1)
        np.testing.assert_array_equal(height[10:18, 20:32], surface(8, 12).height)
        assert np.isfinite(height).sum() == 96
        assert dsm.units == ("m",)
        assert (ortho.read_masks(1) > 0).sum() == 96
        assert ortho.read(1)[10, 20] == 5


def test_the_flags_are_in_the_tags_of_their_band(tmp_path):
    with SurfaceRasters(tmp_path, GRID, "uint16") as rasters:
        rasters.write(10, 20, surface(8, 12))
    with rasterio.open(tmp_path / "quality.tif") as quality:
        tags = quality.tags(1)
    values, names = (int(each) for each in tags["flag_masks"].split(", ")), tags["flag_meanings"].split()
    assert dict(zip(names, values, strict=True)) == {flag.name: int(flag) for flag in Quality}


def test_an_exception_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError), SurfaceRasters(tmp_path, GRID, "uint8"):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_a_raster_that_cannot_be_finished_takes_the_others_with_it(tmp_path):
    (tmp_path / "views.tif").mkdir()
    with pytest.raises(OutputError), SurfaceRasters(tmp_path, GRID, "uint8"):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["views.tif"]


def test_grey_values_are_rounded_and_kept_in_range():
    grey = np.array([-3.2, 0.4, 0.6, 254.7, 900.0], np.float32)
    np.testing.assert_array_equal(as_source(grey, np.dtype("uint8")), [0, 0, 1, 255, 255])
    np.testing.assert_array_equal(as_source(grey, np.dtype("int16")), [-3, 0, 1, 255, 900])
    np.testing.assert_array_equal(as_source(grey, np.dtype("float32")), grey)


def test_a_part_of_a_surface_reaches_beyond_it():
    whole, window = CellWindow(-4, 10, 8, 12), CellWindow(-6, 15, 5, 20)
    part = surface(8, 12).part(window, whole)
    assert part.height.shape == (5, 20)
    np.testing.assert_array_equal(part.height[2:, :7], surface(8, 12).height[:3, 5:])
    assert np.isfinite(part.height).sum() == 21
    outside = np.ones((5, 20), bool)
    outside[2:, :7] = False
    assert (part.quality[outside] == Quality.UNSEEN).all()
    assert (part.views[outside] == 0).all()
    assert np.isnan(part.ortho[outside]).all()


@pytest.mark.parametrize("window", [CellWindow(50, 50, 4, 4), CellWindow(-40, 12, 3, 5), CellWindow(0, -90, 3, 5)])
def test_a_part_beside_a_surface_is_empty(window):
    part = surface(8, 12).part(window, CellWindow(-4, 10, 8, 12))
    assert (part.quality == Quality.UNSEEN).all()
    assert np.isnan(part.height).all()


def test_cells_not_asked_for_are_emptied():
    outside = np.zeros((4, 5), bool)
    outside[1:, 3] = True
    found = surface(4, 5).without(outside)
    np.testing.assert_array_equal(np.isnan(found.height), outside)
    np.testing.assert_array_equal(np.isnan(found.ortho), outside)
    np.testing.assert_array_equal(found.quality == Quality.OUTSIDE, outside)
    np.testing.assert_array_equal(found.views == 0, outside)
    assert (found.quality[~outside] == 256).all()
