"""Bad input through the real command line: exit status 2, one sentence that names the fault, nothing left behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from rendered_scenes import CENTRE, UTM, camera
from rpc_fixtures import rpc_txt, write_image
from zlocus.cli.app import app
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.files import write_image as write_rendered


@pytest.fixture
def refused(tmp_path, monkeypatch):
    """Run `zlocus dsm` in a folder of its own; returns the sentence, once all promises of a refusal are checked."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def run(*arguments, out="out", status=2):
        before = sorted(folder.rglob("*"))
        result = CliRunner().invoke(app, ["dsm", *map(str, arguments), "-o", str(out)])
        said = [line for line in result.stderr.splitlines() if line.startswith("zlocus: ")]
        assert result.exit_code == status, result.output
        assert len(said) == 1
        assert result.stderr.rstrip().endswith(said[0])
        assert "Traceback" not in result.stderr
        assert said[0][-1] in ".?"
        assert sorted(folder.rglob("*")) == before
        return said[0]

    return run


def pixels_and_rpc(path):
    with rasterio.open(path) as source:
        return source.read(1), source.rpcs


def moved(path, name, **changes):
    """A copy of an image with other numbers in its RPC."""
    pixels, rpc = pixels_and_rpc(path)
    for field, value in changes.items():
        setattr(rpc, field, value)
    return write_image(Path(name), pixels, None, rpcs=rpc)


def test_no_such_file(refused, good_pair):
    assert "missing.tif" in refused(good_pair[0], "missing.tif")


@pytest.mark.parametrize("content", [b"", b"these are words, not pixels", b"II*\0\x08\0\0\0"])
def test_not_an_image(refused, good_pair, content):
    Path("words.tif").write_bytes(content)
    assert "words.tif" in refused(good_pair[0], "words.tif")


@pytest.mark.parametrize("kept", [0.3, 0.95])
def test_truncated_image(refused, good_pair, kept):
    whole = good_pair[1].read_bytes()
    Path("short.tif").write_bytes(whole[: int(len(whole) * kept)])
    assert "short.tif" in refused(good_pair[0], "short.tif")


def test_folder_as_image(refused, good_pair):
    Path("images").mkdir()
    assert "images" in refused(good_pair[0], "images")


def test_image_without_a_camera(refused, good_pair):
    write_image(Path("bare.tif"), pixels_and_rpc(good_pair[1])[0])
    sentence = refused(good_pair[0], "bare.tif")
    assert "bare.tif" in sentence
    assert "RPC" in sentence


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rpc_with_a_number_that_is_not_finite(refused, good_pair, value):
    write_image(Path("odd.tif"), pixels_and_rpc(good_pair[1])[0])
    rpc = fit_rpc(camera("fore"), (147, 150), UTM, (0.0, 120.0)).rpc
    Path("odd_RPC.TXT").write_text(rpc_txt(replace(rpc, samp_num=(value, *rpc.samp_num[1:]))))
    assert "odd" in refused(good_pair[0], "odd.tif")


def test_rpc_with_a_missing_coefficient(refused, good_pair):
    write_image(Path("odd.tif"), pixels_and_rpc(good_pair[1])[0])
    rpc = fit_rpc(camera("fore"), (147, 150), UTM, (0.0, 120.0)).rpc
    lines = rpc_txt(rpc).splitlines()
    Path("odd_RPC.TXT").write_text("\n".join(line for line in lines if not line.startswith("LINE_NUM_COEFF_7")))
    assert "LINE_NUM_COEFF" in refused(good_pair[0], "odd.tif")


def test_one_image(refused, good_pair):
    assert "two images or more" in refused(good_pair[0])
    Path("README.md").write_text("# An order")
    assert "README.md is no image. Give images" in refused("README.md")


def test_the_same_image_twice(refused, good_pair):
    assert "nadir.tif" in refused(good_pair[0], good_pair[0])


def test_images_of_different_places(refused, good_pair):
    elsewhere = moved(good_pair[1], "far.tif", lat_off=pixels_and_rpc(good_pair[1])[1].lat_off + 0.1)
    sentence = refused(good_pair[0], elsewhere)
    assert "far" in sentence
    assert "same ground" in sentence


@pytest.mark.parametrize("given_heights", [True, False])
def test_an_area_beside_the_images(refused, good_pair, given_heights):
    x, y = CENTRE[0] + 4000, CENTRE[1]
    extra = ("--heights", 20, 90) if given_heights else ()
    sentence = refused(*good_pair, *extra, "--crs", "EPSG:32632", "--bounds", x, y, x + 50, y + 50)
    assert "--bounds" in sentence


