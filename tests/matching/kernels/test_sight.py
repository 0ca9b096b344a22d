"""Hidden cells: a wall whose shadow of sight is known, and a slow twin on rough ground."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from zlocus.matching.kernels.sight import mark_hidden

SIDE, WALL_M = 40, 6.0


def hidden(surface, by_height, margin=0.0, first=(0, 0), shape=None, stride=1.0):
    shape = surface.shape if shape is None else shape
    out = np.ones(shape, np.bool_)
    direction = np.broadcast_to(np.asarray(by_height, np.float32), (*shape, 2)).copy()
    top = np.float32(np.nanmax(surface))
    mark_hidden(
        surface.astype(np.float32), np.array(first), direction, top, np.float32(margin), np.float32(stride), out
    )
    return out


def slow_twin(surface, by_height, margin):
    """Each ray in steps of one cell, up to above everything."""
    rows, cols = surface.shape
    out = np.zeros(surface.shape, bool)
    by_col, by_row = by_height
    speed = np.hypot(by_col, by_row)
    for r, c in np.ndindex(rows, cols):
        for k in range(1, 3 * max(rows, cols)):
            x, y, z = c + k * by_col / speed, r + k * by_row / speed, surface[r, c] + k / speed
            if z > surface.max() or not (0 <= y < rows - 1 and 0 <= x < cols - 1):
                break
            i, j, v, u = int(y), int(x), y - int(y), x - int(x)
            upper = surface[i, j] * (1 - u) + surface[i, j + 1] * u
            lower = surface[i + 1, j] * (1 - u) + surface[i + 1, j + 1] * u
            out[r, c] |= upper * (1 - v) + lower * v > z + margin
    return out


def test_a_wall_hides_as_many_cells_as_its_height_says():
    surface = np.zeros((SIDE, SIDE))
    surface[:, 20:24] = WALL_M
    # The ray of a sensor in the east moves 1.45 columns per metre: after 8.7 columns it is as high as the wall.
    is_hidden = hidden(surface, (1.45, 0.0))
    assert is_hidden[5, 12:20].all()
    assert not is_hidden[:, :12].any()
    assert not is_hidden[:, 20:].any()


def test_longer_steps_find_the_same_wall():
    surface = np.zeros((SIDE, SIDE))
    surface[:, 20:24] = WALL_M
    assert (hidden(surface, (1.5, 0.0), stride=2.0) == hidden(surface, (1.5, 0.0))).mean() > 0.95


def test_the_block_lies_within_a_larger_surface():
    surface = np.zeros((SIDE, SIDE))
    surface[:, 20:24] = WALL_M
    part = hidden(surface, (1.5, 0.0), first=(4, 8), shape=(10, 12))
    assert (part == hidden(surface, (1.5, 0.0))[4:14, 8:20]).all()


def test_a_sensor_straight_above_sees_everything_and_gaps_hide_nothing():
    surface = np.zeros((SIDE, SIDE))
    surface[:, 20:24] = WALL_M
    assert not hidden(surface, (0.0, 0.0)).any()
    surface[:, 20:24] = np.nan
    assert not hidden(surface, (1.5, 0.0)).any()


@given(st.integers(0, 2**16), st.integers(-200, 200), st.integers(-200, 200))
def test_slow_twin(seed, hundredths_by_col, hundredths_by_row):
    by_col, by_row = hundredths_by_col / 100, hundredths_by_row / 100
    if np.hypot(by_col, by_row) < 0.05:
        return
    surface = np.random.default_rng(seed).uniform(0.0, 4.0, (9, 11)).astype(np.float32)
    by_height = np.float32(by_col), np.float32(by_row)
    expected = slow_twin(surface.astype(float), tuple(map(float, by_height)), 0.25)
    assert (hidden(surface, by_height, 0.25) == expected).mean() > 0.98  # ties of rounding
