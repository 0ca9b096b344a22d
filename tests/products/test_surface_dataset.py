"""A finished surface as a Dataset: what it says of itself, and that it survives being written."""

from __future__ import annotations

import ast
import hashlib
import json
import re
import shutil

import numpy as np
import pytest
import rasterio
import xarray
from pyproj import CRS

import zlocus
from places import ROOT
from rendered_scenes import GSD_M, PART, SMALL_TILES, run
from zlocus.core.errors import InputError
from zlocus.matching.quality import Quality
from zlocus.products.surface_dataset import VARIABLES

UTM = CRS.from_epsg(32632)


@pytest.fixture(scope="module")
def written(images, tmp_path_factory):
    """A surface in which one cell has the highest flag."""
    out = run(images("sine"), tmp_path_factory.mktemp("written") / "out", SMALL_TILES, bounds=PART).out
    with rasterio.open(out / "quality.tif") as file:
        flags, profile = file.read(1), file.profile
    flags[3, 4] |= np.uint16(Quality.PLANE)
    with rasterio.open(out / "quality.tif", "w", **profile | {"driver": "GTiff"}) as file:
        file.write(flags, 1)
    return out


def test_it_says_where_it_comes_from(images, written):
    surface, record = zlocus.open(written), json.loads((written / "run.json").read_text())
    said = surface.attrs
    assert (said["crs"], said["vertical_datum"], said["horizontal_units"]) == ("EPSG:32632", "ellipsoid", "m")
    assert said["resolution_m"] == GSD_M
    assert said["source_images"].splitlines() == [str(path) for path in images("sine").inputs]
    assert said["run"] == str(written)
    assert (said["source"], said["created"]) == (f"zlocus {zlocus.__version__}", record["created"])
    assert (said["method"], said["selection"], said["coverage"]) == ("mvll-sgm", "default", record["coverage"])
    assert json.loads(said["config"]) == record["config"]
    options = json.dumps(record["config"]["options"], sort_keys=True)
    assert said["options_sha256"] == hashlib.sha256(options.encode()).hexdigest()
    for name in (*VARIABLES, "x", "y"):
        assert surface[name].attrs["units"], name
        assert surface[name].attrs["long_name"], name
    assert surface.height.attrs["vertical_datum"] == "ellipsoid"
    assert surface.height.attrs["standard_name"] == "height_above_reference_ellipsoid"


def test_a_surface_in_memory_names_no_folder(images):
    surface = zlocus.match(*images("sine").inputs, config=SMALL_TILES, bounds=PART, resolution=1.0, crs="EPSG:32632")
    assert "run" not in surface.attrs
    assert surface.attrs["resolution_m"] == 1.0


def test_flags_are_named(written):
    surface = zlocus.open(written)
    flags = dict(zip(surface.quality.flag_meanings.split(), surface.quality.flag_masks, strict=True))
    assert flags == {flag.name: int(flag) for flag in Quality}


def test_rasters_written_from_a_surface_know_crs_and_what_is_missing(written, tmp_path):
    surface = zlocus.open(written)
    for name, nodata in (("height", np.nan), ("views", 0), ("quality", None), ("ortho", 0)):
        surface[name].rio.to_raster(tmp_path / f"{name}.tif")
        with rasterio.open(tmp_path / f"{name}.tif") as file, rasterio.open(written / VARIABLES[name][0]) as source:
            assert CRS.from_wkt(file.crs.to_wkt()).to_2d() == UTM
            assert (file.transform, file.dtypes) == (source.transform, source.dtypes)
            if nodata is not None:
                assert np.array_equal(file.nodata, nodata, equal_nan=True)
            np.testing.assert_array_equal(file.read(), source.read())


def same_as(surface: xarray.Dataset, again: xarray.Dataset) -> None:
    """The same values, CRS and attributes, in a Dataset that was read from a file."""
    assert CRS.from_user_input(again.rio.crs.to_wkt()).to_2d() == UTM
    assert CRS.from_user_input(again.height.rio.crs.to_wkt()).to_2d() == UTM
    assert again.rio.transform() == surface.rio.transform()
    assert again.attrs == surface.attrs
    for name in VARIABLES:
        np.testing.assert_array_equal(again[name].values, surface[name].values)
        assert again[name].attrs["units"] == surface[name].attrs["units"]
    assert (again.quality.values & int(Quality.PLANE)).sum() > 0


def test_it_survives_netcdf(written, tmp_path):
    """The oldest format, which SciPy writes, and which has no unsigned numbers: the page says how."""
    surface, page = zlocus.open(written), (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    (told,) = re.findall(r"`surface\.to_netcdf\(FILE, encoding=(\{.*?\})\)`", page.replace("\n", " "))
    surface.to_netcdf(tmp_path / "surface.nc", engine="scipy", encoding=ast.literal_eval(told))
    with xarray.open_dataset(tmp_path / "surface.nc", engine="scipy", decode_coords="all") as again:
        same_as(surface, again)


def test_it_survives_netcdf_4(written, tmp_path):
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    surface = zlocus.open(written)
    surface.to_netcdf(tmp_path / "surface.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "surface.nc", engine="h5netcdf", decode_coords="all") as again:
        same_as(surface, again)


def test_it_survives_zarr(written, tmp_path):
    pytest.importorskip("zarr", reason="zarr is not installed")
    surface = zlocus.open(written)
    surface.to_zarr(tmp_path / "surface.zarr")
    same_as(surface, xarray.open_zarr(tmp_path / "surface.zarr", decode_coords="all"))


def test_another_vertical_datum_and_a_local_frame_are_named(written, tmp_path):
    shutil.copytree(written, tmp_path / "moved")
    record = json.loads((written / "run.json").read_text())
    local = 'ENGCRS["local",EDATUM["local"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    for changed, datum, standard in (
        ({"vertical": {"heights_above": "the EGM96 geoid", "crs": "EPSG:5773"}}, "EGM96 geoid",
         "height_above_geopotential_datum"),
        ({"grid": record["grid"] | {"crs": local}}, "local frame", None),
    ):  # fmt: skip
        (tmp_path / "moved" / "run.json").write_text(json.dumps(record | changed))
        surface = zlocus.open(tmp_path / "moved")
        assert surface.attrs["vertical_datum"] == surface.height.attrs["vertical_datum"] == datum
        assert surface.attrs.get("vertical_crs") == changed.get("vertical", {}).get("crs")
        assert surface.height.attrs.get("standard_name") == standard
        assert ("standard_name" in surface.x.attrs) == (standard is not None)


def test_a_damaged_record_is_said(written, tmp_path):
    shutil.copytree(written, tmp_path / "moved")
    (tmp_path / "moved" / "run.json").write_text("{}")
    with pytest.raises(InputError, match=r"run\.json lacks config"):
        zlocus.open(tmp_path / "moved")
