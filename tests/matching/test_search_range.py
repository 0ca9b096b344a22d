"""Search range of a level from the heights of the coarser one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from zlocus.core.grid import CellWindow
from zlocus.core.options import PyramidOptions
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.search_range import MAX_COST_MARGIN_OF_SECOND_HEIGHT, range_from_coarser

OPTIONS = PyramidOptions(block=16, margin_steps=6, neighbour_cells=2)


def coarse_result(best, second, margin, winner_takes_all, window):
    heights = SimpleNamespace(best=best, second=second, uniqueness=margin)
    zeros = np.zeros((3, *best.shape), np.int32)
    visible = VisibleHeights(zeros, zeros + 100, zeros)
    return SimpleNamespace(
        level=SimpleNamespace(window=window), heights=heights, winner_takes_all=winner_takes_all, visible=visible,
        slope_surface=SimpleNamespace(cells=np.zeros(best.shape, np.float32)),
    )  # fmt: skip


def search_range(second_at, margin_at, ties=(), side=3, winner_at=20):
    """Search range of 40 x 40 cells from 24 x 24 coarse cells, whose best level index is 20.

    `side` x `side` coarse cells have another second height, and another winner-takes-all height.
    """
    coarse = CellWindow(-2, -2, 24, 24)
    best = np.full((24, 24), 20, np.int32)
    second, winner_takes_all, margin = best.copy(), best.copy(), np.full((24, 24), 65535, np.uint16)
    some = np.s_[10 : 10 + side, 12 : 12 + side]
    second[some], margin[some], winner_takes_all[some] = second_at, margin_at, winner_at
    match_scene = SimpleNamespace(
        ties=np.array(ties, float).reshape(-1, 3),
        break_lines=None,
        cell_size=0.5,
        anchor=(1000.0, 2000.0),
        height_origin=10.0,
        height_step=0.25,
    )
    level = SimpleNamespace(window=CellWindow(0, 0, 40, 40), number=1, height_origin=10.0, height_step=0.5)
    return range_from_coarser(
        match_scene, coarse_result(best, second, margin, winner_takes_all, coarse), level, OPTIONS
    )


def test_a_second_height_of_nearly_the_same_cost_is_searched():
    low, high = search_range(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT - 1)
    np.testing.assert_array_equal(high[16:22, 20:26], 110)
    assert (high == 110).sum() == 36
    assert (low == 40).all()
    low, high = search_range(5, MAX_COST_MARGIN_OF_SECOND_HEIGHT - 1)
    assert (low == 10).sum() == 36
    assert (high == 40).all()


def test_winner_takes_all_heights_that_neighbours_share_are_searched():
    """However much more their neighbours make it cost; but not where fewer cells agree than make a tower."""
    low, high = search_range(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT, winner_at=50)
    assert (high[16:22, 20:26] == 100).all()
    assert (high == 100).sum() == 36
    assert (low == 40).all()
    assert (search_range(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT, winner_at=5)[0] == 10).sum() == 36
    assert (search_range(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT, winner_at=50, side=2)[1] == 40).all()


@pytest.mark.parametrize("second_at", [55, 5])
def test_a_second_height_of_few_cells_is_not_searched(second_at):
    """It would widen the range of a whole block."""
    low, high = search_range(second_at, 0, side=2)
    assert (low == 40).all()
    assert (high == 40).all()


def test_a_second_height_of_much_higher_cost_is_not_searched():
    assert (search_range(55, MAX_COST_MARGIN_OF_SECOND_HEIGHT)[1] == 40).all()


def test_search_ranges_contain_the_tie_points():
    """Cells of 1 m at this level: a tie at (1005.3, 1992.1) lies in row 7, column 5; steps of 0.5 m."""
    low, high = search_range(20, 65535, [(1005.3, 1992.1, 72.0), (900.0, 900.0, 500.0)])
    assert high[7, 5] == 124
    assert (high == 40).sum() == high.size - 1
    assert (low == 40).all()
