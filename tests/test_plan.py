from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from zlocus.execution.plan import core_size, plan_tiles, tile_memory_bytes
from zlocus.matching.cells import CellWindow
from zlocus.options import PyramidOptions

OPTIONS = PyramidOptions(tile=64, halo=8)
SEEN = CellWindow(-100, 30, 300, 250)
WINDOWS = st.builds(CellWindow, *[st.integers(-300, 300)] * 2, *[st.integers(1, 300)] * 2)


@given(WINDOWS)
def test_tiles_hold_each_cell_asked_for_once(asked):
    count = np.zeros((asked.rows, asked.cols), int)
    for tile in plan_tiles(asked, SEEN, OPTIONS):
        assert tile.kept.within(asked) == tile.kept
        assert tile.kept.rows * tile.kept.cols > 0
        count[tile.kept.slices_in(asked)] += 1
    assert (count == 1).all()


@given(WINDOWS)
def test_cores_do_not_depend_on_the_area(asked):
    height, width = core_size(SEEN, OPTIONS)
    everything = {(t.core.row, t.core.col): t.core for t in plan_tiles(SEEN, SEEN, OPTIONS)}
    for tile in plan_tiles(asked, SEEN, OPTIONS):
        assert tile.kept.rows <= height
        assert tile.kept.cols <= width
        if tile.core.rows and tile.core.cols:
            assert tile.core == everything[tile.core.row, tile.core.col]


def test_tiles_are_equal_whole_blocks_row_by_row():
    tiles = plan_tiles(SEEN, SEEN, OPTIONS)
    assert core_size(SEEN, OPTIONS) == (64, 64)
    starts = [(-100 + 64 * i, 30 + 64 * j) for i in range(5) for j in range(4)]
    assert [(t.core.row, t.core.col) for t in tiles] == starts


@given(st.integers(1, 20000), st.integers(1, 20000), st.sampled_from([64, 512, 1024]))
def test_cores_are_about_as_large_as_asked(rows, cols, tile):
    options = PyramidOptions(tile=tile)
    seen = CellWindow(7, -3, rows, cols)
    for side, core in zip((rows, cols), core_size(seen, options), strict=True):
        assert core <= 1.5 * tile + options.block
        assert core >= min(side, tile * 2 / 3)
    assert sum(t.core.rows * t.core.cols for t in plan_tiles(seen, seen, options)) == rows * cols


def test_memory_grows_with_tiles_views_and_levels():
    def need(tile=1024, views=3, levels=4, seen=4000):
        scene = SimpleNamespace(views=[None] * views, levels=levels, n_steps=500, seen=CellWindow(0, 0, seen, seen))
        return tile_memory_bytes(scene, PyramidOptions(tile=tile))

    assert need(tile=512) < need() < need(tile=2048)
    assert need(views=2) < need() < need(views=8)
    assert need(levels=3) < need(levels=5)
    assert need(seen=100) < need(seen=500)
    assert 0.1e9 < need() < 2e9
