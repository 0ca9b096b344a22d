"""item.json: valid by STAC's own schemas and rules, without a network, and true to the files that it links."""

from __future__ import annotations

import json
import os
import socket
from datetime import UTC, datetime

import numpy as np
import pystac
import pytest
import rasterio
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS
from pystac.extensions.classification import ClassificationExtension
from pystac.extensions.projection import ProjectionExtension
from shapely.geometry import box, shape

from places import ROOT
from stac_rules import SCHEMAS, check_schemas, validated
from zlocus.core.errors import InputError
from zlocus.io.crs import local_frame
from zlocus.io.rasters import write_cog
from zlocus.matching.quality import Quality
from zlocus.products.rasters import WaterKind
from zlocus.products.stac_item import PRODUCTS, bands_of, write_item

CELL_M = 2.0


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a test reached for the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def grid(west=500000.0, north=4000000.0, crs="EPSG:32632", cell_m=CELL_M, rows=30, cols=40):
    return GeoBox((rows, cols), Affine(cell_m, 0, west, 0, -cell_m, north), crs)


def result(folder, geobox=None, run=None):
    """A folder with a surface of 1 to 1200 m, half of it, an ortho-image and a record."""
    geobox = grid() if geobox is None else geobox
    z = np.arange(1.0, 40.0 * geobox.shape[0] + 1.0, dtype=np.float32).reshape(geobox.shape)
    z[15:] = np.nan
    write_cog(folder / "dsm.tif", z, geobox, nodata=np.nan, descriptions=("height",), units="m")
    rgb = np.repeat(np.arange(z.size, dtype=np.uint16).reshape(1, *z.shape), 3, axis=0)
    write_cog(folder / "ortho.tif", rgb, geobox, mask=np.isfinite(z), descriptions=("red", "green", "blue"))
    if run is not None:
        (folder / "run.json").write_text(json.dumps(run))
    return folder


def item_of(folder):
    assert write_item(folder)
    return validated(json.loads((folder / "item.json").read_text()))


RUN = {"created": "2026-05-17T08:09:10+00:00", "image_dates": ["2025-03-04", "2025-02-28", "2025-03-04"]}


def test_a_valid_item_links_what_is_there(tmp_path):
    item = item_of(result(tmp_path, run=RUN))
    assert {key: asset["href"] for key, asset in item["assets"].items()} == {
        "dsm-tif": "./dsm.tif", "ortho-tif": "./ortho.tif", "run-json": "./run.json",
    }  # fmt: skip
    assert item["assets"]["dsm-tif"]["roles"] == ["data"]
    assert item["assets"]["dsm-tif"]["type"] == pystac.MediaType.COG
    assert item["assets"]["run-json"]["type"] == pystac.MediaType.JSON
    assert "bands" not in item["assets"]["run-json"]
    assert item["properties"]["gsd"] == CELL_M
    assert item["id"] == tmp_path.name
    again = pystac.Item.from_file(str(tmp_path / "item.json"))
    assert all(os.path.exists(asset.get_absolute_href()) for asset in again.assets.values())


def test_every_file_of_a_result_is_linked(tmp_path):
    result(tmp_path, run=RUN)
    for product in PRODUCTS:
        if not (tmp_path / product.name).exists():
            if product.name.endswith(".tif"):
                write_cog(tmp_path / product.name, np.ones((30, 40), np.uint8), grid())
            else:
                (tmp_path / product.name).write_bytes(b"")
    item = item_of(tmp_path)
    assert {asset["href"].removeprefix("./") for asset in item["assets"].values()} == {p.name for p in PRODUCTS}
    assert item["assets"]["contours-gpkg"]["type"] == pystac.MediaType.GEOPACKAGE
    assert item["assets"]["surface-laz"]["type"] == "application/vnd.laszip"


def test_the_schemas_of_the_extensions(tmp_path):
    """An item with all that it may have is valid by them, and one with a wrong field is not."""
    if SCHEMAS not in os.environ:
        pytest.skip(f"{SCHEMAS} does not name a folder with the schemas of STAC's extensions: their rules alone count")
    result(tmp_path, grid(crs=CRS("EPSG:32632+5773").to_wkt()), RUN)
    for name, dtype in (("quality.tif", np.uint16), ("water.tif", np.uint8)):
        write_cog(tmp_path / name, np.zeros((30, 40), dtype), grid())
    item = item_of(tmp_path)
    assert len(item["stac_extensions"]) == 4
    for fields, name in (
        (item["properties"], "proj:code"), (item["assets"]["quality-tif"], "classification:bitfields"),
        (item["assets"]["dsm-tif"], "raster:spatial_resolution"), (item["assets"]["dsm-tif"], "file:size"),
    ):  # fmt: skip
        kept, fields[name] = fields[name], [-1.5]
        with pytest.raises(pystac.STACValidationError):
            check_schemas(item)
        fields[name] = kept
    check_schemas(item)


