"""Possible water: areas without agreement whose rim is flat and lies lowest."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.core.options import WaterOptions
from zlocus.matching.possible_water import WaterBlocks, possible_water
from zlocus.matching.quality import Quality

ROWS, COLS, CELL_M = 180, 240, 0.5
LAKE = np.s_[60:130, 80:170]
OPTIONS = WaterOptions()
# Blocks and windows round an outline off by less than this, in cells.
OUTLINE_CELLS = 6
SLOPE = 0.045


@pytest.fixture
def plain():
    """Flat ground at 100 m with a lake whose heights are noise."""
    rng = np.random.default_rng(8)
    height = (100.0 + 0.02 * rng.standard_normal((ROWS, COLS))).astype(np.float32)
    quality = np.zeros((ROWS, COLS), np.uint16)
    height[LAKE] += rng.normal(0.5, 2.0, height[LAKE].shape).astype(np.float32)
    quality[LAKE] = Quality.WEAK | Quality.DISPUTED
    return height, quality


def areas(height, quality, side=2, options=OPTIONS, rows=60, known=None, grey=None):
    blocks = WaterBlocks.empty((ROWS, COLS), side)
    known = np.zeros((ROWS, COLS), bool) if known is None else known
    grey = np.full((ROWS, COLS), 500, np.uint16) + np.arange(COLS, dtype=np.uint16) if grey is None else grey
    for row in range(0, ROWS, rows):
        part = slice(row, row + rows)
        blocks.add(row, height[part], quality[part], grey[part], known[part])
    found = np.zeros((ROWS, COLS), bool)
    for area in possible_water(blocks, CELL_M, options):
        cells = np.kron(area.is_water, np.ones((side, side), bool))
        row, col = area.row * side, area.col * side
        found[row : row + cells.shape[0], col : col + cells.shape[1]] |= cells[: ROWS - row, : COLS - col]
    return found


@pytest.mark.parametrize("side", [1, 2, 3])
def test_a_lake_is_found_and_nothing_else(plain, side):
    found = areas(*plain, side)
    rows, cols = (slice(s.start + OUTLINE_CELLS, s.stop - OUTLINE_CELLS) for s in LAKE)
    inner, outer = np.zeros_like(found), np.zeros_like(found)
    inner[rows, cols] = True
    rows, cols = (slice(s.start - OUTLINE_CELLS, s.stop + OUTLINE_CELLS) for s in LAKE)
    outer[rows, cols] = True
    assert found[inner].mean() > 0.98
    assert not found[~outer].any()


def test_strips_change_nothing(plain):
    np.testing.assert_array_equal(areas(*plain, rows=60), areas(*plain, rows=20))


def test_cells_without_agreement_count_like_weak_ones(plain):
    height, quality = plain
    height[LAKE], quality[LAKE] = np.nan, Quality.NO_MATCH
    assert areas(height, quality)[LAKE].mean() > 0.6


def roof(height, quality):
    """It stands above the ground beyond its own edge, which is matched."""
    height[52:138, 72:178] = 110.0


def raised(height, quality):
    """All of it stands above its rim."""
    height[LAKE] = 104.0


def slope(height, quality):
    height += (0.1 * CELL_M * np.arange(COLS)).astype(np.float32)


def gentle_slope(height, quality):
    """Little lies lower than the rim, whose lowest quarter is not flat."""
    rows, cols = np.indices(height.shape)
    height += (SLOPE * CELL_M * (rows + cols)).astype(np.float32)


def forest(height, quality):
    """Half of the cells agree."""
    quality[LAKE][::2] = 0


def unseen(height, quality):
    quality[LAKE] |= np.uint16(Quality.UNSEEN)


def lonely(height, quality):
    """Nothing around it is known."""
    height[:], quality[:] = np.nan, Quality.NO_MATCH


@pytest.mark.parametrize("change", [roof, raised, slope, gentle_slope, forest, unseen, lonely])
def test_no_water(plain, change):
    assert areas(*plain).any()
    change(*plain)
    assert not areas(*plain).any()


def test_small_areas_and_known_water_are_left_out(plain):
    options = WaterOptions(min_area_m2=2000.0)  # the lake has 1575 m2
    assert not areas(*plain, options=options).any()
    known = np.zeros((ROWS, COLS), bool)
    known[LAKE] = True
    assert not areas(*plain, known=known).any()


def test_a_lake_across_the_border_of_the_grid(plain):
    height, quality = plain
    assert areas(np.roll(height, -110, axis=1), np.roll(quality, -110, axis=1))[60:130, :40].mean() > 0.6


def test_what_saturates_the_sensor_is_no_water(plain):
    """As bright as the brightest tenth of the rest, also where that saturates it too; glitter is dark on average."""
    rng = np.random.default_rng(2)
    grey = rng.integers(300, 700, (ROWS, COLS)).astype(np.uint16)
    dark = grey.copy()
    dark[LAKE] = np.where(rng.random(dark[LAKE].shape) < 0.05, 4095, 200)
    assert areas(*plain, grey=dark).any()
    white = grey.copy()
    white[LAKE] = 4095
    assert not areas(*plain, grey=white).any()
    white[:, -40:] = 4095
    assert not areas(*plain, grey=white).any()
