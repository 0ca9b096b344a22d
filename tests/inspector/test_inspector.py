"""What the inspector says of a surface is what the run's own functions say, and what it must not answer it does not."""

from __future__ import annotations

import functools
import hashlib
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from inspected import a_cell, heights_of, opened, served
from rendered_scenes import SMALL_TILES, UTM, run
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, InputError, OutputError
from zlocus.core.options import RunConfig
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.inspector.cell import WhatIf, labels_say, match_record, nearest_says
from zlocus.inspector.folder import Patch, read_patch, surface_folder
from zlocus.inspector.guard import inline_hashes
from zlocus.inspector.inspection import MADE_AGAIN, NOT_THE_SAME, Inspection
from zlocus.inspector.queries import BadQuery, number, once, what_if, whole
from zlocus.inspector.reference import name_of
from zlocus.inspector.restored_run import restored
from zlocus.inspector.server import page_files
from zlocus.inspector.serving import checked_address, fragment_of, listening
from zlocus.matching.point_match import curves_at
from zlocus.pipeline.recorded_run import folder_of, request_of
from zlocus.pipeline.report_inputs import SHOWN_WITHIN_CELLS, place_of_cell
from zlocus.products.point_report import PointReport, point_record
from zlocus.products.report.maps import FLAG_GROUPS, groups_of
from zlocus.products.tie_observations import OBSERVATIONS

LAYERS = ["hillshade", "height", "ortho", "sigma", "views", "quality", "dtm", "above", "difference"]
# Of what is rounded for the page: correlations, heights.
ROUNDED_NCC, ROUNDED_M = 1e-5, 1e-4
UNDULATION_M = 47.0
# Longer than any answer takes, and than an end.
PATIENCE_S = 5.0
SHIFT_M = (2.0, -1.0, 0.5)


@pytest.fixture(scope="module")
def out(images, tmp_path_factory):
    """A run over all of the sine; not to be changed."""
    out = tmp_path_factory.mktemp("inspected") / "out"
    return run(images("sine"), out, SMALL_TILES, report=True, products=("hillshade", "dtm")).out


@pytest.fixture(scope="module")
def beside(out, tmp_path_factory):
    """Heights of the surface and 0.25 m, with a hole, above the ellipsoid."""
    return written(out, tmp_path_factory.mktemp("reference") / "reference.tif", lambda z: z + 0.25)


def written(out, path, change, **profile) -> Path:
    with rasterio.open(out / "dsm.tif") as file:
        z, kept, above = file.read(1), file.profile, file.descriptions[0]
    z[60:70, 60:70] = np.nan
    with rasterio.open(path, "w", **{**kept, "driver": "GTiff", **profile}) as file:
        file.write(change(z).astype(np.float32), 1)
        if "crs" not in profile:
            file.set_band_description(1, above)
    return path


@pytest.fixture(scope="module")
def page(out, beside):
    """The inspection with a reference, and a client of its page."""
    with (
        served(out, Comparison(beside, margin_m=0.0)) as (inspection, address),
        httpx.Client(base_url=address) as client,
    ):
        yield inspection, client


@pytest.fixture(scope="module")
def scene(out):
    return restored(out, surface_folder(out).run)


def report_of(scene, folder, row, col, config: RunConfig, reference=None, views=None) -> PointReport:
    """What the library says of a cell, without the inspector."""
    xy = folder.centre_of(row, col)
    match_scene = scene.run.match_scene
    place = place_of_cell(xy, folder.cell(row, col)["dsm"], scene.run)
    if views is not None:
        kept = [i for i, view in enumerate(match_scene.views) if view.name in views]
        match_scene = replace(
            match_scene,
            views=tuple(match_scene.views[i] for i in kept),
            grey_scales=tuple(match_scene.grey_scales[i] for i in kept),
        )
    looked = curves_at("the cell", reference, match_scene, place, config, SHOWN_WITHIN_CELLS)
    return PointReport.of("the cell", looked, match_scene, scene.run.scene.crs)


def same_record(found: dict, report: PointReport, config: RunConfig) -> None:
    expected = json.loads(json.dumps(point_record(report, config.selection)))
    assert {name: found[name] for name in expected} == expected
    np.testing.assert_allclose(np.array(found["ncc"], float), report.curves.single_curves.values, atol=ROUNDED_NCC)
    np.testing.assert_allclose(np.array(found["sncc"], float), report.curves.mean_curves.values, atol=ROUNDED_NCC)
    np.testing.assert_allclose(found["heights_m"], report.heights_m, atol=ROUNDED_M)


def test_the_scene_comes_out_as_it_was_in_the_run(out, scene):
    assert scene.is_same
    assert not list(out.glob(".*"))


def test_a_cell_is_told_as_the_library_tells_it(page, out, scene):
    inspection, client = page
    row, col = a_cell(out)
    x, y = inspection.folder.centre_of(row, col)
    found = client.get("api/cell", params={"x": x + 0.1, "y": y - 0.1}).json()
    for name, raster in (("height_m", "dsm"), ("sigma_m", "sigma"), ("n_images", "views"), ("quality", "quality")):
        with rasterio.open(out / f"{raster}.tif") as file:
            assert found[name] == file.read(1)[row, col].item()
    assert (found["row"], found["col"], found["x"], found["y"]) == (row, col, x, y)
    assert found["difference_m"] == pytest.approx(-0.25, abs=ROUNDED_M)
    same_record(found["match"], report_of(scene, inspection.folder, row, col, scene.config), scene.config)