def test_bands_say_what_the_file_holds(tmp_path):
    result(tmp_path)
    z = np.arange(1.0, 601.0)
    (band,) = bands_of(tmp_path / "dsm.tif")
    statistics = band.pop("statistics")
    assert band == {"name": "band-1", "description": "height", "data_type": "float32", "nodata": "nan", "unit": "m"}
    assert statistics == {"minimum": 1.0, "maximum": 600.0, "mean": 300.5, "stddev": pytest.approx(z.std()),
                          "valid_percent": 50.0}  # fmt: skip
    write_cog(tmp_path / "views.tif", np.ones((30, 40), np.uint8), grid(), nodata=0)
    assert bands_of(tmp_path / "views.tif")[0]["nodata"] == 0
    bands = bands_of(tmp_path / "ortho.tif")
    assert [(b["name"], b["description"], b["data_type"]) for b in bands] == [
        ("band-1", "red", "uint16"), ("band-2", "green", "uint16"), ("band-3", "blue", "uint16"),
    ]  # fmt: skip
    assert all("nodata" not in b and "unit" not in b for b in bands)


def test_the_time_is_that_of_the_images(tmp_path):
    times = item_of(result(tmp_path, run=RUN))["properties"]
    assert times["datetime"] is None
    assert (times["start_datetime"], times["end_datetime"]) == ("2025-02-28T00:00:00Z", "2025-03-04T23:59:59Z")
    assert times["created"] == "2026-05-17T08:09:10Z"
    assert "not known" not in times["description"]


def test_images_without_a_date_are_counted(tmp_path):
    times = item_of(result(tmp_path, run=RUN | {"image_dates": [None, "2025-02-28"]}))["properties"]
    assert (times["start_datetime"], times["end_datetime"]) == ("2025-02-28T00:00:00Z", "2025-02-28T23:59:59Z")
    assert "The dates of 1 of 2 images are not known." in times["description"]


@pytest.mark.parametrize("run", [RUN | {"image_dates": [None, None]}, {"created": RUN["created"]}])
def test_without_dates_the_time_is_that_of_the_run(tmp_path, run):
    times = item_of(result(tmp_path, run=run))["properties"]
    assert times["datetime"] == times["created"] == "2026-05-17T08:09:10Z"
    assert "start_datetime" not in times
    assert "not known: datetime is that of the run" in times["description"]


def test_without_a_record_the_time_is_that_of_the_surface_file(tmp_path):
    result(tmp_path)
    made = datetime(2024, 2, 29, 12, tzinfo=UTC)
    os.utime(tmp_path / "dsm.tif", (made.timestamp(),) * 2)
    assert item_of(tmp_path)["properties"]["datetime"] == "2024-02-29T12:00:00Z"


def test_images_with_their_times(tmp_path):
    """Exact times count as they are, days as whole days; what is known of each image is listed."""
    taken = {
        "a": {"date": "2025-03-04", "time": "2025-03-04T10:11:12.500000+00:00", "satellite": "WV03"},
        "b": {"date": "2025-03-04", "time": "2025-03-04T10:12:13+00:00", "satellite": "WV03"},
    }
    run = {"created": RUN["created"], "image_dates": ["2025-03-04"] * 2, "acquisitions": taken}
    times = item_of(result(tmp_path, run=run))["properties"]
    assert (times["start_datetime"], times["end_datetime"]) == ("2025-03-04T10:11:12.500000Z", "2025-03-04T10:12:13Z")
    assert times["platform"] == "WV03"
    assert times["zlocus:images"] == [
        {"name": "a", "datetime": "2025-03-04T10:11:12.500000Z", "platform": "WV03"},
        {"name": "b", "datetime": "2025-03-04T10:12:13Z", "platform": "WV03"},
    ]
    taken["b"] = {"date": "2025-03-05", "time": None, "satellite": "PHR1A"}
    run["image_dates"] = ["2025-03-04", "2025-03-05", None]
    times = item_of(result(tmp_path, run=run))["properties"]
    assert (times["start_datetime"], times["end_datetime"]) == ("2025-03-04T10:11:12.500000Z", "2025-03-05T23:59:59Z")
    assert "platform" not in times
    assert times["zlocus:images"][1] == {"name": "b", "date": "2025-03-05", "platform": "PHR1A"}
    assert "The dates of 1 of 3 images are not known." in times["description"]


