"""item.json: valid by STAC's own schemas, without a network, and true to the files that it links."""

from __future__ import annotations

import json
import os
import socket
from datetime import UTC, datetime

import numpy as np
import pystac
import pystac.validation
import pytest
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from shapely.geometry import shape

from zlocus.core.errors import InputError
from zlocus.io.crs import local_frame
from zlocus.io.open_raster import open_raster
from zlocus.io.rasters import write_cog
from zlocus.products.stac_item import PRODUCTS, bands_of, footprint_of, write_item

# Coordinates are rounded to 1e-7 degrees.
PLACE_DEG = 1e-7
CELL_M = 2.0
SCHEMA = "https://schemas.stacspec.org/v1.1.0/item-spec/json-schema/item.json"


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a test reached for the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def grid(west=500000.0, north=4000000.0, crs="EPSG:32632", cell_m=CELL_M, rows=30, cols=40):
    return GeoBox((rows, cols), Affine(cell_m, 0, west, 0, -cell_m, north), crs)


def result(folder, box=None, run=None):
    """A folder with a surface of 1 to 1200 m, half of it, an ortho-image and a record."""
    box = grid() if box is None else box
    z = np.arange(1.0, 1201.0, dtype=np.float32).reshape(30, 40)
    z[15:] = np.nan
    write_cog(folder / "dsm.tif", z, box, nodata=np.nan, descriptions=("height",), units="m")
    rgb = np.repeat(np.arange(1200, dtype=np.uint16).reshape(1, 30, 40), 3, axis=0)
    write_cog(folder / "ortho.tif", rgb, box, mask=np.isfinite(z), descriptions=("red", "green", "blue"))
    if run is not None:
        (folder / "run.json").write_text(json.dumps(run))
    return folder


def item_of(folder):
    assert write_item(folder)
    item = json.loads((folder / "item.json").read_text())
    assert pystac.validation.validate_dict(item) == [SCHEMA]
    return item


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


def footprint(folder, box):
    """The footprint of a raster on a grid."""
    write_cog(folder / "flat.tif", np.ones((30, 40), np.uint8), box)
    with open_raster(folder / "flat.tif", "raster") as file:
        return footprint_of(file)


def test_the_footprint_is_the_grid_in_degrees(tmp_path):
    geometry, bbox = footprint(tmp_path, grid(cell_m=500.0))
    outline, to_degrees = shape(geometry), Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    corners = np.array(to_degrees.transform([500000, 520000, 520000, 500000], [4000000, 4000000, 3985000, 3985000])).T
    ring = np.array(outline.exterior.coords)
    for corner in corners:
        assert np.abs(ring - corner).max(axis=1).min() <= PLACE_DEG
    assert outline.exterior.is_ccw
    assert bbox == list(outline.bounds)
    # The southern side is a curve in degrees: it hangs below the straight line between its corners.
    assert bbox[1] < corners[:, 1].min() + PLACE_DEG
    assert outline.is_valid


def test_a_footprint_across_the_date_line_is_cut(tmp_path):
    folder = result(tmp_path, grid(820000.0, 200000.0, "EPSG:32660", cell_m=1000.0))
    item = item_of(folder)
    west, south, east, north = item["bbox"]
    assert 179 < west < 180
    assert -180 < east < -179
    assert south < north
    assert item["geometry"]["type"] == "MultiPolygon"
    first, second = shape(item["geometry"]).geoms
    assert first.bounds[2] == 180.0
    assert second.bounds[0] == -180.0
    # 40 km near the equator
    assert first.area + second.area == pytest.approx(40 * 30 / 111.3**2, rel=0.01)


def test_a_compound_crs_lies_where_its_map_lies(tmp_path):
    assert footprint(tmp_path, grid(crs=CRS("EPSG:32632+5773").to_wkt())) == footprint(tmp_path, grid())


@pytest.mark.parametrize("crs", [None, local_frame().to_wkt()])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_local_frame_gets_no_item(tmp_path, crs):
    result(tmp_path, grid(crs=crs))
    assert not write_item(tmp_path)
    assert not (tmp_path / "item.json").exists()


def test_a_folder_without_a_surface_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"There is no raster .*dsm\.tif"):
        write_item(tmp_path)
