"""Which view sees which height of a cell, through real projection tables."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine

from rendered_scenes import CENTRE
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import HIDDEN
from zlocus.matching.occlusion import BORDER_PX, NOTHING_HIDDEN, above_base, coverage, covers, hide, sees, spare_pairs
from zlocus.matching.slope_surface import BaseSurface
from zlocus.matching.tile_views import ViewPixels, tile_views
from zlocus.matching.view_directions import cells_per_step, parts_of_one_direction
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.cameras import SatelliteCamera

CELL_M, STEP_M, BLOCK, SHAPE = 0.5, 0.5, 16, (30, 50)
ORIGIN_M, N_STEPS = 40.0, 64
LEVEL, LEVEL_BASE = np.zeros(SHAPE, np.float32), BaseSurface.level(SHAPE, BLOCK)


def sensor(along=0.0, across=0.0):
    return SatelliteCamera((*CENTRE, 50.0), (60.0, 50.0), 0.5, along, across)


def tile(sensors, valid=None):
    """A tile around the scene's centre and its lattice of heights."""
    transform = Affine(CELL_M, 0, CENTRE[0] - 12.5, 0, -CELL_M, CENTRE[1] + 7.5)
    pixels = (np.zeros((101, 121), np.float32),)
    mask = (np.ones((101, 121), bool) if valid is None else valid,)
    windows = [ViewPixels(s, (0, 0), 0.0, 1.0, pixels, mask) for s in sensors]
    blocks = (-(-SHAPE[0] // BLOCK), -(-SHAPE[1] // BLOCK))
    lattice = HeightLattice(
        ORIGIN_M, STEP_M, SHAPE, BLOCK, np.zeros(blocks, np.int64), np.full(blocks, N_STEPS, np.int64)
    )
    z = (ORIGIN_M, ORIGIN_M + N_STEPS * STEP_M)
    return tile_views(windows, 0, transform, SHAPE, BLOCK, (ORIGIN_M, STEP_M), z, 2), lattice, transform


def test_all_is_covered_well_inside_the_image():
    views, lattice, _ = tile([sensor(), sensor(10, 5)])
    seen = coverage(views, LEVEL_BASE, lattice)
    assert (seen[0] == 0).all()
    assert (seen[1] == N_STEPS - 1).all()


def test_heights_at_which_a_cell_leaves_the_image():
    """A view 60 degrees off nadir: high ground falls off the image's edge."""
    camera = sensor(along=60.0)
    views, lattice, transform = tile([sensor(), camera])
    seen = coverage(views, LEVEL_BASE, lattice)
    for r, c in ((0, 0), (15, 30), (29, 49)):
        x, y = transform * (c + 0.5, r + 0.5)
        z = ORIGIN_M + STEP_M * np.arange(N_STEPS)
        xy = camera.image_from_ground(np.column_stack([np.full(N_STEPS, x), np.full(N_STEPS, y), z]))
        inside = ((xy >= BORDER_PX) & (xy <= np.array([120, 100]) - BORDER_PX)).all(axis=1)
        assert 0 < inside.sum() < N_STEPS
        first, last = np.flatnonzero(inside)[[0, -1]]
        assert abs(seen[0, 1, r, c] - first) <= 1
        assert abs(seen[1, 1, r, c] - last) <= 1


def rough_base(up):
    """Level at the corners of blocks, so that nodes stay, and up to `up` steps from there between them, anywhere."""
    blocks = [-(-n // BLOCK) for n in SHAPE]
    corners = np.random.default_rng(6).uniform(-up, up, [4 * n + 1 for n in blocks])
    corners[::4, ::4] = 0.0
    return BaseSurface(corners, BLOCK // 4, SHAPE, BLOCK)


def test_a_bound_that_the_image_cuts_is_counted_from_the_relief():
    """A view 60 degrees off nadir covers a cell to the same height in metres, whatever the base under it."""
    base = rough_base(9.0)
    relief = base.relief
    views, lattice, _ = tile([sensor(), sensor(along=60.0)])
    level, rough = coverage(views, LEVEL_BASE, lattice), coverage(views, base, lattice)
    assert (level[0, 1] > 0).any()
    assert (level[1, 1] < N_STEPS - 1).any()
    for r, c in np.ndindex(SHAPE):
        low, high = level[:2, 1, r, c]
        covered = [k for k in range(-20, N_STEPS + 20) if low <= k + relief[r, c] <= high]
        if low > 0:
            assert rough[0, 1, r, c] == covered[0]
        if high < N_STEPS - 1:
            assert rough[1, 1, r, c] == covered[-1]


def test_a_bound_that_the_image_does_not_cut_stays():
    views, lattice, _ = tile([sensor(), sensor(across=60.0)])
    level, rough = coverage(views, LEVEL_BASE, lattice), coverage(views, rough_base(9.0), lattice)
    np.testing.assert_array_equal(rough[:, 0], level[:, 0])
    for bound, end in ((0, 0), (1, N_STEPS - 1)):
        uncut = level[bound, 1] == end
        assert uncut.any()
        assert (rough[bound, 1][uncut] == end).all()


def test_a_short_run_that_the_relief_moves_away_from_itself_is_kept():
    """Where an image covers fewer heights than the relief is deep, both bounds still move alike."""
    valid = np.zeros((101, 121), bool)
    valid[:, 56:67] = True
    base = rough_base(20.0)
    views, lattice, _ = tile([sensor(across=40.0)], valid)
    level, rough = coverage(views, LEVEL_BASE, lattice), coverage(views, base, lattice)
    cut = (level[0, 0] > 0) & (level[1, 0] < N_STEPS - 1) & covers(level)[0]
    run = (level[1] - level[0])[0]
    short = cut & (np.abs(base.relief) > run + 1)
    assert short.sum() > 50
    for r, c in np.argwhere(short):
        whole = np.ceil(level[0, 0, r, c] - base.relief[r, c]), np.floor(level[1, 0, r, c] - base.relief[r, c])
        assert tuple(rough[:2, 0, r, c]) == whole
    never = ~covers(level)[0]
    assert never.sum() > 50
    np.testing.assert_array_equal(rough[:, 0, never], level[:, 0, never])


def test_windows_do_not_touch_nodata():
    valid = np.ones((101, 121), bool)
    valid[50, 60] = False
    views, lattice, transform = tile([sensor(), sensor(5)], valid)
    lost = coverage(views, LEVEL_BASE, lattice)[1, 0] < 0
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


def test_a_tower_hides_the_ground_behind_it():
    """10 m high; a view that leans 45 degrees from the east does not see 10 m of ground to the west of it."""
    views, lattice, _ = tile([sensor(), sensor(across=-45.0)])
    seen = coverage(views, LEVEL_BASE, lattice)
    surface = np.full(SHAPE, 10.0, np.float32)
    surface[:, 35:40] = 30.0
    hide(seen, views, surface, LEVEL, 0.0)
    assert (seen[0] == 0).all()
    sees_ground = sees(seen, np.full((2, *SHAPE), 10.0))
    assert sees_ground[0].all()
    hidden = np.flatnonzero(~sees_ground[1, 15])
    # 20 steps of 0.5 m, a metre of shadow a metre of height; the cells of the tower itself count as hidden at its foot.
    assert hidden.min() in (15, 16)
    assert (np.diff(hidden) == 1).all()
    assert hidden.max() in (38, 39)
    shown = coverage(views, LEVEL_BASE, lattice)
    hide(shown, views, surface, LEVEL, 100.0)
    assert (shown[2] < 0).all()


def test_what_is_hidden_is_counted_from_the_base():
    """The same tower seen along a base surface that rises to the east: the bound sinks by as much."""
    views, lattice, _ = tile([sensor(), sensor(across=-45.0)])
    surface = np.full(SHAPE, 10.0, np.float32)
    surface[:, 35:40] = 30.0
    base = np.broadcast_to(np.arange(SHAPE[1], dtype=np.float32) * 2, SHAPE)
    level, sloped = coverage(views, LEVEL_BASE, lattice), coverage(views, LEVEL_BASE, lattice)
    hide(level, views, surface, LEVEL, 0.0)
    hide(sloped, views, surface, base, 0.0)
    hidden = level[2, 1] > NOTHING_HIDDEN
    assert hidden.sum() > 400
    np.testing.assert_array_equal((level[2, 1] - base)[hidden], sloped[2, 1][hidden])
    # On a level base at height 10, what was hidden at the ground stays so at index 0.
    at_ground = coverage(views, LEVEL_BASE, lattice)
    hide(at_ground, views, surface, LEVEL + 10, 0.0)
    np.testing.assert_array_equal(
        sees(at_ground, np.zeros((2, *SHAPE)))[1], sees(level, np.full((2, *SHAPE), 10.0))[1]
    )  # fmt: skip


def test_nothing_hides_a_view_from_cells_that_two_cover():
    seen = np.zeros((3, 3, 4, 6), np.int32)
    seen[1], seen[2] = 20, 7
    seen[0, 2, :, 4:], seen[1, 2, :, 4:] = HIDDEN, -1
    before = seen.copy()
    spare_pairs(seen)
    np.testing.assert_array_equal(seen[..., :4], before[..., :4])
    np.testing.assert_array_equal(seen[:2], before[:2])
    assert (seen[2, :, :, 4:] == NOTHING_HIDDEN).all()


def test_above_the_base_and_back():
    """Bounds move with the base, to half a step; a cell that a view never covers stays so."""
    seen = np.zeros((3, 2, 4, 5), np.int32)
    seen[1], seen[2] = 20, 7
    seen[0, 1, 2, 3], seen[1, 1, 2, 3] = HIDDEN, -1
    base = np.linspace(-30, 30, 20, dtype=np.float32).reshape(4, 5)
    moved = above_base(seen.copy(), base)
    assert moved.dtype == np.int32
    known = covers(seen)
    assert known.sum() == 39
    np.testing.assert_array_equal(covers(moved), known)
    for bound, plain in enumerate((0, 20, 7)):
        assert (np.abs(moved[bound] - plain - base) <= 0.5)[known].all()
    never = moved[:, 1, 2, 3]
    assert never[0] == HIDDEN
    assert never[1] == NOTHING_HIDDEN
    for height in (-1000.0, -1.0, 0.0, 1000.0):
        assert not sees(moved, np.full((2, 4, 5), height))[1, 2, 3]


def test_a_wide_lens_sees_behind_a_tower_from_its_own_side():
    """Above the middle of the tile: towers on both sides hide what is outwards of them, and nothing inwards."""
    shape, block = (64, 256), 16
    transform = Affine(1.0, 0, CENTRE[0] - 128.0, 0, -1.0, CENTRE[1] + 32.0)
    turn = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    camera = FrameModel((*CENTRE, 150.0), turn, 100.0, (200.0, 100.0))
    pixels = np.zeros((201, 401), np.float32)
    window = ViewPixels(camera, (0, 0), 0.0, 1.0, (pixels,), (np.ones(pixels.shape, bool),))
    views = tile_views([window], 0, transform, shape, block, (0.0, 1.0), (0.0, 40.0), 2)
    surface = np.zeros(shape, np.float32)
    surface[24:40, 40:46] = surface[24:40, 210:216] = 30.0
    seen = np.zeros((3, 1, *shape), np.int32)
    hide(seen, views, surface, np.zeros(shape, np.float32), 0.0)
    hidden = seen[2, 0] > 0
    # 85 m aside and 120 m above the towers' tops, the shadows of 30 m are a quarter longer than 15 m.
    assert hidden[28:36, 28:38].mean() > 0.9
    assert hidden[28:36, 218:228].mean() > 0.9
    assert not hidden[:, 60:196].any()


def test_a_satellite_looks_one_way():
    views, _, _ = tile([sensor(), sensor(10, 5)])
    assert all(len(parts_of_one_direction(views, i)) == 1 for i in range(2))
