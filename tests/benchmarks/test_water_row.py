"""The row on water: lakes are rendered, levelled and judged against their truth; its table on the page."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from pages import scene_tables
from result_files import Results
from rows import water as water_row
from workplace import Figure, Workplace
from zlocus.products.rasters import WaterKind
from zlocus.synthetic.terrain import WATER

STEP_M, CELLS, LEVEL_M, EXACT_M = 0.25, 160, 431.0, 1e-4
LAKE = np.s_[40:120, 50:110]


def write(path: Path, values: np.ndarray, step_m: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {"driver": "GTiff", "count": 1, "crs": "EPSG:32632", "transform": from_origin(5e5, 5e6, step_m, step_m)}
    with rasterio.open(path, "w", height=values.shape[0], width=values.shape[1], dtype=values.dtype, **profile) as file:
        file.write(values, 1)


def write_scene(folder: Path) -> None:
    marks = np.zeros((CELLS, CELLS), np.uint8)
    marks[LAKE] = 1
    write(folder / "trouble.tif", marks, STEP_M)
    write(folder / "truth_class.tif", marks * np.uint8(WATER), STEP_M)
    write(folder / "truth_dsm.tif", np.where(marks, LEVEL_M, 440.0).astype(np.float32), STEP_M)


@pytest.fixture
def commands(monkeypatch):
    """In place of the programs: levels that are .03 m too high, and one cell beside the outline levelled too."""
    given = []

    def run(command, accept=(0,)):
        words = [str(word) for word in command]
        given.append(words)
        out = Path(words[words.index("-o") + 1])
        if "zlocus.synthetic" in words:
            write_scene(out)
            return
        marks = np.zeros((CELLS // 2, CELLS // 2), np.uint8)
        marks[20:60, 25:55] = WaterKind.POSSIBLE if out.name.startswith("rendered") else WaterKind.LEVELLED
        marks[20, 24] = WaterKind.LEVELLED
        write(out / "water.tif", marks, 2 * STEP_M)
        write(out / "dsm.tif", np.where(marks, LEVEL_M + 0.03, 440.0).astype(np.float32), 2 * STEP_M)
        (out / "run.json").write_text(json.dumps({"water": {"possible": 1}}))

    monkeypatch.setattr(water_row, "run", run)
    return given


def test_lakes_are_judged_against_their_truth(tmp_path, monkeypatch, commands):
    monkeypatch.setattr(water_row, "LAKES", {"lake-beach": None, "lake-quay": None})
    monkeypatch.setattr(water_row, "TROUBLE_SEEDS", (5, 6))
    monkeypatch.setattr(water_row, "WIDER_M", {"exact": 0.0, "1 m wide": 1.0})
    monkeypatch.setattr(water_row, "SCENES", {"rendered-real-a": "img_*.tif", "quarry": "img_*.tif"})
    data = tmp_path / "data"
    write_scene(data / "rendered-real-a")
    (data / "quarry").mkdir(parents=True)
    figures = {figure.what: figure for figure in water_row.water(Workplace(data, tmp_path / "out"))}
    for views in ("two", "three"):
        off = figures[f"{views} views, natural shores: level off, root mean square"]
        assert off.value == pytest.approx(0.03, abs=EXACT_M)
        assert figures[f"lake-quay, {views} views, exact: level off, root mean square"].value == pytest.approx(
            0.03, abs=1e-4
        )
    # One cell too many of each lake with its outline; of wider ones, those that are not levelled.
    assert figures["two views: cells that disobey an outline"].value == 4.0
    assert figures["three views: cells that disobey an outline"].value > 4.0
    assert figures["three views: range of the heights of a lake, largest"].value == 0.0
    assert figures["rendered-real-a: cells of possible water that are water"].value == 1.0
    assert figures["rendered-real-a: cells of water that are found"].value == 1.0
    assert figures["quarry, no water: cells called possible water"].value == 0.0
    assert sum("--trouble" in words for words in commands) == 4
    assert sum("--level-water" in words for words in commands) == 8


def test_an_outline_is_written_as_wide_as_it_says(tmp_path):
    write_scene(tmp_path)
    for wider_m in (0.0, 1.0, -1.0):
        (stored,) = water_row.shapely.from_wkb(water_row._stored(water_row.write_outline(tmp_path, wider_m)))
        west, south, east, north = stored.bounds
        assert (east - west, north - south) == pytest.approx((15.0 + 2 * wider_m, 20.0 + 2 * wider_m), abs=0.03)


def test_the_table_of_the_page():
    figures = tuple(
        Figure(f"lake-beach, {views} views, {outline}: level off, root mean square", 0.125)
        for views in ("two", "three")
        for outline in ("exact", "1 m wide", "1 m narrow", "possible")
    )
    results = {"water": Results("water", "abc", "2026", {}, "make", None, {}, figures)}
    assert scene_tables.water(results).splitlines()[2:] == ["| lake-beach | 0.12 | 0.12 | 0.12 | 0.12 | 0.12 | 0.12 |"]
