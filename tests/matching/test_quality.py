from __future__ import annotations

import numpy as np

from zlocus.matching.quality import EMPTY, Quality, flags_of, is_empty, is_water


def test_bits_are_distinct_and_fit_the_raster():
    values = [int(reason) for reason in Quality]
    assert len(set(values)) == len(values)
    assert all(value & (value - 1) == 0 and value < 2**16 for value in values)


def test_which_reasons_empty_a_cell():
    empties = {reason for reason in Quality if is_empty(np.array([reason], np.uint16))[0]}
    assert empties == {Quality.OUTSIDE, Quality.UNSEEN, Quality.OCCLUDED, Quality.RANGE_END, Quality.NO_MATCH,
                       Quality.FAILED, Quality.INCONSISTENT, Quality.IMPRECISE}  # fmt: skip
    filled = np.array([EMPTY | Quality.FILLED, Quality.WEAK, 0, EMPTY | Quality.WEAK], np.uint16)
    np.testing.assert_array_equal(is_empty(filled), [False, False, False, True])


def test_water_is_two_bits_that_no_other_cell_has():
    assert Quality.WATER == Quality.FILLED | Quality.PLANE
    assert Quality.WATER not in list(Quality)
    codes = np.array([Quality.WATER, Quality.WATER | Quality.UNSEEN, Quality.FILLED, Quality.PLANE, 0], np.uint16)
    np.testing.assert_array_equal(is_water(codes), [True, True, False, False, False])
    assert flags_of(int(Quality.WATER | Quality.UNSEEN)) == [Quality.UNSEEN, Quality.WATER]
    assert flags_of(int(Quality.FILLED | Quality.NO_MATCH)) == [Quality.NO_MATCH, Quality.FILLED]
    assert flags_of(0) == []
