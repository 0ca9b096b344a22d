"""Ground outside the overlap of two views: covered at wrong heights only, and therefore not matched."""

from __future__ import annotations

import numpy as np
import pytest

import free_ray_scene as free
from zlocus.core.grid import CellWindow
from zlocus.matching import overlap as stage
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.shared_records import NEVER_COVERED, VisibleHeights
from zlocus.matching.occlusion import covered_heights
from zlocus.matching.overlap import (
    MAX_GROUND_STEPS,
    MAX_RISE_BY_DISTANCE,
    CoarsestHeights,
    ExpectedBounds,
    OverlapGround,
    covered_ground,
    ground_nearby,
    overlap_ground,
    unsupported,
)
from zlocus.matching.slope_surface import SlopeSurface

ROWS, COLS, LAST = 12, 60, 40
# Two views whose images end at a column that moves by a cell per two steps of height: further out, only higher ground
# is shown. Up to EDGE all heights are.
EDGE, SLANT = 30, 0.5
GROUND, GHOST = 6.0, 33.0
CELL_STEPS = 1.0
# Windows of the coarse level need so many cells around.
WINDOW = 4


def views(edge=EDGE, n=2):
    """Visible heights of n views: a cell at column c is shown from 2 (c - edge) on."""
    col = np.arange(COLS)
    low = np.maximum(np.ceil((col - edge) / SLANT), 0).astype(np.int32)
    full = (np.broadcast_to(bound, (n, ROWS, COLS)).astype(np.int32) for bound in (low, LAST, NEVER_COVERED))
    visible = VisibleHeights(*full)
    never = np.broadcast_to(low > LAST, (n, ROWS, COLS))
    visible.lowest_covered[never], visible.highest_covered[never] = NEVER_COVERED, -1
    return visible


def found(surface=None, shown=None, matched=None):
    expected = ExpectedBounds(np.zeros((ROWS, COLS), np.float32), np.full((ROWS, COLS), LAST, np.float32))
    shown = views() if shown is None else shown
    matched = views(EDGE - WINDOW) if matched is None else matched
    return covered_ground(shown, matched, ground() if surface is None else surface, expected, CELL_STEPS)


def ground():
    """As a matcher finds it: the ground as far as it is shown, then the lowest height that is."""
    col = np.arange(COLS)
    true = np.full(COLS, GROUND)
    return np.tile(np.maximum(true, (col - EDGE + WINDOW) / SLANT), (ROWS, 1)).astype(np.float32)


def test_ground_ends_where_two_views_end_at_its_height():
    covered = found()
    # Shown from (c - 30) / 0.5 on: ground at 6 is up to column 33, and up to 35 within the 5.5 steps that are allowed.
    assert covered[:, :33].all()
    assert not covered[:, 36:].any()


def test_heights_found_beyond_are_not_followed():
    """What was matched beside the ground climbs as steeply as the rays do, and is no ground."""
    surface = ground()
    surface[:, EDGE - WINDOW + 4 :] = GHOST
    np.testing.assert_array_equal(found(surface), found())


def test_ground_that_rises_is_followed():
    """A slope of 0.3 cells per cell under rays of 2: the views end later on it."""
    slope = (GROUND + 0.3 * np.arange(COLS)).astype(np.float32)
    surface = np.tile(slope, (ROWS, 1))
    covered = found(surface, matched=views(EDGE))
    # (c - 30) / 0.5 = 6 + 0.3 c at c = 38.8.
    assert covered[:, :38].all()
    assert not covered[:, 43:].any()


def test_a_tower_at_the_edge_is_kept_with_the_ground_around_it():
    surface = ground()
    surface[3:7, 28:32] = 20.0
    assert found(surface)[:, :33].all()


def test_where_nothing_is_shown_at_all_heights_nothing_is_cut_off():
    shown = views(-2)
    np.testing.assert_array_equal(
        found(shown=shown, matched=shown), shown.highest_covered[0] >= shown.lowest_covered[0]
    )


def test_ground_apart_from_all_other_is_kept():
    """Beyond a gap that no two views cover; what is cut off by ground that is shown at wrong heights is not."""
    shown = views()
    shown.lowest_covered[:, :, 36:], shown.highest_covered[:, :, 36:] = NEVER_COVERED, -1
    shown.lowest_covered[:, :, 50:], shown.highest_covered[:, :, 50:] = 10, LAST
    covered = found(shown=shown, matched=views(EDGE - WINDOW))
    assert covered[:, 50:].all()
    assert not covered[:, 36:50].any()
    shown = views()
    shown.lowest_covered[:, :, 40:], shown.highest_covered[:, :, 40:] = 10, LAST
    assert not found(shown=shown)[:, 36:].any()


@pytest.mark.parametrize("n", [1, 3])
def test_two_views_it_takes(n):
    shown, matched = views(n=n), views(EDGE - WINDOW, n)
    covered = found(shown=shown, matched=matched)
    assert covered[:, :33].all() == (n > 1)
    if n == 1:
        assert not covered.any()


