"""Masks of images in whole runs: what they hide takes no part, and quality.tif, run.json and the pages say so."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import yaml

from mask_files import write_raster
from rendered_scenes import SIZE_PX, SMALL_TILES, camera, read, run, truth_at
from zlocus.core.options import RunConfig, large_window_side
from zlocus.inspector.cell import WhatIf
from zlocus.inspector.inspection import Inspection
from zlocus.io.scene_file import open_scene, read_scene_file
from zlocus.matching.quality import Quality
from zlocus.matching.tile_views import GROWN_PX
from zlocus.pipeline.doctor.quality import image_quality, quality_findings
from zlocus.products.corrected_cameras import write_cameras
from zlocus.products.report.text import masks

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif")
# The right half of an image, but not a window in it.
MASK = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
MASK[:, SIZE_PX // 2 :], MASK[60:80, 100:120] = 1, 0


def scene_of(folder, images, views, mask=None):
    """A scene file of some views, the nadir one with a mask."""
    entries = [{"name": name, "image": str(images.paths[name]), "camera": {"kind": "rpc"}} for name in views]
    if mask is not None:
        entries[0]["mask"] = str(write_raster(folder / "mask.tif", mask))
    (folder / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "views": entries}))
    return folder / "scene.yaml"


def surface_of(folder, images, views, mask=None, **request):
    folder.mkdir()
    return run((scene_of(folder, images, views, mask),), folder / "out", SMALL_TILES, **request).out


@pytest.fixture(scope="module")
def pair(images, tmp_path_factory):
    return surface_of(tmp_path_factory.mktemp("masked") / "pair", images("plane"), ("nadir", "fore"), MASK)


@pytest.fixture(scope="module")
def triplet(images, tmp_path_factory):
    folder = tmp_path_factory.mktemp("masked") / "triplet"
    return surface_of(folder, images("plane"), ("nadir", "fore", "aft"), MASK)


def expected_flags(source):
    """Cells whose window in the nadir image has a masked pixel, (r, c); those a pixel farther and nearer; and those
    that are not at the border of the image."""
    col, row = np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
    x, y = source.transform * (col, row)
    xyz = np.column_stack([x.ravel(), y.ravel(), truth_at("plane", source).ravel()])
    at = np.floor(camera("nadir").image_from_ground(xyz) + 0.5).astype(int)
    inside = ((at >= 0) & (at < SIZE_PX)).all(axis=1)
    flags, reach = [], large_window_side(RunConfig().cost) // 2 + GROWN_PX
    for more in (0, 1, -1):
        side = 2 * (reach + more) + 1
        hidden = cv2.dilate(MASK, np.ones((side, side), np.uint8)) > 0
        flags.append(np.zeros(len(xyz), bool))
        flags[-1][inside] = hidden[at[inside, 1], at[inside, 0]]
    flags.append(((at >= 1) & (at < SIZE_PX - 1)).all(axis=1))
    return [flag.reshape(col.shape) for flag in flags]


@pytest.mark.parametrize("out", ["pair", "triplet"])
def test_the_flag_is_set_exactly_where_the_mask_hides_the_image(out, request):
    """Where heights or cameras are a little off, the next pixel may decide: in one cell of a thousand."""
    quality, source = read(request.getfixturevalue(out) / "quality.tif")
    expected, farther, nearer, is_inner = expected_flags(source)
    found = (quality & Quality.IMAGE_EXCLUDED) != 0
    assert 0.3 < expected.mean() < 0.6
    assert (found != expected).mean() < 1e-3
    assert not (found & ~farther & is_inner).any()
    assert not (nearer & ~found & is_inner).any()
    assert quality.dtype == np.uint16


def test_of_two_images_what_is_masked_in_one_is_unseen(pair):
    quality, _ = read(pair / "quality.tif")
    height, _ = read(pair / "dsm.tif")
    excluded = (quality & Quality.IMAGE_EXCLUDED) != 0
    np.testing.assert_array_equal((quality & Quality.MASKED) == Quality.MASKED, excluded & np.isnan(height))
    assert np.isnan(height[excluded]).all()
    record = json.loads((pair / "run.json").read_text())
    assert record["masked_cells"] == excluded.sum()
    assert record["left_out_cells"] == 0


def test_of_three_images_the_others_still_make_heights(triplet):
    quality, source = read(triplet / "quality.tif")
    height, _ = read(triplet / "dsm.tif")
    views, _ = read(triplet / "views.tif")
    excluded = (quality & Quality.IMAGE_EXCLUDED) != 0
    kept = excluded & np.isfinite(height)
    assert kept.sum() > 0.7 * excluded.sum()
    assert views[kept].max() == 2
    assert views.max() == 3
    assert np.abs(height - truth_at("plane", source))[kept].max() < 0.5


def test_a_mask_of_nothing_changes_no_byte(images, tmp_path):
    without = surface_of(tmp_path / "without", images("plane"), ("nadir", "fore"))
    clear = surface_of(tmp_path / "clear", images("plane"), ("nadir", "fore"), np.zeros_like(MASK))
    for name in RASTERS:
        assert (without / name).read_bytes() == (clear / name).read_bytes(), name


def test_worker_processes_obey_masks_too(images, pair, tmp_path):
    spread = surface_of(tmp_path / "spread", images("plane"), ("nadir", "fore"), MASK, workers=2)
    for name in RASTERS:
        assert (pair / name).read_bytes() == (spread / name).read_bytes(), name


def test_the_record_the_report_and_the_doctor_tell_the_masked_share(pair):
    record = json.loads((pair / "run.json").read_text())
    assert record["masked_shares"] == {"nadir": pytest.approx(MASK.mean(), abs=1e-4)}
    assert str(pair.parent / "mask.tif") in [each["path"] for each in record["inputs"]]
    assert masks(record["masked_shares"]) == "Masks cover 48.2 % of nadir."
    assert masks({}) == ""
    qualities = [image_quality(view.image) for view in open_scene([pair.parent / "scene.yaml"]).views]
    assert [quality.masked for quality in qualities] == [pytest.approx(MASK.mean()), None]
    assert qualities[0].nodata == 0.0
    said = [finding.sentence for finding in quality_findings(["nadir", "fore"], qualities)]
    assert "nadir: its mask covers 48 % of its pixels." in said


def test_the_inspector_names_the_image_whose_mask_covers_a_cell(triplet):
    quality, source = read(triplet / "quality.tif")
    excluded = (quality & Quality.IMAGE_EXCLUDED) != 0
    with Inspection(triplet) as inspection:
        inspection._scene.result()
        found = []
        for cells in (excluded, ~excluded & ((quality & Quality.UNSEEN) == 0)):
            row, col = np.argwhere(cells)[cells.sum() // 2]
            accounts = inspection.cell(*(source.transform * (col + 0.5, row + 0.5)), WhatIf())["accounts"]
            found.append([account["image"] for account in accounts if account["kind"] == "masked"])
    assert found == [["nadir"], []]


def test_corrected_cameras_keep_the_masks_of_their_views(pair, tmp_path):
    given = pair.parent / "scene.yaml"
    write_cameras(tmp_path, [given], open_scene([given]))
    masked = [
        open_scene([path]).views[0].image.masked(0, 0, SIZE_PX, SIZE_PX) for path in (given, tmp_path / "scene.yaml")
    ]
    np.testing.assert_array_equal(*masked)
    assert read_scene_file(tmp_path / "scene.yaml").views[1].mask is None


def test_another_mask_is_another_run(images, pair, tmp_path):
    """A changed mask is a changed input: tiles of the old one are not used again."""
    out = surface_of(tmp_path / "first", images("plane"), ("nadir", "fore"), MASK)
    scene_file = scene_of(tmp_path / "first", images("plane"), ("nadir", "fore"), 1 - MASK)
    again = run((scene_file,), out, SMALL_TILES, overwrite=True).out
    assert (again / "quality.tif").read_bytes() != (pair / "quality.tif").read_bytes()
    share = json.loads((again / "run.json").read_text())["masked_shares"]["nadir"]
    assert share == pytest.approx(1 - MASK.mean(), abs=1e-4)
