"""Where the surface is broken in the view in three dimensions."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.inspector.folder import Patch
from zlocus.inspector.relief import MAX_SLOPE, TO_BELOW, TO_RIGHT, breaks_of, jump_m, relief_of
from zlocus.inspector.server import page_files
from zlocus.matching.height_checks import MAX_DIFFERENCE_WITHOUT_JUMP_STEPS

JUMP_M = 2.0


def test_it_is_broken_along_the_edges_of_a_block_only():
    heights = np.full((6, 7), 10.0, np.float32)
    heights[2:4, 3:5] = 15.0
    breaks = breaks_of(heights, (0.5, 0.5), JUMP_M)
    right, below = (breaks & TO_RIGHT) > 0, (breaks & TO_BELOW) > 0
    assert sorted(zip(*np.nonzero(right), strict=True)) == [(2, 2), (2, 4), (3, 2), (3, 4)]
    assert sorted(zip(*np.nonzero(below), strict=True)) == [(1, 3), (1, 4), (3, 3), (3, 4)]


def test_the_page_reads_the_same_bits():
    script = page_files()["js/relief.js"][0].decode()
    assert f"const TO_RIGHT = {TO_RIGHT}, TO_BELOW = {TO_BELOW};" in script
    assert (TO_RIGHT, TO_BELOW) == (1, 2)


def test_slopes_and_small_steps_are_whole_and_holes_break_nothing():
    steep = np.arange(8, dtype=np.float32)[None] * np.ones((4, 1), np.float32) * 0.99 * JUMP_M
    assert not breaks_of(steep, (0.5, 0.5), JUMP_M).any()
    steep[:, 4] += 0.1 * JUMP_M
    assert (breaks_of(steep, (0.5, 0.5), JUMP_M)[:, 3] == TO_RIGHT).all()
    steep[:, 4] = np.nan
    assert not breaks_of(steep, (0.5, 0.5), JUMP_M).any()


def test_places_far_apart_may_differ_more():
    far_m = 20.0
    heights = np.array([[0.0, 0.9 * MAX_SLOPE * far_m, 2.1 * MAX_SLOPE * far_m]], np.float32)
    assert breaks_of(heights, (far_m, far_m), JUMP_M).tolist() == [[0, TO_RIGHT, 0]]


def test_a_jump_is_that_of_the_flag(block):
    folder, scene = block
    step_m = scene.run.match_scene.height_step
    assert jump_m(folder) == pytest.approx(MAX_DIFFERENCE_WITHOUT_JUMP_STEPS * step_m)
    rows, cols = folder.shape
    relief = relief_of(folder, Patch(0, 0, rows, cols, rows, cols))
    content = relief.content
    assert len(content) == 5 * rows * cols
    np.testing.assert_array_equal(np.frombuffer(content, "<f4", rows * cols).reshape(rows, cols), relief.heights)
    # The wall of the block runs through the middle, from north to south.
    middle = rows // 2
    assert (relief.breaks[middle] & TO_RIGHT).any()
