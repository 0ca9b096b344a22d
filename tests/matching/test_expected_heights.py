"""Heights that the tie points around a place suggest."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from zlocus.core.grid import CellWindow
from zlocus.matching import expected_heights as module
from zlocus.matching.expected_heights import ABOVE_M, BELOW_M, MAX_SLOPE, SQUARE_CELLS, expected_heights
from zlocus.matching.match_scene import MatchScene

ORIGIN_M, STEP_M, CELL_M = 50.0, 2.0, 2.0
ROUNDING_STEPS, ROUNDING_M = 1e-3, 0.01


def plateau(n=4000, side_m=800.0, seed=1):
    """Ties (n, 3) on a plain at 100 m whose eastern half is a plateau at 180 m."""
    xy = np.random.default_rng(seed).uniform(0.0, side_m, (n, 2))
    return np.column_stack([xy, np.where(xy[:, 0] < side_m / 2, 100.0, 180.0)])


def bounds(ties, window=None, expected_range=(90.0, 200.0), has_margins=True):
    """Lowest and highest expected height (r, c), m, of coarsest cells whose north-west corner is at (0, 800) m."""
    window = CellWindow(0, 0, 400, 400) if window is None else window
    match_scene = MatchScene(
        views=(), anchor=(0.0, 800.0), cell_size=CELL_M, height_origin=ORIGIN_M, height_step=STEP_M, n_steps=100,
        levels=1, overlap_window=window, grey_scales=(), ties=ties, trusted_ties=ties, expected_range=expected_range,
    )  # fmt: skip
    level = SimpleNamespace(
        window=window, shape=(window.rows, window.cols), number=0, height_origin=ORIGIN_M, height_step=STEP_M
    )
    found = expected_heights(match_scene, level, has_margins)
    return None if found is None else tuple(ORIGIN_M + STEP_M * index for index in found)


def test_the_nearest_ties_tell_what_is_expected():
    low, high = bounds(plateau())
    rise_m = 25.0 * MAX_SLOPE  # no square is so far from a tie
    west, east = np.s_[:, :160], np.s_[:, 240:]
    assert (low[west] <= 100.0 - BELOW_M).all()
    assert (high[west] < 100.0 + ABOVE_M + rise_m).all()
    assert (low[east] > 180.0 - BELOW_M - rise_m).all()
    assert (high[east] == 200.0).all()  # the end of the expected range
    at_edge = np.s_[:, 199:201]
    both = (low[at_edge] < 100.0) & (high[at_edge] > 180.0)
    assert both.mean() > 0.9


def test_without_margins_only_the_heights_of_ties_are_expected():
    """As far from the nearest tie as the ground may rise or fall."""
    with_margins, without = bounds(plateau()), bounds(plateau(), has_margins=False)
    low, high = without[0][:, :160], without[1][:, :160]
    is_inside = with_margins[0][:, :160] > 90.0  # not at the end of the expected range
    assert is_inside.mean() > 0.9
    rise_m = 100.0 - low[is_inside]
    assert (rise_m >= 0.0).all()
    np.testing.assert_allclose(with_margins[0][:, :160][is_inside], low[is_inside] - BELOW_M, atol=ROUNDING_M)
    np.testing.assert_allclose(high[is_inside], 100.0 + rise_m, atol=ROUNDING_M)


def test_one_false_tie_suggests_nothing():
    ties = plateau()
    false = np.argmin(np.hypot(*(ties[:, :2] - (200.0, 400.0)).T))
    with_false = ties.copy()
    with_false[false, 2] = 195.0
    before, after = bounds(ties)[1], bounds(with_false)[1]
    np.testing.assert_allclose(after, before, atol=ROUNDING_STEPS)


def test_far_from_all_ties_only_the_whole_range_is_known():
    ties = plateau()
    ties = ties[ties[:, 1] > 700.0]
    low, high = bounds(ties)
    assert (low[-50:] == 90.0).all()
    assert (high[-50:] == 200.0).all()


@pytest.mark.parametrize("offset", [(0, 0), (3, 5), (SQUARE_CELLS, 13)])
def test_a_window_is_told_the_same_as_the_whole(offset):
    whole = bounds(plateau())
    part = bounds(plateau(), CellWindow(*offset, 120, 90))
    for a, b in zip(whole, part, strict=True):
        np.testing.assert_allclose(b, a[offset[0] : offset[0] + 120, offset[1] : offset[1] + 90], atol=ROUNDING_STEPS)


def test_without_ties_nothing_is_expected():
    assert bounds(np.empty((0, 3))) is None
    assert bounds(plateau(), expected_range=None) is None
    low, high = bounds(plateau()[: module.NEIGHBOURS - 1])
    assert (low == 90.0).all()
    assert (high == 200.0).all()
