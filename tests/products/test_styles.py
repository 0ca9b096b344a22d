"""Styles of the products of a result: ranges, names of flags, attribute table, and which files are there."""

from __future__ import annotations

import json
import os
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS
from shapely import box

from zlocus.core.options import ProductOptions
from zlocus.core.progress import SilentProgress
from zlocus.io.rasters import write_cog
from zlocus.io.styles.file_names import OF_SURFACE, REASONS, style_files
from zlocus.matching.quality import Quality
from zlocus.products.derived import write_derived
from zlocus.products.footprints import write_footprints
from zlocus.products.report.maps import FLAG_GROUPS, NO_FLAG, groups_of
from zlocus.products.stac_item import write_item
from zlocus.products.styles import MAX_INDEX_CONTOURS, missing_styles, write_styles

GRID = GeoBox((60, 80), Affine(1.0, 0, 500000, 0, -1.0, 4000000), "EPSG:32632")
CODES = tuple(
    int(flags)
    for flags in (0, Quality.NO_MATCH, Quality.WEAK | Quality.JUMP, Quality.WATER, Quality.UNSEEN | Quality.PLANE)
)


@pytest.fixture
def surface(tmp_path):
    row, col = np.mgrid[:60, :80]
    z = (100 + 0.05 * row + 0.1 * col).astype(np.float32)
    z[0, 0] = 5000.0  # a blunder does not matter
    z[:4] = np.nan
    write_cog(tmp_path / "dsm.tif", z, GRID, nodata=np.nan, units="m")
    write_cog(tmp_path / "sigma.tif", np.linspace(0.05, 0.4, z.size, dtype=np.float32).reshape(z.shape), GRID,
              nodata=np.nan)  # fmt: skip
    write_cog(tmp_path / "quality.tif", np.take(CODES, (row + col) % 5).astype(np.uint16), GRID)
    write_cog(tmp_path / "views.tif", (2 + col % 3).astype(np.uint8), GRID, nodata=0)
    write_cog(tmp_path / "ortho.tif", np.stack([row, col, row + col]).astype(np.uint16), GRID, mask=np.isfinite(z),
              descriptions=("red", "green", "blue"))  # fmt: skip
    write_cog(tmp_path / "water.tif", np.zeros(z.shape, np.uint8), GRID)
    return tmp_path


def qml(folder, name):
    return ElementTree.parse(folder / name).getroot()


def values(root, tag):
    return {float(each.get("value")): each.get("label") for each in root.iter(tag)}


def test_every_product_has_a_style(surface):
    write_derived(surface, ("hillshade", "contours", "laz"), ProductOptions(), SilentProgress())
    outline = box(500000, 3999940, 500080, 4000000)
    features = [(outline, {"kind": kind, "name": "a"}) for kind in ("image", "overlap")]
    write_footprints(surface / "footprints.geojson", features, CRS.from_epsg(32632))
    products = sorted(name for name in os.listdir(surface) if name in OF_SURFACE)
    assert missing_styles(surface, ProductOptions()) != ()
    write_styles(surface, ProductOptions())
    assert missing_styles(surface, ProductOptions()) == ()
    assert sorted(os.listdir(surface)) == sorted([*products, *(n for p in products for n in style_files(p))])
    for name in os.listdir(surface):
        if name.endswith((".qml", ".sld", ".vrt", ".xml")):
            ElementTree.parse(surface / name)


def test_heights_have_the_colours_of_most_of_them(surface):
    write_styles(surface, ProductOptions())
    stops = values(qml(surface, "dsm.qml"), "item")
    assert (min(stops), max(stops)) == (101.0, 110.0)  # the 2nd and the 98th percentile, outwards to 0.1 m
    assert stops[101.0] == "101.0 m"
    sigmas = values(qml(surface, "sigma.qml"), "item")
    assert (min(sigmas), max(sigmas)) == (0.0, 0.4)
    assert list(values(qml(surface, "views.qml"), "paletteEntry").values()) == ["2 images", "3 images", "4 images"]


def test_flags_have_their_names_in_the_order_of_the_report(surface):
    write_styles(surface, ProductOptions())
    assert list(values(qml(surface, "quality.qml"), "paletteEntry").items()) == [
        (CODES[3], "WATER"), (CODES[4], "UNSEEN, PLANE"), (CODES[1], "NO_MATCH"), (CODES[2], "WEAK, JUMP"),
        (CODES[0], NO_FLAG[0]),
    ]  # fmt: skip


