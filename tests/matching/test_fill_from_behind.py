"""Gaps filled from behind: on a row worked out by hand, and beside a jump."""

from __future__ import annotations

import numpy as np

from zlocus.matching.fill import DIRECTIONS, filled_from_behind, nearest

NAN = np.float32(np.nan)


def test_nearest_in_every_direction():
    height = np.full((5, 5), NAN)
    expected = {}
    for number, (by_row, by_col) in enumerate(DIRECTIONS):
        # Two cells from the middle, so that one gap is passed.
        height[2 + 2 * by_row, 2 + 2 * by_col] = expected[by_row, by_col] = number + 1.0
    for step, value in expected.items():
        assert nearest(height, *step)[2, 2] == value


def test_a_height_is_its_own_nearest():
    height = np.array([[1.0, NAN, 3.0]], np.float32)
    np.testing.assert_array_equal(nearest(height, 0, -1), [[1.0, 1.0, 3.0]])
    np.testing.assert_array_equal(nearest(height, 0, 1), [[1.0, 3.0, 3.0]])


def test_beside_a_jump_the_gap_takes_what_is_behind():
    height = np.full((9, 12), 5.0, np.float32)
    height[:, 6:] = 20.0
    height[:, 4:7] = NAN
    filled = filled_from_behind(height, np.zeros(height.shape, bool))
    assert (filled[:, 4:7] == 5.0).all()
    known = np.isfinite(height)
    np.testing.assert_array_equal(filled[known], height[known])


def test_one_low_outlier_is_not_taken():
    height = np.full((5, 5), 7.0, np.float32)
    height[2, 2], height[1, 1] = NAN, -100.0
    assert filled_from_behind(height, np.zeros(height.shape, bool))[2, 2] == 7.0


def test_what_is_beyond_stays_empty():
    height = np.array([[1.0, NAN, NAN, 4.0]], np.float32)
    filled = filled_from_behind(height, np.array([[False, False, True, False]]))
    np.testing.assert_array_equal(filled, [[1.0, 4.0, NAN, 4.0]])


def test_nothing_known_stays_nothing():
    assert np.isnan(filled_from_behind(np.full((3, 4), NAN), np.zeros((3, 4), bool))).all()
