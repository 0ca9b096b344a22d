"""The range belongs to the cell: towers stay in it, open ground is cheap."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from zlocus.core.grid import CellWindow
from zlocus.core.options import PyramidOptions
from zlocus.matching.height_lattice import MAX_DIFFERENCE_OF_NEIGHBOURS_PX, LANES, search_lattice, shared_heights, without_spikes
from zlocus.matching.search_range import MAX_COST_MARGIN_OF_SECOND_HEIGHT, range_from_coarser

OPTIONS = PyramidOptions(block=16, margin_steps=6, neighbour_cells=2)


def nearby(low, high=None):
    low = np.asarray(low, np.float32)
    return search_lattice(low, low if high is None else high, 10.0, 0.5, OPTIONS)


def holds(lattice, block, low, high):
    first, count = lattice.first[block], lattice.count[block]
    return first <= low and high <= first + count - 1


def test_the_whole_range():
    lattice = nearby(np.zeros((37, 70)), np.full((37, 70), 49, np.float32))
    assert lattice.first.shape == (3, 5)
    assert (lattice.first == -6).all()
    assert (lattice.count == 64).all()
    assert (lattice.origin_m, lattice.step_m) == (10.0, 0.5)


def test_flat_ground_has_a_short_range_around_it():
    lattice = nearby(np.full((37, 70), 100.3))
    assert (lattice.count == 16).all()
    assert holds(lattice, (0, 0), 95, 106)


def test_a_tower_widens_its_block_and_those_within_reach():
    low = np.full((48, 80), 100.0, np.float32)
    high = low.copy()
    high[20:26, 14:19] = 210.0  # in the second and, by its neighbourhood, in the first and second column of blocks
    lattice = nearby(low, high)
    for block in ((1, 0), (1, 1)):
        assert holds(lattice, block, 94, 216)
    # Four fine cells further on, across the border of blocks, the tower still counts.
    assert holds(lattice, (0, 1), 94, 106)
    assert not holds(lattice, (1, 3), 94, 216)
    beside = low.copy()
    beside[20, 12] = 210.0
    assert holds(nearby(low, beside), (1, 1), 94, 216)
    beside[20, 12], beside[20, 11] = 100.0, 210.0
    assert not holds(nearby(low, beside), (1, 1), 94, 216)


def test_heights_below_the_base_surface_have_negative_indices():
    lattice = nearby(np.full((20, 20), -40.5), np.full((20, 20), -31.0, np.float32))
    assert (lattice.first == -47).all()
    assert holds(lattice, (0, 0), -47, -25)
    assert (lattice.count == 24).all()


def test_a_block_that_nobody_saw_searches_the_least():
    """Also at the border of the tile and beside blocks with candidates."""
    low = np.full((80, 80), np.nan, np.float32)
    low[:16, :16] = 120.0
    lattice = nearby(low)
    assert holds(lattice, (0, 0), 114, 126)
    assert (lattice.count[3:, 3:] == LANES).all()
    assert (lattice.count > 0).all()
    assert (lattice.first[3:, 3:] == 0).all()


def coarse_result(best, second, margin, winner_takes_all, window):
    heights = SimpleNamespace(best=best, second=second, uniqueness=margin)
    visible = np.zeros((3, 3, *best.shape), np.int32)
    visible[1] = 100
    return SimpleNamespace(
        level=SimpleNamespace(window=window), heights=heights, winner_takes_all=winner_takes_all, visible=visible,
        slope_surface=SimpleNamespace(cells=np.zeros(best.shape, np.float32)),
    )  # fmt: skip


def candidates(second_at, margin_at, ties=(), side=3, lone_at=20):
    """Candidates on 40 x 40 cells above 24 x 24 coarse ones, whose best index is 20.

    `side` x `side` have a rival, and other least costs.
    """
    coarse = CellWindow(-2, -2, 24, 24)
    best = np.full((24, 24), 20, np.int32)
    second, lone, margin = best.copy(), best.copy(), np.full((24, 24), 65535, np.uint16)
    some = np.s_[10 : 10 + side, 12 : 12 + side]
    second[some], margin[some], lone[some] = second_at, margin_at, lone_at
    match_scene = SimpleNamespace(
        ties=np.array(ties, float).reshape(-1, 3), cell_m=0.5, anchor=(1000.0, 2000.0), origin_m=10.0, step_m=0.25
    )
    level = SimpleNamespace(window=CellWindow(0, 0, 40, 40), number=1, origin_m=10.0, step_m=0.5)
    return range_from_coarser(match_scene, coarse_result(best, second, margin, lone, coarse), level, OPTIONS)


def test_a_near_rival_is_a_candidate():
    low, high = candidates(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT - 1)
    np.testing.assert_array_equal(high[16:22, 20:26], 110)
    assert (high == 110).sum() == 36
    assert (low == 40).all()
    low, high = candidates(5, MAX_COST_MARGIN_OF_SECOND_HEIGHT - 1)
    assert (low == 10).sum() == 36
    assert (high == 40).all()


def test_what_cells_would_choose_alone_is_a_candidate():
    """However much more their neighbours make it cost; but not where fewer cells agree than make a tower."""
    low, high = candidates(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT, lone_at=50)
    assert (high[16:22, 20:26] == 100).all()
    assert (high == 100).sum() == 36
    assert (low == 40).all()
    assert (candidates(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT, lone_at=5)[0] == 10).sum() == 36
    assert (candidates(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT, lone_at=50, side=2)[1] == 40).all()


@pytest.mark.parametrize("second_at", [55, 5])
def test_a_rival_of_few_cells_is_none(second_at):
    """It would widen the range of a whole block."""
    low, high = candidates(second_at, 0, side=2)
    assert (low == 40).all()
    assert (high == 40).all()


def test_spikes_beside_cells_that_nobody_saw():
    """Unknown cells stay unknown, and neither hold up a spike nor wear away what lies beside them."""
    known = np.ones((12, 12), bool)
    known[:, 6:] = False
    low, high = np.full((12, 12), 40, np.float32), np.full((12, 12), 40, np.float32)
    high[2:5, 3:6], high[8, 5] = 90, 90
    found_low, found_high = without_spikes(low, high, known)
    assert np.isnan(found_high[~known]).all()
    assert np.isnan(found_low[~known]).all()
    expected = np.full((12, 6), 40.0)
    expected[2:5, 3:6] = 90
    np.testing.assert_array_equal(found_high[:, :6], expected)
    assert (found_low[:, :6] == 40).all()


def test_heights_that_cells_share():
    """Three by three cells agree; a cell beside them, and cells that each find another height, do not. Whatever slope
    they stand on."""
    alike = round(MAX_DIFFERENCE_OF_NEIGHBOURS_PX / OPTIONS.max_shift_px)
    slope = 3 * alike * np.arange(24, dtype=np.float32) * np.ones((20, 1), np.float32)
    best = np.full((20, 24), 40, np.int32)
    lone = best.copy()
    lone[2:5, 3:6] = 90 + np.arange(3) * (alike // 2)
    lone[2:5, 6] = 90 + 3 * alike
    lone[10:18, 2:10] = 60 + 10 * np.random.default_rng(1).permutation(64).reshape(8, 8)
    lone[10:13, 14:17] = 90 + np.arange(3) * alike
    expected = best.copy()
    expected[2:5, 3:6] = lone[2:5, 3:6]
    for base in (np.zeros_like(slope), slope):
        steps = base.astype(np.int32)
        found = shared_heights(lone + steps, best + steps, base, OPTIONS)
        np.testing.assert_array_equal(found, expected + steps)


def test_a_far_rival_is_none():
    assert (candidates(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT)[1] == 40).all()


def test_tie_points_are_candidates():
    """Cells of 1 m at this level: a tie at (1005.3, 1992.1) lies in row 7, column 5; steps of 0.5 m."""
    low, high = candidates(20, 65535, [(1005.3, 1992.1, 72.0), (900.0, 900.0, 500.0)])
    assert high[7, 5] == 124
    assert (high == 40).sum() == high.size - 1
    assert (low == 40).all()