@pytest.mark.parametrize(
    ("asked", "window", "selection", "reference", "views"),
    [
        ({"window": "7"}, 7, {}, None, None),
        ({"rho1_high": "0.99", "ratio_low": "3", "neighbours": "tin"}, None,
         {"rho1_high": 0.99, "ratio_low": 3.0, "neighbours": "tin"}, None, None),
        ({"reference": "aft", "nearest": "9"}, None, {"nearest": 9}, "aft", None),
        ({"without": "nadir"}, None, {}, None, ("fore", "aft")),
    ],
)  # fmt: skip
def test_what_if_is_computed_by_the_same_functions(page, out, scene, asked, window, selection, reference, views):
    inspection, client = page
    row, col = a_cell(out)
    x, y = inspection.folder.centre_of(row, col)
    config = replace(scene.config, selection=replace(scene.config.selection, **selection))
    if window is not None:
        config = replace(config, cost=replace(config.cost, large_window=window))
    found = client.get("api/cell", params={"x": x, "y": y, **asked}).json()["match"]
    expected = report_of(scene, inspection.folder, row, col, config, reference, views)
    same_record(found, expected, config)
    as_run = report_of(scene, inspection.folder, row, col, scene.config)
    assert json.dumps(found["curves"]) != json.dumps(point_record(as_run, scene.config.selection)["curves"])


def test_windows_and_lines_are_those_of_the_images(page, out, scene):
    """The middle of the patch is the window whose correlation is shown, and the line goes where the camera says."""
    inspection, client = page
    row, col = a_cell(out)
    xy = inspection.folder.centre_of(row, col)
    found = client.get("api/cell", params={"x": xy[0], "y": xy[1]}).json()["match"]
    report = report_of(scene, inspection.folder, row, col, scene.config)
    views = {view.name: view for view in scene.run.match_scene.views}
    for image in found["images"]:
        xyz = np.column_stack([np.broadcast_to(report.middle, (len(report.heights_m), 2)), report.heights_m])
        exact = views[image["image"]].sensor.image_from_ground(xyz)
        np.testing.assert_allclose(image["line"], exact, atol=0.006)
        assert image["col"] <= exact[:, 0].min()
        assert exact[:, 0].max() <= image["col"] + image["cols"] - 1
        assert image["row"] <= exact[:, 1].min()
        assert exact[:, 1].max() <= image["row"] + image["rows"] - 1
    assert [image["image"] for image in found["images"]] == [report.reference, *report.search]


def test_a_cell_without_a_height_has_curves_all_the_same(out, scene):
    folder = surface_folder(out)
    row, col = a_cell(out)
    found = match_record(folder, scene, folder.centre_of(row, col), np.nan, WhatIf())["match"]
    assert "tie points" in found["height_from"]
    assert len(found["heights_m"]) == 2 * scene.config.selection.reach_steps + 1


def test_two_images_are_needed(page, out):
    inspection, client = page
    x, y = inspection.folder.centre_of(*a_cell(out))
    found = client.get("api/cell", params={"x": x, "y": y, "without": ["nadir", "fore"]}).json()
    assert found["error"] == "At least two images are needed. Switch on another one."
    assert "match" not in found
    assert found["height_m"] is not None


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_are_clear_where_the_surface_is_empty(page, out, layer):
    _, client = page
    answer = client.get(f"tiles/{layer}/0/0/0.png")
    assert answer.headers["content-type"] == "image/png"
    drawn = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert drawn.shape == (256, 256, 4)
    known = np.isfinite(heights_of(out))
    rows, cols = known.shape
    shown = drawn[:rows, :cols, 3] > 0
    assert not drawn[rows:, :, 3].any()
    assert not drawn[:, cols:, 3].any()
    with rasterio.open(out / "quality.tif") as file:
        has_reason = groups_of(file.read(1).astype(np.int64)) < len(FLAG_GROUPS)
    if layer == "hillshade":
        assert shown[known].mean() > 0.95  # at holes it needs neighbours
    elif layer == "quality":
        np.testing.assert_array_equal(shown, has_reason)
    elif layer == "difference":
        known[60:70, 60:70] = False
        np.testing.assert_array_equal(shown, known)
    elif layer in ("dtm", "above"):
        with rasterio.open(out / "dtm.tif") as file:
            is_ground = np.isfinite(file.read(1))
        np.testing.assert_array_equal(shown, is_ground & known if layer == "above" else is_ground)
    else:
        np.testing.assert_array_equal(shown, known)


