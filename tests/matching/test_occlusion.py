"""Which view sees which height of a cell, through real projection tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine

from rendered_scenes import CENTRE
from zlocus.matching import occlusion
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.shared_records import NEVER_COVERED, NEVER_OCCLUDED, VisibleHeights
from zlocus.matching.occlusion import (
    EDGE_PX,
    covered_heights,
    covers,
    exclude_views_of_one_direction,
    in_level_indices,
    keep_enough_views,
    mark_occlusions,
    sees,
    usual_number,
)
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.view_directions import cells_per_step, parts_of_one_direction
from zlocus.matching.view_pixels import ViewPixels
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.cameras import SatelliteCamera

CELL_M, STEP_M, BLOCK, SHAPE = 0.5, 0.5, 16, (30, 50)
ORIGIN_M, N_STEPS = 40.0, 64
LEVEL, FLAT = np.zeros(SHAPE, np.float32), SlopeSurface.flat(SHAPE, BLOCK)


def sensor(along=0.0, across=0.0):
    return SatelliteCamera((*CENTRE, 50.0), (60.0, 50.0), 0.5, along, across)


def tile(sensors, valid=None):
    """A tile around the scene's centre and its lattice of heights."""
    transform = Affine(CELL_M, 0, CENTRE[0] - 12.5, 0, -CELL_M, CENTRE[1] + 7.5)
    pixels = np.zeros((101, 121), np.float32)
    mask = np.ones((101, 121), bool) if valid is None else valid
    windows = [ViewPixels(s, (0, 0), pixels, mask) for s in sensors]
    blocks = (-(-SHAPE[0] // BLOCK), -(-SHAPE[1] // BLOCK))
    lattice = HeightLattice(
        ORIGIN_M, STEP_M, SHAPE, BLOCK, np.zeros(blocks, np.int64), np.full(blocks, N_STEPS, np.int64)
    )
    z = (ORIGIN_M, ORIGIN_M + N_STEPS * STEP_M)
    return tile_views(windows, TileGrid(0, transform, SHAPE, BLOCK, ORIGIN_M, STEP_M), z, 2), lattice, transform


def test_cells_that_views_of_one_direction_show_alone_are_covered_by_none():
    """Two views from one point of the orbit, and a third one that shows the western part only."""
    views, lattice, _ = tile([sensor(), sensor(0.05), sensor(12)])
    visible = covered_heights(views, FLAT, lattice)
    visible.lowest_covered[2, :, 20:], visible.highest_covered[2, :, 20:] = NEVER_COVERED, NEVER_OCCLUDED
    exclude_views_of_one_direction(visible, views, CELL_M / STEP_M)
    covered = covers(visible)
    assert covered[:, :, :20].all()
    assert not covered[:, :, 20:].any()


def test_narrow_pairs_that_tell_heights_stay():
    views, lattice, _ = tile([sensor(), sensor(1.0)])
    visible = covered_heights(views, FLAT, lattice)
    exclude_views_of_one_direction(visible, views, CELL_M / STEP_M)
    assert covers(visible).all()


def test_all_is_covered_well_inside_the_image():
    views, lattice, _ = tile([sensor(), sensor(10, 5)])
    visible = covered_heights(views, FLAT, lattice)
    assert (visible.lowest_covered == 0).all()
    assert (visible.highest_covered == N_STEPS - 1).all()


def test_heights_at_which_a_cell_leaves_the_image():
    """A view 60 degrees off nadir: high ground falls off the image's edge."""
    camera = sensor(along=60.0)
    views, lattice, transform = tile([sensor(), camera])
    visible = covered_heights(views, FLAT, lattice)
    for r, c in ((0, 0), (15, 30), (29, 49)):
        x, y = transform * (c + 0.5, r + 0.5)
        z = ORIGIN_M + STEP_M * np.arange(N_STEPS)
        xy = camera.image_from_ground(np.column_stack([np.full(N_STEPS, x), np.full(N_STEPS, y), z]))
        inside = ((xy >= EDGE_PX) & (xy <= np.array([120, 100]) - EDGE_PX)).all(axis=1)
        assert 0 < inside.sum() < N_STEPS
        first, last = np.flatnonzero(inside)[[0, -1]]
        assert abs(visible.lowest_covered[1, r, c] - first) <= 1
        assert abs(visible.highest_covered[1, r, c] - last) <= 1


def rough_slope(up):
    """Level at the corners of blocks, so that nodes stay, and up to `up` steps from there between them, anywhere."""
    blocks = [-(-n // BLOCK) for n in SHAPE]
    corners = np.random.default_rng(6).uniform(-up, up, [4 * n + 1 for n in blocks])
    corners[::4, ::4] = 0.0
    return SlopeSurface(corners, BLOCK // 4, SHAPE, BLOCK)


def test_a_bound_that_the_image_cuts_is_counted_from_the_relief():
    """A view 60 degrees off nadir covers a cell to the same height in metres, whatever the support surface under it."""
    base = rough_slope(9.0)
    relief = base.relief
    views, lattice, _ = tile([sensor(), sensor(along=60.0)])
    level, rough = covered_heights(views, FLAT, lattice), covered_heights(views, base, lattice)
    assert (level.lowest_covered[1] > 0).any()
    assert (level.highest_covered[1] < N_STEPS - 1).any()
    for r, c in np.ndindex(SHAPE):
        low, high = level.lowest_covered[1, r, c], level.highest_covered[1, r, c]
        covered = [k for k in range(-20, N_STEPS + 20) if low <= k + relief[r, c] <= high]
        if low > 0:
            assert rough.lowest_covered[1, r, c] == covered[0]
        if high < N_STEPS - 1:
            assert rough.highest_covered[1, r, c] == covered[-1]


def test_a_bound_that_the_image_does_not_cut_stays():
    views, lattice, _ = tile([sensor(), sensor(across=60.0)])
    level, rough = covered_heights(views, FLAT, lattice), covered_heights(views, rough_slope(9.0), lattice)
    for found, expected in zip(rough, level, strict=True):
        np.testing.assert_array_equal(found[0], expected[0])
    for bound, end in ((0, 0), (1, N_STEPS - 1)):
        uncut = level[bound][1] == end
        assert uncut.any()
        assert (rough[bound][1][uncut] == end).all()


def test_a_short_run_that_the_relief_moves_away_from_itself_is_kept():
    """Where an image covers fewer heights than the relief is deep, both bounds still move alike."""
    valid = np.zeros((101, 121), bool)
    valid[:, 56:67] = True
    base = rough_slope(20.0)
    views, lattice, _ = tile([sensor(across=40.0)], valid)
    level, rough = covered_heights(views, FLAT, lattice), covered_heights(views, base, lattice)
    cut = (level.lowest_covered[0] > 0) & (level.highest_covered[0] < N_STEPS - 1) & covers(level)[0]
    run = (level.highest_covered - level.lowest_covered)[0]
    short = cut & (np.abs(base.relief) > run + 1)
    assert short.sum() > 50
    for r, c in np.argwhere(short):
        whole = (
            np.ceil(level.lowest_covered[0, r, c] - base.relief[r, c]),
            np.floor(level.highest_covered[0, r, c] - base.relief[r, c]),
        )
        assert (rough.lowest_covered[0, r, c], rough.highest_covered[0, r, c]) == whole
    never = ~covers(level)[0]
    assert never.sum() > 50
    for found, expected in zip(rough, level, strict=True):
        np.testing.assert_array_equal(found[0, never], expected[0, never])


def test_the_usual_number_of_views_is_that_of_some_cells():
    covered = np.zeros((3, 2, 4), np.int32)
    covered[2, :, :2] = 5
    visible = VisibleHeights(covered, np.full((3, 2, 4), 4, np.int32), np.zeros((3, 2, 4), np.float32))
    assert usual_number(visible, np.s_[:, :2]) == 2
    assert usual_number(visible, np.arange(8).reshape(2, 4) > 5) == 3


def test_windows_do_not_touch_nodata():
    valid = np.ones((101, 121), bool)
    valid[50, 60] = False
    views, lattice, transform = tile([sensor(), sensor(5)], valid)
    lost = covered_heights(views, FLAT, lattice).highest_covered[0] < 0
    col, row = ~transform * CENTRE
    r, c = np.nonzero(lost)
    assert 64 <= lost.sum() <= 81
    assert np.abs(r + 0.5 - row).max() <= 4.6
    assert np.abs(c + 0.5 - col).max() <= 4.6


@pytest.mark.parametrize(("along", "across"), [(20.0, 0.0), (0.0, -15.0), (-10.0, 12.0)])
def test_how_far_a_fixed_pixel_moves_per_step(along, across):
    camera = sensor(along, across)
    views, _, _ = tile([camera])
    low, high = camera.ground_from_image(np.array([[60.0, 50.0]] * 2), np.array([50.0, 51.0]))
    east, north = (high - low)[:2] * STEP_M / CELL_M
    np.testing.assert_allclose(cells_per_step(views, 0), (east, -north), rtol=0, atol=1e-3)


def test_a_tower_occludes_the_ground_behind_it():
    """10 m high; a view that leans 45 degrees from the east does not see 10 m of ground to the west of it."""
    views, lattice, _ = tile([sensor(), sensor(across=-45.0)])
    visible = covered_heights(views, FLAT, lattice)
    surface = np.full(SHAPE, 10.0, np.float32)
    surface[:, 35:40] = 30.0
    mark_occlusions(visible, views, surface, LEVEL, 0.0)
    assert (visible.lowest_covered == 0).all()
    sees_ground = sees(visible, np.full((2, *SHAPE), 10.0))
    assert sees_ground[0].all()
    hidden = np.flatnonzero(~sees_ground[1, 15])
    # 20 steps of 0.5 m, a metre of shadow a metre of height; the cells of the tower count as occluded at its foot.
    assert hidden.min() in (15, 16)
    assert (np.diff(hidden) == 1).all()
    assert hidden.max() in (38, 39)
    shown = covered_heights(views, FLAT, lattice)
    mark_occlusions(shown, views, surface, LEVEL, 100.0)
    assert (shown.lowest_unoccluded < 0).all()


@pytest.mark.parametrize("across", [-45.0, 30.0])
def test_occlusions_of_parts_are_those_of_the_whole_tile(across, monkeypatch):
    views, lattice, _ = tile([sensor(), sensor(35.0, across)])
    surface = (10 + 20 * np.random.default_rng(2).random(SHAPE)).astype(np.float32)
    whole, parts = covered_heights(views, FLAT, lattice), covered_heights(views, FLAT, lattice)
    mark_occlusions(whole, views, surface, LEVEL, 0.0)
    quarters = [(rows, cols) for rows in (slice(0, 16), slice(16, 32)) for cols in (slice(0, 32), slice(32, 64))]
    monkeypatch.setattr(occlusion, "parts_of_one_direction", lambda tile_views, view: quarters)
    monkeypatch.setattr(occlusion, "cells_per_step", lambda tile_views, view, part=None: cells_per_step(views, view))
    mark_occlusions(parts, views, surface, LEVEL, 0.0)
    assert (whole.lowest_unoccluded[1] > 0).mean() > 0.5
    for height in range(N_STEPS):
        at = np.full((2, *SHAPE), float(height))
        np.testing.assert_array_equal(sees(parts, at), sees(whole, at))


@pytest.mark.parametrize("beside", [(20.0, 0.0), (-25.0, 18.0), (0.0, -30.0)])
def test_blocks_that_a_view_does_not_show_are_left_out(beside):
    """They are found without losing any cell that the view covers."""
    aside = SatelliteCamera((CENTRE[0] + beside[0], CENTRE[1] + beside[1], 50.0), (60.0, 50.0), 0.5, 50.0, 0.0)
    views, lattice, _ = tile([sensor(), aside])
    everywhere = replace(views, is_projected=np.ones_like(views.is_projected))
    found, expected = covered_heights(views, FLAT, lattice), covered_heights(everywhere, FLAT, lattice)
    np.testing.assert_array_equal(found.lowest_covered, expected.lowest_covered)
    np.testing.assert_array_equal(found.highest_covered, expected.highest_covered)
    assert covers(found)[1].any()


def test_a_view_far_beside_a_tile_is_projected_nowhere():
    far = SatelliteCamera((CENTRE[0] + 300.0, CENTRE[1], 50.0), (60.0, 50.0), 0.5, 0.0, 0.0)
    views, _, _ = tile([sensor(), far])
    assert views.is_projected[0].all()
    assert not views.is_projected[1].any()


def test_occluded_heights_are_counted_from_the_support_surface():
    """The same tower along a support surface that rises to the east: the bound sinks by as much."""
    views, lattice, _ = tile([sensor(), sensor(across=-45.0)])
    surface = np.full(SHAPE, 10.0, np.float32)
    surface[:, 35:40] = 30.0
    base = np.broadcast_to(np.arange(SHAPE[1], dtype=np.float32) * 2, SHAPE)
    level, sloped = covered_heights(views, FLAT, lattice), covered_heights(views, FLAT, lattice)
    mark_occlusions(level, views, surface, LEVEL, 0.0)
    mark_occlusions(sloped, views, surface, base, 0.0)
    hidden = level.lowest_unoccluded[1] > NEVER_OCCLUDED
    assert hidden.sum() > 400
    np.testing.assert_array_equal((level.lowest_unoccluded[1] - base)[hidden], sloped.lowest_unoccluded[1][hidden])
    # Counted from a level surface at height 10, cells that were occluded at the ground are so at index 0.
    at_ground = covered_heights(views, FLAT, lattice)
    mark_occlusions(at_ground, views, surface, LEVEL + 10, 0.0)
    np.testing.assert_array_equal(
        sees(at_ground, np.zeros((2, *SHAPE)))[1], sees(level, np.full((2, *SHAPE), 10.0))[1]
    )  # fmt: skip


def visible_everywhere(n_views, shape):
    """Covered from 0 to 20, and not occluded from 7 on."""
    full = (np.full((n_views, *shape), index, np.int32) for index in (0, 20, 7))
    return VisibleHeights(*full)


def test_nothing_occludes_a_view_from_cells_that_two_cover():
    visible = visible_everywhere(3, (4, 6))
    visible.lowest_covered[2, :, 4:], visible.highest_covered[2, :, 4:] = NEVER_COVERED, -1
    before = visible.copy()
    keep_enough_views(visible)
    np.testing.assert_array_equal(visible.lowest_unoccluded[..., :4], before.lowest_unoccluded[..., :4])
    np.testing.assert_array_equal(visible.lowest_covered, before.lowest_covered)
    np.testing.assert_array_equal(visible.highest_covered, before.highest_covered)
    assert (visible.lowest_unoccluded[:, :, 4:] == NEVER_OCCLUDED).all()


def test_of_four_views_the_three_that_are_seen_lowest_are_not_occluded():
    """Views that do not cover a cell are none of them, and views of equal rank are treated alike."""
    visible = visible_everywhere(5, (2, 3))
    visible.lowest_unoccluded[:] = np.array([9, 3, 4, 8, 5])[:, None, None]
    visible.lowest_covered[1, :, 0], visible.highest_covered[1, :, 0] = NEVER_COVERED, -1
    visible.lowest_unoccluded[3, :, 2] = 5
    visible.lowest_covered[:2, 1, 1], visible.highest_covered[:2, 1, 1] = NEVER_COVERED, -1
    keep_enough_views(visible)
    of_column = visible.lowest_unoccluded[:, 0]
    assert (of_column[[0, 2, 3, 4], 0] == [9, NEVER_OCCLUDED, NEVER_OCCLUDED, NEVER_OCCLUDED]).all()
    assert (of_column[:, 1] == [9, NEVER_OCCLUDED, NEVER_OCCLUDED, 8, NEVER_OCCLUDED]).all()
    assert (of_column[:, 2] == [9, *[NEVER_OCCLUDED] * 4]).all()
    # Three views cover this cell, and each may be occluded.
    assert (visible.lowest_unoccluded[2:, 1, 1] == [4, 8, 5]).all()


def test_slope_indices_and_level_indices():
    """Bounds move with the support surface, to half a step; a cell that a view never covers stays so."""
    visible = visible_everywhere(2, (4, 5))
    visible.lowest_covered[1, 2, 3], visible.highest_covered[1, 2, 3] = NEVER_COVERED, -1
    slope_cells = np.linspace(-30, 30, 20, dtype=np.float32).reshape(4, 5)
    moved = in_level_indices(visible.copy(), slope_cells)
    assert all(bound.dtype == np.int32 for bound in moved)
    known = covers(visible)
    assert known.sum() == 39
    np.testing.assert_array_equal(covers(moved), known)
    for bound, plain in zip(moved, (0, 20, 7), strict=True):
        assert (np.abs(bound - plain - slope_cells) <= 0.5)[known].all()
    assert moved.lowest_covered[1, 2, 3] == NEVER_COVERED
    assert moved.highest_covered[1, 2, 3] == NEVER_OCCLUDED
    for height in (-1000.0, -1.0, 0.0, 1000.0):
        assert not sees(moved, np.full((2, 4, 5), height))[1, 2, 3]


def test_a_wide_lens_sees_behind_a_tower_from_its_own_side():
    """Above the middle of the tile: towers on both sides occlude the ground outwards of them, none inwards."""
    shape, block = (64, 256), 16
    transform = Affine(1.0, 0, CENTRE[0] - 128.0, 0, -1.0, CENTRE[1] + 32.0)
    turn = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    camera = FrameModel((*CENTRE, 150.0), turn, 100.0, (200.0, 100.0))
    pixels = np.zeros((201, 401), np.float32)
    window = ViewPixels(camera, (0, 0), pixels, np.ones(pixels.shape, bool))
    views = tile_views([window], TileGrid(0, transform, shape, block, 0.0, 1.0), (0.0, 40.0), 2)
    surface = np.zeros(shape, np.float32)
    surface[24:40, 40:46] = surface[24:40, 210:216] = 30.0
    visible = VisibleHeights(*np.zeros((3, 1, *shape), np.int32))
    mark_occlusions(visible, views, surface, np.zeros(shape, np.float32), 0.0)
    hidden = visible.lowest_unoccluded[0] > 0
    # 85 m aside and 120 m above the towers' tops, the shadows of 30 m are a quarter longer than 15 m.
    assert hidden[28:36, 28:38].mean() > 0.9
    assert hidden[28:36, 218:228].mean() > 0.9
    assert not hidden[:, 60:196].any()


def test_a_satellite_looks_one_way():
    views, _, _ = tile([sensor(), sensor(10, 5)])
    assert all(len(parts_of_one_direction(views, i)) == 1 for i in range(2))
