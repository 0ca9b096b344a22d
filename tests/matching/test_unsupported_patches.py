"""Patches that stand off their surroundings: which of them the costs support."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernel_scene import even_lattice
from zlocus.matching.prior_costs import add_costs_far_from_surface
from zlocus.matching.semiglobal import SemiGlobalHeights, winner_takes_all_heights
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.unsupported_patches import (
    MAX_GAIN,
    MIN_MEAN_OFF,
    heights_of_surroundings,
    joined_share,
    lacks_evidence,
)

BLOCK, SHAPE, N_HEIGHTS = 16, (128, 128), 120
GROUND = 60
STEP_CELLS = 1.8
PATCH = np.s_[50:62, 40:56]


def costs(height, depth):
    """A volume in which each cell costs 100, and `depth` (r, c) less at its height (r, c)."""
    lattice = even_lattice(N_HEIGHTS, SHAPE, BLOCK)
    dense = np.full((*SHAPE, N_HEIGHTS), 100.0)
    np.put_along_axis(dense, height[..., None].astype(int), 100.0 - depth[..., None], axis=2)
    volume = np.empty(lattice.size, np.uint8)
    for b in range(lattice.first.shape[0]):
        for d in range(lattice.first.shape[1]):
            rows, cols = slice(b * BLOCK, (b + 1) * BLOCK), slice(d * BLOCK, (d + 1) * BLOCK)
            for r in range(rows.start, rows.stop):
                start = lattice.layout.block_row_start[b, d] + (r - rows.start) * lattice.layout.row_length[b, d]
                start += lattice.layout.block_start[b, d]
                volume[start : start + BLOCK * N_HEIGHTS] = dense[r, cols].ravel()
    return volume, lattice


def surface_with(patch, height, base=GROUND):
    surface = np.full(SHAPE, base, np.float32)
    surface[patch] = height
    return surface


def replaced(surface, depth, level=0):
    """Where a surface stands off its surroundings without evidence, and what takes its place."""
    volume, lattice = costs(surface, np.broadcast_to(np.float32(depth), SHAPE))
    return heights_of_surroundings(volume, lattice, SlopeSurface.flat(SHAPE, BLOCK), surface, level, STEP_CELLS)


@pytest.mark.parametrize("height", [GROUND + 45, GROUND - 45])
def test_a_patch_with_little_evidence_takes_the_height_of_its_surroundings(height):
    found = replaced(surface_with(PATCH, height), depth=20)
    inside = np.zeros(SHAPE, bool)
    inside[PATCH] = True
    np.testing.assert_array_equal(np.isfinite(found), inside)
    assert (found[inside] == GROUND).all()


@pytest.mark.parametrize("height", [GROUND + 45, GROUND - 45])
def test_a_patch_with_much_evidence_stays(height):
    assert np.isnan(replaced(surface_with(PATCH, height), depth=90)).all()


def test_low_patches_need_no_more_evidence_than_any_cell():
    assert np.isnan(replaced(surface_with(PATCH, GROUND + MIN_MEAN_OFF / STEP_CELLS - 1), depth=0)).all()


def test_streets_between_tall_roofs_are_no_pits():
    """Roofs stand close together on ground that is seen between them, and around them."""
    surface = np.full(SHAPE, GROUND, np.float32)
    for row in range(30, 90, 24):
        for col in range(30, 90, 24):
            surface[row : row + 16, col : col + 16] = GROUND + 30
    depth = np.where(surface == GROUND, 5, 90)
    volume, lattice = costs(surface, depth)
    assert np.isnan(
        heights_of_surroundings(volume, lattice, SlopeSurface.flat(SHAPE, BLOCK), surface, 0, STEP_CELLS)
    ).all()


def test_trees_seen_with_a_wide_base_are_no_patches():
    """Twice as many steps for the same height: what stands off is measured in sides of a cell."""
    surface = surface_with(PATCH, GROUND + 36)
    volume, lattice = costs(surface, np.full(SHAPE, 20.0))
    base = SlopeSurface.flat(SHAPE, BLOCK)
    assert np.isfinite(heights_of_surroundings(volume, lattice, base, surface, 0, STEP_CELLS)).any()
    assert np.isnan(heights_of_surroundings(volume, lattice, base, surface, 0, STEP_CELLS / 2)).all()


def test_the_corner_of_a_plain_roof_is_no_patch():
    """The window of the surroundings does not fit into the corners of a roof that lies across the grid."""
    row, col = np.indices(SHAPE)
    is_roof = np.abs(row - 64) + np.abs(col - 64) < 50
    surface = np.where(is_roof, GROUND + 30, GROUND).astype(np.float32)
    assert np.isnan(replaced(surface, depth=5)).all()


def test_a_patch_beside_a_roof_of_another_height_is_one():
    surface = np.full(SHAPE, GROUND, np.float32)
    surface[60:, 30:100] = GROUND + 20
    surface[48:60, 50:62] = GROUND + 50
    assert np.isfinite(replaced(surface, depth=5)[48:60, 50:62]).all()


def test_share_of_the_border_over_which_the_surface_goes_on():
    """A patch of 4 x 6 cells at height 40, beside 40 + 4.9 on one long side and 40 - 5.1 on the other sides."""
    labels, height = np.zeros((20, 20), np.int32), np.full((20, 20), 40 - 5.1, np.float32)
    labels[8:12, 6:12], height[8:12, 6:12] = 1, 40
    height[7, 6:12] = 40 + 4.9
    np.testing.assert_allclose(joined_share(labels, height, 2), [0, 6 / 20])
    labels[0, 0] = 2
    np.testing.assert_allclose(joined_share(labels, height, 3), [0, 6 / 20, 1])


def test_a_slope_is_no_patch():
    rows = np.arange(SHAPE[0])[:, None] * np.ones(SHAPE)
    surface = (10 + 0.6 * rows).astype(np.float32)
    assert np.isnan(replaced(np.rint(surface), depth=0)).all()


@settings(max_examples=30, deadline=None)
@given(st.floats(37, 200), st.floats(0, 60), st.integers(2, 20))
def test_more_evidence_or_more_cells_never_remove_a_patch(off, gain, side):
    def lacks(with_gain, cells):
        away = np.zeros((40, 40), np.float32)
        away[5 : 5 + cells, 5 : 5 + cells] = off
        return bool(lacks_evidence(away, np.full((40, 40), with_gain, np.float32), away).any())

    assert lacks(gain, side) or not (lacks(gain + 5, side) or lacks(gain, side + 3))
    assert not lacks(MAX_GAIN * 10.1, 1)


def test_heights_off_the_surroundings_cost_more_where_a_patch_is_replaced():
    surface = surface_with(PATCH, GROUND + 45)
    volume, lattice = costs(surface, np.full(SHAPE, 20.0))
    before = winner_takes_all_heights(volume, lattice)
    heights = SemiGlobalHeights(before.best, before.second, before.uniqueness, surface)
    add_costs_far_from_surface(volume, lattice, SlopeSurface.flat(SHAPE, BLOCK), heights, 0, STEP_CELLS)
    after = winner_takes_all_heights(volume, lattice).best
    assert (before.best[PATCH] == GROUND + 45).all()
    assert (np.abs(after[PATCH] - GROUND) <= 12).all()
    after[PATCH] = GROUND
    assert (after == GROUND).all()
