"""The demo as a whole on a small scene, and the picture it leaves."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from zlocus.core.errors import OutputError
from zlocus.core.progress import LineProgress, SilentProgress
from zlocus.core.requests import DEMO_ACCURACY, DEMO_BEGUN
from zlocus.evaluation.table import evaluation_table
from zlocus.pipeline import tile_run as tiles
from zlocus.pipeline.demo import run_demo
from zlocus.products.demo_figure import CAPTION, GAP, error_map, picture_beside_truth, relief
from zlocus.synthetic import files, scenes

SIDE = 60


def write(path: Path, z: np.ndarray, cell_m: float = 1.0) -> Path:
    profile = {"driver": "GTiff", "height": z.shape[0], "width": z.shape[1], "count": 1, "dtype": "float32"}
    transform = from_origin(500_000.0, 5_000_000.0, cell_m, cell_m)
    with rasterio.open(path, "w", crs="EPSG:32632", transform=transform, nodata=float("nan"), **profile) as file:
        file.write(z.astype(np.float32), 1)
    return path


def test_slopes_towards_the_north_west_are_the_brightest():
    row, col = np.mgrid[:9, :9]
    towards = {"north-west": row + col, "south-east": -row - col, "north-east": row - col, "south-west": col - row}
    light = {name: relief(0.5 * z, 1.0, (-1e6, 1e6)).mean() for name, z in towards.items()}
    assert max(light, key=light.get) == "north-west"
    assert min(light, key=light.get) == "south-east"


def test_errors_are_red_above_blue_below_and_white_where_empty():
    blue, green, red = error_map(np.array([[2.0, -2.0, 0.0, np.nan]], np.float32))[0].astype(int).T
    assert red[0] > 200
    assert blue[0] == green[0] == 0
    assert blue[1] > 200
    assert red[1] == green[1] == 0
    assert red[2] == green[2] == blue[2] < 255
    assert red[3] == green[3] == blue[3] == 255


def test_the_surface_is_shown_on_the_cells_of_the_truth(tmp_path):
    z = np.zeros((SIDE, SIDE))
    z[20:30, 10:20] = 5.0
    # The surface reaches 5 cells beyond the truth on each side.
    found = np.full((SIDE + 10, SIDE + 10), np.nan)
    found[5:-5, 5:-5] = z + np.where(z > 0, 3.0, 0.0)
    dsm = write(tmp_path / "dsm.tif", found)
    with rasterio.open(dsm, "r+") as file:
        file.transform = from_origin(500_000.0 - 5.0, 5_000_000.0 + 5.0, 1.0, 1.0)
    picture_beside_truth(dsm, write(tmp_path / "truth.tif", z), tmp_path / "demo.png", side=SIDE)
    picture = cv2.imread(str(tmp_path / "demo.png"))
    assert picture.shape == (SIDE + CAPTION, 3 * SIDE + 2 * GAP, 3)
    blue, _, red = np.moveaxis(picture[CAPTION:, -SIDE:].astype(int), -1, 0)
    np.testing.assert_array_equal(red - blue > 100, z > 0)


def test_a_picture_that_cannot_be_written_is_a_sentence(tmp_path):
    z = write(tmp_path / "z.tif", np.zeros((SIDE, SIDE)))
    with pytest.raises(OutputError, match=r"demo\.png cannot be written"):
        picture_beside_truth(z, z, tmp_path / "missing" / "demo.png", side=SIDE)


def test_the_demo_runs_twice_into_one_folder(tmp_path, monkeypatch):
    whole = scenes.demo_spec()
    small = replace(
        whole,
        size=150,
        hill_m=0.0,
        objects=replace(whole.objects, buildings_per_ha=0.0, towers_per_ha=0.0),
        views=whole.views[:3],
    )
    monkeypatch.setattr(scenes, "demo_spec", lambda: small)
    first = stopped_and_taken_on(tmp_path, monkeypatch)
    assert [limit.threshold_m for limit in first.evaluations] == [0.42, 1.0]
    assert all(each.class_statistics["ground"].within > 0.9 for each in first.evaluations)
    for each in first.evaluations:
        # Its cameras are corrected on exact trajectories: no shift to speak of, and both kinds of figures in the table.
        assert np.hypot(*each.found_shift.enu_m[:2]) < each.threshold_m
        assert each.aligned_accuracy.class_statistics["ground"].within > 0.9
        assert evaluation_table(each).splitlines()[0].split() == ["absolute", "aligned"]
    picture = (tmp_path / "demo.png").read_bytes()
    # Now it is finished, and starts anew.
    (tmp_path / DEMO_ACCURACY).write_text("{}")
    (tmp_path / "scene" / "scene.yaml").unlink()
    assert run_demo(tmp_path, SilentProgress()).evaluations == first.evaluations
    assert (tmp_path / "demo.png").read_bytes() == picture


def stopped_and_taken_on(out, monkeypatch):
    """A demo that is stopped when its tiles are made, and goes on with its scene and with them."""
    said = io.StringIO()
    with monkeypatch.context() as patch:
        patch.setattr(tiles.TileRun, "assemble", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_demo(out, LineProgress(said))
    found = re.search(
        r"(\d) of \1 tiles? (?:is|are) finished and kept: the same command resumes from there\.", said.getvalue()
    )
    with monkeypatch.context() as patch:
        patch.setattr(files, "render_scene", interrupt)
        result = run_demo(out, LineProgress(said))
    assert re.search(rf"{found[1]} of {found[1]} tiles? (?:is|are) there already\.", said.getvalue())
    return result


def interrupt(*_, **__):
    raise KeyboardInterrupt


def test_a_demo_that_is_not_of_today_is_rendered_anew(tmp_path, monkeypatch):
    """Of another version, or damaged: it is a demo's all the same."""
    monkeypatch.setattr(files, "render_scene", interrupt)
    (tmp_path / "scene").mkdir()
    for content in ('{"scene_sha256": "0"}', "{}", "nonsense"):
        (tmp_path / DEMO_BEGUN).write_text(content)
        with pytest.raises(KeyboardInterrupt):
            run_demo(tmp_path, SilentProgress())
        assert not (tmp_path / "scene").exists()
        (tmp_path / "scene").mkdir()


def test_a_demo_keeps_the_scenes_of_others(tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="not the scene of a demo"):
        run_demo(tmp_path, SilentProgress())
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "mine.txt"]
