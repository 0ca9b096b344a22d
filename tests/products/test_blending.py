"""Cells of several runs joined: means where they agree, one of them where they contradict each other, and no steps."""

from __future__ import annotations

import numpy as np
import pytest

from overlapping_surfaces import noise, stated_sigma, town
from zlocus.io.surface_cells import SurfaceCells
from zlocus.io.surface_inputs import QUALITY
from zlocus.matching.quality import Quality
from zlocus.products.blending import RunRelations, SeamKind, blended, halo_cells

SHAPE = (60, 80)
FEATHER = 16


def cells(z, sigma=0.2, quality=None):
    z = np.asarray(z, np.float32)
    flags = {} if quality is None else {QUALITY: quality}
    sigma = np.where(np.isfinite(z), sigma, np.nan).astype(np.float32)
    return SurfaceCells(z, sigma, np.ones(z.shape, bool), flags)


def relations(n, shared=False):
    return RunRelations(np.ones((n, n)), np.full((n, n), shared))


def test_where_runs_agree_the_mean_is_weighted_by_precision():
    joined = blended([cells(np.full(SHAPE, 10.0), 0.1), cells(np.full(SHAPE, 10.2), 0.2)], relations(2), FEATHER)
    assert np.allclose(joined.height, (4 * 10.0 + 10.2) / 5, atol=1e-5)
    assert np.allclose(joined.sigma, np.sqrt(1 / (1 / 0.1**2 + 1 / 0.2**2)), atol=1e-6)
    assert (joined.kind == SeamKind.BLENDED).all()


def test_runs_that_share_images_are_no_more_precise_together():
    both = [cells(np.full(SHAPE, 10.0)), cells(np.full(SHAPE, 10.0))]
    assert np.allclose(blended(both, relations(2, shared=True), FEATHER).sigma, 0.2, atol=1e-6)
    assert np.allclose(blended(both, relations(2), FEATHER).sigma, 0.2 / np.sqrt(2), atol=1e-6)


def test_a_run_ends_without_a_step():
    """The difference of 0.3 m is spread over the feather, and the first cell of the other run is almost as before."""
    first, second = np.full(SHAPE, 10.0), np.full(SHAPE, 10.3)
    first[:, 50:] = np.nan
    second[:, :20] = np.nan
    joined = blended([cells(first), cells(second)], relations(2), FEATHER)
    steps = np.abs(np.diff(joined.height, axis=1))
    assert steps.max() < 0.3 * 1.6 / FEATHER
    assert np.allclose(joined.height[:, :20], 10.0)
    assert np.allclose(joined.height[:, 50:], 10.3)
    assert (joined.kind[:, :20] == SeamKind.ONE).all()


def test_a_hole_in_a_run_is_filled_without_a_step():
    first, second = np.full(SHAPE, 10.0), np.full(SHAPE, 10.3)
    first[20:32, 30:44] = np.nan
    joined = blended([cells(first), cells(second)], relations(2), FEATHER)
    assert max(np.abs(np.diff(joined.height, axis=axis)).max() for axis in (0, 1)) < 0.3 * 1.6 / FEATHER
    assert np.allclose(joined.height[20:32, 30:44], 10.3)


def test_runs_that_contradict_each_other_are_not_averaged():
    first, second = np.full(SHAPE, 10.0), np.full(SHAPE, 10.0)
    second[25:40, 30:50] = 15.0
    joined = blended([cells(first), cells(second)], relations(2), FEATHER)
    assert np.isin(joined.height, np.float32([10.0, 15.0])).all()
    assert len(np.unique(joined.height[25:40, 30:50])) == 1, "one run for the whole object"
    assert (joined.kind[25:40, 30:50] == SeamKind.CHOSEN).all()
    assert (joined.kind[:25] == SeamKind.BLENDED).all()


def test_an_edge_that_lies_elsewhere_in_both_stays_sharp():
    first, second = np.full(SHAPE, 10.0), np.full(SHAPE, 10.0)
    first[20:40, 30:50] = second[21:41, 31:51] = 18.0
    joined = blended([cells(first), cells(second)], relations(2), FEATHER)
    assert np.array_equal(joined.height, first.astype(np.float32)), "the roof of the run that was named first"


def test_of_three_runs_the_two_that_agree_win():
    runs = [cells(np.full(SHAPE, z), sigma) for z, sigma in ((17.0, 0.15), (10.0, 0.2), (10.1, 0.2))]
    joined = blended(runs, relations(3), FEATHER)
    assert np.allclose(joined.height, 10.05, atol=1e-4)
    assert set(np.unique(joined.chosen)) == {1}
    assert (joined.kind == SeamKind.CHOSEN).all()


@pytest.mark.parametrize("is_second", [False, True])
def test_an_interpolated_height_counts_only_where_nothing_was_measured(is_second):
    quality = np.full(SHAPE, Quality.FILLED, np.uint16)
    quality[:, 60:] = 0
    measured = np.full(SHAPE, 10.0)
    measured[:, 50:] = np.nan
    runs = [cells(np.full(SHAPE, 10.4), quality=quality), cells(measured)]
    joined = blended(runs[::-1] if is_second else runs, relations(2), FEATHER)
    assert np.allclose(joined.height[:, :49], 10.0, atol=2e-3)
    assert np.allclose(joined.height[:, 51:], 10.4)


def test_the_level_of_water_counts_as_measured():
    water = np.full(SHAPE, Quality.WATER, np.uint16)
    joined = blended([cells(np.full(SHAPE, 10.0), quality=water), cells(np.full(SHAPE, 10.2))], relations(2), FEATHER)
    assert np.allclose(joined.height, 10.1, atol=1e-5)


def test_a_height_of_unknown_precision_leaves_that_of_the_mean_unknown():
    joined = blended([cells(np.full(SHAPE, 10.0), np.nan), cells(np.full(SHAPE, 10.0))], relations(2), FEATHER)
    assert np.isnan(joined.sigma).all()
    assert np.isfinite(joined.height).all()


def test_empty_cells():
    z = np.full(SHAPE, np.nan)
    joined = blended([cells(z), cells(z)], relations(2), FEATHER)
    assert np.isnan(joined.height).all()
    assert (joined.kind == SeamKind.EMPTY).all()
    assert (joined.chosen == -1).all()


def test_a_block_has_the_bytes_of_the_whole():
    rng = np.random.default_rng(3)
    shape, halo = (120, 130), halo_cells(FEATHER)
    runs = []
    for _ in range(2):
        sigma = stated_sigma(rng, shape, 0.3)
        z = town(*shape) + sigma * noise(rng, shape, 1.0)
        z[rng.random(shape) < 0.002] = np.nan
        runs.append(cells(z, sigma))
    whole = blended(runs, relations(2), FEATHER)
    rows, cols = slice(10, 120), slice(0, 70 + halo)
    part = blended([cells(run.height[rows, cols], run.sigma[rows, cols]) for run in runs], relations(2), FEATHER)
    core, of_part = (slice(10 + halo, 120), slice(0, 70)), (slice(halo, 110), slice(0, 70))
    assert np.array_equal(part.chosen[of_part], whole.chosen[core])
    assert np.allclose(part.height[of_part], whole.height[core], atol=1e-5, equal_nan=True)
