"""Free rays: a height in free air costs more where images clearly see a surface behind it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from free_ray_scene import AIR, ANGLES_DEG, BLOCK, GROUND, N_STEPS, PATCH, SHAPE, level_ground, with_patch
from kernel_scene import even_lattice, ragged_lattice
from reference import free_rays as twin
from zlocus.matching import free_rays as stage
from zlocus.matching.free_rays import PairAgreement, add_costs_of_rays, agreement_on, free_rays, pair_agreement
from zlocus.matching.kernels.free_rays import add_ray_costs, lowest_free_ray
from zlocus.matching.occlusion import covered_heights
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.view_directions import cells_along_rays

HEIGHT_TOLERANCE_STEPS = 1e-3
STEP_CELLS = 0.5


@pytest.mark.parametrize(
    "direction", [(0.5, 0.0), (-0.5, 0.0), (0.0, 2.0), (0.0, -0.25), (1.0, 1.0), (0.7, -0.3), (-0.4, 0.9), (0.0, 0.0)]
)
def test_lowest_free_ray_against_its_slow_twin(direction):
    rng = np.random.default_rng(3)
    surface = (25 * rng.random((23, 31))).astype(np.float32)
    supported = rng.random(surface.shape) < 0.2
    found = np.empty_like(surface)
    lowest_free_ray(surface, supported, *direction, found)
    expected = twin.lowest_free_ray(surface, supported, *direction)
    np.testing.assert_allclose(found, expected, rtol=0, atol=HEIGHT_TOLERANCE_STEPS)
    assert np.isfinite(expected).any() == (direction != (0.0, 0.0))


@pytest.mark.parametrize("direction", [(0.7, 0.3), (-0.9, 0.2), (0.2, -1.3), (-0.4, -0.5), (0.0, 0.6)])
def test_a_part_of_a_tile_has_the_rays_that_it_has_in_the_whole(direction):
    rng = np.random.default_rng(0)
    surface = (rng.random((90, 110)) * 20).astype(np.float32)
    supported, highest = rng.random(surface.shape) < 0.3, 25.0
    whole, part = np.empty_like(surface), (slice(32, 64), slice(64, 96))
    lowest_free_ray(surface, supported, *direction, whole)
    around, inside = cells_along_rays(part, direction, highest - float(surface.min()), surface.shape)
    found = np.empty(surface[around].shape, np.float32)
    lowest_free_ray(np.ascontiguousarray(surface[around]), np.ascontiguousarray(supported[around]), *direction, found)
    matters = whole[part] <= highest
    assert matters.mean() > 0.5
    np.testing.assert_array_equal(found[inside][matters], whole[part][matters])
    assert (found[inside][~matters] > highest).all()


@pytest.mark.parametrize("lattice", [ragged_lattice(), even_lattice()], ids=["ragged", "even"])
def test_costs_of_rays_against_their_slow_twin(lattice):
    rng = np.random.default_rng(5)
    base = rng.uniform(-3, 3, lattice.shape).astype(np.float32)
    rays = rng.uniform(0, 40, (4, *lattice.shape)).astype(np.float32)
    rays[rng.random(rays.shape) < 0.6] = np.inf
    cost = rng.integers(0, 256, lattice.size).astype(np.uint8)
    expected = twin.with_ray_costs(rays, base, lattice, 12, 30, cost)
    add_ray_costs(rays, base, lattice.layout, 12, 30, cost)
    np.testing.assert_array_equal(cost, expected)


def test_agreement_of_pairs_against_its_slow_twin():
    rng = np.random.default_rng(7)
    truth = gaussian_filter(rng.normal(size=(19, 22)), 1.0) * 3
    truth[:8, :9] *= 0.02  # ground without texture
    grey = np.stack([truth + rng.normal(scale=scale, size=truth.shape) for scale in (0.02, 0.05, 0.1, 1.0)])
    grey, covers = grey.astype(np.float32), rng.random(grey.shape) < 0.9
    found = pair_agreement(grey, covers)
    limits = stage.MIN_NCC, stage.MAX_GREY_DIFFERENCE, stage.MAX_DEVIATION_WITHOUT_TEXTURE
    textured, untextured = twin.agreeing_images(grey, covers, stage.WINDOW_CELLS, *limits)
    np.testing.assert_array_equal(found.textured, textured)
    np.testing.assert_array_equal(found.clearly, textured)
    np.testing.assert_array_equal(found.untextured, untextured)
    assert (textured >= 2).any()
    assert (untextured >= 1).any()


def test_a_pair_must_agree_better_to_see_a_cell_and_less_well_to_keep_its_height():
    rng = np.random.default_rng(9)
    truth = gaussian_filter(rng.normal(size=(40, 40)), 1.0) * 3
    grey = np.stack([truth + rng.normal(scale=scale, size=truth.shape) for scale in (0.3, 0.3)]).astype(np.float32)
    covers = np.ones(grey.shape, bool)
    found = pair_agreement(grey, covers)
    others = stage.MAX_GREY_DIFFERENCE, stage.MAX_DEVIATION_WITHOUT_TEXTURE
    for counts, min_ncc in (
        (found.clearly, stage.MIN_NCC_TO_SEE_OF_PAIR),
        (found.textured, stage.MIN_NCC_AT_HEIGHT_OF_PAIR),
    ):
        expected, _ = twin.agreeing_images(grey, covers, stage.WINDOW_CELLS, min_ncc, *others)
        np.testing.assert_array_equal(counts, expected)
    assert 0 < found.clearly.sum() < found.textured.sum()


@pytest.mark.parametrize(("n_views", "needed"), [(2, 1), (3, 2), (6, 2), (9, 4), (19, 8)])
def test_a_height_is_seen_where_a_share_of_the_images_agree(n_views, needed):
    shape, covering = (n_views, 9, 9), np.full((9, 9), n_views)
    for n_agreeing in range(n_views):
        some, none = np.full(shape, n_agreeing, np.uint8), np.zeros(shape, np.uint8)
        for agreement in (PairAgreement(some, none, none, covering), PairAgreement(none, none, some, covering)):
            assert (agreement.height_is_seen == (n_agreeing >= needed)).all()


def test_images_agree_on_the_ground_and_not_in_free_air():
    views, _ = level_ground()
    agreement = agreement_on(views, with_patch(), np.ones((len(ANGLES_DEG), *SHAPE), bool))
    inside = np.zeros(SHAPE, bool)
    inside[PATCH] = True
    assert agreement.clearly_seen[:, ~inside].mean() > 0.9
    assert agreement.height_is_seen[:, inside].mean() < 0.05


def test_rays_to_the_ground_pass_below_a_patch_in_free_air():
    views, _ = level_ground()
    rays = free_rays(views, with_patch(), np.ones((len(ANGLES_DEG), *SHAPE), bool), float(N_STEPS))
    below = (rays < with_patch() - stage.MARGIN_STEPS).sum(axis=0)
    # Of three images one looks straight down, and has no ray that passes beside the patch.
    assert (below[PATCH] >= 2).mean() > 0.9
    ground = np.ones(SHAPE, bool)
    ground[PATCH] = False
    assert not below[ground].any()
    # What an image sees at its own height, it has no ray below, whatever lies behind.
    assert np.isinf(rays[:, ground]).mean() > 0.9


def test_a_height_in_free_air_becomes_more_expensive_than_the_ground():
    views, lattice = level_ground()
    base, cost = SlopeSurface.flat(SHAPE, BLOCK), np.full(lattice.size, 50, np.uint8)
    visible = covered_heights(views, base, lattice)
    assert add_costs_of_rays(cost, views, base, lattice, visible, with_patch(), level=0, step_cells=STEP_CELLS)
    by_cell = cost.reshape(lattice.shape[0], -1)
    for row, col in ((28, 38), (30, 40), (31, 41)):
        b, d = row // BLOCK, col // BLOCK
        start = lattice.address[0, b, 0] + (row - b * BLOCK) * lattice.address[1, b, 0]
        start += lattice.address[2, b, d] + (col - d * BLOCK) * N_STEPS
        of_cell = by_cell.ravel()[start : start + N_STEPS]
        assert of_cell[int(GROUND)] == 50
        assert of_cell[int(AIR)] >= 50 + 2 * stage.RAY_COST


def test_two_images_have_free_rays_too():
    """Of two images that look at the ground beside a patch, the slanted one has rays that pass below it."""
    views, lattice = level_ground(ANGLES_DEG[:2])
    base, cost = SlopeSurface.flat(SHAPE, BLOCK), np.full(lattice.size, 50, np.uint8)
    visible = covered_heights(views, base, lattice)
    assert add_costs_of_rays(cost, views, base, lattice, visible, with_patch(), level=0, step_cells=STEP_CELLS)
    assert (cost > 50).any()
    assert cost.max() <= 50 + stage.MAX_RAY_COST


@pytest.mark.parametrize(
    ("level", "step_cells", "margin"), [(0, 0.5, 8.0), (0, 1.8, 4.0), (1, 0.5, 4.0), (2, 1.8, 2.0), (0, 3.6, 2.0)]
)
def test_margin_above_a_ray_is_lower_where_steps_are_high(level, step_cells, margin):
    assert stage.margin_above_ray(level, step_cells) == pytest.approx(margin)


def test_rays_cost_more_where_many_views_cover_the_cells():
    """There no view is excluded by the coarser surface; at coarser levels jumps are cheaper."""
    assert stage.costs_of_ray(0, 12.0) == (stage.RAY_COST, stage.MAX_RAY_COST)
    assert stage.costs_of_ray(1, 3.0) == (stage.COARSER_RAY_COST, stage.MAX_RAY_COST)
    assert stage.costs_of_ray(1, 2.0) == stage.costs_of_ray(0, 2.0) == (stage.RAY_COST_OF_PAIR, stage.MAX_RAY_COST)
    assert stage.costs_of_ray(0, 13.0) == (stage.RAY_COST_OF_MANY, stage.MAX_RAY_COST_OF_MANY)
    assert stage.costs_of_ray(2, 19.0) == (stage.COARSER_RAY_COST_OF_MANY, stage.MAX_RAY_COST_OF_MANY)


def test_images_that_show_parts_agree_as_if_all_were_compared_everywhere(monkeypatch):
    rng = np.random.default_rng(8)
    ground, shape = gaussian_filter(rng.normal(size=(40, 50)), 1.5), (40, 50)
    grey = np.stack([3 * ground + rng.normal(0, 0.05, shape) for _ in range(4)]).astype(np.float32)
    covering = np.zeros(grey.shape, bool)
    for view, part in enumerate((np.s_[:, :30], np.s_[10:35, 12:], np.s_[5:20, 5:45])):
        covering[view][part] = True
    found = pair_agreement(np.where(covering, grey, np.float32(0.0)), covering)
    monkeypatch.setattr(stage, "_box_around", lambda mask: (slice(0, shape[0]), slice(0, shape[1])))
    expected = pair_agreement(np.where(covering, grey, np.float32(0.0)), covering)
    assert expected.textured.max() == 2
    np.testing.assert_array_equal(found.textured, expected.textured)
    np.testing.assert_array_equal(found.untextured, expected.untextured)
