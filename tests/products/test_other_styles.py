"""Styles of what other commands write: differences about zero, classes by name."""

from __future__ import annotations

import os
from xml.etree import ElementTree

import numpy as np
import pytest
from affine import Affine
from odc.geo.geobox import GeoBox

from zlocus.core.options import ProductOptions
from zlocus.io.rasters import RasterBands, RasterSink, write_cog
from zlocus.matching.quality import Quality
from zlocus.products.number_names import RUNS, number_tag, numbered_names, short_names
from zlocus.products.other_styles import MAX_NUMBERS, NUMBER_COLOURS, write_other_styles
from zlocus.products.point_cloud import write_map

GRID = GeoBox((60, 80), Affine(1.0, 0, 500000, 0, -1.0, 4000000), "EPSG:32632")


def qml(folder, name):
    return ElementTree.parse(folder / name).getroot()


def values(root, tag):
    return {float(each.get("value")): each.get("label") for each in root.iter(tag)}


def test_differences_are_drawn_about_zero(tmp_path):
    errors = np.linspace(-0.2, 2.0, 4800, dtype=np.float32).reshape(60, 80)
    write_cog(tmp_path / "error.tif", errors, GRID, nodata=np.nan)
    write_other_styles(tmp_path, ["error.tif", "difference.tif", "change.json"])
    assert sorted(os.listdir(tmp_path)) == ["error.qml", "error.sld", "error.tif"]
    assert list(values(qml(tmp_path, "error.qml"), "item")) == [-1.9, 0.0, 1.9]
    (tmp_path / "error.tif").unlink()
    write_other_styles(tmp_path, ["error.tif"])
    assert os.listdir(tmp_path) == []


def test_classes_have_names(tmp_path):
    write_cog(tmp_path / "class.tif", np.ones((60, 80), np.uint8), GRID, nodata=0)
    write_cog(tmp_path / "seams.tif", np.ones((60, 80), np.uint8), GRID, nodata=0)
    write_other_styles(tmp_path, ["class.tif", "seams.tif"])
    assert values(qml(tmp_path, "class.qml"), "paletteEntry") == {
        1: "no significant change", 2: "raised", 3: "lowered",
    }  # fmt: skip
    assert list(values(qml(tmp_path, "seams.qml"), "paletteEntry")) == [1, 2, 3]


@pytest.mark.parametrize("n", [len(NUMBER_COLOURS) + 2, MAX_NUMBERS + 1])
def test_runs_of_a_mosaic_have_their_names(tmp_path, n):
    names = [f"run; {k}" if k == 2 else f"run {k}" for k in range(1, n + 1)]
    bands = RasterBands("uint16", 0, ("number",), tags={RUNS: number_tag(names)})
    with RasterSink(tmp_path / "source.tif", GRID, bands) as sink:
        sink.write(0, 0, np.resize(np.arange(n + 1, dtype=np.uint16), (60, 80)))
    write_other_styles(tmp_path, ["source.tif"])
    root = qml(tmp_path, "source.qml")
    if n > MAX_NUMBERS:
        assert max(values(root, "item")) == n
        return
    colours = {int(each.get("value")): each.get("color") for each in root.iter("paletteEntry")}
    assert list(values(root, "paletteEntry").values()) == names
    assert colours[1] == colours[1 + len(NUMBER_COLOURS)] != colours[2]


def test_names_of_numbers():
    assert numbered_names(number_tag(["a b", "2020; x"])) == {1: "a b", 2: "2020; x"}
    assert numbered_names("") == {}
    assert short_names(["/data/may/north", "/data/may/south/dsm.tif=0.3"]) == ["north", "south/dsm.tif=0.3"]
    assert short_names(["north", "north/joined"]) == ["north", "north/joined"]


def test_images_of_a_cloud_have_the_styles_of_a_surface(tmp_path):
    """A cloud has files of several images in one folder, without a place on the Earth."""
    codes = np.full((60, 80), int(Quality.OCCLUDED), np.uint16)
    write_map(tmp_path / "a_quality.tif", (60, 80), [codes], "flags")
    heights = np.linspace(100.0, 200.0, 4800, dtype=np.float32).reshape(60, 80)
    write_map(tmp_path / "a_height.tif", (60, 80), [heights], "height", "m")
    write_map(tmp_path / "a_depth.tif", (60, 80), [heights], "depth", "m")
    (tmp_path / "cloud.laz").write_bytes(b"points")
    names = ["a_quality.tif", "a_height.tif", "a_depth.tif", "cloud.laz", "cloud.ply"]
    made = ["a_quality.qml", "a_quality.sld", "a_quality.tif.aux.xml", "a_reasons.vrt", "a_height.qml", "a_height.sld",
            "a_depth.qml", "a_depth.sld", "cloud.qml"]  # fmt: skip
    assert write_other_styles(tmp_path, names) == made
    assert values(qml(tmp_path, "a_quality.qml"), "paletteEntry") == {int(Quality.OCCLUDED): "OCCLUDED"}
    assert (
        '<SourceFilename relativeToVRT="1">a_quality.tif</SourceFilename>' in (tmp_path / "a_reasons.vrt").read_text()
    )
    near, far = (list(qml(tmp_path, f"a_{of}.qml").iter("item")) for of in ("height", "depth"))
    assert near[0].get("color") == far[-1].get("color")
    (tmp_path / "cloud.qml").unlink()
    assert write_other_styles(tmp_path, names, is_new=False) == ["cloud.qml"]
    assert write_other_styles(tmp_path, names, ProductOptions(styles=False)) == []
    assert not set(made) & set(os.listdir(tmp_path))


@pytest.mark.parametrize("has_names", [True, False])
def test_colours_of_an_image_of_many_bands(tmp_path, has_names):
    """As a multispectral image has them: its red is not the first band."""
    values = np.arange(5 * 4800).reshape(5, 60, 80).astype(np.uint16)
    names = ("coastal", "Blue", "Green", "Red", "NIR") if has_names else ("",) * 5
    write_cog(tmp_path / "a_ortho.tif", values, GRID, mask=np.ones((60, 80), bool), descriptions=names)
    write_other_styles(tmp_path, ["a_ortho.tif"])
    renderer = qml(tmp_path, "a_ortho.qml").find("pipe/rasterrenderer")
    found = [renderer.get(name) for name in ("redBand", "greenBand", "blueBand", "alphaBand")]
    assert found == (["4", "3", "2", "6"] if has_names else ["1", "2", "3", "6"])
