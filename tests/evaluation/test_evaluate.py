"""Judging a surface: definitions on small known cases, and agreement with an independent judge on rendered scenes."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin
from rasterio.warp import Resampling, reproject
from typer.testing import CliRunner

from evaluation_rasters import CRS, NORTH, WEST, grid, write
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.heights import read_heights
from zlocus.evaluation.statistics import error_statistics
from zlocus.evaluation.table import evaluation_table
from zlocus.evaluation.truth import truth_blocks

SHIFT_TOLERANCE_M = 0.03
# Half of it is the judge's rounding of errors to three digits.
JUDGES_DIFFER = 1e-3
FIGURES = ("complete", "within", "median", "nmad", "rmse", "le90")


@pytest.fixture
def hills():
    """Rolling ground without edges: height of x, y in m from the corner."""
    return lambda x, y: (100 + 3 * np.sin(x / 7) + 2 * np.cos(y / 5) + 0.02 * x * y / 10).astype(np.float32)


def test_figures_of_known_errors():
    errors = np.array([0.0, 0.2, -0.2, 0.4, 2.0, np.nan, np.nan, np.nan, np.nan, np.nan])
    figures = error_statistics(errors, threshold_m=1.0)
    assert (figures.n, figures.completeness, figures.within) == (10, 0.5, 0.4)
    assert figures.median == pytest.approx(0.2)
    assert figures.nmad == pytest.approx(1.4826 * 0.2)
    assert figures.rmse == pytest.approx(math.sqrt((0.04 + 0.04 + 0.16 + 4) / 5))
    assert figures.le90 == pytest.approx(0.4 + 0.6 * 1.6)
    assert figures.le95 == pytest.approx(0.4 + 0.8 * 1.6)
    assert figures.mean == pytest.approx(2.4 / 5)
    assert figures.std == pytest.approx(math.sqrt((0.48**2 + 0.28**2 + 0.68**2 + 0.08**2 + 1.52**2) / 5))


def test_shares_within_several_thresholds():
    errors = np.array([0.0, 0.2, -0.2, 0.5, 2.0, np.nan, np.nan, np.nan, np.nan, np.nan])
    figures = error_statistics(errors, 1.0, (0.5, 0.1, 5.0))
    assert figures.shares == ((1.0, 0.4), (0.5, 0.3), (0.1, 0.1), (5.0, 0.5))
    assert figures.within == 0.4
    assert figures.as_dict()["within_m"] == {"1": 0.4, "0.5": 0.3, "0.1": 0.1, "5": 0.5}
    nothing = error_statistics(np.zeros(0), 1.0, (0.5,)).as_dict()
    assert nothing["within_m"] == {"1": None, "0.5": None}
    assert [nothing[name] for name in ("within", "median", "le95", "std")] == [None] * 4


def test_nothing_found_is_missing_and_not_within():
    figures = error_statistics(np.full(4, np.nan), 1.0)
    assert (figures.completeness, figures.within) == (0.0, 0.0)
    assert figures.as_dict()["nmad"] is None


def test_missing_cells_count_against_completeness_and_within(tmp_path, hills):
    truth = hills(*grid(100))
    dsm = truth.copy()
    dsm[:50] = np.nan
    result = evaluate(write(tmp_path / "d.tif", dsm), Comparison(write(tmp_path / "t.tif", truth), margin_m=0))
    assert result.statistics.completeness == result.statistics.within == pytest.approx(0.5, abs=0.01)
    assert result.statistics.rmse == 0


@pytest.mark.parametrize(
    ("empty", "nodata"),
    [
        (-9999.0, -9999.0),
        (-9999.0, None),
        (-9999.0, -1.0),
        (-32767.0, None),
        (-32768.0, None),
        (np.finfo("f4").min, None),
    ],
)
def test_nodata_is_no_height(tmp_path, hills, empty, nodata):
    truth = hills(*grid(60))
    dsm = truth.copy()
    dsm[:, 30:] = empty
    result = evaluate(
        write(tmp_path / "d.tif", dsm, nodata=nodata), Comparison(write(tmp_path / "t.tif", truth), margin_m=0)
    )
    assert result.statistics.completeness == pytest.approx(0.5, abs=0.02)


def test_either_side_of_an_edge_is_right(tmp_path):
    # Blocks of 2 x 2 quarter-metre cells; a wall runs through the middle of a column of blocks.
    truth = np.full((80, 80), 10.0, np.float32)
    truth[:, 41:] = 20.0
    quarter = from_origin(WEST, NORTH, 0.25, 0.25)
    reference = write(tmp_path / "t.tif", truth, quarter)
    for low_or_high in (10.0, 20.0):
        dsm = np.repeat(np.where(np.arange(40) < 20, 10.0, 20.0)[None], 40, axis=0).astype(np.float32)
        dsm[:, 20] = low_or_high
        assert evaluate(write(tmp_path / "d.tif", dsm), Comparison(reference, margin_m=0)).statistics.rmse == 0
    dsm[:, 20] = 15.0
    assert evaluate(write(tmp_path / "d.tif", dsm), Comparison(reference, margin_m=0)).statistics.rmse == pytest.approx(
        5 / math.sqrt(40)
    )


def test_without_an_edge_the_mean_of_the_block_is_right(tmp_path):
    truth = np.full((80, 80), 10.0, np.float32)
    truth[:, ::2] += 0.4
    reference = write(tmp_path / "t.tif", truth, from_origin(WEST, NORTH, 0.25, 0.25))
    dsm = write(tmp_path / "d.tif", np.full((40, 40), 10.4, np.float32))
    result = evaluate(dsm, Comparison(reference, margin_m=0))
    assert result.statistics.median == pytest.approx(0.2, abs=1e-5)
    assert repr(result).startswith("Evaluation(absolute: ")
    assert ", 100.0 % within 1 m, median 0.200 m, NMAD 0.000 m, RMSE 0.200 m)" in repr(result)


def test_classes_are_judged_apart(tmp_path, hills):
    truth = hills(*grid(80))
    classes = np.repeat(np.arange(4, dtype=np.uint8), 20)[:, None] * np.ones((1, 80), np.uint8)
    dsm = truth + np.where(classes == 2, 0.5, np.where(classes == 3, 2.0, 0.0)).astype(np.float32)
    result = evaluate(
        write(tmp_path / "d.tif", dsm), Comparison(write(tmp_path / "t.tif", truth), margin_m=0,
        classes=write(tmp_path / "c.tif", classes)),
    )  # fmt: skip
    assert [result.class_statistics[name].n for name in ("ground", "building", "tree")] == [3200, 1600, 1600]
    assert result.class_statistics["ground"].rmse == 0
    assert result.class_statistics["building"].median == pytest.approx(0.5, abs=1e-4)
    assert result.class_statistics["tree"].within == 0


def test_margin_and_threshold(tmp_path, hills):
    truth = hills(*grid(100))
    dsm = truth + np.float32(0.3)
    dsm[10:90, 10:90] -= np.float32(0.3)
    paths = write(tmp_path / "d.tif", dsm), write(tmp_path / "t.tif", truth)
    assert evaluate(paths[0], Comparison(paths[1], margin_m=5)).statistics.n == 80 * 80
    assert evaluate(paths[0], Comparison(paths[1], margin_m=5)).statistics.rmse == 0
    assert evaluate(paths[0], Comparison(paths[1], margin_m=0, threshold_m=0.2)).statistics.within == pytest.approx(
        0.64
    )


def test_align_finds_a_planted_shift_and_reports_it(tmp_path, hills):
    east, north, up = 1.23, -0.68, 0.75
    truth = write(tmp_path / "t.tif", hills(*grid(160)))
    moved = write(
        tmp_path / "d.tif", hills(*grid(160)) + np.float32(up), from_origin(WEST + east, NORTH + north, 0.5, 0.5)
    )
    plain = evaluate(moved, Comparison(truth))
    aligned = evaluate(moved, Comparison(truth, align=True))
    assert plain.shift is None
    assert plain.statistics.nmad > 0.2
    found = (aligned.shift.east_m, aligned.shift.north_m, aligned.shift.up_m)
    np.testing.assert_allclose(found, (east, north, up), atol=SHIFT_TOLERANCE_M)
    assert aligned.statistics.nmad < 0.02
    assert abs(aligned.statistics.median) < 0.01
    assert f"{aligned.shift.up_m:+.3f} m up" in evaluation_table(aligned)


def test_a_surface_in_another_crs(tmp_path, hills):
    truth = write(tmp_path / "t.tif", hills(*grid(200)))
    other = np.full((400, 400), np.nan, np.float32)
    at = Affine(0.5, 0, 42000.0, 0, -0.5, 0)
    with rasterio.open(truth) as source:
        x, y = rasterio.warp.transform(CRS, "EPSG:32633", [WEST], [NORTH])
        at = from_origin(x[0] - 30, y[0] + 30, 0.5, 0.5)
        reproject(
            rasterio.band(source, 1), other, dst_transform=at, dst_crs="EPSG:32633", dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )  # fmt: skip
    result = evaluate(write(tmp_path / "d.tif", other, at, "EPSG:32633"), Comparison(truth))
    assert result.statistics.completeness > 0.99
    assert result.statistics.rmse < 0.2


def test_bad_input_is_said_in_one_sentence(tmp_path, hills):
    good = write(tmp_path / "good.tif", hills(*grid(80)))
    far = write(tmp_path / "far.tif", hills(*grid(80)), from_origin(WEST + 5000, NORTH, 0.5, 0.5))
    degrees = write(tmp_path / "deg.tif", hills(*grid(80)), from_origin(9, 47, 1e-5, 1e-5), "EPSG:4326")
    empty = write(tmp_path / "empty.tif", np.full((80, 80), np.nan, np.float32))
    tiny = write(tmp_path / "tiny.tif", np.zeros((1, 5), np.float32))
    classes = write(tmp_path / "c.tif", np.zeros((40, 80), np.uint8))
    text = tmp_path / "text.tif"
    text.write_text("not an image")
    for error, says, arguments in (
        (InputError, "There is no raster of heights .*missing.tif", (tmp_path / "missing.tif", good, {})),
        (InputError, "There is no raster of heights .*missing.tif", (good, tmp_path / "missing.tif", {})),
        (InputError, "text.tif cannot be opened as a raster", (text, good, {})),
        (InputError, "do not overlap", (far, good, {})),
        (InputError, "EPSG:4326.* do not overlap", (good, degrees, {})),
        (InputError, "has no height", (good, empty, {})),
        (InputError, "holds no height at all, so nothing can be compared", (empty, good, {"align": True})),
        (InputError, "too few", (tiny, good, {})),
        (InputError, "leaves nothing", (good, good, {"margin_m": 100.0})),
        (ConfigError, "is negative", (good, good, {"margin_m": -1.0})),
        (ConfigError, "is not a size", (good, good, {"threshold_m": 0.0})),
        (ConfigError, "is not a size", (good, good, {"more_thresholds_m": [-2.0]})),
        (ConfigError, "--slopes 30,15 must rise", (good, good, {"slope_edges_deg": [30, 15]})),
        (ConfigError, "--slopes 5,95 must rise", (good, good, {"slope_edges_deg": [5, 95]})),
        (ConfigError, "is not on the grid", (good, good, {"classes": classes})),
        (
            InputError,
            "There is no raster of classes .*nowhere.tif",
            (good, good, {"classes": tmp_path / "nowhere.tif"}),
        ),
        (InputError, "cannot be opened as a raster", (good, good, {"classes": text})),
    ):
        with pytest.raises(error, match=says) as caught:
            evaluate(arguments[0], Comparison(arguments[1], **arguments[2]))
        assert "\n" not in str(caught.value)


def test_undeclared_fills_of_whole_numbers_with_a_scale(tmp_path):
    stored = np.full((80, 80), 350, np.int16)
    stored[:20] = -32768
    scaled = write(tmp_path / "scaled.tif", stored)
    with rasterio.open(scaled, "r+") as file:
        file.scales = (0.1,)
    result = evaluate(scaled, Comparison(write(tmp_path / "r.tif", np.full((80, 80), 35, np.float32)), margin_m=0))
    assert (result.statistics.completeness, result.statistics.rmse) == (0.75, pytest.approx(0, abs=1e-5))


def test_an_empty_surface_is_judged_not_refused(tmp_path, hills):
    good = write(tmp_path / "good.tif", hills(*grid(80)))
    empty = write(tmp_path / "empty.tif", np.full((80, 80), np.nan, np.float32))
    result = evaluate(empty, Comparison(good))
    lines = evaluation_table(result).splitlines()
    assert "no error is known: no cell has a height in both the surface and the reference" in lines
    assert "MVS3DM, absolute: completeness 0.00 %, median error -" in lines
    assert "aligned: there are no figures, because no cell has a height in both the surface and the reference" in lines
    assert "nan" not in "\n".join(lines)
    assert "no error is known" not in evaluation_table(evaluate(good, Comparison(good)))
    assert result.statistics.completeness == 0.0
    assert lines[2].split() == ["all", "1600", "0.00", "%", "0.00", "%", *["-"] * 9]
    assert (result.mvs3dm.completeness, result.as_dict()["mvs3dm_median_error"]) == (0.0, None)
    json.dumps(result.as_dict(), allow_nan=False)


def test_bands_of_slope_are_judged_apart(tmp_path):
    # Planes of 10, 20 and 50 degrees side by side, each 10 m wide; the surface is out by 0.1, 0.2 and 0.5 m on them.
    slopes, wide = (10, 20, 50), 20
    x, _ = grid(60)
    rise = np.repeat(np.tan(np.radians(slopes)), wide)
    truth = np.tile(np.cumsum(rise) * 0.5, (60, 1)) + 0 * x
    dsm = truth + np.repeat([0.1, 0.2, 0.5], wide)
    paths = write(tmp_path / "d.tif", dsm.astype(np.float32)), write(tmp_path / "t.tif", truth.astype(np.float32))
    result = evaluate(paths[0], Comparison(paths[1], margin_m=0, threshold_m=0.15))
    # The rim has no slope, and where two planes meet it is between theirs: of 15.1 and of 37.9 degrees.
    columns = {"0-5": 0, "5-15": 18, "15-30": 20, "30-45": 1, "45-90": 19}
    assert {name: result.slope_statistics[name].n for name in columns} == {name: 58 * n for name, n in columns.items()}
    assert result.slope_statistics["unknown"].n == 60 * 60 - 58 * 58
    assert result.slope_statistics["5-15"].median == pytest.approx(0.1, abs=1e-4)
    assert result.slope_statistics["15-30"].median == pytest.approx(0.2, abs=1e-4)
    assert result.slope_statistics["45-90"].median == pytest.approx(0.5, abs=1e-4)
    assert result.slope_statistics["5-15"].within == 1
    assert result.slope_statistics["15-30"].within == 1 / 20
    assert sum(band.n for band in result.slope_statistics.values()) == result.statistics.n
    names = list(evaluate(paths[0], Comparison(paths[1], margin_m=0, slope_edges_deg=(12.5,))).slope_statistics)
    assert names == ["0-12.5", "12.5-90", "unknown"]
    assert evaluate(paths[0], Comparison(paths[1], slope_edges_deg=())).slope_statistics == {}


def test_a_slope_has_its_angle_whatever_its_direction(tmp_path):
    x, y = grid(40)
    for east, north in ((0.5, 0), (0, 0.5), (-0.3, 0.4), (0.4, -0.3)):
        heights = read_heights(write(tmp_path / "t.tif", (east * x - north * y).astype(np.float32)))
        truth = truth_blocks(heights, 2, None)
        np.testing.assert_allclose(truth.gradient, np.tile((east, north), (len(truth.xy), 1)), atol=1e-4)
        np.testing.assert_allclose(truth.slope_deg, np.degrees(np.arctan(0.5)), atol=0.01)


def test_heights_between_cells_need_all_four(tmp_path):
    z = np.array([[1, 2, 3], [4, 5, 6], [7, 8, np.nan]], np.float32)
    raster = read_heights(write(tmp_path / "z.tif", z, from_origin(0, 3, 1, 1)))
    # Column and row in cells from the north-west corner: the middle, half a cell in, outside of the centres, by a hole.
    at = np.array([[1.0, 1.0], [1.25, 1.5], [0.4, 1.0], [1.0, 2.6], [-0.2, 1.0], [2.0, 2.0]])
    xy = np.column_stack([at[:, 0], 3 - at[:, 1]])
    np.testing.assert_allclose(raster.between_cells(xy), [3.0, 4.75, *[np.nan] * 4])
    np.testing.assert_allclose(raster.bilinear(xy), [3.0, 4.75, 4.0, 8.0, np.nan, np.nan])


def test_a_case_computed_by_hand(tmp_path):
    # Cells of 1 m under cells of 2 m that start a metre further north-west; a hole in each.
    nan = np.nan
    reference = np.array([[10, 11, 12], [13, 14, 15], [16, nan, 18]], np.float32)
    surface = np.array([[10.5, 12], [nan, 15]], np.float32)
    result = evaluate(
        write(tmp_path / "d.tif", surface, from_origin(WEST - 1, NORTH + 1, 2, 2)),
        Comparison(write(tmp_path / "r.tif", reference, from_origin(WEST, NORTH, 1, 1)), margin_m=0),
    )
    # Errors 0.5, 1, 0 / -, 1, 0 / -, (no reference), -3.
    figures = result.statistics
    assert (figures.n, figures.completeness, figures.within) == (8, 6 / 8, 3 / 8)
    assert (figures.median, figures.le90, figures.le95) == pytest.approx((0.25, 2.0, 2.5))
    assert figures.nmad == pytest.approx(1.4826 * 0.5)
    assert figures.rmse == pytest.approx(math.sqrt(11.25 / 6))
    assert figures.mean == pytest.approx(-0.5 / 6)
    assert (result.mvs3dm.completeness, result.mvs3dm.median_error_m) == (3 / 8, 0.75)
    expected = [[0.5, 1, 0], [nan, 1, 0], [nan, nan, -3]]
    np.testing.assert_array_equal(result.error_map.errors, np.array(expected, np.float32))


def test_many_cells_are_judged_as_few_at_a_time(tmp_path, hills, monkeypatch):
    truth = hills(*grid(60))
    dsm = truth + np.linspace(-2, 2, 60, dtype=np.float32)
    paths = write(tmp_path / "d.tif", dsm), write(tmp_path / "t.tif", truth)
    whole = evaluate(paths[0], Comparison(paths[1], margin_m=3)).mvs3dm
    monkeypatch.setattr("zlocus.evaluation.mvs3dm.CELLS_AT_A_TIME", 150)
    assert evaluate(paths[0], Comparison(paths[1], margin_m=3)).mvs3dm == whole
    # Columns 15 to 44 are within 1 m, of columns 6 to 53 inside the margin.
    assert whole.completeness == 30 / 48


def test_the_definitions_of_mvs3dm(tmp_path):
    # 100 quarter-metre cells, two of them empty in the reference; blocks and edges would judge them otherwise.
    truth = np.full((10, 10), 10.0, np.float32)
    truth[:, 5:] = 20.0
    dsm = truth + np.float32(0.3)
    dsm[:, 4] = 20.0  # the wall one cell too far west: 10 m too high
    dsm[0, :3] = np.nan
    dsm[9, 9] -= np.float32(1.3)  # 1 m too low: not within 1 m
    truth[5, 6:8] = np.nan
    quarter = from_origin(WEST, NORTH, 0.25, 0.25)
    result = evaluate(
        write(tmp_path / "d.tif", dsm, quarter), Comparison(write(tmp_path / "t.tif", truth, quarter), margin_m=0)
    )
    assert result.mvs3dm.completeness == (98 - 10 - 3 - 1) / 98
    assert result.mvs3dm.median_error_m == pytest.approx(0.3, abs=1e-5)
    assert result.as_dict()["mvs3dm_completeness"] == result.mvs3dm.completeness
    assert "MVS3DM, absolute: completeness 85.71 %, median error 0.300 m" in evaluation_table(result)


def test_its_median_error_is_absolute_and_its_shift_removed(tmp_path, hills):
    truth = hills(*grid(100))
    signs = np.where((np.arange(100) % 2)[None], 0.5, -0.5) * np.ones((100, 1))
    dsm = write(tmp_path / "d.tif", (truth + signs).astype(np.float32))
    reference = write(tmp_path / "t.tif", truth)
    result = evaluate(dsm, Comparison(reference, margin_m=0))
    assert result.statistics.median == pytest.approx(0, abs=1.0)
    assert result.mvs3dm.median_error_m == pytest.approx(0.5, abs=1e-4)
    high = write(tmp_path / "h.tif", truth + np.float32(30))
    assert evaluate(high, Comparison(reference)).mvs3dm.completeness == 0
    assert evaluate(high, Comparison(reference, align=True)).mvs3dm.completeness == 1
    assert evaluate(high, Comparison(reference, align=True)).unshifted_statistics.median == pytest.approx(30, abs=1e-3)


@pytest.fixture(scope="module")
def judge(shared_data):
    """A judge of surfaces that shares no code with ours: it lies beside the scenes."""
    found = shared_data.parent / "tools" / "evaluate_dsm.py"
    assert found.is_file(), f"ZLOCUS_TEST_DATA names {shared_data}, and there is no {found}"
    return found


@pytest.mark.parametrize("align", [False, True])
def test_agrees_with_the_independent_judge(tmp_path, shared_data, judge, align):
    scene = shared_data / "rendered-city"
    rows, cols = slice(100, 700), slice(200, 760)
    with rasterio.open(scene / "truth_dsm.tif") as source:
        truth = source.read(1)[rows, cols]
        at = source.transform * Affine.translation(cols.start, rows.start)
    with rasterio.open(scene / "truth_class.tif") as source:
        classes = source.read(1)[rows, cols]
    rng = np.random.default_rng(7)
    dsm = truth[::2, ::2] + rng.normal(0, 0.3, truth[::2, ::2].shape).astype(np.float32)
    dsm[rng.random(dsm.shape) < 0.05] = np.nan
    dsm[rng.random(dsm.shape) < 0.05] += 5
    shifted = Affine.translation(0.8, -0.45) * at * Affine.scale(2)
    paths = [
        write(tmp_path / "d.tif", dsm, shifted), write(tmp_path / "t.tif", truth, at),
        write(tmp_path / "c.tif", classes, at),
    ]  # fmt: skip
    command = [sys.executable, judge, *paths[:2], "--class", paths[2], "--json", *(["--align"] if align else [])]
    theirs = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    ours = evaluate(paths[0], Comparison(paths[1], classes=paths[2], align=align))
    for name, figures in {"all": ours.statistics, **ours.class_statistics}.items():
        assert figures.n == theirs[name]["n"]
        mine = figures.completeness, figures.within, figures.median, figures.nmad, figures.rmse, figures.le90
        digits = (4, 4, 3, 3, 3, 3)
        assert [round(v, d) for v, d in zip(mine, digits, strict=True)] == [theirs[name][key] for key in FIGURES]
    if align:
        assert [round(ours.shift.east_m, 3), round(ours.shift.north_m, 3)] == theirs["shift"]


def _city(truth, at, rng):
    """Half-metre cells with noise, holes and gross errors, a little beside the truth."""
    dsm = truth[::2, ::2] + rng.normal(0, 0.3, truth[::2, ::2].shape)
    dsm[rng.random(dsm.shape) < 0.05] = np.nan
    dsm[rng.random(dsm.shape) < 0.05] += 5
    return dsm, Affine.translation(0.3, -0.2) * at * Affine.scale(2), CRS


def _hills(truth, at, rng):
    """Cells of 0.7 m that start elsewhere, in the zone beside, with a hole of 60 m and a step in height."""
    west, north = (place[0] for place in rasterio.warp.transform(CRS, "EPSG:32633", [at.c], [at.f]))
    there = Affine(0.7, 0, west - 12.3, 0, -0.7, north + 8.1)
    dsm = np.full((800, 800), np.nan)
    reproject(
        truth, dsm, src_transform=at, src_crs=CRS, dst_transform=there, dst_crs="EPSG:32633", src_nodata=np.nan,
        dst_nodata=np.nan, resampling=Resampling.bilinear,
    )  # fmt: skip
    dsm[300:386, 200:286] = np.nan
    dsm[:, 400:] += 0.8
    return dsm + rng.normal(0, 0.2, dsm.shape), there, "EPSG:32633"


def _part(truth, at, rng):
    """Three-metre cells, rounded to 0.1 m, of the east of the truth alone."""
    dsm = np.round(truth[6::12, 966::12] + rng.normal(0.2, 0.5, truth[6::12, 966::12].shape), 1)
    return dsm, at * Affine.translation(960, 0) * Affine.scale(12), CRS


@pytest.mark.parametrize(
    ("scene", "spoilt"),
    [("rendered-city", _city), ("rendered-hills-biased", _hills), ("rendered-city", _part)],
    ids=["holes and noise", "another zone and grid", "a part, coarse"],
)
def test_three_cases_agree_with_the_independent_judge_to_a_thousandth(tmp_path, shared_data, judge, scene, spoilt):
    reference, classes = (shared_data / scene / f"truth_{name}.tif" for name in ("dsm", "class"))
    with rasterio.open(reference) as source:
        dsm, at, crs = spoilt(source.read(1).astype(float), source.transform, np.random.default_rng(11))
    path = write(tmp_path / "d.tif", dsm.astype(np.float32), at, crs)
    command = [sys.executable, judge, path, reference, "--class", classes, "--margin", "10", "--json"]
    theirs = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    mine = ["evaluate", path, reference, "--classes", classes, "--margin", "10", "--json"]
    ours = json.loads(CliRunner().invoke(app, list(map(str, mine)), catch_exceptions=False).stdout)
    names = ("completeness", "within", "median", "nmad", "rmse", "le90")
    for kind in ("all", "ground", "building", "tree"):
        if theirs[kind]["within"] == 0 == theirs[kind]["complete"]:
            continue
        assert ours[kind]["n"] == theirs[kind]["n"] > 1000
        for name, key in zip(names, FIGURES, strict=True):
            assert ours[kind][name] == pytest.approx(theirs[kind][key], abs=JUDGES_DIFFER), (kind, name)
