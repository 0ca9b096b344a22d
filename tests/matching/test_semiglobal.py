"""Penalties from the ortho-image, and the two forms of picking heights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from kernel_scene import even_lattice
from reference.semiglobal import BEHIND
from zlocus.core.options import SemiGlobalOptions
from zlocus.matching.local_contrast import edge_unit
from zlocus.matching.semiglobal import (
    SemiGlobalHeights,
    aggregate,
    jump_penalties,
    penalty_of_one_step,
    winner_takes_all_heights,
)

OPTIONS = SemiGlobalOptions(p1=20, p2=240, p2_edge=60, edge_contrast=2.0, penalty_factor_per_level=0.5)


def test_without_an_ortho_image_penalties_are_even():
    p2 = jump_penalties(None, (5, 7), 0, OPTIONS)
    assert p2.dtype == np.uint16
    assert p2.shape == (4, 5, 7)
    assert (p2 == 240).all()


def test_penalties_shrink_with_the_grey_difference_to_the_cell_behind():
    ortho = gaussian_filter(np.random.default_rng(0).normal(size=(12, 15)), 1).astype(np.float32)
    p2 = jump_penalties(ortho, (12, 15), 0, OPTIONS)
    unit = 2.0 * edge_unit(ortho)
    for path, (dr, dc) in enumerate(BEHIND):
        for r in range(1, 11):
            for c in range(1, 14):
                plain = 240 / (1 + abs(ortho[r, c] - ortho[r + dr, c + dc]) / unit)
                assert abs(p2[path, r, c] - max(plain, 60)) <= 1
    assert p2.min() < 100
    assert p2.max() > 150


@pytest.mark.parametrize("shape", [(9, 14), (1, 6), (5, 1), (1, 1)])
def test_penalties_of_all_cells(shape):
    """At the border too, where the image goes on as it ends; to a rounding of P2. An edge is worth what it is worth at
    both cells."""
    rng = np.random.default_rng(3)
    ortho, has_two_views = rng.normal(size=shape).astype(np.float32), rng.random(shape) < 0.5
    ortho[rng.random(shape) < 0.1] = np.nan
    weight, unit = rng.random(shape).astype(np.float32), max(edge_unit(ortho), 1e-6)
    found = jump_penalties(ortho, shape, 0, OPTIONS, has_two_views, edge_weight=weight)
    for path, (dr, dc) in enumerate(BEHIND):
        for r, c in np.ndindex(shape):
            other = max(r + dr, 0), min(max(c + dc, 0), shape[1] - 1)
            away, worth = abs(ortho[r, c] - ortho[other]), min(weight[r, c], weight[other])
            contrast = 8.0 if has_two_views[r, c] else 2.0
            plain = 240 / (1 + (0 if np.isnan(away) else away) / (contrast * unit))
            assert abs(found[path, r, c] - (240 - worth * (240 - max(plain, 60)))) <= 1, (path, r, c)


def test_a_strong_edge_is_cheap_to_cross_only_where_it_is():
    ortho = np.zeros((8, 12), np.float32) + np.random.default_rng(1).normal(0, 0.01, (8, 12)).astype(np.float32)
    ortho[:, 6:] += 5
    p2 = jump_penalties(ortho, (8, 12), 0, OPTIONS)
    assert (p2[0, :, 6] == 60).all()
    assert (p2[2, 1:, 6] > 60).all()


def test_a_penalty_of_edges_above_p2_does_not_raise_it():
    ortho = np.random.default_rng(0).normal(size=(6, 6)).astype(np.float32)
    assert jump_penalties(ortho, (6, 6), 0, SemiGlobalOptions(p2=50, p2_edge=400)).max() <= 50


def test_edges_count_less_where_two_views_see_a_cell():
    ortho = np.random.default_rng(0).normal(size=(9, 10)).astype(np.float32)
    has_two_views = np.zeros((9, 10), bool)
    has_two_views[:, 5:] = True
    p2 = jump_penalties(ortho, (9, 10), 0, OPTIONS, has_two_views)
    few, many = (jump_penalties(ortho, (9, 10), 0, replace(OPTIONS, edge_contrast=c)) for c in (8.0, 2.0))
    np.testing.assert_array_equal(p2, np.where(has_two_views, few, many))
    assert (few[few > 60] > many[few > 60]).mean() > 0.9


def test_no_edge_counts_where_nothing_is_shown():
    ortho = np.random.default_rng(0).normal(size=(9, 10)).astype(np.float32)
    ortho[:, 6:] = np.nan
    p2 = jump_penalties(ortho, (9, 10), 0, OPTIONS)
    assert (p2[:, :, 6:] == 240).all()
    assert (p2[:, 1:-1, 1:5] < 240).all()


@pytest.mark.parametrize("level", [0, 1, 2])
def test_penalties_ease_from_level_to_level(level):
    """Those of even ground and those of edges alike."""
    ortho = gaussian_filter(np.random.default_rng(0).normal(size=(12, 15)), 1).astype(np.float32)
    ortho[:, 6:] += 5
    even, finest = jump_penalties(None, (12, 15), level, OPTIONS), jump_penalties(ortho, (12, 15), 0, OPTIONS)
    assert (even == 240 // 2**level).all()
    eased = jump_penalties(ortho, (12, 15), level, OPTIONS)
    assert (finest == 60).any()
    assert (eased[finest == 60] == 60 // 2**level).all()
    assert np.abs(eased - finest / 2**level).max() <= 1


def test_penalties_without_easing_are_the_same_at_every_level():
    ortho = np.random.default_rng(0).normal(size=(6, 6)).astype(np.float32)
    kept = replace(OPTIONS, penalty_factor_per_level=1.0)
    np.testing.assert_array_equal(jump_penalties(ortho, (6, 6), 3, kept), jump_penalties(ortho, (6, 6), 0, kept))


@pytest.mark.parametrize("predecessors", [1, 2])
def test_aggregation_joins_what_picking_alone_does_not(predecessors):
    lattice = even_lattice(16, (20, 24), 16)
    rng = np.random.default_rng(3)
    cost = rng.integers(30, 90, (20, 24, 16)).astype(np.uint8)
    cost[..., 7] -= 25
    p2 = jump_penalties(None, lattice.shape, 0, OPTIONS)
    joined = aggregate(cost.ravel(), lattice, p2, 1.0, replace(OPTIONS, predecessors=predecessors))
    single = winner_takes_all_heights(cost.ravel(), lattice)
    assert (np.abs(joined.best - 7) <= 1).mean() > 0.97
    assert (np.abs(single.best - 7) <= 1).mean() < 0.9
    assert joined.vertex.dtype == np.float32
    assert np.abs(joined.vertex - joined.best).max() <= 0.5


def test_cells_by_themselves_are_aggregation_without_penalties():
    """Margins included, on which the ranges of the next level and the flag of ambiguous cells depend."""
    lattice = even_lattice(16, (20, 24), 16)
    cost = np.random.default_rng(4).integers(0, 256, lattice.size).astype(np.uint8)
    free = aggregate(cost, lattice, np.zeros((4, *lattice.shape), np.uint16), 1.0, replace(OPTIONS, p1=0))
    single = winner_takes_all_heights(cost, lattice)
    for name in ("best", "second", "uniqueness", "vertex"):
        np.testing.assert_array_equal(getattr(single, name), getattr(free, name))
    assert 0 < np.median(single.uniqueness) < 65535


def test_one_and_two_predecessors_give_margins_of_the_same_size():
    """The chosen kernel is the one that the option names: the sums differ, their size does not."""
    lattice = even_lattice(16, (20, 24), 16)
    cost = np.random.default_rng(3).integers(30, 90, lattice.size).astype(np.uint8)
    p2 = jump_penalties(None, lattice.shape, 0, OPTIONS)
    one, two = (aggregate(cost, lattice, p2, 1.0, replace(OPTIONS, predecessors=n)).uniqueness for n in (1, 2))
    assert (one != two).any()
    assert np.median(two) == pytest.approx(np.median(one), rel=0.5)
    for step_cells, expected in ((2.0, two), (2.1, one)):
        unset = aggregate(cost, lattice, p2, step_cells, OPTIONS).uniqueness
        np.testing.assert_array_equal(unset, expected, err_msg=f"steps of {step_cells} cells")


def test_heights_above_a_base_surface():
    """Indices along the base become indices of the lattice: whole ones to half a step, the vertex exactly."""
    base = np.linspace(-7.3, 12.9, 12, dtype=np.float32).reshape(3, 4)
    best, second = np.arange(12, dtype=np.int32).reshape(3, 4), np.full((3, 4), -3, np.int32)
    uniqueness, vertex = np.arange(12, dtype=np.uint16).reshape(3, 4), (best + 0.25).astype(np.float32)
    moved = SemiGlobalHeights(best, second, uniqueness, vertex).on_lattice(base)
    np.testing.assert_array_equal(moved.uniqueness, uniqueness)
    np.testing.assert_allclose(moved.vertex, vertex + base, rtol=0, atol=1e-6)
    assert moved.vertex.dtype == np.float32
    for found, plain in ((moved.best, best), (moved.second, second)):
        assert found.dtype == np.int32
        assert np.abs(found - plain - base).max() <= 0.5


@pytest.mark.parametrize("predecessors", [1, 2])
def test_the_penalty_of_one_step_is_divided_by_the_images_less_one(predecessors):
    lattice, rng = even_lattice(6, (9, 11), 8), np.random.default_rng(4)
    cost = rng.integers(0, 129, lattice.size).astype(np.uint8)
    p2 = jump_penalties(None, (9, 11), 0, OPTIONS)
    options = replace(OPTIONS, predecessors=predecessors, p1=180)
    found = {n: aggregate(cost, lattice, p2, 1.0, options, n).uniqueness for n in (2, 3, 4, 40)}
    for n, p1 in ((2, 180), (3, 90), (4, 60), (40, 45)):
        expected = aggregate(cost, lattice, p2, 1.0, replace(options, p1=p1)).uniqueness
        np.testing.assert_array_equal(found[n], expected)
    assert (found[2] != found[3]).any()


@pytest.mark.parametrize(
    ("p1", "n_images", "expected"), [(100, 1, 100), (200, 3.5, 80), (100, 9, 45), (10, 9, 10), (0, 2, 0)]
)
def test_the_penalty_of_one_step(p1, n_images, expected):
    assert penalty_of_one_step(p1, n_images) == expected


@pytest.mark.parametrize(
    ("n_images", "step_cells", "expected"),
    [(2, 1.35, 100), (2, 4.0, 100), (2, 0.675, 25), (3, 1.2, 45), (3, 0.9, 40), (9, 0.9, 40), (9, 0.6, 20)],
)
def test_low_height_steps_cost_less(n_images, step_cells, expected):
    # 100 (0.675 / 1.35)^2 = 25; the least P1 of many images at 0.9 cells is 45 * 0.9 = 40.5. That of two at 0.6 is 20.
    assert penalty_of_one_step(100, n_images, step_cells) == expected


@pytest.mark.parametrize("predecessors", [1, 2])
def test_a_penalty_of_one_step_that_is_set_does_not_follow_the_height_of_a_step(predecessors):
    lattice, rng = even_lattice(6, (9, 11), 8), np.random.default_rng(4)
    cost = rng.integers(0, 129, lattice.size).astype(np.uint8)
    p2 = jump_penalties(None, (9, 11), 0, OPTIONS)
    unset, as_set = (replace(OPTIONS, predecessors=predecessors, p1=p1) for p1 in (None, 100))
    found = {
        (name, step): aggregate(cost, lattice, p2, step, options).uniqueness
        for name, options in (("unset", unset), ("set", as_set)) for step in (0.75, 1.35)
    }  # fmt: skip
    np.testing.assert_array_equal(found["set", 0.75], found["set", 1.35])
    np.testing.assert_array_equal(found["set", 1.35], found["unset", 1.35])
    assert (found["unset", 0.75] != found["unset", 1.35]).any()
