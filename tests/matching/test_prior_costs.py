"""Costs of heights far from what is known, the misfit of a surface, and the penalties that follow from it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernel_scene import ragged_lattice
from reference.semiglobal import dense
from zlocus.core.options import SemiGlobalOptions
from zlocus.matching.kernels.prior_costs import (
    CoarserCells,
    DistanceCost,
    add_costs_beyond,
    add_costs_of_candidates,
    write_misfit,
)
from zlocus.matching.prior_costs import (
    FREE_SIDES,
    FREE_STEPS,
    HALVING_MISFIT,
    LEAST_PENALTY,
    cost_beyond,
    penalties_after_misfit,
    penalty_factor,
    share_at_least_cost,
    smaller_penalties,
)
from zlocus.matching.semiglobal import SemiGlobalHeights

SHAPE, BLOCK = (13, 22), 8
BY_DISTANCE = DistanceCost(np.float32(3.0), np.float32(5.0), np.float32(30.0))


def volume(seed):
    """A ragged volume of costs, and the surface from which its heights are counted."""
    rng, lattice = np.random.default_rng(seed), ragged_lattice(SHAPE, BLOCK)
    cost = rng.integers(0, 256, lattice.size).astype(np.uint8)
    return cost, lattice, rng.uniform(-2, 2, SHAPE).astype(np.float32)


def heights_of(lattice, slope_cells):
    """Level index of every place of the dense volume, (r, c, h)."""
    first, count = lattice.cell_ranges()
    return np.arange(int((first + count).max())) + slope_cells[..., None].astype(float)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_heights_far_from_all_candidates_cost_more(seed):
    cost, lattice, slope = volume(seed)
    rng = np.random.default_rng(seed + 1)
    coarse = (SHAPE[0] // 2 + 2, SHAPE[1] // 2 + 2)
    candidates = rng.integers(0, 10, (3, *coarse)).astype(np.int32)
    cells, before = CoarserCells(1, 2, 1), dense(cost.copy(), lattice, np.inf)
    add_costs_of_candidates(cost, lattice.layout, slope, candidates, cells, BY_DISTANCE)
    found = dense(cost, lattice, np.inf)
    first, count = lattice.cell_ranges()
    lowest = first + np.rint(slope).astype(int)
    row_of, col_of = (1 + np.arange(SHAPE[0])) // 2, (2 + np.arange(SHAPE[1])) // 2
    for r in range(SHAPE[0]):
        for c in range(SHAPE[1]):
            row, col = row_of[r], col_of[c]
            near = candidates[:, max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2].ravel()
            # Candidates beyond the heights of all cells in the same coarser cell count as the nearest of these.
            siblings = np.ix_(row_of == row, col_of == col)
            at = np.clip(2 * near, lowest[siblings].min(), (lowest + count)[siblings].max() - 1)
            k = np.arange(count[r, c])
            away = np.abs(lowest[r, c] + k[:, None] - at).min(axis=1)
            added = np.floor(np.minimum(5.0 * np.maximum(away - 3.0, 0), 30.0) + 0.5)
            expected = np.minimum(before[r, c, first[r, c] + k] + added, 255)
            np.testing.assert_array_equal(found[r, c, first[r, c] + k], expected)


def test_heights_beyond_the_surface_cost_more():
    cost, lattice, slope = volume(3)
    before = dense(cost.copy(), lattice, np.inf)
    low, high = np.full(SHAPE, 6.0, np.float32), np.full(SHAPE, 9.0, np.float32)
    add_costs_beyond(cost, lattice.layout, slope, low, high, BY_DISTANCE)
    height = heights_of(lattice, slope)
    away = np.maximum(np.maximum(6.0 - height, height - 9.0) - 3.0, 0)
    expected = np.minimum(before + np.floor(np.minimum(5.0 * away, 30.0) + 0.5), 255)
    searched = np.isfinite(before)
    # A cost between two whole numbers may fall either way.
    assert np.abs(dense(cost, lattice, np.inf)[searched] - expected[searched]).max() <= 1
    assert (expected[searched] > before[searched]).any()


def test_misfit_is_the_cost_above_the_least():
    cost, lattice, _ = volume(5)
    first, count = lattice.cell_ranges()
    height = (first + np.random.default_rng(6).integers(0, count)).astype(np.int32)
    found = np.empty(SHAPE, np.float32)
    is_wanted = np.random.default_rng(7).random(SHAPE) < 0.8
    write_misfit(cost, lattice.layout, height, is_wanted, found)
    all_costs = dense(cost, lattice, np.inf)
    expected = np.take_along_axis(all_costs, height[..., None].astype(int), axis=2)[..., 0] - all_costs.min(axis=2)
    np.testing.assert_array_equal(found, np.where(is_wanted, expected, 0))


def test_the_share_at_least_cost_is_that_of_cells_within_a_step_of_their_minimum():
    cost, lattice, _ = volume(8)
    rng = np.random.default_rng(9)
    first, count = lattice.cell_ranges()
    least = dense(cost, lattice, np.inf).argmin(axis=2)
    best = np.clip(least + rng.integers(-3, 4, SHAPE), first, first + count - 1).astype(np.int32)
    core = (slice(2, 11), slice(3, 20))
    n_near = sum(abs(int(best[r, c]) - int(least[r, c])) <= 1 for r in range(2, 11) for c in range(3, 20))
    assert share_at_least_cost(cost, lattice, heights_at(best), core) == pytest.approx(n_near / (9 * 17))
    assert 0.2 < n_near / (9 * 17) < 0.8
    assert share_at_least_cost(cost, lattice, heights_at(best), (slice(0, 0), slice(0, 0))) == 0.0


def test_a_height_that_costs_as_little_as_another_one_counts_as_least():
    cost, lattice, _ = volume(8)
    first, count = lattice.cell_ranges()
    cost[:] = 7
    best = (first + count - 1).astype(np.int32)
    assert share_at_least_cost(cost, lattice, heights_at(best), (slice(None), slice(None))) == 1.0


def heights_at(best):
    zero = np.zeros(SHAPE, np.uint16)
    return SemiGlobalHeights(best, best, zero, best.astype(np.float32))


@pytest.mark.parametrize(("n_of_40", "factor"), [(0, 1.0), (28, 1.0), (33, 0.75), (38, 0.5), (40, 0.5)])
def test_penalties_are_smaller_the_more_cells_the_costs_alone_find(n_of_40, factor):
    cost, lattice, heights = costs_that_find(n_of_40)
    found = penalty_factor(cost, lattice, heights, (slice(0, 4), slice(0, 10)), SemiGlobalOptions())
    assert found == pytest.approx(factor)


def test_a_given_p2_stays():
    cost, lattice, heights = costs_that_find(40)
    assert penalty_factor(cost, lattice, heights, (slice(0, 4), slice(0, 10)), SemiGlobalOptions(p2=400)) == 1.0


def costs_that_find(n_of_40):
    """Costs whose minimum is the height found in so many of the first 4 x 10 cells."""
    cost, lattice, _ = volume(8)
    best = dense(cost, lattice, np.inf).argmin(axis=2).astype(np.int32)
    first, count = lattice.cell_ranges()
    other = np.where(best - first > 2, first, first + count - 1)
    assert (np.abs(other - best)[:4, :10] > 1).all()
    is_missed = np.zeros(SHAPE, bool)
    is_missed[:4, :10] = (np.arange(40) >= n_of_40).reshape(4, 10)
    return cost, lattice, heights_at(np.where(is_missed, other, best).astype(np.int32))


def test_no_penalty_falls_below_that_of_an_edge():
    penalties = np.array([0, 10, 45, 46, 90, 400], np.uint16).reshape(1, 1, 6).repeat(4, axis=0)
    np.testing.assert_array_equal(smaller_penalties(penalties, 0.5, 45.0)[0, 0], [0, 10, 45, 45, 45, 200])


def test_the_uniqueness_is_told_in_units_of_the_full_penalties():
    zero = np.zeros((1, 5), np.int32)
    heights = SemiGlobalHeights(zero, zero, np.array([[0, 10, 301, 60000, 65535]], np.uint16), zero.astype(np.float32))
    np.testing.assert_array_equal(heights.with_full_penalties(0.5).uniqueness, [[0, 20, 602, 65534, 65535]])
    np.testing.assert_array_equal(heights.with_full_penalties(1.0).uniqueness, heights.uniqueness)


def test_jumps_are_cheaper_where_the_surface_contradicts_the_images():
    penalties = np.full((4, 20, 30), 400, np.uint16)
    of_patch = np.zeros((20, 30), np.float32)
    assert (penalties_after_misfit(penalties, of_patch) == 400).all()
    of_patch[5:15, 10:20] = HALVING_MISFIT
    found = penalties_after_misfit(penalties, of_patch)
    assert (found[:, 6:15, 11:19] == 200).all()
    assert (found[0, 5:15, 10] == 300).all()  # the cell in the west is outside the patch
    assert (found[2, 5, 10:20] == 300).all()
    assert (found[3, 5:15, 19] == 300).all()
    assert (found[1, 5:15, 20] != 400).sum() == 9
    of_patch[:] = 1e6
    assert (penalties_after_misfit(penalties, of_patch) == LEAST_PENALTY).all()


@settings(max_examples=20, deadline=None)
@given(st.floats(0, 200), st.floats(0, 200), st.integers(1, 2000))
def test_a_worse_fit_never_makes_jumps_dearer(one, other, penalty):
    penalties = np.full((4, 3, 3), penalty, np.uint16)
    small, large = (
        penalties_after_misfit(penalties, np.full((3, 3), value, np.float32)) for value in sorted((one, other))
    )
    assert (large <= small).all()
    assert pytest.approx(penalty, abs=max(1, LEAST_PENALTY)) == int(
        penalties_after_misfit(penalties, np.zeros((3, 3), np.float32)).max()
    )


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 10.0), st.integers(0, 3), st.floats(1.0, 5.0))
def test_a_narrow_base_frees_no_more_metres_than_a_wide_one(step_cells, level, times):
    """Heights that are so many times as far as the free steps cost the same with every base."""
    found, wide = cost_beyond(3.0, 30.0, level, step_cells), cost_beyond(3.0, 30.0, level, 0.1)
    assert found.free_steps * 2**level * step_cells <= FREE_SIDES * (1 + 1e-6)
    assert found.free_steps * 2**level <= FREE_STEPS * (1 + 1e-6)
    assert wide == DistanceCost(np.float32(FREE_STEPS / 2**level), np.float32(3.0), np.float32(30.0))
    costs = [each.cost_per_step * (times - 1) * each.free_steps for each in (found, wide)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-5)
