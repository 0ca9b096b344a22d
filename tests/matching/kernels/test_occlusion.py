"""Occlusion kernels against their slow twins and by hand."""

from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import rough_surface
from reference import surfaces
from zlocus.matching.kernels.occlusion import (
    count_seeing,
    finest_view,
    forget_most_occlusions,
    lowest_visible,
    write_lowest_unoccluded,
)
from zlocus.matching.kernels.shared_records import NEVER_COVERED, NEVER_OCCLUDED, CellBox, VisibleHeights


def visible_from(surface, by_col, by_row):
    out = np.empty(surface.shape, np.float32)
    lowest_visible(surface, by_col, by_row, out)
    return out


@pytest.mark.parametrize("direction", [(0.5, 0.0), (-0.5, 0.0), (0.0, 2.0), (0.0, -0.25), (1.0, 1.0), (-1.0, 1.0)])
def test_lowest_visible_along_rows_columns_and_diagonals(direction):
    surface = rough_surface((37, 53))
    expected = surfaces.marched(surface.astype(float), *direction)
    found = visible_from(surface, *direction)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("direction", [(0.5, 0.2), (-0.3, 1.0), (0.7, -0.69), (-1.5, -0.1)])
def test_lowest_visible_in_any_direction(direction):
    """A hill 60 high. Between two rays their bounds are interpolated again at every cell: tops lose a little."""
    row, col = np.indices((57, 73))
    hill = (60 * np.exp(-((row - 28) ** 2 + (col - 36) ** 2) / 100)).astype(np.float32)
    found, expected = visible_from(hill, *direction), surfaces.marched(hill.astype(float), *direction)
    hidden = expected > hill
    assert hidden.sum() > 50
    assert np.abs(found - expected)[hidden].max() < 3.5


def test_a_nadir_view_sees_everything():
    assert (visible_from(rough_surface((9, 12)), 0.0, 0.0) == np.float32(-1e30)).all()


def test_a_tower_occludes_the_cells_behind_it():
    """20 high, view gains 2 per cell: hidden behind it 18, 16, ... down to 0 after ten cells."""
    surface = np.zeros((5, 30), np.float32)
    surface[:, 20] = 20.0
    found = visible_from(surface, 0.5, 0.0)[2]
    np.testing.assert_allclose(found[10:20], np.arange(0.0, 20.0, 2.0))
    assert (found[:9] < 0).all()


def any_visible(n_views, shape, seed=0):
    """Ranges of height indices that contain, touch or miss a surface of heights 0 to 9; some contain none."""
    rng = np.random.default_rng(seed)
    visible = VisibleHeights(*rng.integers(0, 10, (3, n_views, *shape)).astype(np.int32))
    visible.highest_covered[:] += visible.lowest_covered - 2
    visible.lowest_covered[visible.highest_covered < visible.lowest_covered] = NEVER_COVERED
    return visible, np.round(rng.uniform(0, 9, shape) * 2).astype(np.float32) / 2


def test_views_that_see_a_surface():
    visible, surface = any_visible(3, (11, 14))
    found = np.full(surface.shape, -7, np.int32)
    count_seeing(visible, surface, found)
    for at in np.ndindex(surface.shape):
        ranges = zip(*visible.at(np.s_[:, *at]), strict=True)
        assert found[at] == sum(max(low, free_from) <= surface[at] <= high for low, high, free_from in ranges)
    assert set(found.ravel().tolist()) == {0, 1, 2, 3}


def test_the_finest_view_of_those_that_see_a_cell():
    """Blocks of 4 cells; of equal sizes the first; a cell that has a view already keeps it."""
    (visible, surface), block = any_visible(4, (11, 14)), 4
    size = np.random.default_rng(1).integers(0, 4, (4, 3, 4)).astype(float)
    size[0, 0, 0] = np.nan
    found = np.full(surface.shape, -1, np.int32)
    found[5, :] = 9
    finest_view(size, visible, surface, block, found)
    for r, c in np.ndindex(surface.shape):
        low, high, free_from = visible.at(np.s_[:, r, c])
        sees = (np.maximum(low, free_from) <= surface[r, c]) & (surface[r, c] <= high)
        of_view = np.where(sees, np.nan_to_num(size[:, r // block, c // block]), 0)
        assert found[r, c] == (9 if r == 5 else of_view.argmax() if of_view.max() > 0 else -1)
    assert {-1, 0, 1, 2, 3} <= set(found.ravel().tolist())


def test_lowest_height_indices_at_which_nothing_occludes_a_cell():
    """Of a part of the tile, which begins at row 2 and column 3 of a wider surface; other cells stay."""
    rng, least = np.random.default_rng(0), np.float32(NEVER_OCCLUDED)
    lowest, base = rng.uniform(-9, 9, (12, 15)).astype(np.float32), rng.uniform(-3, 3, (8, 10)).astype(np.float32)
    lowest[4, 5] = -1e30
    out = np.full(base.shape, 77, np.int32)
    write_lowest_unoccluded(lowest, np.array([2, 3]), base, np.float32(1.5), least, CellBox(1, 6, 2, 10), out)
    expected = np.full(base.shape, 77)
    expected[1:6, 2:10] = np.floor(np.maximum(lowest[3:8, 5:13] - base[1:6, 2:10] - 1.5, least))
    np.testing.assert_array_equal(out, expected)
    assert out[2, 2] == NEVER_OCCLUDED


@pytest.mark.parametrize("n_views", [2, 3, 4, 7])
def test_the_three_views_that_are_seen_lowest_are_not_occluded(n_views):
    """Against sorted heights, cell by cell. Equal heights are treated alike."""
    visible, _ = any_visible(n_views, (13, 17), seed=n_views)
    expected = visible.lowest_unoccluded.copy()
    for row, col in np.ndindex(expected.shape[1:]):
        covering = np.flatnonzero((visible.lowest_covered <= visible.highest_covered)[:, row, col])
        of_cell = expected[:, row, col]
        if len(covering) <= 2:
            of_cell[:] = NEVER_OCCLUDED
        elif len(covering) > 3:
            third = sorted(of_cell[covering])[2]
            of_cell[[view for view in covering if of_cell[view] <= third]] = NEVER_OCCLUDED
    forget_most_occlusions(visible, np.int32(NEVER_OCCLUDED))
    np.testing.assert_array_equal(visible.lowest_unoccluded, expected)
