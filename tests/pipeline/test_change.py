"""`zlocus change` on surfaces with known errors and planted change: calibrated significance, honest volumes."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from affine import Affine

from overlapping_surfaces import CELL_M, CORNER, CRS, noise, stated_sigma, town, write_raster, write_run
from zlocus.core.errors import ConfigError, InputError, OutputError
from zlocus.core.progress import KeptNotes, SilentProgress
from zlocus.core.surface_requests import ChangeRequest
from zlocus.io.styles.file_names import style_files
from zlocus.pipeline.change import run_change

SHAPE = (200, 210)
# Place, half the side of the polygon in cells, height of a planted hill, m.
PLANTED = ((45, 50, 22, 2.0), (140, 60, 16, -0.5), (60, 150, 26, 0.2), (150, 160, 10, 0.8))
# The bars of the issue.
INSIDE, MAX_FALSE = (0.55, 0.80), 0.06


def date(rng, truth, usual_m):
    """A surface with errors that reach over none, few and many cells, and the standard deviations that it states."""
    sigma = stated_sigma(rng, truth.shape, usual_m)
    errors = 0.5 * noise(rng, SHAPE, 0) + 0.7 * noise(rng, SHAPE, 1.5) + 0.5 * noise(rng, SHAPE, 5.0)
    return truth + errors * sigma, sigma / 1.2


def hill(row, col, half, height_m):
    r, c = np.indices(SHAPE)
    inside = (np.abs(r - row) <= half) & (np.abs(c - col) <= half)
    return np.where(inside, height_m * np.exp(-((r - row) ** 2 + (c - col) ** 2) / (half / 2) ** 2), 0.0)


def square(row, col, half):
    (left, top), (right, bottom) = CORNER * (col - half, row - half), CORNER * (col + half + 1, row + half + 1)
    return shapely.box(left, bottom, right, top)


def write_polygons(path, polygons):
    names = np.array([f"pit {number}" for number in range(len(polygons))], object)
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array(polygons)), [names], ["name"], geometry_type="Polygon", crs=CRS, driver="GPKG"
    )
    return path


def two_dates(folder, seed, is_changed=True):
    rng, truth = np.random.default_rng(seed), town(*SHAPE)
    hills = [hill(*each) for each in PLANTED] if is_changed else [np.zeros(SHAPE)]
    first, sigma = date(rng, truth, 0.25)
    first[rng.random(SHAPE) < 0.02] = np.nan
    second, second_sigma = date(rng, truth + sum(hills), 0.3)
    before = write_run(folder / "before", first, sigma)
    after = write_run(folder / "after", second + 0.3 * rng.normal(), second_sigma)
    area = write_polygons(folder / "area.gpkg", [square(*each[:3]) for each in PLANTED])
    return before, after, area, [float(each.sum()) * CELL_M**2 for each in hills]


def change(out, first, second, progress=None, **more):
    run_change(ChangeRequest(str(first), str(second), out, **more), progress or SilentProgress())
    return json.loads((out / "change.json").read_text())


def read(path):
    with rasterio.open(path) as file:
        return file.read(1)


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("changed")
    before, after, area, volumes = two_dates(folder, seed=0)
    found = change(folder / "out", before, after, area=area, name="name")
    return folder, found, volumes


def test_planted_volumes_lie_in_their_intervals_as_often_as_they_should(tmp_path, monkeypatch):
    """Over ten seeds, with four polygons each."""
    monkeypatch.setattr("zlocus.pipeline.change.write_change_picture", lambda *_: None)
    errors = []
    for seed in range(10):
        folder = tmp_path / str(seed)
        before, after, area, volumes = two_dates(folder, seed)
        found = change(folder / "out", before, after, area=area)["volumes"]
        errors += [(each["volume_m3"] - true) / each["sigma_m3"] for each, true in zip(found, volumes, strict=True)]
    share = np.mean(np.abs(errors) < 1.0)
    assert INSIDE[0] <= share <= INSIDE[1]
    assert np.sqrt(np.mean(np.square(errors))) < 1.3


def test_a_null_change_is_significant_in_few_cells(tmp_path, monkeypatch):
    monkeypatch.setattr("zlocus.pipeline.change.write_change_picture", lambda *_: None)
    before, after, area, _ = two_dates(tmp_path, seed=3, is_changed=False)
    found = change(tmp_path / "out", before, after, area=area)
    assert found["cells"]["significant_share"] <= MAX_FALSE
    unknown = change(tmp_path / "unknown", before, after)
    assert unknown["cells"]["significant_share"] <= MAX_FALSE


def test_files(changed):
    folder, found, volumes = changed
    names = {path.name for path in (folder / "out").iterdir()}
    drawn = ("difference.tif", "sigma.tif", "significance.tif", "class.tif", "volumes.gpkg")
    assert names - {name for product in drawn for name in style_files(product)} == {
        "change.json", "difference.tif", "sigma.tif", "significance.tif", "class.tif", "volumes.csv", "volumes.gpkg",
        "change.png",
    }  # fmt: skip
    rows = list(csv.DictReader((folder / "out" / "volumes.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["name"] for row in rows] == ["pit 0", "pit 1", "pit 2", "pit 3"]
    assert [float(row["volume_m3"]) for row in rows] == [each["volume_m3"] for each in found["volumes"]]
    _, _, geometry, columns = pyogrio.raw.read(folder / "out" / "volumes.gpkg", columns=["volume_m3"])
    assert list(columns[0]) == [each["volume_m3"] for each in found["volumes"]]
    assert shapely.area(shapely.from_wkb(geometry[0])) == pytest.approx((45 * CELL_M) ** 2)
    assert found["command"] == "zlocus change"
    assert len(found["inputs"]) == 5
    assert found["volumes"][0]["significant"]
    assert abs(found["volumes"][0]["volume_m3"] - volumes[0]) < 3 * found["volumes"][0]["sigma_m3"]


def test_classes_follow_significance(changed):
    folder, _, _ = changed
    kind, size, difference = (
        read(folder / "out" / name) for name in ("class.tif", "significance.tif", "difference.tif")
    )
    assert np.array_equal(kind == 0, np.isnan(difference))
    assert np.array_equal(kind == 2, np.nan_to_num(size) > 1.959964)
    assert np.array_equal(kind == 3, np.nan_to_num(size) < -1.959964)
    peak = kind[40:51, 45:56]
    assert (peak[peak > 0] == 2).mean() > 0.95


def test_the_offset_stays_on_request(changed, tmp_path):
    folder, found, _ = changed
    kept = change(tmp_path / "out", folder / "before", folder / "after", area=folder / "area.gpkg", keep_offset=True)
    offset = found["noise"]["offset_m"]
    moved = read(tmp_path / "out" / "difference.tif") - read(folder / "out" / "difference.tif")
    assert np.nanmax(np.abs(moved - offset)) < 1e-5
    for one, other in zip(kept["volumes"], found["volumes"], strict=True):
        assert one["sigma_m3"] > other["sigma_m3"]


def test_unchanged_ground_that_is_named(changed, tmp_path):
    folder, _, _ = changed
    stable = write_polygons(tmp_path / "stable.gpkg", [square(100, 105, 30)])
    found = change(tmp_path / "out", folder / "before", folder / "after", area=folder / "area.gpkg", stable=stable)
    assert MIN_CELLS < found["noise"]["cells"] <= 61 * 61


MIN_CELLS = 1000


def test_surfaces_of_other_cells_and_without_standard_deviations(changed, tmp_path):
    folder, _, _ = changed
    coarse = write_raster(
        tmp_path / "coarse.tif", town(*SHAPE).reshape(100, 2, 105, 2).mean(axis=(1, 3)).astype(np.float32),
        CORNER * Affine.scale(2, 2),
    )  # fmt: skip
    notes = KeptNotes()
    found = change(tmp_path / "out", folder / "before", coarse, progress=notes)
    assert found["grid"]["shape"] == [100, 105], "the larger cells"
    assert any("states no standard deviation" in sentence for sentence in notes.sentences)
    assert any("they are resampled" in sentence for sentence in notes.sentences)
    assert any("Neither --area nor --stable says" in sentence for sentence in notes.sentences)


def test_a_shift_in_plan_is_noted(tmp_path):
    truth = 30.0 * town(*SHAPE) / 10.0
    rng = np.random.default_rng(5)
    shifted = np.roll(truth, 1, axis=1)
    for name, z in (("a", truth), ("b", shifted)):
        write_run(tmp_path / name, z + 0.02 * rng.normal(size=SHAPE), np.full(SHAPE, 0.05))
    notes = KeptNotes()
    change(tmp_path / "out", tmp_path / "a", tmp_path / "b", progress=notes)
    (said,) = [sentence for sentence in notes.sentences if "seems to lie" in sentence]
    assert "Align them first." in said


def test_what_is_refused_leaves_nothing(changed, tmp_path):
    folder, _, _ = changed
    before, after = folder / "before", folder / "after"
    far = write_raster(tmp_path / "far.tif", np.zeros((9, 9), np.float32), Affine(1, 0, 9e5, 0, -1, 5e6))
    with pytest.raises(InputError, match="do not overlap"):
        change(tmp_path / "out", before, far)
    small = write_raster(tmp_path / "small.tif", np.zeros((9, 9), np.float32))
    with pytest.raises(InputError, match="Only 79 cells have a height in both"):
        change(tmp_path / "out", before, small)
    whole = write_polygons(tmp_path / "whole.gpkg", [square(100, 100, 200)])
    with pytest.raises(InputError, match="Only 0 cells of unchanged ground"):
        change(tmp_path / "out", before, after, area=whole)
    with pytest.raises(OutputError, match=r"holds another result \(change\.json"):
        change(folder / "out", before, after)
    with pytest.raises(InputError, match="and no attribute depth"):
        change(tmp_path / "out", before, after, area=folder / "area.gpkg", name="depth")
    with pytest.raises(ConfigError, match="is no probability"):
        change(tmp_path / "out", before, after, level=5.0)
    with pytest.raises(ConfigError, match="has no change against itself"):
        change(tmp_path / "out", before, before)
    assert not (tmp_path / "out").exists()


def test_a_polygon_without_heights_has_no_volume(changed, tmp_path):
    folder, _, _ = changed
    area = write_polygons(tmp_path / "area.gpkg", [square(45, 50, 22), square(900, 900, 10)])
    notes = KeptNotes()
    found = change(tmp_path / "out", folder / "before", folder / "after", area=area, progress=notes)
    assert found["volumes"][1]["volume_m3"] is None
    assert any("1 of 2 polygons have no cell" in sentence for sentence in notes.sentences)
    assert ",,," in (tmp_path / "out" / "volumes.csv").read_text().splitlines()[2]
