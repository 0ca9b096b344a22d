"""Benchmarks on realistic scenes and painted troubles: their judges, their rows, and the verdicts on other programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml
from pyproj import CRS
from rasterio.transform import from_origin

import rows.realistic as realistic_rows
from marked_cells import MarkedErrors, marked_errors
from pages import scene_tables
from peers import realistic as peer_scenes
from peers.results import Results as PeerResults
from peers.verdicts import (
    MEAN_SCENE,
    REASONS,
    SMALL_PIXELS,
    lost_classes,
    severity,
    verdict_lines,
    why,
    with_means_of_seeds,
)
from result_files import Results
from rows import clouds as cloud_rows
from rows import troubles as trouble_rows
from workplace import CannotRun, Figure, Workplace
from zlocus.io.open_raster import open_raster
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.files import write_image

TRUTH_STEP_M, CELLS = 0.25, 80
SHARE = 1e-9


def write(path: Path, values: np.ndarray, step_m: float) -> Path:
    profile = {"driver": "GTiff", "count": 1, "crs": "EPSG:32632", "transform": from_origin(5e5, 5e6, step_m, step_m)}
    rows, cols = values.shape
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(path, "w", height=rows, width=cols, dtype=values.dtype, **profile) as file:
        file.write(values, 1)
    return path


@pytest.fixture
def scene(tmp_path) -> Path:
    """A plane at 100 m whose western half is marked."""
    marks = np.zeros((CELLS, CELLS), np.uint8)
    marks[:, : CELLS // 2] = 1
    write(tmp_path / "scene" / "truth_dsm.tif", np.full((CELLS, CELLS), 100.0, np.float32), TRUTH_STEP_M)
    write(tmp_path / "scene" / "trouble.tif", marks, TRUTH_STEP_M)
    return tmp_path / "scene"


def test_errors_in_marked_cells(scene, tmp_path):
    """A quarter is empty, a quarter off by 5 m and one of 20 m in another; errors beside the marks do not count."""
    heights = np.full((CELLS // 2, CELLS // 2), 100.0, np.float32)
    heights[:10, :20] = np.nan
    heights[10:20, :20] += 5.0
    heights[20:30, :20] -= 20.0
    heights[:, 20:] += 50.0
    found = marked_errors(write(tmp_path / "dsm.tif", heights, 2 * TRUTH_STEP_M), scene)
    assert found.with_height == pytest.approx(0.75, abs=SHARE)
    assert found.off_by_more(3.0) == pytest.approx(2 / 3, abs=SHARE)
    assert found.off_by_more(10.0) == pytest.approx(1 / 3, abs=SHARE)


def test_both_sides_of_an_edge_are_right_in_a_marked_block(scene, tmp_path):
    truth = np.full((CELLS, CELLS), 100.0, np.float32)
    truth[:, 11:] = 110.0
    write(scene / "truth_dsm.tif", truth, TRUTH_STEP_M)
    heights = np.full((CELLS // 2, CELLS // 2), 110.0, np.float32)
    heights[:, :5] = 100.0
    for at_edge_m, off in ((100.0, 0.0), (105.0, 0.0), (110.0, 0.0), (114.0, 1.0 / 20.0)):
        heights[:, 5] = at_edge_m
        found = marked_errors(write(tmp_path / "dsm.tif", heights, 2 * TRUTH_STEP_M), scene)
        assert found.off_by_more(3.0) == pytest.approx(off, abs=SHARE)


def test_nothing_marked_is_said(scene, tmp_path):
    write(scene / "trouble.tif", np.zeros((CELLS, CELLS), np.uint8), TRUTH_STEP_M)
    dsm = write(tmp_path / "dsm.tif", np.zeros((CELLS // 2, CELLS // 2), np.float32), 2 * TRUTH_STEP_M)
    with pytest.raises(CannotRun, match=r"trouble\.tif` marks no block"):
        marked_errors(dsm, scene)


def test_a_trouble_is_matched_and_judged(tmp_path, monkeypatch):
    """The row renders each trouble in each town and gives the mean of the shares."""
    monkeypatch.setattr(trouble_rows, "TROUBLES", {"square": None})
    monkeypatch.setattr(trouble_rows, "VIEWS", {"two": ("n1", "f1")})
    monkeypatch.setattr(trouble_rows, "TROUBLE_SEEDS", (5, 6))
    commands = []
    monkeypatch.setattr(trouble_rows, "run", lambda command, accept=(0,): commands.append(list(map(str, command))))

    def errors(dsm, scene):
        return MarkedErrors(np.array([{"square-5": 5.0, "square-6": 0.0}[scene.name], 0.0]))

    monkeypatch.setattr(trouble_rows, "marked_errors", errors)
    figures = {figure.what: figure.value for figure in trouble_rows.troubles(Workplace(None, tmp_path))}
    assert figures == {
        "square, two views: with a height": 1.0,
        "square, two views: off by more than 3 m": 0.25,
        "square, two views: off by more than 10 m": 0.0,
    }
    assert sum("--trouble" in command for command in commands) == 2
    assert sum("dsm" in command for command in commands) == 2


def test_a_cloud_is_masked_and_judged(tmp_path, monkeypatch):
    """The copy of the scene has its cloud, mask and marks; a surface off by 11 m under the cloud misses both bars."""
    town, side = tmp_path / "town", 120
    write(town / "truth_dsm.tif", np.full((side, side), 50.0, np.float32), TRUTH_STEP_M)
    write(town / "truth_class.tif", np.full((side, side), 2, np.uint8), TRUTH_STEP_M)
    half_m = side * TRUTH_STEP_M / 2
    camera = SatelliteCamera((5e5 + half_m, 5e6 - half_m, 50.0), (35.0, 35.0), 0.5, 1.0, -3.0)
    numbers = np.random.default_rng(1).integers(200, 900, (71, 71)).astype(np.uint16)
    rpc = fit_rpc(camera, numbers.shape, CRS.from_epsg(32632), (0.0, 120.0)).rpc
    write_image(town / "img_n1.tif", numbers, rpc)
    folder = cloud_rows.clouded_scene(town, tmp_path / "clouded", 2)
    with open_raster(folder / "mask.tif") as mask, open_raster(folder / "cloud.tif") as marks:
        assert 0.3 < mask.read(1).mean() < 0.6
        under = marks.read(1) > 0
    assert 0.1 < under.mean() < 0.6

    def matched(command, accept):
        """The surface without a mask is 11 m too high under the cloud, and that with the mask lacks a part."""
        out, given = Path(command[command.index("-o") + 1]), Path(command[2]).name
        heights = np.full(under.shape, 50.0, np.float32)
        if given == "cloudy.yaml":
            heights[under] = 61.0
        if given == "masked.yaml":
            heights[side // 2 :] = np.nan
        write(out / "dsm.tif", heights, TRUTH_STEP_M)

    monkeypatch.setattr(cloud_rows, "run", matched)
    figures = {figure.what: figure for figure in cloud_rows.cloud_figures("town", folder, is_realistic=False)}
    off = "under the cloud off by more than 10 m"
    assert figures[f"town, without mask, {off}"].value == 1.0
    assert not figures[f"town, without mask, {off}"].passes
    assert figures[f"town, masked, {off}"].value == 0.0
    lost = figures["town, three clear images less masked, within 0.5 m: all"]
    assert lost.value == figures["town, three clear images less masked, with a height"].value > 0.005
    assert not lost.passes
    entries = [yaml.safe_load((folder / name).read_text())["views"][0] for name in ("masked.yaml", "cloudy.yaml")]
    assert [entry.get("mask") for entry in entries] == ["mask.tif", None]


def row(scene: str, program: str, within: float, rmse: float, **classes: float) -> dict:
    by_class = {name: {"n": 10, "within": value} for name, value in classes.items()}
    return {
        "scene": scene, "program": program, "cpu_s": 10.0, "wall_s": 5.0, "peak_gb": 1.0, "beside": 0.0,
        "classes": {"all": {"n": 100, "within": within, "rmse": rmse, "nmad": 0.3}, **by_class},
    }  # fmt: skip


@pytest.fixture
def found() -> dict:
    about = {"kind": "real", "views": 2, "million_cells": 0.5, "pairs": 1, "truth": True}
    names = ["won", "lost", "realistic 1, 2 views", "realistic 2, 2 views", "rendered-real-a, 2 views"]
    names += ["rendered-real-b, 2 views"]
    rows = [
        row("won", "zlocus", 0.9, 1.0), row("won", "CARS", 0.8, 2.0),
        row("lost", "zlocus", 0.6, 30.0, road=0.2, tree=0.3), row("lost", "CARS", 0.8, 2.0, road=0.8, tree=0.305),
        row("realistic 1, 2 views", "zlocus", 0.7, 4.0, road=0.5),
        row("realistic 2, 2 views", "zlocus", 0.8, 6.0, road=0.7),
        row("realistic 1, 2 views", "CARS", 0.70, 4.0), row("realistic 2, 2 views", "CARS", 0.78, 6.0),
        row("rendered-real-a, 2 views", "CARS", 0.75, 2.0), row("rendered-real-b, 2 views", "CARS", 0.80, 2.0),
    ]  # fmt: skip
    return {"programs": {"zlocus": {}, "CARS": {}}, "scenes": dict.fromkeys(names, about), "surfaces": rows}


def test_scenes_of_fresh_seeds_are_shown_as_their_mean(found):
    mean = with_means_of_seeds(found)
    name = MEAN_SCENE.format(n=2, views=2)
    assert list(mean["scenes"]) == ["won", "lost", "rendered-real-a, 2 views", "rendered-real-b, 2 views", name]
    (own,) = (r for r in mean["surfaces"] if r["scene"] == name and r["program"] == "zlocus")
    assert own["classes"]["all"]["within"] == pytest.approx(0.75)
    assert own["classes"]["road"]["within"] == pytest.approx(0.6)
    assert own["spread"] == pytest.approx(0.0707, abs=1e-4)
    # A program that missed one of the seeds has no mean, and its row says so.
    found["surfaces"][5]["failed"] = "no surface"
    rows = {r["program"]: r for r in with_means_of_seeds(found)["surfaces"] if r["scene"] == name}
    assert rows["zlocus"]["failed"] == "no surface on 1 of 2 scenes"
    assert "failed" not in rows["CARS"]


def test_the_heaviest_loss_comes_first_with_its_reason(found):
    lines = [cells for cells in verdict_lines(found) if cells[0] in ("won", "lost")]
    assert [cells[0] for cells in lines] == ["lost", "won"]
    assert lines[0][1] == "**CARS 0.800**, zlocus 0.600"
    assert "roads 0.200, CARS 0.800" in lines[0][-1]
    assert "trees" not in lines[0][-1]
    assert lines[1][1] == "zlocus 0.900, CARS 0.800"
    assert lines[1][-1] == ""
    rows = {r["program"]: r for r in found["surfaces"] if r["scene"] == "lost"}
    assert severity(rows) == pytest.approx(2.0)
    assert lost_classes(rows) == [("road", "CARS", 0.8, 0.2)]


def test_frames_have_a_reason_of_their_own():
    def row(of_all, of_roofs):
        return {"classes": {"all": {"n": 9, "within": of_all}, "building": {"n": 9, "within": of_roofs}}}

    rows = {"zlocus": row(0.6, 0.5), "CARS": row(0.8, 0.7)}
    assert why(rows, "frames") == f"roofs 0.500, CARS 0.700 ({SMALL_PIXELS})"
    assert why(rows, "city") == f"roofs 0.500, CARS 0.700 ({REASONS['building']})"


def test_how_hard_the_recipe_is_for_others(found, tmp_path, monkeypatch):
    """The mean of the seeds less the figure of each independent scene."""
    results = tmp_path / "results.json"
    results.write_text(json.dumps(found), encoding="utf-8")
    monkeypatch.setattr(realistic_rows, "RESULTS", results)
    monkeypatch.setattr(realistic_rows, "GAUGES", ("CARS",))
    monkeypatch.setattr(realistic_rows, "VIEWS", {"two": ("n1", "f1")})
    figures = {figure.what: figure for figure in realistic_rows.hardness(Workplace(None, tmp_path))}
    assert figures["CARS, two views: mean within 1 m of 2 seeds"].value == pytest.approx(0.74)
    near, far = (figures[f"CARS, two views: mean less that on rendered-real-{name}"] for name in "ab")
    assert near.value == pytest.approx(-0.01)
    assert near.passes
    assert far.value == pytest.approx(-0.06)
    assert not far.passes
    # A run that failed leaves the other seeds; one that was never made is asked for.
    seeds = [row for row in found["surfaces"] if row["scene"].startswith("realistic ") and row["program"] == "CARS"]
    seeds[0]["failed"] = "no surface"
    results.write_text(json.dumps(found), encoding="utf-8")
    with pytest.raises(CannotRun, match="too few realistic scenes matched by CARS"):
        realistic_rows.hardness(Workplace(None, tmp_path))
    found["surfaces"].remove(seeds[0])
    results.write_text(json.dumps(found), encoding="utf-8")
    with pytest.raises(CannotRun, match=f"no run of CARS on {seeds[0]['scene']}: run `make peers`"):
        realistic_rows.hardness(Workplace(None, tmp_path))
    results.unlink()
    with pytest.raises(CannotRun, match="run `make peers`"):
        realistic_rows.hardness(Workplace(None, tmp_path))


def test_scenes_of_seeds_are_rendered_and_judged(tmp_path, monkeypatch):
    """A scene that is there is not rendered again; its height range, area and coarse terrain come from its truth."""
    folder = tmp_path / "scenes"
    truth = np.full((400, 400), 420.0, np.float32)
    truth[:20, :20] = np.nan
    truth[200:, 200:] = 450.0
    write(folder / "real-9" / "truth_dsm.tif", truth, TRUTH_STEP_M)
    (folder / "real-9" / "scene.json").write_text("{}", encoding="utf-8")
    monkeypatch.setattr(peer_scenes.subprocess, "run", lambda *_, **__: pytest.fail("rendered again"))
    two, three = peer_scenes.seed_scenes([9], folder)
    assert (two.name, three.name) == ("realistic 9, 2 views", "realistic 9, 3 views")
    assert list(three.images) == ["n1", "f1", "b1"]
    assert two.heights == pytest.approx((417.0, 453.0))
    assert two.bounds == pytest.approx((5e5, 5e6 - 100.0, 5e5 + 100.0, 5e6))
    with rasterio.open(two.terrain) as terrain:
        assert 419.0 < terrain.read(1).min() <= terrain.read(1).max() < 451.0


def test_results_of_earlier_seeds_are_dropped(tmp_path):
    results = PeerResults(tmp_path / "results.json", (0,))
    for scene in ("town, 2 views", "realistic 1, 2 views", "realistic 7, 2 views"):
        results.describe("scenes", scene, {"truth": True})
        results.add("surfaces", {"scene": scene, "program": "zlocus"}, "scene", "program")
    results.forget_scenes(lambda name: name.startswith("realistic "), ["realistic 7, "])
    assert list(results.found["scenes"]) == ["town, 2 views", "realistic 7, 2 views"]
    assert [r["scene"] for r in results.found["surfaces"]] == ["town, 2 views", "realistic 7, 2 views"]


def test_tables_of_realistic_scenes(found, tmp_path, monkeypatch):
    """Lines are those of the results, the heaviest loss first; a missing results file is one sentence."""
    monkeypatch.setattr(scene_tables, "PEERS_RESULTS", tmp_path / "results.json")
    with pytest.raises(CannotRun, match="run `make peers`"):
        scene_tables.programs({})
    found["scenes"] = {name: about | {"views": 3} for name, about in found["scenes"].items()}
    (tmp_path / "results.json").write_text(json.dumps(found), encoding="utf-8")
    lines = scene_tables.programs_short({}).splitlines()[2:]
    assert lines[0] == "| lost | 0.600 | 0.800 CARS | 30.00 m | 2.00 m CARS |"
    assert "| won | **0.900** | 0.800 CARS | **1.00 m** | 2.00 m CARS |" in lines
    assert scene_tables.programs({}).splitlines()[2].startswith("| lost | **CARS 0.800**, zlocus 0.600 |")
    whats = ("with a height", "off by more than 3 m", "off by more than 10 m")
    figures = tuple(
        Figure(f"lake, {views} views: {what}", value)
        for views in ("two", "three")
        for what, value in zip(whats, (1.0, 0.5, 0.25), strict=True)
    )
    figures += (Figure("peak memory by its plan, least", 0.9),)  # of the runs, no trouble
    of_troubles = Results("troubles", "abc", "2026", {}, "make", None, {}, figures)
    assert scene_tables.troubles({"troubles": of_troubles}).splitlines()[2:] == [
        "| lake | 1.00 / 0.50 / 0.25 | 1.00 / 0.50 / 0.25 |"
    ]
