"""Which edges of the ortho-image make jumps cheaper: those that lie across the parallax."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from affine import Affine
from scipy.ndimage import gaussian_filter

from rendered_scenes import CENTRE
from zlocus.core.grid import CellWindow
from zlocus.core.options import SemiGlobalOptions
from zlocus.matching.edge_penalties import (
    FULL_SHARE,
    by_cell,
    parallax_tensors,
    penalties_at_edges,
    share_along_parallax,
    weights_of_edges,
)
from zlocus.matching.level_records import PyramidLevel
from zlocus.matching.semiglobal import jump_penalties
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.view_directions import cells_per_step, directions_of_blocks
from zlocus.matching.view_pixels import ViewPixels
from zlocus.synthetic.cameras import SatelliteCamera

CELL_M, STEP_M, BLOCK, SHAPE, SIDE_PX = 0.5, 0.5, 16, (40, 60), 301
ORIGIN_M, N_STEPS = 40.0, 64


def views_of(*angles, grey=None):
    """Views from satellites with angles (along, across) in degrees, all of one image (301, 301)."""
    transform = Affine(CELL_M, 0, CENTRE[0] - 15.0, 0, -CELL_M, CENTRE[1] + 10.0)
    image = np.zeros((SIDE_PX, SIDE_PX), np.float32) if grey is None else grey.astype(np.float32)
    mask = np.ones((SIDE_PX, SIDE_PX), bool)
    pixels = [
        ViewPixels(SatelliteCamera((*CENTRE, 50.0), (150.0, 150.0), CELL_M, *each), (0, 0), image, mask)
        for each in angles
    ]
    z = (ORIGIN_M, ORIGIN_M + N_STEPS * STEP_M)
    return tile_views(pixels, TileGrid(0, transform, SHAPE, BLOCK, ORIGIN_M, STEP_M), z, 2)


def stripes(angle_deg, seed=0):
    """An image (r, c) whose grey values change along one direction only, clockwise from the columns."""
    row, col = np.indices(SHAPE)
    turn = np.deg2rad(angle_deg)
    profile = gaussian_filter(np.random.default_rng(seed).normal(size=400), 2.0)
    return np.interp(col * np.cos(turn) + row * np.sin(turn), np.arange(-200, 200), profile).astype(np.float32)


@pytest.mark.parametrize("view", [0, 1, 2])
def test_directions_of_blocks_are_those_of_single_blocks(view):
    views = views_of((17.0, 0.0), (-16.0, 5.0), (2.0, -11.0))
    found = directions_of_blocks(views)
    n_rows, n_cols = found.shape[1:3]
    assert (n_rows, n_cols) == (3, 4)
    for b in range(n_rows):
        for d in range(n_cols):
            part = (slice(b * BLOCK, (b + 1) * BLOCK), slice(d * BLOCK, (d + 1) * BLOCK))
            np.testing.assert_allclose(found[view, b, d], cells_per_step(views, view, part), rtol=0, atol=1e-9)


def test_a_view_has_no_direction_where_it_shows_nothing():
    views = views_of((17.0, 0.0), (-16.0, 0.0))
    views.is_projected[0, 1, 1] = False
    found = directions_of_blocks(views)
    assert (found[0, 1, 1] == 0).all()
    assert (found[0, 0, 0] != 0).any()


def test_tensors_are_the_mean_of_the_pairs_by_their_squared_parallax():
    views = views_of((17.0, 0.0), (-16.0, 5.0), (2.0, -11.0))
    direction = directions_of_blocks(views)[:, 1, 2]
    expected = np.zeros((2, 2))
    for i, j in combinations(range(3), 2):
        expected += np.outer(direction[i] - direction[j], direction[i] - direction[j])
    expected /= np.trace(expected)
    found = parallax_tensors(views)[1, 2]
    np.testing.assert_allclose(found, (expected[0, 0], expected[1, 1], expected[0, 1]), rtol=0, atol=1e-6)


def test_one_view_alone_prefers_no_direction():
    views = views_of((17.0, 0.0), (-16.0, 5.0))
    views.is_projected[1] = False
    np.testing.assert_array_equal(parallax_tensors(views)[0, 0], (0.5, 0.5, 0.0))


def test_cells_take_the_value_of_their_block():
    of_block = np.arange(24, dtype=np.float32).reshape(3, 4, 2)
    found = by_cell(of_block, BLOCK, SHAPE)
    assert found.shape == (*SHAPE, 2)
    np.testing.assert_array_equal(found[17, 33], of_block[1, 2])
    np.testing.assert_array_equal(found[39, 59], of_block[2, 3])


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 90, 135])
def test_share_of_gradients_along_the_parallax(angle_deg):
    """Of stripes it is the squared cosine of the angle between the change of grey and the parallax."""
    parallax_deg = 20.0
    p = np.array([np.cos(np.deg2rad(parallax_deg)), np.sin(np.deg2rad(parallax_deg))])
    tensor = np.broadcast_to(np.float32([p[0] ** 2, p[1] ** 2, p[0] * p[1]]), (*SHAPE, 3))
    found = share_along_parallax(stripes(angle_deg), tensor)
    expected = np.cos(np.deg2rad(angle_deg - parallax_deg)) ** 2
    # Differences of three cells see the curves of the profile, along the two axes not quite alike.
    np.testing.assert_allclose(np.median(found), expected, rtol=0, atol=0.03)


def test_noise_has_half_of_its_gradients_along_any_parallax():
    tensor = np.broadcast_to(np.float32([1, 0, 0]), (*SHAPE, 3))
    noise = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)
    assert abs(share_along_parallax(noise, tensor).mean() - 0.5) < 0.03


def test_plain_and_unknown_cells_keep_their_jumps():
    tensor = np.broadcast_to(np.float32([1, 0, 0]), (*SHAPE, 3))
    assert (share_along_parallax(np.full(SHAPE, 3.0, np.float32), tensor) == 1).all()
    assert (share_along_parallax(np.full(SHAPE, np.nan, np.float32), tensor) == 1).all()


def test_edges_along_the_base_line_are_worth_nothing_and_others_all():
    """The base line of two views along the track runs along the columns of cells: from north to south."""
    views = views_of((17.0, 0.0), (-16.0, 0.0))
    road = np.zeros(SHAPE, np.float32)
    road[:, 25:35] = 1.0
    assert (weights_of_edges(road, views)[:, [*range(22, 28), *range(32, 38)]] < 0.01 / FULL_SHARE).all()
    across = np.zeros(SHAPE, np.float32)
    across[15:25] = 1.0
    assert (weights_of_edges(across, views) == 1).all()


def test_penalties_fall_at_edges_across_the_parallax_alone():
    """An image of two edges, seen by two views along the track: only the one from east to west makes jumps cheaper."""
    grey = np.random.default_rng(2).normal(0, 0.02, (SIDE_PX, SIDE_PX))
    grey[:, 150:] += 2.0
    grey[150:] += 2.0
    views = views_of((0.3, 0.0), (-0.3, 0.0), grey=grey)
    surface = np.full(SHAPE, (50.0 - ORIGIN_M) / STEP_M, np.float32)
    options, covered = SemiGlobalOptions(p1=20, p2=240, p2_edge=60), np.ones((2, *SHAPE), bool)
    whole = (slice(0, SHAPE[0]), slice(0, SHAPE[1]))
    level = PyramidLevel(
        0, CellWindow(0, 0, *SHAPE), whole, Affine.scale(CELL_M), CELL_M, ORIGIN_M, STEP_M, N_STEPS
    )  # fmt: skip
    found = penalties_at_edges(views, surface, covered, np.ones(2), level, options)
    to_the_east, to_the_south = found[0, 4:12].max(axis=0), found[2][:, 4:20].max(axis=1)
    assert to_the_east.min() > 200
    assert to_the_south.min() < 100
    even = penalties_at_edges(views, None, covered, None, level, options)
    np.testing.assert_array_equal(even, jump_penalties(None, SHAPE, 0, options))