def test_heights_are_coloured_by_their_share_of_the_range(page, out):
    inspection, client = page
    drawn = cv2.imdecode(np.frombuffer(client.get("tiles/height/0/0/0.png").content, np.uint8), cv2.IMREAD_UNCHANGED)
    heights = heights_of(out)
    low, high = (float(tick) for tick in np.array(inspection.layers["height"].legend["ticks"])[[0, -1]])
    share = np.clip((heights - low) / (high - low), 0, 1)
    known = np.isfinite(heights)
    expected = cv2.applyColorMap(np.nan_to_num(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    away = np.abs(drawn[: heights.shape[0], : heights.shape[1], :3].astype(int) - expected)[known]
    assert np.percentile(away, 99) <= 8  # ticks are rounded


def test_heights_above_the_terrain_are_those_of_both_rasters(page, out):
    inspection, client = page
    row, col = a_cell(out)
    with rasterio.open(out / "dtm.tif") as file:
        ground = file.read(1)
    heights = heights_of(out)
    x, y = inspection.folder.centre_of(row, col)
    found = client.get("api/cell", params={"x": x, "y": y}).json()
    assert found["above_terrain_m"] == pytest.approx(heights[row, col] - ground[row, col], abs=ROUNDED_M)
    line = client.get("api/profile", params={"x0": x, "y0": y, "x1": x + 10, "y1": y}).json()
    expected = ground[row, col : col + len(line["terrain_m"])]
    np.testing.assert_allclose(np.array(line["terrain_m"], float), expected, atol=ROUNDED_M)
    drawn = cv2.imdecode(np.frombuffer(client.get("tiles/above/0/0/0.png").content, np.uint8), cv2.IMREAD_UNCHANGED)
    top = float(inspection.layers["above"].legend["ticks"][-1])
    share = np.clip((heights - ground) / top, 0, 1)[row, col]
    expected = cv2.applyColorMap(np.array([[255 * share]], np.uint8), cv2.COLORMAP_INFERNO)[0, 0]
    assert np.abs(drawn[row, col, :3].astype(int) - expected).max() <= 8  # ticks are rounded


def test_without_a_terrain_model_there_are_no_layers_of_it(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    (copy / "dtm.tif").unlink()
    inspection = Inspection(copy)
    assert not {"dtm", "above"} & set(inspection.layers)
    assert not inspection.summary()["has_terrain"]


def test_the_extent_is_that_of_the_heights(page, out):
    inspection, _ = page
    rows, cols = np.nonzero(np.isfinite(heights_of(out)))
    assert inspection.summary()["extent"] == [rows.min(), cols.min(), rows.max() + 1, cols.max() + 1]


def test_tie_points_are_told_with_their_heights(page, out, scene):
    inspection, client = page
    row, col = a_cell(out)
    x, y = inspection.folder.centre_of(row, col)
    found = client.get("api/cell", params={"x": x, "y": y}).json()["match"]["neighbours"]
    heights = heights_of(out)
    for point in found["points"]:
        (tie,) = np.flatnonzero(np.hypot(*(scene.run.match_scene.ties[:, :2] - (point["x"], point["y"])).T) < 1e-6)[:1]
        assert point["height_m"] == pytest.approx(scene.run.match_scene.ties[tie, 2])
        at = inspection.folder.cell_of(point["x"], point["y"])
        if at is None or np.isnan(heights[at]):
            assert point["above_surface_m"] is None
        else:
            assert point["above_surface_m"] == pytest.approx(point["height_m"] - heights[at], abs=ROUNDED_M)
        assert f"lies {point['distance_m']:.1f} m from the cell" in point["says"]
    first = found["points"][0]
    assert found["says"] == (
        f"The nearest tie point lies {first['distance_m']:.1f} m away; its height differs by "
        f"{abs(first['above_surface_m']):.2f} m from the surface there."
    )


def test_labels_of_a_tie_point_in_words():
    assert labels_say("a", ["b", "c", "d"], [1, -1, 1]) == "There the match of a is good with b, d; poor with c."
    assert nearest_says(6.4, -0.02).endswith("differs by 0.02 m from the surface there.")
    assert "no height there" in nearest_says(6.4, np.nan)


def test_what_the_matcher_weighed_is_asked_for_by_itself(page, out):
    inspection, client = page
    x, y = inspection.folder.centre_of(*a_cell(out))
    found = client.get("api/matcher", params={"x": x, "y": y}).json()
    assert found["says"][0].endswith("The cell gets the height of the surface again.")
    part = inspection._matched_part
    beside = client.get("api/matcher", params={"x": x + inspection.folder.cell_m, "y": y}).json()
    assert inspection._matched_part is part  # it is not matched a second time
    assert beside["says"][0] == found["says"][0]
    assert client.get("api/matcher", params={"x": 0, "y": 0}).status_code == 404
    assert client.get("api/matcher", params={"x": x, "y": y, "window": 7}).status_code == 400


def test_hillshade_is_made_where_the_run_made_none(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    with_file = Inspection(copy).layers["hillshade"].draw(Patch(0, 0, 100, 100, 100, 100))
    (copy / "hillshade.tif").unlink()
    without = Inspection(copy).layers["hillshade"].draw(Patch(0, 0, 100, 100, 100, 100))
    both = (with_file[..., 3] > 0) & (without[..., 3] > 0)
    assert both.sum() > 5000
    np.testing.assert_array_equal(with_file[both], without[both])


def test_patches_come_from_overviews_and_keep_their_place(tmp_path, out):
    """A patch at a quarter of the size is the mean of four by four cells, wherever it begins."""
    folder = surface_folder(out)
    heights = heights_of(out)
    rows, cols = 40, 48
    cells = read_patch(folder.path("dsm"), Patch(64, 72, rows, cols, rows // 4, cols // 4), True)
    part = heights[64 : 64 + rows, 72 : 72 + cols]
    means = part.reshape(rows // 4, 4, cols // 4, 4).mean(axis=(1, 3))
    known = np.isfinite(means)
    np.testing.assert_allclose(cells.values[0][known], means[known], atol=2e-3)
    outside = read_patch(folder.path("dsm"), Patch(-20, -20, 40, 40, 40, 40), False)
    assert not outside.known[:20].any()
    assert not outside.known[:, :20].any()
    np.testing.assert_array_equal(outside.values[0][20:, 20:], heights[:20, :20])


def test_profiles_are_the_cells_along_the_line(page, out):
    inspection, client = page
    folder, heights = inspection.folder, heights_of(out)
    (x0, y0), (x1, y1) = folder.centre_of(50, 20), folder.centre_of(50, 120)
    found = client.get("api/profile", params={"x0": x0, "y0": y0, "x1": x1, "y1": y1}).json()
    assert found["spacing_m"] == pytest.approx(folder.cell_m)
    assert found["distance_m"][-1] == pytest.approx(100 * folder.cell_m)
    np.testing.assert_allclose(np.array(found["height_m"], float), heights[50, 20:121], atol=ROUNDED_M)
    with rasterio.open(out / "sigma.tif") as file:
        np.testing.assert_allclose(np.array(found["sigma_m"], float), file.read(1)[50, 20:121], atol=ROUNDED_M)
    (x0, y0), (x1, y1) = folder.centre_of(64, 40), folder.centre_of(64, 90)
    found = client.get("api/profile", params={"x0": x0, "y0": y0, "x1": x1, "y1": y1}).json()
    expected = heights[64, 40:91] + 0.25
    expected[20:30] = np.nan
    np.testing.assert_allclose(np.array(found["reference_m"], float), expected, atol=ROUNDED_M)


def test_long_profiles_and_those_beyond_the_surface(page):
    _, client = page
    found = client.get("api/profile", params={"x0": 0, "y0": 0, "x1": 9e8, "y1": 9e8}).json()
    assert len(found["height_m"]) == 2000
    assert set(found["height_m"]) == {None}


def test_heights_for_the_view_in_three_dimensions(page, out):
    _, client = page
    asked = {"row": 10, "col": 20, "rows": 30, "cols": 40, "height": 30, "width": 40}
    content = client.get("api/heights", params=asked).content
    assert len(content) == 5 * 30 * 40  # heights, and a byte of breaks for each
    found = np.frombuffer(content, "<f4", 30 * 40).reshape(30, 40)
    np.testing.assert_array_equal(found, heights_of(out)[10:40, 20:60])


def test_a_picture_is_the_layers_over_each_other(page):
    inspection, client = page
    asked = {"row": 30, "col": 30, "rows": 50, "cols": 60, "height": 50, "width": 60}
    answer = client.get("api/picture.png", params={**asked, "layer": ["hillshade", "height:0.25"]})
    drawn = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]].astype(float)
    below, above = (
        inspection.layers[name].draw(Patch(30, 30, 50, 60, 50, 60)).astype(float) for name in ("hillshade", "height")
    )
    both = (below[..., 3] > 0) & (above[..., 3] > 0)
    expected = 0.75 * below[..., :3] + 0.25 * above[..., :3]
    assert both.sum() > 2000
    np.testing.assert_allclose(drawn[both][:, :3], expected[both], atol=1)


def test_the_surface_of_another_run_has_the_name_of_its_folder(tmp_path):
    assert name_of(tmp_path / "winter" / "dsm.tif") == "winter/dsm.tif"
    assert name_of(tmp_path / "winter" / "laser.tif") == "laser.tif"


def test_the_reference_is_moved_as_the_surface_is(out, tmp_path):
    with rasterio.open(out / "dsm.tif") as file:
        moved = file.transform.translation(-SHIFT_M[0], -SHIFT_M[1]) * file.transform
    reference = written(out, tmp_path / "moved.tif", lambda z: z - SHIFT_M[2], transform=moved)
    comparison = Comparison(reference, coregister="nuth-kaab", margin_m=0.0)
    shift = evaluate(out / "dsm.tif", comparison).shift
    np.testing.assert_allclose(shift.enu_m, SHIFT_M, atol=0.1)
    with Inspection(out, comparison) as inspection:
        opened(inspection)
        row, col = a_cell(out)
        x, y = inspection.folder.centre_of(row, col)
        assert abs(inspection.cell(x, y, WhatIf())["difference_m"]) < 0.1


def test_a_reference_above_a_geoid_is_raised(out, tmp_path):
    geoid = tmp_path / "geoid.tif"
    with rasterio.open(out / "dsm.tif") as file:
        bounds = rasterio.warp.transform_bounds(file.crs, "EPSG:4326", *file.bounds)
    transform = rasterio.transform.from_bounds(bounds[0] - 1, bounds[1] - 1, bounds[2] + 1, bounds[3] + 1, 20, 20)
    with rasterio.open(geoid, "w", driver="GTiff", width=20, height=20, count=1, dtype="float32", crs="EPSG:4326",
                       transform=transform) as file:  # fmt: skip
        file.write(np.full((20, 20), UNDULATION_M, np.float32), 1)
    reference = written(out, tmp_path / "above.tif", lambda z: z - UNDULATION_M + 0.25, crs="EPSG:32632")
    with Inspection(out, Comparison(reference, geoid=geoid, margin_m=0.0)) as inspection:
        opened(inspection)
        x, y = inspection.folder.centre_of(*a_cell(out))
        assert inspection.cell(x, y, WhatIf())["difference_m"] == pytest.approx(-0.25, abs=1e-3)


def test_a_surface_above_a_geoid_is_looked_at_above_it(images, tmp_path):
    geoid = tmp_path / "geoid.tif"
    transform = rasterio.transform.from_bounds(7, 46, 10, 49, 30, 30)
    with rasterio.open(geoid, "w", driver="GTiff", width=30, height=30, count=1, dtype="float32", crs="EPSG:4326",
                       transform=transform) as file:  # fmt: skip
        file.write(np.full((30, 30), UNDULATION_M, np.float32), 1)
    from zlocus.core.progress import SilentProgress
    from zlocus.core.requests import DsmRequest
    from zlocus.pipeline.dsm import run_dsm

    request = DsmRequest(images("sine").inputs, tmp_path / "out", crs="EPSG:32632", resolution=0.5,
                         heights=(25 - UNDULATION_M, 80 - UNDULATION_M), vertical=str(geoid), report=False)  # fmt: skip
    out = run_dsm(request, SMALL_TILES, SilentProgress()).out
    ellipsoidal = out / "ellipsoidal.tif"
    with rasterio.open(out / "dsm.tif") as file:
        z, profile = file.read(1), file.profile
    with rasterio.open(ellipsoidal, "w", **{**profile, "driver": "GTiff", "crs": "EPSG:32632"}) as file:
        file.write(z + UNDULATION_M, 1)
        file.set_band_description(1, "height above the ellipsoid")
    with Inspection(out, Comparison(ellipsoidal, geoid=geoid, margin_m=0.0)) as inspection:
        opened(inspection)
        row, col = a_cell(out)
        found = inspection.cell(*inspection.folder.centre_of(row, col), WhatIf())
    assert found["difference_m"] == pytest.approx(0.0, abs=1e-3)
    heights = found["match"]["heights_m"]
    assert heights[len(heights) // 2] == pytest.approx(z[row, col], abs=1e-3)
    assert abs(found["match"]["peak_m"] - z[row, col]) < 0.5


@pytest.mark.parametrize("is_relative", [True, False])
def test_a_folder_that_was_moved_with_its_images_finds_them(images, tmp_path, monkeypatch, is_relative):
    home = tmp_path / "home"
    home.mkdir()
    for path in images("plane").inputs:
        shutil.copy(path, home)
    monkeypatch.chdir(home)
    inputs = tuple(Path(path.name) for path in images("plane").inputs)
    run(inputs, Path("out"), SMALL_TILES)
    monkeypatch.chdir(tmp_path)
    shutil.move(home, tmp_path / "away")
    moved = Path("away/out") if is_relative else tmp_path / "away" / "out"
    record = surface_folder(moved).run
    assert folder_of(moved, record).resolve() == (tmp_path / "away").resolve()
    assert restored(moved, record).is_same


def test_without_its_images_a_surface_is_still_shown(images, tmp_path):
    home = tmp_path / "images"
    home.mkdir()
    inputs = tuple(Path(shutil.copy(path, home)) for path in images("plane").inputs)
    out = run(inputs, tmp_path / "out", SMALL_TILES).out
    inputs[0].unlink()
    with Inspection(out) as inspection:
        opened(inspection)
        x, y = inspection.folder.centre_of(*a_cell(out))
        found = inspection.cell(x, y, WhatIf())
        assert found["height_m"] is not None
        assert found["error"].startswith(f"There is no image {inputs[0]}")
        assert inspection.state()["scene"]["is"] == "failed"


def test_images_that_have_changed_are_noticed(images, tmp_path):
    home = tmp_path / "images"
    home.mkdir()
    inputs = tuple(Path(shutil.copy(path, home)) for path in images("plane").inputs)
    out = run(inputs, tmp_path / "out", SMALL_TILES).out
    with rasterio.open(inputs[0], "r+") as file:
        file.write(np.roll(file.read(1), 7, axis=1), 1)
    with Inspection(out) as inspection:
        assert opened(inspection).state()["notes"] == [NOT_THE_SAME]


def test_what_is_no_surface_is_refused_with_a_sentence(out, tmp_path):
    with pytest.raises(InputError, match=r"no run\.json"):
        Inspection(tmp_path)
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    (copy / OBSERVATIONS).write_bytes(b"PK nothing")
    with pytest.raises(InputError, match=r"observations\.npz is missing or damaged"):
        restored(copy, surface_folder(copy).run)
    record = json.loads((copy / "run.json").read_text())
    record["config"]["request"]["inputs"] = 7
    with pytest.raises(InputError, match="does not hold the request of the run"):
        request_of(copy / "run.json", record)
    (copy / "views.tif").unlink()
    with pytest.raises(InputError, match=r"views\.tif"):
        Inspection(copy)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("../", 404), ("..%2f", 404), ("%2e%2e/", 404), ("../../../../etc/passwd", 404), ("/etc/passwd", 403),
        ("//etc/passwd", 404), ("static/../../server.py", 404), ("static/..%2f..%2fserver.py", 404),
        ("static/%2e%2e/server.py", 404), ("static//etc/passwd", 404), ("static/%2fetc%2fpasswd", 404),
        ("static/vendor", 404), ("static/", 404), ("tiles/..%2f..%2fdsm/0/0/0.png", 404),
        ("tiles/dsm.tif/0/0/0.png", 404),
        ("tiles/height/0/0/../../../run.json", 404), ("tiles/height/-1/0/0.png", 400), ("tiles/height/99/0/0.png", 400),
        ("tiles/height/0/1/0.png", 400), ("tiles/height/0/0/9999999999999999999999.png", 400),
        ("tiles/height/0/nan/0.png", 400), ("tiles/height/0/0.5/0.png", 400), ("tiles/height/0/0/0.png?layer=x", 400),
        ("api/cell", 400), ("api/cell?x=1", 400), ("api/cell?x=nan&y=1", 400), ("api/cell?x=inf&y=-inf", 400),
        ("api/cell?x=1e400&y=1", 400), ("api/cell?x=1e300&y=1e300", 404), ("api/cell?x=0&y=0", 404),
        ("api/cell?x=1&x=2&y=1", 400), ("api/cell?x=1&y=1&path=/etc/passwd", 400),
        ("api/cell?x=1_0&y=" + "9" * 999, 400),
        ("api/cell?x={x}&y={y}&window=4", 400), ("api/cell?x={x}&y={y}&window=nan", 400),
        ("api/cell?x={x}&y={y}&rho1_high=nan", 400), ("api/cell?x={x}&y={y}&rho1_high=2", 400),
        ("api/cell?x={x}&y={y}&neighbours=all", 400), ("api/cell?x={x}&y={y}&reference=../../dsm.tif", 400),
        ("api/cell?x={x}&y={y}&without=/etc/passwd", 400), ("api/cell?x={x}&y={y}&reach_steps=1e9", 400),
        ("api/cell?x={x}&y={y}&nearest=2.5", 400),
        ("api/profile?x0=nan&y0=0&x1=1&y1=1", 400), ("api/profile?x0=1e10&y0=0&x1=1&y1=1", 400),
        ("api/heights?row=0&col=0&rows=10&cols=10&height=5000&width=10", 400),
        ("api/heights?row=0&col=0&rows=0&cols=10&height=10&width=10", 400),
        ("api/heights?row=1e9&col=0&rows=10&cols=10&height=10&width=10", 400),
        ("api/picture.png?row=0&col=0&rows=1&cols=1&height=1&width=1&layer=..", 404),
        ("api/picture.png?row=0&col=0&rows=1&cols=1&height=1&width=1&layer=height:7", 400),
        ("api/surface?x=1", 400), ("api/nothing", 404), ("index.html", 404), ("dsm.tif", 404), ("run.json", 404),
    ],
)  # fmt: skip
def test_nothing_but_what_the_page_asks_is_answered(page, out, path, status):
    """The address goes to the server just as it stands here: no client tidies it first."""
    inspection, client = page
    x, y = inspection.folder.centre_of(*a_cell(out))
    answer, content = raw(client, "GET", path.replace("{x}", str(x)).replace("{y}", str(y)))
    assert answer.status == status
    assert len(content) < 300
    assert b"root:" not in content
    assert str(out).encode() not in content


def raw(client, method, path, headers=None, token=True):
    """An answer to a request line that nothing has changed."""
    base = urlsplit(str(client.base_url))
    connection = HTTPConnection(base.hostname, base.port, timeout=20)
    target = path if path.startswith("/") and not path.startswith("//") else base.path + path
    connection.putrequest(method, target, skip_host="Host" in (headers or {}))
    for name, value in (headers or {}).items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer, content


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("GET", {}, 200), ("HEAD", {}, 200), ("POST", {}, 405), ("PUT", {}, 405), ("DELETE", {}, 405),
        ("OPTIONS", {}, 405), ("GET", {"Origin": "http://evil.example"}, 403), ("GET", {"Origin": "null"}, 403),
        ("GET", {"Origin": "https://{host}"}, 403), ("GET", {"Origin": "http://{host}"}, 200),
        ("GET", {"Host": "evil.example"}, 403), ("GET", {"Host": "localhost:1"}, 403), ("GET", {"Host": ""}, 403),
        ("GET", {"Host": "{host}"}, 200),
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["", "api/surface", "tiles/height/0/0/0.png", "static/style.css"])
def test_other_hosts_origins_and_methods_are_refused(page, path, method, headers, status):
    _, client = page
    host = urlsplit(str(client.base_url)).netloc
    answer, content = raw(
        client, method, path, {name: value.replace("{host}", host) for name, value in headers.items()}
    )
    assert answer.status == status
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert answer.headers["Referrer-Policy"] == "no-referrer"
    assert "access-control-allow-origin" not in {name.lower() for name in answer.headers}
    if status != 200:
        assert len(content) < 100


@pytest.mark.parametrize(
    "path", ["/", "/api/surface", "/wrong/api/surface", "/tiles/height/0/0/0.png", "{token}x/", "{token}x", "/%00/"]
)
def test_without_the_token_nothing_is_answered(page, path):
    _, client = page
    token = urlsplit(str(client.base_url)).path.rstrip("/")
    answer, content = raw(client, "GET", path.replace("{token}", token))
    assert answer.status == 403
    assert content == b"Not allowed. Open the address that `zlocus inspect` printed when it started."


def test_every_server_has_another_token(out):
    addresses = set()
    for _ in range(2):
        with served(out) as (_, address):
            addresses.add(urlsplit(address).path)
    assert len(addresses) == 2
    assert all(len(path) >= 32 for path in addresses)


def test_bundles_are_those_that_are_listed():
    files = page_files()
    listed = json.loads(files["vendor/bundles.json"][0])
    assert {name for name in files if name.startswith("vendor/")} == {
        "vendor/bundles.json",
        *(f"vendor/{each['file']}" for each in listed),
    }
    for each in listed:
        assert hashlib.sha256(files[f"vendor/{each['file']}"][0]).hexdigest() == each["sha256"]
    assert {each["file"].split("/")[0] for each in listed if each["path"] == "LICENSE"} == {
        "d3",
        "leaflet",
        "plot",
        "three",
    }


def test_the_page_asks_nobody_else():
    for name, (content, _) in page_files().items():
        if not name.startswith("vendor/"):
            addresses = re.findall(rb"https?://[^\s\"')]+", content)
            assert set(addresses) <= {b"http://www.w3.org/2000/svg"}, name
    page = page_files()["index.html"][0].decode()
    assert all(not address.startswith(("/", "http")) for address in re.findall(r'(?:src|href)="([^"]*)"', page))
    assert len(inline_hashes(page).split()) == 1
    assert not re.search(r"\son\w+=", page)


def test_questions_are_checked():
    assert once([("a", "1"), ("b", "2"), ("b", "3")], ["a"], "b") == ({"a": "1"}, ["2", "3"])
    assert number({"a": "1e3"}, "a") == 1000.0
    assert whole({"a": "7"}, "a", 0, 9) == 7
    with pytest.raises(BadQuery, match="a is given twice"):
        once([("a", "1"), ("a", "2")], ["a"])
    with pytest.raises(BadQuery, match="not a parameter of this request"):
        once([("b", "1")], ["a"])
    with pytest.raises(BadQuery, match="whole number"):
        whole({"a": "7.5"}, "a", 0, 9)
    found = what_if({"nearest": "3", "order": "labels", "window": "9", "reference": "b"}, ["c"])
    assert found == WhatIf(frozenset({"c"}), "b", 9, {"nearest": 3, "order": "labels"})
    with pytest.raises(ConfigError, match="order"):
        what_if({"order": "size"}, []).config(RunConfig())


def test_addresses_and_views():
    assert str(checked_address("localhost")) == "127.0.0.1"
    assert str(checked_address("::1")) == "::1"
    for host in ("example.org", "0.0.0.0", "::", ""):
        with pytest.raises(ConfigError, match="--host"):
            checked_address(host)
    assert fragment_of("") == ""
    assert fragment_of("http://127.0.0.1:1/t/#tab=cell&cell=1,2") == "#tab=cell&cell=1,2"
    assert fragment_of("tab=cell") == "#tab=cell"
    assert fragment_of("\x1b[31m a\n\u00e9") == "#%1B[31m%20a%0A%C3%A9"
    with listening(checked_address("127.0.0.1"), 0) as listener:
        taken = listener.getsockname()[1]
        address = checked_address("127.0.0.1")
        with pytest.raises(OutputError, match="Choose another --port"):
            listening(address, taken)


def test_the_crs_is_that_of_the_run(out):
    folder = surface_folder(out)
    assert folder.crs == UTM
    assert not folder.is_local
    assert folder.cell_of(*folder.centre_of(3, 4)) == (3, 4)
    assert folder.cell_of(*folder.centre_of(-1, 4)) is None
    assert folder.cell_of(np.inf, 0) is None


def test_clicks_that_nobody_waits_for_keep_nobody_waiting(page, out):
    """Those that were given up are not computed, and what else is asked is answered meanwhile."""
    inspection, client = page
    x, y = inspection.folder.centre_of(*a_cell(out))
    base = urlsplit(str(client.base_url))
    gone = [HTTPConnection(base.hostname, base.port) for _ in range(60)]
    for connection in gone:
        connection.request("GET", f"{base.path}api/cell?x={x}&y={y}&reach_steps=200&neighbours=tin")
        connection.sock.shutdown(socket.SHUT_WR)
        connection.close()
    begin = time.perf_counter()
    assert client.get("api/state").status_code == 200
    assert client.get("api/cell", params={"x": x, "y": y}).status_code == 200
    assert time.perf_counter() - begin < PATIENCE_S


def test_a_surface_that_is_made_again_is_not_mixed_with_the_old(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    with Inspection(copy) as inspection:
        opened(inspection)
        x, y = inspection.folder.centre_of(*a_cell(out))
        assert "match" in inspection.cell(x, y, WhatIf())
        record = (copy / "run.json").read_text()
        (copy / "run.json").write_text(record + " ")
        with pytest.raises(InputError, match="made again"):
            inspection.check_unchanged()
        assert inspection.state()["notes"] == [MADE_AGAIN]


def test_files_that_are_gone_are_an_answer(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    with served(copy) as (inspection, address), httpx.Client(base_url=address) as client:
        x, y = inspection.folder.centre_of(*a_cell(out))
        (copy / "sigma.tif").unlink()
        for path in (f"api/cell?x={x}&y={y}", "tiles/sigma/0/0/0.png", f"api/profile?x0={x}&y0={y}&x1={x}&y1={y}"):
            answer = client.get(path)
            assert answer.status_code == 409
            assert "sigma.tif" in answer.json()["error"]
        (copy / "run.json").unlink()
        for path in ("api/heights?row=0&col=0&rows=9&cols=9&height=9&width=9", "tiles/height/0/0/0.png", "api/surface"):
            answer = client.get(path)
            assert (answer.status_code, answer.json()["error"]) == (409, MADE_AGAIN)
        assert client.get("api/state").status_code == 200


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda run: run["grid"].update(shape=[3]), "grid.shape"), (lambda run: run["grid"].update(crs="nowhere"), ""),
        (lambda run: run["orientation"].pop("views"), "orientation.views"),
        (lambda run: run["config"]["options"].pop("products"), "config.options.products"),
        (lambda run: run["config"].update(request=[]), "config.request"), (lambda run: run.update(inputs=7), "inputs"),
    ],
)  # fmt: skip
def test_a_damaged_record_is_one_sentence(out, tmp_path, change, says):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    record = json.loads((copy / "run.json").read_text())
    change(record)
    (copy / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=rf"run\.json is not what a run writes.*{says}.* Make the surface again"):
        Inspection(copy)


def test_of_options_that_are_not_known_there_is_a_page_without_curves(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    record = json.loads((copy / "run.json").read_text())
    record["config"]["options"]["selection"]["nonsense"] = 1
    (copy / "run.json").write_text(json.dumps(record))
    with Inspection(copy) as inspection:
        opened(inspection)
        assert inspection.summary()["shape"] == list(inspection.folder.shape)
        assert "nonsense is not an option" in inspection.state()["scene"]["why"]


def test_servers_are_asked_only_where_that_is_wanted(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    record = json.loads((copy / "run.json").read_text())
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        record["inputs"].append({"path": f"/vsicurl/http://127.0.0.1:{server.getsockname()[1]}/image.tif"})
        record["config"]["request"]["inputs"][0] = record["inputs"][-1]["path"]
        (copy / "run.json").write_text(json.dumps(record))
        with Inspection(copy) as inspection:
            opened(inspection)
            assert "Add --remote" in inspection.state()["scene"]["why"]
        with pytest.raises(BlockingIOError):  # nobody came
            server.accept()


@pytest.mark.parametrize(
    ("number", "says"),
    [(signal.SIGINT, "Interrupted."), (signal.SIGTERM, "Ended by SIGTERM."), (signal.SIGHUP, "Ended by SIGHUP.")],
)
def test_the_command_serves_until_it_is_ended(out, tmp_path, number, says):
    command = [sys.executable, "-m", "zlocus", "inspect", str(out), "--view", "http://127.0.0.1:1/old/#tab=profile"]
    heard = functools.partial(signal.signal, number, signal.SIG_DFL)
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heard) as process:
        address = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}/#tab=profile", address)
        assert "Ctrl-C" in process.stdout.readline()
        assert httpx.get(address).status_code == 200
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == 128 + number
        assert process.stderr.read() == f"zlocus: {says}\n"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--align",), "--align is about a reference, and none is given"), (("--host", "0.0.0.0"), "no single address"),
        (("--host", "example.org"), "no address"),
        (("--reference", "nothing.tif"), "There is no reference nothing.tif"),
        (("--reference", "pyproject.toml", "--margin", "nan"), "--margin nan"),
        (("--reference", "pyproject.toml", "--coregister", "foo"), "--coregister foo is not known"),
        (("--reference", "pyproject.toml", "--geoid", "nothing.tif"), "nothing.tif"),
    ],
)  # fmt: skip
def test_what_cannot_be_served_is_one_sentence(out, arguments, says):
    said = CliRunner().invoke(app, ["inspect", str(out), *arguments])
    assert said.exit_code == 2
    assert says in said.stderr
    assert said.stderr.count("\n") == 1


def test_without_its_libraries_it_says_what_to_install(out, monkeypatch):
    monkeypatch.setattr("zlocus.cli.inspect.find_spec", lambda name: None)
    said = CliRunner().invoke(app, ["inspect", str(out)])
    assert said.exit_code == 2
    assert "pip install anyio starlette uvicorn" in said.stderr
