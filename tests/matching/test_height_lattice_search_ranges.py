"""Search ranges of blocks: towers stay inside, open ground needs few heights."""

from __future__ import annotations

import numpy as np

from zlocus.core.options import PyramidOptions
from zlocus.matching.height_lattice import (
    LANES,
    MAX_DIFFERENCE_OF_NEIGHBOURS_PX,
    search_lattice,
    shared_heights,
    without_spikes,
)

OPTIONS = PyramidOptions(block=16, margin_steps=6, neighbour_cells=2)


def nearby(low, high=None):
    low = np.asarray(low, np.float32)
    return search_lattice(low, low if high is None else high, 10.0, 0.5, OPTIONS)


def holds(lattice, block, low, high):
    first, count = lattice.first[block], lattice.count[block]
    return first <= low and high <= first + count - 1


def test_a_level_without_prior_searches_the_whole_range():
    lattice = nearby(np.zeros((37, 70)), np.full((37, 70), 49, np.float32))
    assert lattice.first.shape == (3, 5)
    assert (lattice.first == -6).all()
    assert (lattice.count == 64).all()
    assert (lattice.height_origin, lattice.height_step) == (10.0, 0.5)


def test_flat_ground_has_a_short_range_around_it():
    lattice = nearby(np.full((37, 70), 100.3))
    assert (lattice.count == 16).all()
    assert holds(lattice, (0, 0), 95, 106)


def test_a_tower_widens_its_block_and_those_within_reach():
    low = np.full((48, 80), 100.0, np.float32)
    high = low.copy()
    high[20:26, 14:19] = 210.0  # in the second and, by its neighbourhood, in the first and second column of blocks
    lattice = nearby(low, high)
    for block in ((1, 0), (1, 1)):
        assert holds(lattice, block, 94, 216)
    # Four fine cells further on, across the border of blocks, the tower still counts.
    assert holds(lattice, (0, 1), 94, 106)
    assert not holds(lattice, (1, 3), 94, 216)
    beside = low.copy()
    beside[20, 12] = 210.0
    assert holds(nearby(low, beside), (1, 1), 94, 216)
    beside[20, 12], beside[20, 11] = 100.0, 210.0
    assert not holds(nearby(low, beside), (1, 1), 94, 216)


def test_heights_below_the_slanted_support_surface_have_negative_indices():
    lattice = nearby(np.full((20, 20), -40.5), np.full((20, 20), -31.0, np.float32))
    assert (lattice.first == -47).all()
    assert holds(lattice, (0, 0), -47, -25)
    assert (lattice.count == 24).all()


def test_a_block_without_a_known_range_searches_the_smallest_number_of_heights():
    """Also at the border of the tile and beside blocks with a known range."""
    low = np.full((80, 80), np.nan, np.float32)
    low[:16, :16] = 120.0
    lattice = nearby(low)
    assert holds(lattice, (0, 0), 114, 126)
    assert (lattice.count[3:, 3:] == LANES).all()
    assert (lattice.count > 0).all()
    assert (lattice.first[3:, 3:] == 0).all()


def test_spikes_beside_unknown_cells_are_removed():
    """Unknown cells stay unknown, and neither keep a spike nor remove what lies beside them."""
    known = np.ones((12, 12), bool)
    known[:, 6:] = False
    low, high = np.full((12, 12), 40, np.float32), np.full((12, 12), 40, np.float32)
    high[2:5, 3:6], high[8, 5] = 90, 90
    found_low, found_high = without_spikes(low, high, known)
    assert np.isnan(found_high[~known]).all()
    assert np.isnan(found_low[~known]).all()
    expected = np.full((12, 6), 40.0)
    expected[2:5, 3:6] = 90
    np.testing.assert_array_equal(found_high[:, :6], expected)
    assert (found_low[:, :6] == 40).all()


def test_winner_takes_all_heights_count_where_neighbours_agree():
    """Three by three cells agree; a cell beside them, and cells that each find another height, do not. Whatever slope
    they stand on."""
    alike = round(MAX_DIFFERENCE_OF_NEIGHBOURS_PX / OPTIONS.max_shift_px)
    slope = 3 * alike * np.arange(24, dtype=np.float32) * np.ones((20, 1), np.float32)
    best = np.full((20, 24), 40, np.int32)
    lone = best.copy()
    lone[2:5, 3:6] = 90 + np.arange(3) * (alike // 2)
    lone[2:5, 6] = 90 + 3 * alike
    lone[10:18, 2:10] = 60 + 10 * np.random.default_rng(1).permutation(64).reshape(8, 8)
    lone[10:13, 14:17] = 90 + np.arange(3) * alike
    expected = best.copy()
    expected[2:5, 3:6] = lone[2:5, 3:6]
    for base in (np.zeros_like(slope), slope):
        steps = base.astype(np.int32)
        found = shared_heights(lone + steps, best + steps, base, OPTIONS)
        np.testing.assert_array_equal(found, expected + steps)
