from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orientation_scenes import hill_scene
from zlocus.core.grid import CellWindow
from zlocus.core.height_range import HeightRange
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.io.decoded_images import DECODED, DECODED_BYTES
from zlocus.matching.match_scene import build_match_scene
from zlocus.matching.view_pixels import PYRAMID_BYTES, PYRAMIDS
from zlocus.pipeline.execution.plan import (
    CELL_S,
    VIEW_CELL_S,
    TileNeeds,
    core_size,
    keep_at_most,
    kept_bytes,
    plan_tiles,
    tile_needs,
)
from zlocus.sensors.correction import ShiftedModel

OPTIONS = PyramidOptions(tile=64, halo=8)
SEEN = CellWindow(-100, 30, 300, 250)
WINDOWS = st.builds(CellWindow, *[st.integers(-300, 300)] * 2, *[st.integers(1, 300)] * 2)


@given(WINDOWS)
def test_tiles_hold_each_cell_asked_for_once(asked):
    count = np.zeros((asked.rows, asked.cols), int)
    for tile in plan_tiles(asked, SEEN, OPTIONS):
        assert tile.kept_window.within(asked) == tile.kept_window
        assert tile.kept_window.rows * tile.kept_window.cols > 0
        count[tile.kept_window.slices_in(asked)] += 1
    assert (count == 1).all()


@given(WINDOWS)
def test_cores_do_not_depend_on_the_area(asked):
    height, width = core_size(SEEN, OPTIONS)
    everything = {(t.core_window.row, t.core_window.col): t.core_window for t in plan_tiles(SEEN, SEEN, OPTIONS)}
    for tile in plan_tiles(asked, SEEN, OPTIONS):
        assert tile.kept_window.rows <= height
        assert tile.kept_window.cols <= width
        if tile.core_window.rows and tile.core_window.cols:
            assert tile.core_window == everything[tile.core_window.row, tile.core_window.col]


def test_tiles_are_equal_whole_blocks_row_by_row():
    tiles = plan_tiles(SEEN, SEEN, OPTIONS)
    assert core_size(SEEN, OPTIONS) == (64, 64)
    starts = [(-100 + 64 * i, 30 + 64 * j) for i in range(5) for j in range(4)]
    assert [(t.core_window.row, t.core_window.col) for t in tiles] == starts


@given(st.integers(1, 20000), st.integers(1, 20000), st.sampled_from([64, 512, 1024]))
def test_cores_are_about_as_large_as_asked(rows, cols, tile):
    options = PyramidOptions(tile=tile)
    seen = CellWindow(7, -3, rows, cols)
    for side, core in zip((rows, cols), core_size(seen, options), strict=True):
        assert core <= 1.5 * tile + options.block
        assert core >= min(side, tile * 2 / 3)
    assert sum(t.core_window.rows * t.core_window.cols for t in plan_tiles(seen, seen, options)) == rows * cols


@cache
def scene_of(n_views, size=280, cell_m=0.5, z=(90.0, 130.0)):
    """Images of the same ground, looking elsewhere, and one of ground far away."""
    looks = [(0.05 * k, 0.0) for k in range(n_views - 1)]
    scene = hill_scene([(0.0, 0.0)] * (n_views - 1), looks, size, [0.0] * (n_views - 1))
    away = replace(scene.views[0], name="away", sensor=ShiftedModel(scene.views[0].sensor, 9000.0, 0.0))
    return build_match_scene(
        replace(scene, views=(*scene.views, away)),
        cell_m,
        (0.0, 0.0),
        HeightRange.limited_to(z),
        np.empty((0, 3)),
        "view0",
        PyramidOptions(),
    )


def needs_of(scene, tile=1024, candidates=12):
    config = RunConfig(
        pyramid=PyramidOptions(tile=tile), selection=replace(RunConfig().selection, max_candidates=candidates)
    )
    return tile_needs(scene, plan_tiles(scene.overlap_window, scene.overlap_window, config.pyramid), config)


def test_memory_is_that_of_cells_heights_and_the_views_of_a_tile():
    plain = needs_of(scene_of(4)).n_bytes
    assert needs_of(scene_of(4), tile=64).n_bytes < plain < needs_of(scene_of(4, size=500)).n_bytes
    assert needs_of(scene_of(3)).n_bytes < plain < needs_of(scene_of(6)).n_bytes
    assert needs_of(scene_of(4, z=(109.0, 111.0))).n_bytes < plain
    # Images of other ground are none of its views, and of many of the same only some are compared.
    assert needs_of(scene_of(4), candidates=2).n_bytes == plain
    assert needs_of(scene_of(6), candidates=2).n_bytes < 0.9 * needs_of(scene_of(6)).n_bytes
    # Coarse cells hold many pixels.
    fine, coarse = scene_of(4), scene_of(4, cell_m=3.0)
    per_cell = [
        needs_of(scene).n_bytes / (scene.overlap_window.rows * scene.overlap_window.cols) for scene in (fine, coarse)
    ]
    assert per_cell[1] > 2 * per_cell[0]


def test_time_is_that_of_cells_and_views():
    plain = needs_of(scene_of(4))
    cells = scene_of(4).overlap_window.rows * scene_of(4).overlap_window.cols
    # At their borders views show less than the tile.
    assert cells * (CELL_S + 2.5 * VIEW_CELL_S) < plain.seconds <= cells * (CELL_S + 3 * VIEW_CELL_S)
    assert needs_of(scene_of(4), tile=64).seconds == pytest.approx(plain.seconds, rel=0.05)
    assert needs_of(scene_of(6)).seconds > 1.3 * plain.seconds


def test_images_that_are_kept_take_no_more_than_is_allowed():
    scene = scene_of(4)
    n_pixels = 4 * 280**2
    assert kept_bytes(scene) == int(n_pixels * 5 / 16 * 4 / 3)
    jpegs = [SimpleNamespace(shape=(3000, 4000), decoded_bytes=36_000_000) for _ in scene.views]
    drone = replace(scene, views=tuple(replace(v, image=jpeg) for v, jpeg in zip(scene.views, jpegs, strict=True)))
    assert kept_bytes(drone) == 4 * 36_000_000 + int(4 * 12e6 * 5 / 16 * 4 / 3)
    large = [SimpleNamespace(shape=(30000, 40000), decoded_bytes=3_600_000_000) for _ in scene.views]
    large = replace(scene, views=tuple(replace(v, image=one) for v, one in zip(scene.views, large, strict=True)))
    assert kept_bytes(large) == DECODED_BYTES + PYRAMID_BYTES
    try:
        for n_bytes in (0, 1_000_000, 10**12):
            keep_at_most(n_bytes)
            assert DECODED.n_bytes + PYRAMIDS.n_bytes == min(n_bytes, DECODED_BYTES + PYRAMID_BYTES)
        # Where all that is needed may be kept, all of it fits.
        for one in (scene, drone):
            keep_at_most(kept_bytes(one), one.views)
            decoded = sum(getattr(view.image, "decoded_bytes", 0) for view in one.views)
            assert (DECODED.n_bytes, PYRAMIDS.n_bytes) == (decoded, kept_bytes(one) - decoded)
    finally:
        keep_at_most()
    assert (DECODED.n_bytes, PYRAMIDS.n_bytes) == (DECODED_BYTES, PYRAMID_BYTES)


def test_needs_of_no_tile():
    assert tile_needs(scene_of(3), [], RunConfig()) == TileNeeds(0, 0.0)
