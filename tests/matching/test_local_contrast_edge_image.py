"""The image at whose edges heights may jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine

from rendered_scenes import CENTRE
from zlocus.matching.local_contrast import MIN_AGREEMENT_SHARE, MIN_SHARED_CELLS, agreement, edge_image
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.true_ortho import ortho_image
from zlocus.matching.view_pixels import ViewPixels
from zlocus.synthetic.cameras import SatelliteCamera

CELL_M, STEP_M, BLOCK, SHAPE, SIDE_PX = 0.5, 0.5, 16, (40, 60), 201
ORIGIN_M, N_STEPS = 40.0, 64
SURFACE = np.full(SHAPE, (50.0 - ORIGIN_M) / STEP_M, np.float32)
CORE = (slice(4, 34), slice(10, 50))
# Correlations of what is sampled twice from one texture, and of what is not.
ALIKE, UNLIKE = 0.99, 0.2


def views_of(*greys):
    """Views straight from above that show the given images (201, 201)."""
    transform = Affine(CELL_M, 0, CENTRE[0] - 15.0, 0, -CELL_M, CENTRE[1] + 10.0)
    sensor = SatelliteCamera((*CENTRE, 50.0), (100.0, 100.0), CELL_M, 0.0, 0.0)
    mask = np.ones((SIDE_PX, SIDE_PX), bool)
    pixels = [ViewPixels(sensor, (0, 0), np.asarray(grey, np.float32), mask) for grey in greys]
    z = (ORIGIN_M, ORIGIN_M + N_STEPS * STEP_M)
    return tile_views(pixels, TileGrid(0, transform, SHAPE, BLOCK, ORIGIN_M, STEP_M), z, 2)


def textures(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, SIDE_PX, SIDE_PX))


def plain(count):
    return [np.full((SIDE_PX, SIDE_PX), float(grey)) for grey in range(count)]


@pytest.fixture
def covering():
    return np.ones((3, *SHAPE), bool)


def test_views_of_one_texture_agree_and_one_of_another_does_not(covering):
    same, other = textures(2)
    found = agreement(views_of(other, same, 5 + 2 * same, same), SURFACE, np.ones((4, *SHAPE), bool), CORE)
    assert found.shape == (4,)
    assert abs(found[0]) < UNLIKE
    assert (found[1:] > ALIKE).all()


def test_agreement_is_the_correlation_of_the_cells_that_both_views_show(covering):
    views = views_of(*textures(3))
    covering[0, :, 30:], covering[1, 20:] = False, False
    grey = [ortho_image(views, SURFACE, view)[CORE] for view in range(3)]
    shown = covering[:, *CORE]
    alike = np.full((3, 3), np.nan)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        both = shown[i] & shown[j]
        alike[i, j] = alike[j, i] = np.corrcoef(grey[i][both], grey[j][both])[0, 1]
    np.testing.assert_allclose(agreement(views, SURFACE, covering, CORE), np.nanmedian(alike, axis=1), atol=1e-4)


def test_views_that_share_too_few_cells_say_nothing_of_each_other(covering):
    same = textures(1)[0]
    covering[0] = False
    covering[0, 10, : 10 + MIN_SHARED_CELLS - 1] = True
    found = agreement(views_of(same, same, same), SURFACE, covering, CORE)
    assert np.isnan(found[0])
    assert (found[1:] > ALIKE).all()


def test_edges_are_those_of_the_first_view_that_shows_half_as_much_as_another(covering):
    views, alike = views_of(*plain(3)), np.ones(3)
    covering[0, :, 35:] = False
    leading = edge_image(views, SURFACE, covering, CORE, alike)
    assert (leading[:, :35] == ortho_image(views, SURFACE)[:, :35]).all()
    assert np.isnan(leading[:, 35:]).all()
    covering[0, :, 20:] = False
    covering[1, 15:] = False
    leading = edge_image(views, SURFACE, covering, CORE, alike)
    np.testing.assert_array_equal(leading, ortho_image(views, SURFACE, 2))


def test_a_view_that_does_not_agree_with_the_others_gives_no_edges(covering):
    views, barely = views_of(*plain(3)), 0.99 * MIN_AGREEMENT_SHARE
    cases = [
        ([barely, 1.0, 1.0], 1),
        ([MIN_AGREEMENT_SHARE, 1.0, 0.9], 0),
        ([np.nan] * 3, 0),
        ([-0.2, -0.1, np.nan], 0),
    ]
    for agrees, leads in cases:
        image = edge_image(views, SURFACE, covering, CORE, np.array(agrees))
        np.testing.assert_array_equal(image, ortho_image(views, SURFACE, leads))
    # Nor does what it shows more of count against those that agree.
    covering[1:, :, 15:] = False
    image = edge_image(views, SURFACE, covering, CORE, np.array([barely, 1.0, 1.0]))
    assert np.nanmax(image) == 1.0


def test_where_no_view_shows_anything_no_edge_is_known(covering):
    nothing = edge_image(views_of(*plain(3)), SURFACE, np.zeros_like(covering), CORE, np.full(3, np.nan))
    assert np.isnan(nothing).all()


def test_where_masked_pixels_hide_the_first_view_the_next_one_that_agrees_gives_edges(covering):
    """Not the one that disagrees; and not where only the border of the image, and no mask, ends the first view."""
    views, agrees = views_of(*plain(3)), np.array([0.9, 0.1, 0.9])
    covering[0, :, 20:35] = False
    covering[2, 30:] = False
    border = edge_image(views, SURFACE, covering, CORE, agrees)
    assert np.isnan(border[:, 20:35]).all()
    hidden = replace(views, has_blocked=np.array([True, False, False]))
    found = edge_image(hidden, SURFACE, covering, CORE, agrees)
    np.testing.assert_array_equal(found[covering[0]], border[covering[0]])
    np.testing.assert_allclose(found[:30, 20:35], 2.0, atol=1e-6)
    assert np.isnan(found[30:, 20:35]).all()
