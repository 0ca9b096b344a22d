"""The comparison of two folders of results, on small rasters with planted differences."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from affine import Affine

import same_pixels
from benchmark_scripts import run_script

SHAPE = (40, 60)
GRID = {
    "driver": "GTiff", "height": SHAPE[0], "width": SHAPE[1], "crs": "EPSG:32632",
    "transform": Affine(0.5, 0, 400_000, 0, -0.5, 5_000_000),
}  # fmt: skip


def heights() -> np.ndarray:
    z = np.random.default_rng(3).normal(50.0, 5.0, SHAPE).astype(np.float32)
    z[:4] = np.nan
    return z


def write_results(folder, z=None, profile=None, mask=None, **more):
    """A surface without heights in the first rows, and an ortho-image of three bands with an internal mask."""
    folder.mkdir()
    z = heights() if z is None else z
    profile = GRID | {"nodata": np.nan, "dtype": "float32", "count": 1} | (profile or {})
    with rasterio.open(folder / "dsm.tif", "w", **profile, **more) as file:
        file.write(z.astype(profile["dtype"]), 1)
    mask = np.isfinite(heights()) if mask is None else mask
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(folder / "ortho.tif", "w", **GRID, dtype="uint8", count=3, photometric="RGB") as file,
    ):
        file.write(np.random.default_rng(4).integers(0, 255, (3, *SHAPE)).astype(np.uint8))
        file.write_mask(mask)
    return folder


@pytest.fixture
def results(tmp_path):
    return write_results(tmp_path / "results")


def test_equal_rasters_are_the_same_whatever_their_compression(results, tmp_path, monkeypatch, capsys):
    other = write_results(tmp_path / "other", compress="deflate", tiled=True, blockxsize=16, blockysize=16)
    monkeypatch.setattr(same_pixels, "ROWS_AT_ONCE", 7)
    assert run_script(monkeypatch, same_pixels, results, other) == 0
    assert capsys.readouterr().out == ""


def changed_height():
    z = heights()
    z[20, 30:32] += 0.25
    return z


def height_lost():
    z = heights()
    z[39, 59] = np.nan
    return z


@pytest.mark.parametrize(
    ("planted", "sentences"),
    [
        ({"z": changed_height()}, ["dsm.tif: 2 of 2400 pixels differ, by 0.25 at most."]),
        (
            {"z": np.nextafter(heights(), np.float32(0))},
            ["dsm.tif: 2160 of 2400 pixels differ, by 7.62939e-06 at most."],
        ),
        (
            {"z": height_lost()},
            ["dsm.tif: the mask differs in 1 of 2400 pixels.", "dsm.tif: 1 of 2400 pixels differ, by 0 at most."],
        ),
        (
            {"mask": np.ones(SHAPE, bool)},
            [f"ortho.tif: the mask of band {k} differs in 240 of 2400" for k in (1, 2, 3)],
        ),
        (
            {"profile": {"nodata": -9999.0}},
            ["dsm.tif: the no-data values differ: (nan,) and (-9999.0,).", "dsm.tif: the mask differs in 240"],
        ),
        (
            {"profile": {"dtype": "float64"}},
            ["dsm.tif: the types of the bands differ: ('float32',) and ('float64',)."],
        ),
        ({"profile": {"crs": "EPSG:32633"}}, ["dsm.tif: the CRS differs: PROJCS["]),
        (
            {"profile": {"transform": Affine(0.5, 0, 400_001, 0, -0.5, 5_000_000)}},
            ["dsm.tif: the transform differs: ("],
        ),
        (
            {"z": heights()[:30], "profile": {"height": 30}},
            ["dsm.tif: the shape differs: (40, 60) and (30, 60)."],
        ),
    ],
)
def test_each_planted_difference_is_one_sentence(results, tmp_path, monkeypatch, capsys, planted, sentences):
    other = write_results(tmp_path / "other", **planted)
    assert run_script(monkeypatch, same_pixels, results, other) == 1
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == len(sentences)
    for line, sentence in zip(printed, sentences, strict=True):
        assert line.startswith(sentence)


def test_a_raster_that_only_one_folder_has_is_a_difference(results, tmp_path, monkeypatch, capsys):
    other = write_results(tmp_path / "other")
    (other / "ortho.tif").unlink()
    assert run_script(monkeypatch, same_pixels, results, other) == 1
    assert capsys.readouterr().out == f"{other / 'ortho.tif'} is missing.\n"
    assert run_script(monkeypatch, same_pixels, results, other, "--rasters", "dsm") == 0


def test_the_maps_of_each_image_are_compared(results, tmp_path, monkeypatch, capsys):
    other = write_results(tmp_path / "other")
    for folder in (results, other):
        (folder / "0002_height.tif").write_bytes((folder / "dsm.tif").read_bytes())
    assert run_script(monkeypatch, same_pixels, results, other) == 0
    with rasterio.open(other / "0002_height.tif", "r+") as file:
        file.write(changed_height(), 1)
    assert run_script(monkeypatch, same_pixels, results, other) == 1
    assert capsys.readouterr().out == "0002_height.tif: 2 of 2400 pixels differ, by 0.25 at most.\n"


def test_a_folder_without_results_is_refused(tmp_path, monkeypatch, capsys):
    assert run_script(monkeypatch, same_pixels, tmp_path, tmp_path) == 2
    assert capsys.readouterr().err == f"{tmp_path} and {tmp_path} hold no rasters of a result.\n"
