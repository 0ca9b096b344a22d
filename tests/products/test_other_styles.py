"""Styles of what other commands write: differences about zero, classes by name."""

from __future__ import annotations

import os
from xml.etree import ElementTree

import numpy as np
from affine import Affine
from odc.geo.geobox import GeoBox

from zlocus.io.rasters import write_cog
from zlocus.products.other_styles import write_other_styles

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
