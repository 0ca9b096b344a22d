from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from zlocus.core.grid import CellWindow, on_cells

SIDES = st.integers(0, 60)
STARTS = st.integers(-100, 100)
WINDOWS = st.builds(CellWindow, STARTS, STARTS, SIDES, SIDES)


def cells(window):
    return {(r, c) for r in range(window.row, window.row + window.rows)
            for c in range(window.col, window.col + window.cols)}  # fmt: skip


@given(WINDOWS, WINDOWS)
def test_the_part_inside_another_window_and_its_place_in_an_array(one, other):
    shared = one.within(other)
    assert cells(shared) == cells(one) & cells(other)
    names = np.array([[(r, c) for c in range(other.cols)] for r in range(other.rows)]).reshape(
        other.rows, other.cols, 2
    )
    for row, col in names[shared.slices_in(other)].reshape(-1, 2):
        assert (row + other.row, col + other.col) in cells(shared)
    if shared.rows and shared.cols:
        assert names[shared.slices_in(other)].shape[:2] == (shared.rows, shared.cols)


@given(WINDOWS.filter(lambda w: w.rows and w.cols), st.integers(0, 4), st.integers(0, 5))
def test_a_coarser_level_covers_the_same_ground(window, level, halo):
    size = 2**level
    coarse = window.at_level(level, halo)
    bare = window.at_level(level, 0)
    assert {(r // size, c // size) for r, c in cells(window)} <= cells(bare)
    assert bare.row * size > window.row - size
    assert (bare.row + bare.rows) * size < window.row + window.rows + size
    assert coarse == CellWindow(bare.row - halo, bare.col - halo, bare.rows + 2 * halo, bare.cols + 2 * halo)


@given(WINDOWS, WINDOWS)
def test_the_smallest_window_that_contains_two(one, other):
    both = one.around(other)
    assert cells(one) | cells(other) <= cells(both)
    assert one.meets(other) == bool(cells(one) & cells(other)) == other.meets(one)


@given(WINDOWS.filter(lambda w: w.rows and w.cols), st.integers(0, 3))
def test_a_coarse_cell_has_its_value_on_all_finer_ones(window, levels):
    values = np.arange(window.rows * window.cols, dtype=np.float32).reshape(window.rows, window.cols)
    finer = window.finer(levels)
    np.testing.assert_array_equal(
        on_cells(values, window, finer, levels), values.repeat(2**levels, axis=0).repeat(2**levels, axis=1)
    )
    beside = CellWindow(finer.row - 3, finer.col, 2, finer.cols)
    np.testing.assert_array_equal(on_cells(values, window, beside, levels), values[[0, 0]].repeat(2**levels, axis=1))