def test_gdal_reads_the_attribute_table(surface):
    """Columns and rows, as GDAL's own file has them."""
    write_styles(surface, ProductOptions())
    root = ElementTree.parse(surface / "quality.tif.aux.xml").getroot()
    table = root.find("PAMRasterBand/GDALRasterAttributeTable")
    uses = {column.findtext("Name"): column.findtext("Usage") for column in table.iter("FieldDefn")}
    assert uses == {
        "Value": "5", "Count": "1", "Name": "2", "Red": "6", "Green": "7", "Blue": "8", "HasHeight": "0", "Group": "0",
    }  # fmt: skip
    rows = [dict(zip(uses, (cell.text for cell in row), strict=True)) for row in table.iter("Row")]
    assert {int(row["Value"]): row["Name"] for row in rows}[CODES[2]] == "WEAK, JUMP"
    assert sum(int(row["Count"]) for row in rows) == 60 * 80
    heights = {int(row["Value"]): row["HasHeight"] for row in rows}
    assert [heights[code] for code in CODES] == ["1", "0", "1", "1", "0"]
    # GDAL does not read its own file after a declaration of XML.
    assert (surface / "quality.tif.aux.xml").read_text().startswith("<PAMDataset>")


def test_reasons_are_the_groups_of_the_flags(surface):
    write_styles(surface, ProductOptions())
    with rasterio.open(surface / "quality.tif") as file, rasterio.open(surface / REASONS) as reasons:
        np.testing.assert_array_equal(reasons.read(1), groups_of(file.read(1).astype(np.int64)))
        assert (reasons.transform, reasons.crs) == (file.transform, file.crs)
        assert reasons.colormap(1)[0] == (*FLAG_GROUPS[0][2], 255)


def test_every_fifth_contour_is_thick_and_has_a_label(surface):
    options = ProductOptions(contour_interval_m=0.5)
    write_derived(surface, ("contours",), options, SilentProgress())
    write_styles(surface, options)
    rules = [rule.get("label") for rule in qml(surface, "contours.qml").iter("rule") if rule.get("label")]
    assert rules == ["every 2.5 m", "every 0.5 m"]
    levels = [float(each.text) for each in qml(surface, "contours.sld").iter("{http://www.opengis.net/ogc}Literal")]
    assert {102.25, 102.75, 104.75, 105.25} <= set(levels)
    # Of the heights up to that of the blunder those around the mean are listed.
    assert len(levels) <= 2 * (MAX_INDEX_CONTOURS + 1)


def test_the_item_links_styles(surface):
    write_styles(surface, ProductOptions())
    write_item(surface)
    assets = json.loads((surface / "item.json").read_text())["assets"]
    roles = {asset["href"]: asset["roles"] for asset in assets.values()}
    assert roles["./dsm.qml"] == roles["./quality.sld"] == ["style"]
    assert roles["./quality.tif.aux.xml"] == roles[f"./{REASONS}"] == ["metadata"]
    assert assets["dsm-qml"]["type"] == "application/x-qgis-layer-settings"


def test_styles_can_be_left_out(surface):
    before = set(os.listdir(surface))
    write_styles(surface, ProductOptions(styles=False))
    assert set(os.listdir(surface)) == before
    assert missing_styles(surface, ProductOptions(styles=False)) == ()


def test_a_style_is_kept_until_its_product_is_made_again(surface):
    write_styles(surface, ProductOptions())
    (surface / "dsm.qml").write_text("mine")
    write_styles(surface, ProductOptions())
    assert (surface / "dsm.qml").read_text() == "mine"
    write_styles(surface, ProductOptions(), ["dsm.tif"])
    assert (surface / "dsm.qml").read_text() != "mine"
    write_styles(surface, ProductOptions(styles=False), ["dsm.tif"])
    assert not (surface / "dsm.qml").exists()


def test_a_surface_without_any_height_has_styles_too(tmp_path):
    write_cog(tmp_path / "dsm.tif", np.full((60, 80), np.nan, np.float32), GRID, nodata=np.nan)
    write_cog(tmp_path / "views.tif", np.zeros((60, 80), np.uint8), GRID, nodata=0)
    write_styles(tmp_path, ProductOptions())
    assert missing_styles(tmp_path, ProductOptions()) == ()