# Of the second half: ground that views compare at all heights up to a column, and what stands on and beside it.
WIDE_ROWS, WIDE_COLS, COMPARED = 40, 90, 60
OBJECT = 15  # cells, the widest that is taken off the ground


def compared(cols=COMPARED):
    is_compared = np.zeros((WIDE_ROWS, WIDE_COLS), bool)
    is_compared[:, :cols] = True
    return is_compared


def test_the_ground_nearby_has_no_buildings_and_may_rise_with_the_distance():
    surface = np.full((WIDE_ROWS, WIDE_COLS), GROUND, np.float32)
    surface[10:22, 48:60] = 30.0  # a building at the edge of the cells that views compare
    surface[:, COMPARED:] = GHOST
    height, rise = ground_nearby(surface, compared(), OBJECT, CELL_STEPS)
    np.testing.assert_array_equal(height, GROUND)
    distance = np.arange(WIDE_COLS) - (COMPARED - 1)
    expected = MAX_RISE_BY_DISTANCE * CELL_STEPS * np.maximum(distance, 0)
    np.testing.assert_allclose(rise, np.tile(expected, (WIDE_ROWS, 1)), rtol=0, atol=1e-3)


def test_a_slope_is_ground():
    slope = np.tile(0.4 * np.arange(WIDE_COLS, dtype=np.float32), (WIDE_ROWS, 1))
    height, rise = ground_nearby(slope, compared(), OBJECT, CELL_STEPS)
    assert (height + rise + MAX_GROUND_STEPS >= slope).all()
    np.testing.assert_allclose(height[5:-5, 10:50], slope[5:-5, 10:50], rtol=0, atol=0.5)


def ground_of_wide(level=1, beside=COMPARED):
    highest = np.full((WIDE_ROWS, WIDE_COLS), GROUND + MAX_GROUND_STEPS, np.float32)
    window = CellWindow(5, 3, WIDE_ROWS, WIDE_COLS)
    return OverlapGround(window, level, ~compared(0), ~compared(), ~compared(beside), highest)


def test_heights_off_the_ground_need_support_beside_it():
    beside = ground_of_wide(beside=COMPARED + 5)
    window = beside.window.finer(beside.level)
    height = np.full((window.rows, window.cols), 2 * GROUND, np.float32)
    assert not beside.needs_support(window, height).any()
    height[20:30, 100:150] = 2 * 35.0
    needs = beside.needs_support(window, height)
    assert needs[20:30, 2 * (COMPARED + 5) : 150].all()
    assert needs.sum() == 10 * (150 - 2 * (COMPARED + 5))
    assert beside.is_at_edge_in(window)[:, 2 * COMPARED :].all()
    assert not beside.is_at_edge_in(window)[:, : 2 * COMPARED].any()


@pytest.mark.parametrize("edge", [EDGE + 20, EDGE - 24])
def test_where_most_cells_are_at_the_edge_none_is(edge, monkeypatch):
    """Of oblique views hardly a cell is compared at all heights, and the ground beside would be guessed far away."""
    matched = views(edge)
    expected = ExpectedBounds(np.zeros((ROWS, COLS), np.float32), np.full((ROWS, COLS), LAST, np.float32))
    monkeypatch.setattr(stage, "heights_shown", lambda *_: views(EDGE + 24))
    lattice = HeightLattice(0.0, 1.0, (ROWS, COLS), 4, np.zeros((3, 15), np.int64), np.full((3, 15), LAST, np.int64))
    window = CellWindow(0, 0, ROWS, COLS)
    coarsest = CoarsestHeights(None, lattice, matched, window, 0, ground(), expected)
    found = overlap_ground(coarsest, LAST, CELL_STEPS)
    assert found.is_at_edge.any() == (edge > EDGE)
    assert found.is_outside.any() == (edge > EDGE)
    assert np.isinf(found.max_ground).all() == (edge < EDGE)


@pytest.mark.parametrize("n_views", [2, 3])
def test_a_height_in_free_air_at_the_edge_has_no_support(n_views):
    """All cells stand off the ground that is known; in the patch alone images do not agree."""
    views, lattice = free.level_ground(free.ANGLES_DEG[:n_views])
    window = CellWindow(0, 0, *free.SHAPE)
    nowhere = np.zeros(free.SHAPE, bool)
    low = np.full(free.SHAPE, free.GROUND - 5, np.float32)
    around = OverlapGround(window, 0, ~nowhere, ~nowhere, ~nowhere, low)
    visible = covered_heights(views, SlopeSurface.flat(free.SHAPE, free.BLOCK), lattice)
    found = unsupported(around, window, views, visible, free.with_patch())
    in_patch = np.zeros(free.SHAPE, bool)
    in_patch[free.PATCH] = True
    assert found[in_patch].mean() > 0.8
    assert found[~in_patch].mean() < 0.1
