"""The morphological filter on shapes whose ground is known."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.core.options import ProductOptions
from zlocus.products.smrf import between_blocks, block_mean, block_min, membrane, opened, outside_of, rises, terrain

OPTIONS = ProductOptions(ground_window_m=15.0)
CELL_M = 1.0
# The membrane over a gap of 20 cells of a tilted plane, after so many rounds.
MEMBRANE_M = 0.1
# Ground on one side only goes on level, here for 15 cells that rise by 0.08 each.
RIM_M = 1.3
ROUNDING_M = 1e-4


def tilted(rows=90, cols=110, east=0.08, south=-0.05):
    row, col = np.mgrid[:rows, :cols]
    return (100 + east * col + south * row).astype(np.float32)


def inside(z):
    return np.zeros(z.shape, bool)


def test_an_opening_by_hand():
    z = np.zeros((21, 21), np.float32)
    z[8:13, 8:13] = 3.0  # 5 x 5 cells
    # Radius 2 is a square of half side 1 grown by a diamond of 1: it fits, and leaves out the four corners.
    expected = z.copy()
    expected[[8, 8, 12, 12], [8, 12, 8, 12]] = 0
    np.testing.assert_array_equal(opened(z, inside(z), 2), expected)
    assert (opened(z, inside(z), 3) == 0).all()
    np.testing.assert_array_equal(opened(-z, inside(z), 2), -z)


def test_what_lies_at_the_rim_or_beside_nothing_is_no_wider_than_it_is():
    z = np.zeros((40, 40), np.float32)
    z[15:25, :6] = 9.0
    assert (opened(z, inside(z), 6) == 0).all()
    # A roof as deep beside nothing, where a membrane would go on at its height.
    nothing = inside(z)
    nothing[:, :12] = True
    other = np.zeros((40, 40), np.float32)
    other[5:35, :18] = 9.0
    assert (opened(other, nothing, 6)[~nothing] == 0).all()
    assert (opened(other, inside(z), 6)[5:35, 12:18] == 9).any()
    # A narrow strip of level ground between nothing stays level, whatever a membrane would have beside it.
    strip = np.where(nothing := np.abs(np.arange(40) - 20) > 2, -50, np.zeros((40, 40))).astype(np.float32)
    assert (opened(strip, np.tile(nothing, (40, 1)), 6)[:, 18:23] == 0).all()


def test_a_rise_is_found_by_the_first_window_wider_than_it():
    z = np.zeros((60, 60), np.float32)
    z[20:30, 20:41] = 2.0  # half as narrow as 10 cells
    # Windows of up to 9 cells only cut its corners.
    assert not rises(z, inside(z), CELL_M, 0.15, range(1, 5))[23:27, 23:38].any()
    np.testing.assert_array_equal(rises(z, inside(z), CELL_M, 0.15, range(1, 7)), z > 0)
    # 0.8 m is less than 0.15 x 6 m.
    assert not rises(0.4 * z, inside(z), CELL_M, 0.15, range(6, 7)).any()


def test_gaps_that_reach_the_rim_are_outside():
    z = np.zeros((9, 9), np.float32)
    z[:2, 3:] = z[5, 5] = z[7:, 0] = z[6, 1] = np.nan
    expected = np.isnan(z)
    # The second one touches a gap at the rim by a corner.
    expected[5, 5] = expected[6, 1] = False
    np.testing.assert_array_equal(outside_of(z), expected)
    for row in (np.zeros((1, 9), np.float32), np.full((3, 9), np.nan, np.float32)):
        np.testing.assert_array_equal(outside_of(row), np.isnan(row))


def test_buildings_trees_and_pits_on_tilted_ground():
    ground = tilted()
    z = ground.copy()
    z[20:40, 30:55] += 12
    row, col = np.mgrid[:90, :110]
    away = np.hypot(row - 65, col - 30)
    z += np.where(away <= 4, 8 - 0.3 * away**2, 0).astype(np.float32)
    z[50:70, 95:] += 8  # at the rim
    z[75, 60] -= 50
    found = terrain(z, CELL_M, OPTIONS)
    np.testing.assert_allclose(found, ground, atol=RIM_M)
    assert np.abs(found - ground)[:, :90].max() < MEMBRANE_M


def test_what_is_wider_than_the_window_is_ground():
    z = tilted()
    z[20:70, 20:80] += 10
    found = terrain(z, CELL_M, OPTIONS)
    assert (found[40:50, 40:60] == z[40:50, 40:60]).all()


def test_hills_as_steep_as_allowed_stay():
    row, col = np.mgrid[:80, :80]
    hill = (30 - 0.14 * np.hypot(row - 40, col - 40)).astype(np.float32)
    np.testing.assert_array_equal(terrain(hill, CELL_M, OPTIONS), hill)


def test_nothing_known():
    assert np.isnan(terrain(np.full((5, 7), np.nan, np.float32), CELL_M, OPTIONS)).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (37, 23), (64, 64)])
def test_a_membrane_keeps_what_is_known_and_stays_within_it(shape):
    rng = np.random.default_rng(3)
    z = rng.uniform(5, 6, shape).astype(np.float32)
    z[rng.random(shape) < 0.6] = np.nan
    z.flat[0] = 5.5
    filled = membrane(z)
    np.testing.assert_array_equal(filled[np.isfinite(z)], z[np.isfinite(z)])
    assert filled.min() >= 5 - ROUNDING_M
    assert filled.max() <= 6 + ROUNDING_M


def test_a_membrane_over_tilted_ground_is_tilted():
    z = tilted()
    gap = z.copy()
    gap[30:50, 40:60] = np.nan
    assert np.abs(membrane(gap) - z).max() < MEMBRANE_M


def test_blocks_by_hand():
    z = np.array([[1, 2, 9], [3, np.nan, np.nan], [np.nan, np.nan, 4]], np.float32)
    np.testing.assert_array_equal(block_mean(z, 2), [[2, 9], [np.nan, 4]])
    np.testing.assert_array_equal(block_min(z, 2), [[1, 9], [np.nan, 4]])


@pytest.mark.parametrize("side", [1, 2, 3, 5])
def test_between_blocks_lies_the_plane_they_are_means_of(side):
    z = tilted(11 * side, 7 * side)
    found = between_blocks(block_mean(z, side), side, 0, z.shape)
    np.testing.assert_allclose(found[side:-side, side:-side], z[side:-side, side:-side], atol=ROUNDING_M)
    np.testing.assert_array_equal(between_blocks(block_mean(z, side), side, 4, (3, z.shape[1])), found[4:7])
