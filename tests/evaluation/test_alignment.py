"""Absolute and aligned accuracy beside each other: what the shift explains, and when no shift can be known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from evaluation_rasters import NORTH, WEST, grid, moved, rolling, write
from zlocus.core.errors import InputError
from zlocus.evaluation import spread
from zlocus.evaluation.alignment import best_shift
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.truth import truth_blocks

N = 200
PLANTED = (0.7, -1.2, 0.4)
# The last step of the search is 0.03 m.
SHIFT_TOLERANCE_M = 0.03
# What remains of a shift that is known to 0.02 m on slopes of up to 40 degrees, and of interpolation over half a metre.
ALIGNED_ERROR_M = 0.02


def level(x, y):
    return 0 * x + 10.0


def tilted(x, y):
    return 0.3 * x - 0.2 * y


def valley(x, y):
    return 4 * np.sin(x / 12)


def village(x, y):
    """Level ground with a pitched roof on every twentieth of it."""
    return 10 + 4 * np.clip(1 - abs((x % 40) - 20) / 6, 0, 1) * (abs((y % 40) - 20) < 4)


def noisy(seed, sigma_m, correlation_cells=0.0):
    def change(z):
        noise = gaussian_filter(np.random.default_rng(seed).normal(size=z.shape), correlation_cells)
        return z + sigma_m * noise / noise.std()

    return change


@pytest.fixture
def shifted(tmp_path):
    return moved(tmp_path / "d.tif", N, PLANTED), moved(tmp_path / "r.tif", N, (0, 0, 0))


def test_a_planted_shift_is_in_the_absolute_errors_and_not_in_the_aligned_ones(shifted):
    dsm, reference = shifted
    result = evaluate(dsm, Comparison(reference))
    assert result.found_shift.enu_m == pytest.approx(PLANTED, abs=SHIFT_TOLERANCE_M)
    assert result.absolute_accuracy.statistics.rmse > 0.5
    assert result.absolute_accuracy.statistics.nmad > 0.4
    assert result.aligned_accuracy.statistics.rmse < ALIGNED_ERROR_M
    assert abs(result.aligned_accuracy.statistics.median) < 1e-6
    assert result.absolute_accuracy.mvs3dm.median_error_m > 0.4
    assert result.aligned_accuracy.mvs3dm.median_error_m < ALIGNED_ERROR_M
    # Without --align the main figures are the absolute ones, and no shift was removed from them.
    assert result.shift is None
    assert result.unshifted_statistics is None
    assert result.statistics == result.absolute_accuracy.statistics


def test_the_shift_is_the_same_whether_or_not_it_is_asked_for(shifted):
    dsm, reference = shifted
    plain, asked = evaluate(dsm, Comparison(reference)), evaluate(dsm, Comparison(reference, align=True))
    assert (plain.absolute_accuracy, plain.aligned_accuracy, plain.found_shift) == (
        asked.absolute_accuracy,
        asked.aligned_accuracy,
        asked.found_shift,
    )
    assert asked.shift == plain.found_shift
    assert asked.statistics == plain.aligned_accuracy.statistics
    assert asked.unshifted_statistics == plain.absolute_accuracy.statistics
    np.testing.assert_allclose(asked.error_map.errors[40:-40, 40:-40], 0, atol=5 * ALIGNED_ERROR_M)
    assert np.nanmedian(plain.error_map.errors) == pytest.approx(plain.absolute_accuracy.statistics.median, abs=1e-5)


@pytest.mark.parametrize("cell_m", [0.5, 0.25])
def test_a_surface_that_equals_the_reference_has_no_shift_and_equal_figures(tmp_path, cell_m):
    z = rolling(*grid(N, cell_m)) + np.random.default_rng(1).normal(0, 0.05, (N, N))
    z[60:100, 60:100] += 8.0
    same = write(tmp_path / "r.tif", z.astype(np.float32), from_origin(WEST, NORTH, cell_m, cell_m))
    for asks in (False, True):
        result = evaluate(same, Comparison(same, align=asks))
        assert result.found_shift.enu_m == pytest.approx((0, 0, 0), abs=1e-6)
        assert result.found_shift.undetermined is None
        assert result.aligned_accuracy == result.absolute_accuracy


@pytest.mark.parametrize("asks", [False, True])
@pytest.mark.parametrize("noise_m", [0.0, 0.3])
@pytest.mark.parametrize("ground", [level, tilted, valley], ids=["level", "tilted", "one direction"])
def test_no_shift_is_invented_where_none_can_be_known(tmp_path, ground, noise_m, asks):
    reference = moved(tmp_path / "r.tif", N, (0, 0, 0), ground)
    dsm = moved(tmp_path / "d.tif", N, (0, 0, 0.4), ground, noisy(2, noise_m))
    result = evaluate(dsm, Comparison(reference, align=asks))
    assert result.found_shift.enu_m == pytest.approx((0, 0, 0.4), abs=0.01)
    assert "in one direction slopes differ by 0.0 %, and 1 % is needed" in result.found_shift.undetermined
    # The height explains the median alone: noise is not averaged away.
    assert result.aligned_accuracy.statistics.nmad == pytest.approx(result.absolute_accuracy.statistics.nmad, abs=1e-6)
    assert result.aligned_accuracy.statistics.median == pytest.approx(0, abs=1e-6)
    assert result.absolute_accuracy.statistics.median == pytest.approx(0.4, abs=0.01)
    record = result.as_dict()
    assert record["aligned"]["shift_m"]["east"] is record["aligned"]["shift_m"]["north"] is None
    assert record["aligned"]["shift_m"]["up"] == result.found_shift.up_m
    assert record["aligned"]["reason"] == result.found_shift.undetermined
    assert record["shift_m"] == (record["aligned"]["shift_m"] if asks else None)


def test_a_few_roofs_on_level_ground_determine_no_exact_shift(tmp_path):
    # Over half of the blocks fit wherever the surface lies, and a search would follow them without end.
    reference = moved(tmp_path / "r.tif", N, (0, 0, 0), village)
    dsm = moved(tmp_path / "d.tif", N, PLANTED, village)
    found = evaluate(dsm, Comparison(reference)).found_shift
    assert "4 m more in some direction raise the spread by less than 5 %" in found.undetermined
    assert found.enu_m == pytest.approx((0, 0, 0.4), abs=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_both_surfaces_is_no_relief(tmp_path, seed):
    # The slopes of the noise of the reference differ by 6 %, more than the ground must.
    reference = moved(tmp_path / "r.tif", 2 * N, (0, 0, 0), level, noisy(seed, 0.2, 3))
    dsm = moved(tmp_path / "d.tif", 2 * N, (0, 0, 0.4), level, noisy(seed + 50, 0.3, 3))
    found = evaluate(dsm, Comparison(reference)).found_shift
    assert "raise the spread by less than 5 %" in found.undetermined


def test_noise_does_not_hide_relief(tmp_path):
    dsm = moved(tmp_path / "d.tif", N, PLANTED, change=noisy(4, 0.3, 3))
    found = evaluate(dsm, Comparison(moved(tmp_path / "r.tif", N, (0, 0, 0)))).found_shift
    assert found.undetermined is None
    # Steps between the centres of cells, which average noise, draw a search towards them.
    assert found.enu_m == pytest.approx(PLANTED, abs=0.25)


def test_too_few_blocks_give_no_shift(tmp_path):
    def corner(z):
        z[8:] = np.nan
        z[:, 8:] = np.nan
        return z

    dsm = moved(tmp_path / "d.tif", N, (0, 0, 0.4), change=corner)
    result = evaluate(dsm, Comparison(moved(tmp_path / "r.tif", N, (0, 0, 0)), margin_m=0))
    assert result.found_shift.undetermined == "fewer than 100 blocks without an edge have a height in both"
    assert result.found_shift.enu_m == pytest.approx((0, 0, 0.4), abs=0.05)


def test_without_common_heights_the_absolute_figures_stand_alone(tmp_path, shifted):
    empty = write(tmp_path / "e.tif", np.full((N, N), np.nan, np.float32))
    result = evaluate(empty, Comparison(shifted[1]))
    assert result.aligned_accuracy is None
    assert result.found_shift is None
    assert result.absolute_accuracy.statistics.completeness == 0
    aligned = result.as_dict()["aligned"]
    assert (aligned["shift_m"], aligned["all"], aligned["classes"]) == (None, None, {})
    assert aligned["reason"] == "no cell has a height in both the surface and the reference"
    for options in ({"align": True}, {"coregister": "nuth-kaab"}):
        with pytest.raises(InputError):
            evaluate(empty, Comparison(shifted[1], **options))


def test_each_class_has_both_kinds_of_figures(tmp_path, shifted):
    classes = np.repeat(np.arange(4, dtype=np.uint8), N // 4)[:, None] * np.ones((1, N), np.uint8)
    result = evaluate(shifted[0], Comparison(shifted[1], classes=write(tmp_path / "c.tif", classes)))
    record = result.as_dict()
    for kind in ("absolute", "aligned"):
        assert set(record[kind]["classes"]) == {"ground", "building", "tree"}
        assert record[kind]["slopes_deg"].keys() == record["slopes_deg"].keys()
    for name in ("ground", "building", "tree"):
        assert record[name] == record["absolute"]["classes"][name]
        assert record["absolute"]["classes"][name]["rmse"] > 0.15
        assert record["aligned"]["classes"][name]["rmse"] < ALIGNED_ERROR_M
    assert record["all"] == record["absolute"]["all"]
    assert record["mvs3dm_completeness"] == record["absolute"]["mvs3dm_completeness"]


def plain_search(surface, truth, points):
    """The search without samples: every spread is computed from all blocks."""
    flat = ~truth.is_edge
    points, height = points.where(flat), truth.mean[flat]

    def spread_at(shift):
        difference = points.heights(surface, HeightRaster.bilinear, shift) - height
        difference = difference[np.isfinite(difference)]
        return np.median(np.abs(difference - np.median(difference)))

    best = min(itertools.product(np.arange(-4.0, 5.0), repeat=2), key=spread_at)
    step = 0.5
    while step > 0.02:
        nearby = min(
            ((best[0] + u * step, best[1] + v * step) for u, v in itertools.product((-1, 0, 1), repeat=2)),
            key=spread_at,
        )
        step = step / 2 if nearby == best else step
        best = nearby
    return best


def holes_and_gross_errors(z):
    rng = np.random.default_rng(9)
    z = z + rng.normal(0, 0.3, z.shape)
    z[rng.random(z.shape) < 0.05] += 20.0
    z[30:60, 30:70] = np.nan
    return z


@pytest.mark.parametrize(
    ("shift", "change"),
    [
        ((0.7, -1.2, 0.4), noisy(1, 0.3)), ((-3.3, 5.1, 9), noisy(2, 0.3, 2)), ((0, 0, 0), noisy(3, 3.0)),
        ((1.3, 0.2, -2), holes_and_gross_errors),
    ],
)  # fmt: skip
def test_the_search_with_samples_finds_what_the_plain_search_finds(tmp_path, monkeypatch, shift, change):
    monkeypatch.setattr(spread, "SAMPLE_BLOCKS", (400, 1600))
    surface = read_heights(moved(tmp_path / "d.tif", 120, shift, change=change))
    truth = truth_blocks(read_heights(moved(tmp_path / "r.tif", 120, (0, 0, 0))), 5.0, None)
    points = Points(truth.xy)
    assert best_shift(surface, truth, points) == plain_search(surface, truth, points)


def test_a_search_that_runs_away_ends_and_determines_nothing(tmp_path):
    # The surface is the reference 11 m farther east: on ground this smooth the spread falls all the way.
    reference = moved(tmp_path / "r.tif", N, (0, 0, 0), valleys)
    dsm = moved(tmp_path / "d.tif", N, (11, 0, 0.4), valleys)
    found = evaluate(dsm, Comparison(reference)).found_shift
    assert found.undetermined == "the differences spread less and less up to 8 m, as far as is searched"


def valleys(x, y):
    """Hills of 40 and 60 m from top to top."""
    return 5 * np.sin(2 * np.pi * x / 60) + 5 * np.sin(2 * np.pi * y / 40)