def test_the_projection_is_that_of_the_files(tmp_path):
    item = item_of(result(tmp_path, run=RUN))
    properties, asset = item["properties"], item["assets"]["dsm-tif"]
    assert properties["proj:code"] == asset["proj:code"] == "EPSG:32632"
    # Half of the rows have heights; the outline reaches no further than its simplification.
    assert shape(properties["proj:geometry"]).bounds == pytest.approx((500000, 3999970, 500080, 4000000), abs=1.0)
    assert properties["proj:bbox"] == list(shape(properties["proj:geometry"]).bounds)
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert asset["proj:shape"] == list(file.shape)
        assert Affine(*asset["proj:transform"]) == file.transform
        assert asset["proj:bbox"] == list(file.bounds)
    assert asset["raster:spatial_resolution"] == CELL_M
    assert asset["file:size"] == (tmp_path / "dsm.tif").stat().st_size
    assert "file:size" not in item["assets"]["run-json"]
    read = pystac.Item.from_file(str(tmp_path / "item.json"))
    projection = ProjectionExtension.ext(read.assets["ortho-tif"])
    assert (projection.code, projection.shape) == ("EPSG:32632", [30, 40])


def test_heights_above_a_geoid_have_their_compound_crs(tmp_path):
    result(tmp_path, grid(crs=CRS("EPSG:32632+5773").to_wkt()), RUN)
    (tmp_path / "surface.laz").write_bytes(b"")
    write_cog(tmp_path / "views.tif", np.ones((30, 40), np.uint8), grid())
    item = item_of(tmp_path)
    assert item["properties"]["proj:code"] == item["assets"]["views-tif"]["proj:code"] == "EPSG:32632"
    for name in ("dsm-tif", "surface-laz"):
        assert item["assets"][name]["proj:code"] is None
        assert CRS(item["assets"][name]["proj:wkt2"]) == CRS("EPSG:32632+5773")


def test_a_crs_without_a_code_is_written_in_full(tmp_path):
    crs = CRS("+proj=tmerc +lat_0=47 +lon_0=8.25 +x_0=500000 +y_0=4000000 +ellps=GRS80 +units=m +type=crs")
    item = item_of(result(tmp_path, grid(crs=crs.to_wkt()), RUN))
    for fields in (item["properties"], item["assets"]["dsm-tif"]):
        assert fields["proj:code"] is None
        assert CRS(fields["proj:wkt2"]).to_2d().equals(CRS.from_wkt(crs.to_wkt()), ignore_axis_order=True)


def test_flags_and_water_are_classes(tmp_path):
    result(tmp_path, run=RUN)
    write_cog(tmp_path / "quality.tif", np.zeros((30, 40), np.uint16), grid())
    write_cog(tmp_path / "water.tif", np.zeros((30, 40), np.uint8), grid())
    assets = item_of(tmp_path)["assets"]
    found = [
        (str(1 << each["offset"]), each["name"], each["description"])
        for each in assets["quality-tif"]["classification:bitfields"]
    ]
    page = (ROOT / "docs" / "reference" / "quality.md").read_text(encoding="utf-8")
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in page.splitlines()]
    assert found == [row[:3] for row in rows if row[0].isdigit()]
    classes = assets["water-tif"]["classification:classes"]
    assert [(each["value"], each["name"]) for each in classes] == [(int(kind), kind.name) for kind in WaterKind]
    (bits,) = (
        ClassificationExtension.ext(asset).bitfields
        for key, asset in pystac.Item.from_file(str(tmp_path / "item.json")).assets.items() if key == "quality-tif"
    )  # fmt: skip
    value = int(Quality.UNSEEN | Quality.PLANE)
    is_set = {bit.name for bit in bits if value >> bit.offset & (1 << bit.length) - 1}
    assert is_set == {"UNSEEN", "PLANE"}


def test_the_geometry_is_the_outline_of_the_heights(tmp_path):
    item = item_of(result(tmp_path, run=RUN))
    west, south, east, north = item["bbox"]
    assert shape(item["geometry"]).within(box(west, south, east, north).buffer(1e-9))
    whole = item_of(result(tmp_path, grid(rows=15), RUN))["bbox"]
    assert item["bbox"] == pytest.approx(whole, abs=2e-5)


@pytest.mark.parametrize("crs", [None, local_frame().to_wkt()])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_local_frame_gets_no_item(tmp_path, crs):
    result(tmp_path, grid(crs=crs))
    assert not write_item(tmp_path)
    assert not (tmp_path / "item.json").exists()


def test_a_folder_without_a_surface_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"There is no raster .*dsm\.tif"):
        write_item(tmp_path)
