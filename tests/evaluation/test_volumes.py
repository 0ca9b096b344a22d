"""Volumes inside polygons and their standard deviation, beside plain sums over all pairs of cells."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from odc.geo.geobox import GeoBox

from overlapping_surfaces import CELL_M, CORNER, CRS
from zlocus.evaluation.change_noise import ChangeNoise, Correlation
from zlocus.evaluation.volumes import ChangeCells, ChangeClass, correlated_variance, volume_of

SHAPE = (60, 80)
GEOBOX = GeoBox(SHAPE, CORNER, CRS)
NO_OFFSET = 0.0


def noise_of(correlation, offset_sigma_m=NO_OFFSET):
    """Errors as stated, with an offset that is known."""
    row, col = np.indices((200, 200))
    places = np.column_stack([row.ravel() + 5000, col.ravel() + 5000])
    normal = np.array([0.67, 1.0, 1.96])
    return ChangeNoise(
        0.0, offset_sigma_m, 1.0, correlation, normal, normal, places, 0.2, 0.0, 1000, 0.2, (0.0, 0.0), False
    )  # fmt: skip


INDEPENDENT = Correlation(np.zeros(1), np.ones(1))


def reader(difference, sigma=0.2):
    def read(window):
        inner = window.within(type(window)(0, 0, *difference.shape))
        out = np.full((window.rows, window.cols), np.nan)
        out[inner.slices_in(window)] = difference[
            inner.row : inner.row + inner.rows, inner.col : inner.col + inner.cols
        ]
        kind = np.select([np.isnan(out), out > 0.5, out < -0.5], [0, ChangeClass.RAISED, ChangeClass.LOWERED], 1)
        return ChangeCells(out, np.where(np.isfinite(out), sigma, np.nan), kind.astype(np.uint8))

    return read


def box(row, col, rows, cols):
    (left, top), (right, bottom) = CORNER * (col, row), CORNER * (col + cols, row + rows)
    return shapely.box(left, bottom, right, top)


def slow_variance(weights, correlation, cell_m):
    """The sum over all pairs of cells."""
    row, col = np.indices(weights.shape)
    row, col, weights = row.ravel(), col.ravel(), weights.ravel()
    distance = cell_m * np.hypot(row[:, None] - row[None], col[:, None] - col[None])
    return float((weights[:, None] * weights[None] * correlation.at(distance)).sum())


CORRELATED = Correlation(np.array([0.4, 0.3]), np.array([2.0, 9.0]))


def test_the_variance_of_a_sum_is_that_of_all_pairs():
    weights = np.random.default_rng(0).uniform(0.0, 1.0, (17, 23))
    assert correlated_variance(weights, CORRELATED, CELL_M) == pytest.approx(
        slow_variance(weights, CORRELATED, CELL_M), rel=1e-9
    )


def test_blocks_of_cells_have_nearly_the_variance_of_their_cells():
    weights = np.random.default_rng(1).uniform(0.5, 1.0, (40, 44))
    blocks = weights.reshape(10, 4, 11, 4).sum(axis=(1, 3))
    assert correlated_variance(blocks, CORRELATED, CELL_M, 4) == pytest.approx(
        slow_variance(weights, CORRELATED, CELL_M), rel=0.02
    )


def test_independent_errors():
    difference = np.full(SHAPE, 0.1)
    difference[10:20, 10:30] = 2.0
    volume = volume_of(box(10, 10, 10, 20), GEOBOX, reader(difference), noise_of(INDEPENDENT))
    assert volume.n_cells == volume.n_known == 200
    assert volume.volume_m3 == pytest.approx(200 * 2.0 * CELL_M**2)
    assert volume.sigma_m3 == pytest.approx(CELL_M**2 * 0.2 * math.sqrt(200))
    assert volume.raised_m2 == pytest.approx(200 * CELL_M**2)
    assert volume.lowered_m2 == 0.0
    assert volume.is_significant


def test_errors_that_all_cells_share():
    """Correlation far beyond the polygon: the errors add up, and the offset adds its own."""
    shared = Correlation(np.ones(1), np.array([1e7]))
    noise = noise_of(shared)
    volume = volume_of(box(10, 10, 10, 20), GEOBOX, reader(np.zeros(SHAPE)), noise)
    assert volume.sigma_m3 == pytest.approx(0.5 * CELL_M**2 * 200 * 0.2, rel=0.02), "at most three quarters cancel"
    kept = volume_of(box(10, 10, 10, 20), GEOBOX, reader(np.zeros(SHAPE)), noise, is_removed=False)
    assert kept.sigma_m3 == pytest.approx(CELL_M**2 * 200 * 0.2, rel=1e-3)


def test_the_error_of_the_offset_grows_with_the_area():
    volume = volume_of(box(0, 0, 20, 20), GEOBOX, reader(np.zeros(SHAPE)), noise_of(INDEPENDENT, 0.1))
    own = 0.2 / math.sqrt(400)
    assert volume.sigma_m3 == pytest.approx(400 * CELL_M**2 * math.hypot(own, 0.1), rel=1e-6)
    assert volume.offset_sigma_m3 == pytest.approx(400 * CELL_M**2 * 0.1)


def test_missing_cells_count_with_the_mean_and_cost_certainty():
    difference = np.full(SHAPE, 1.0)
    difference[10:20, 10:20], difference[10:15, 20:30] = 3.0, np.nan
    volume = volume_of(box(10, 10, 10, 20), GEOBOX, reader(difference), noise_of(INDEPENDENT))
    mean = (100 * 3.0 + 50 * 1.0) / 150
    assert volume.known_share == 0.75
    assert volume.volume_m3 == pytest.approx(200 * CELL_M**2 * mean)
    spread = math.sqrt((100 * (3.0 - mean) ** 2 + 50 * (1.0 - mean) ** 2) / 150)
    assert volume.missing_sigma_m3 == pytest.approx(50 * CELL_M**2 * spread)
    assert volume.sigma_m3 > volume.missing_sigma_m3


def test_gross_errors_stand_beside_the_others():
    noise = replace(noise_of(INDEPENDENT), mismatch_m2=4.0)
    difference = np.full(SHAPE, 0.2)
    volume = volume_of(box(10, 10, 10, 20), GEOBOX, reader(difference), noise)
    assert volume.mismatch_sigma_m3 == pytest.approx(CELL_M**2 * math.sqrt(200 * 4.0))
    assert volume.sigma_m3 == pytest.approx(CELL_M**2 * 0.2 * math.sqrt(200))
    assert not volume.is_significant


def test_a_polygon_beyond_the_grid():
    volume = volume_of(box(-10, -10, 20, 20), GEOBOX, reader(np.ones(SHAPE)), noise_of(INDEPENDENT))
    assert (volume.n_cells, volume.n_known) == (400, 100)
    nowhere = volume_of(box(500, 500, 10, 10), GEOBOX, reader(np.ones(SHAPE)), noise_of(INDEPENDENT))
    assert (nowhere.n_cells, nowhere.n_known) == (100, 0)
    assert math.isnan(nowhere.volume_m3)
    assert not nowhere.is_significant


def test_a_large_polygon_is_read_in_strips(monkeypatch):
    difference = np.random.default_rng(3).normal(size=SHAPE)
    polygon = shapely.Polygon([CORNER * each for each in ((3, 5), (70, 8), (60, 55), (11, 40))])
    whole = volume_of(polygon, GEOBOX, reader(difference), noise_of(CORRELATED))
    monkeypatch.setattr("zlocus.evaluation.volumes.STRIP_CELLS", 200)
    monkeypatch.setattr("zlocus.evaluation.volumes.MAX_SIDE", 16)
    in_strips = volume_of(polygon, GEOBOX, reader(difference), noise_of(CORRELATED))
    assert in_strips.n_cells == whole.n_cells
    assert in_strips.volume_m3 == pytest.approx(whole.volume_m3, rel=1e-9)
    assert in_strips.sigma_m3 == pytest.approx(whole.sigma_m3, rel=0.03)
