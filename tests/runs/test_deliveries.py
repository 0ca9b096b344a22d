"""From a delivery to its products: the heights of single files, in the colours of the multispectral images."""

from __future__ import annotations

import io
import json
import shutil
import zipfile

import laspy
import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp

from made_up_deliveries import dimap_delivery, maxar_delivery, shots, write_single, zipped
from rendered_scenes import read, run
from stac_rules import validated
from zlocus.core.options import RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import progress_for
from zlocus.core.requests import CloudRequest
from zlocus.core.rerun_request import RerunRequest
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.orient import run_orient
from zlocus.pipeline.rerun import run_again
from zlocus.products.ortho_colours import colour_records, colour_sentence
from zlocus.products.report.page import write_report


@pytest.fixture(scope="module")
def taken(images):
    return shots({name: images("sine").paths[name] for name in ("nadir", "fore")})


@pytest.fixture(scope="module")
def archive(taken, tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    return zipped(maxar_delivery(folder / "delivery", taken), folder / "d.zip", zipfile.ZIP_STORED)


@pytest.fixture(scope="module")
def surface(archive, tmp_path_factory):
    return run((archive,), tmp_path_factory.mktemp("surface") / "out").out


def test_the_heights_are_those_of_single_files(taken, surface, tmp_path):
    single = run(tuple(write_single(tmp_path / "single", shot) for shot in taken), tmp_path / "out").out
    for name in ("dsm.tif", "sigma.tif", "quality.tif", "views.tif"):
        assert (surface / name).read_bytes() == (single / name).read_bytes(), name
    record = json.loads((surface / "run.json").read_text())
    assert [path["path"].rpartition("/")[2] for path in record["inputs"]] == ["d.zip"]
    assert list(record["acquisitions"]) == ["WV03_20141005T160138", "WV03_20141005T160218"]
    assert record["image_dates"] == ["2014-10-05"] * 2
    properties = validated(json.loads((surface / "item.json").read_text()))["properties"]
    assert [image["name"] for image in properties["zlocus:images"]] == list(record["acquisitions"])
    assert [properties["start_datetime"][:19], properties["end_datetime"][:19]] == [
        "2014-10-05T16:01:38", "2014-10-05T16:02:18",
    ]  # fmt: skip


def test_the_ortho_image_has_the_colours(surface):
    with rasterio.open(surface / "ortho.tif") as file:
        assert file.colorinterp == (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        bands, valid = file.read().astype(float), file.read_masks(1) > 0
    # Each band is another multiple of the grey value: see the made-up delivery.
    red, green, blue = (band[valid].mean() for band in bands)
    assert green / red == pytest.approx(0.75, abs=0.01)
    assert blue / red == pytest.approx(0.5, abs=0.01)


def test_the_run_says_what_gives_the_colours(surface):
    record = json.loads((surface / "run.json").read_text())
    names = [path.rpartition("/")[2] for path in record["colours"].values()]
    assert all("-M1BS-" in name for name in names)
    sentence = f"The ortho-image has the colours of {', '.join(names)}."
    assert colour_sentence(record["colours"]) == sentence
    write_report(surface)
    assert sentence in (surface / "report.html").read_text()


def test_why_an_ortho_image_is_grey(taken, tmp_path):
    root = maxar_delivery(tmp_path / "delivery", taken)
    shutil.rmtree(next(root.glob("*P001_MUL")))
    records = colour_records(open_scene([root]).views)
    assert colour_sentence(records).startswith("The ortho-image is grey, because")
    assert "and WV03_20141005T160138 has none" in colour_sentence(records)
    assert colour_records(open_scene([write_single(tmp_path / "single", shot) for shot in taken]).views) == {}


def test_the_cloud_has_the_colours(archive, tmp_path):
    request = CloudRequest((archive,), tmp_path / "cloud", crs="EPSG:32632", references=("WV03_20141005T160138",))
    run_cloud(request, RunConfig(), progress_for(io.StringIO()))
    points = laspy.read(tmp_path / "cloud" / "cloud.laz")
    ratio = np.median(points.green / points.red)
    assert ratio == pytest.approx(0.75, abs=0.02)


def test_corrected_cameras_keep_colours_and_masks(taken, archive, surface, tmp_path):
    for kind, given in (("archive", archive), ("folder", dimap_delivery(tmp_path / "delivery", taken))):
        oriented = tmp_path / kind
        run_orient(OrientRequest((given,), oriented), RunConfig(), progress_for(io.StringIO()))
        for view, shot in zip(open_scene([oriented / "scene.yaml"]).views, taken, strict=True):
            assert view.image.has_colours
            expected = np.ones_like(shot.is_cloudy) if kind == "archive" else ~shot.is_cloudy
            assert np.array_equal(view.image.read(0, 0, *shot.grey.shape).valid, expected)
    again = run((tmp_path / "archive" / "scene.yaml",), tmp_path / "again").out
    with rasterio.open(again / "ortho.tif") as file, rasterio.open(surface / "ortho.tif") as before:
        assert file.count == 3
        # The cameras were corrected by some hundredths of a pixel.
        assert np.abs(file.read().astype(float) - before.read()).mean() < 1.0


def test_the_run_is_repeated_from_its_record(surface, tmp_path):
    run_again(RerunRequest(surface / "run.json", tmp_path / "again"), progress_for(io.StringIO()))
    assert (surface / "dsm.tif").read_bytes() == (tmp_path / "again" / "dsm.tif").read_bytes()
    heights, _ = read(surface / "dsm.tif")
    assert np.isfinite(heights).mean() > 0.5