def test_polygons_beside_the_images(refused, good_pair):
    ring = [[12.0, 47.0], [12.1, 47.0], [12.1, 47.1], [12.0, 47.0]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    Path("area.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    assert "area.geojson" in refused(*good_pair, "--heights", 20, 90, "--area", "area.geojson")


@pytest.mark.parametrize("heights", [(60, 60), (90, 20), ("nan", 20)])
def test_heights_that_are_no_range(refused, good_pair, heights):
    assert "--heights" in refused(*good_pair, "--heights", *heights)


def test_heights_at_which_nothing_overlaps(refused, good_pair):
    assert "heights" in refused(*good_pair, "--heights", 8000, 9000)


@pytest.mark.parametrize("resolution", [0, -0.5, 0.04, "nan"])
def test_resolution(refused, good_pair, resolution):
    assert "--resolution" in refused(*good_pair, "--heights", 20, 90, "--resolution", resolution)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4979", "EPSG:999999", "somewhere"])
def test_crs(refused, good_pair, crs):
    assert crs.split(":")[-1] in refused(*good_pair, "--heights", 20, 90, "--crs", crs)


def test_like_that_is_geographic_or_no_raster(refused, good_pair):
    with rasterio.open(
        "degrees.tif", "w", driver="GTiff", width=5, height=5, count=1, dtype="uint8", crs="EPSG:4326",
        transform=rasterio.Affine(1e-5, 0, 8.5, 0, -1e-5, 47.4),
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, 5, 5), np.uint8))
    assert "degrees" in refused(*good_pair, "--like", "degrees.tif")
    Path("words.tif").write_text("words")
    assert "words.tif" in refused(*good_pair, "--like", "words.tif")


def test_like_with_oblong_cells(refused, good_pair):
    with rasterio.open(
        "oblong.tif", "w", driver="GTiff", width=5, height=5, count=1, dtype="uint8", crs="EPSG:32632",
        transform=rasterio.Affine(0.5, 0, CENTRE[0], 0, -0.7, CENTRE[1]),
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, 5, 5), np.uint8))
    assert "oblong.tif" in refused(*good_pair, "--heights", 20, 90, "--like", "oblong.tif")


@pytest.mark.parametrize("name", ["--dem", "--area", "--mask", "--like", "--config"])
def test_missing_side_files(refused, good_pair, name):
    assert "nowhere" in refused(*good_pair, name, "nowhere.tif")


def test_a_dem_that_does_not_cover_the_grid_is_refused(refused, good_pair):
    with rasterio.open(
        "dem.tif", "w", driver="GTiff", width=5, height=5, count=1, dtype="float32", crs="EPSG:32632",
        transform=rasterio.Affine(10, 0, CENTRE[0] + 9000, 0, -10, CENTRE[1]),
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, 5, 5), np.float32))
    assert "dem.tif" in refused(*good_pair, "--dem", "dem.tif")


def test_output_that_is_a_file(refused, good_pair):
    Path("taken").write_text("mine")
    assert "taken" in refused(*good_pair, out="taken")
    assert Path("taken").read_text() == "mine"


def test_output_that_cannot_be_written(refused, good_pair):
    assert "/proc/zlocus" in refused(*good_pair, out="/proc/zlocus")


def test_output_that_holds_another_run(refused, good_pair):
    Path("out").mkdir()
    Path("out/dsm.tif").write_text("mine")
    assert "--overwrite" in refused(*good_pair)


@pytest.mark.parametrize(("value", "says"), [(0, "valid"), (800, "800")])
def test_empty_and_constant_images(refused, good_pair, value, says):
    pixels, _ = pixels_and_rpc(good_pair[1])
    rpc = fit_rpc(camera("fore"), pixels.shape, UTM, (0.0, 120.0)).rpc
    write_rendered(Path("even.tif"), np.full_like(pixels, value), rpc)
    sentence = refused(good_pair[0], "even.tif")
    assert "even.tif" in sentence
    assert says in sentence


@pytest.mark.parametrize("heights", [(), ("--heights", 20, 90)])
def test_an_image_of_noise_is_not_matched(refused, good_pair, heights):
    """No tie point supports either image, with heights given and without."""
    pixels, rpc = pixels_and_rpc(good_pair[1])
    noise = np.random.default_rng(0).integers(1, 3000, pixels.shape).astype(np.uint16)
    write_image(Path("noise.tif"), noise, None, rpcs=rpc)
    said = refused(good_pair[0], "noise.tif", *heights, status=3)
    assert "No two images are held together by tie points" in said
    assert "noise" in said


def test_two_images_from_the_same_direction(refused, good_pair):
    pixels, rpc = pixels_and_rpc(good_pair[0])
    write_image(Path("twin.tif"), np.roll(pixels, 1), None, rpcs=rpc)
    assert "have the identical RPC" in refused(good_pair[0], "twin.tif", "--heights", 20, 90)
    rpc.line_off -= 1
    write_image(Path("part.tif"), pixels[1:], None, rpcs=rpc)
    assert "same line" in refused(good_pair[0], "part.tif", "--heights", 20, 90)


def test_unknown_configuration_keys(refused, good_pair):
    Path("mine.toml").write_text("[pyramid]\nblocks = 32\n")
    assert "blocks" in refused(*good_pair, "--config", "mine.toml")


def test_the_installed_command(good_pair, tmp_path):
    """One subprocess: as a shell sees it."""
    code = "from zlocus.cli.app import main; main()"
    run = subprocess.run(
        [sys.executable, "-c", code, "dsm", str(good_pair[0]), "gone.tif", "-o", "out"], cwd=tmp_path, text=True,
        capture_output=True, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert run.returncode == 2
    assert run.stdout == ""
    assert run.stderr.count("\n") == 1
    assert "gone.tif" in run.stderr
    assert not list(tmp_path.iterdir())
