"""The more-global kernel against its slow twin, on cells with ranges of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernel_scene import even_lattice, ragged_lattice, random_cost, random_p2
from reference.semiglobal import dense, more_global_path_sums
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.mgm import sweep_quarter
from zlocus.matching.semiglobal import heights_of_sums
from zlocus.matching.semiglobal import more_global_path_sums as aggregated


def twin(cost, lattice, p1, p2):
    return more_global_path_sums(dense(cost, lattice, np.inf), p1, p2)


@pytest.mark.parametrize(
    ("shape", "block", "counts"),
    [
        ((37, 50), 32, (16, 32, 48)),
        ((33, 21), 16, (16, 32)),
        ((9, 11), 32, (16,)),
        ((17, 1), 8, (16, 32)),
        ((1, 19), 8, (16, 32)),
        ((21, 40), 16, (4, 12, 28)),
    ],
)
@pytest.mark.parametrize("p1", [20, 0])
def test_sums_over_directions(shape, block, counts, p1):
    lattice = ragged_lattice(shape, block, seed=4, counts=counts)
    cost, p2 = random_cost(lattice), random_p2(shape)
    found = dense(aggregated(cost, lattice, p2, p1), lattice, np.inf)
    np.testing.assert_array_equal(found, twin(cost, lattice, p1, p2))


@st.composite
def lattices(draw):
    """Blocks of 1 to 80 heights that may lie apart; single rows, columns and blocks among them."""
    shape = draw(st.tuples(st.integers(1, 11), st.integers(1, 11)))
    block = draw(st.sampled_from([1, 2, 4, 16]))
    n = (-(-shape[0] // block), -(-shape[1] // block))
    count = draw(st.lists(st.integers(1, 80), min_size=n[0] * n[1], max_size=n[0] * n[1]))
    spread = draw(st.sampled_from([0, 5, 200]))
    first = draw(st.lists(st.integers(0, spread), min_size=n[0] * n[1], max_size=n[0] * n[1]))
    return HeightLattice(0.0, 1.0, shape, block, np.reshape(first, n).astype(np.int64), np.reshape(count, n))


@settings(deadline=None, max_examples=60)
@given(lattice=lattices(), p1=st.sampled_from([0, 28, 1000]), seed=st.integers(0, 1000))
def test_sums_on_any_ranges(lattice, p1, seed):
    cost, p2 = random_cost(lattice, seed, high=256), random_p2(lattice.shape, seed)
    found = dense(aggregated(cost, lattice, p2, p1), lattice, np.inf)
    np.testing.assert_array_equal(found, twin(cost, lattice, p1, p2))


def test_what_lies_beyond_the_volume_has_no_effect_and_stays():
    """Loops run over whole vectors, the last one of the volume not."""
    lattice = ragged_lattice((9, 11), 4, seed=2, counts=(4, 12, 20))
    cost, p2 = random_cost(lattice), random_p2(lattice.shape)
    beyond = np.full(64, 7, np.uint16)
    sums = []
    for value in (0, 255):
        longer = np.concatenate([cost, np.full(64, value, np.uint8)])
        total = np.concatenate([np.zeros(lattice.size, np.uint16), beyond])
        for turn in range(4):
            sweep_quarter(longer[: lattice.size], lattice.layout, p2, np.uint16(28), turn, total[: lattice.size])
        np.testing.assert_array_equal(total[lattice.size :], beyond)
        sums.append(total[: lattice.size])
    np.testing.assert_array_equal(sums[0], sums[1])
    np.testing.assert_array_equal(sums[0], aggregated(cost, lattice, p2, 28))


def test_ranges_that_do_not_meet():
    """Neighbouring blocks without a common height: each is reached by a jump."""
    lattice = even_lattice(16, (20, 30), 8)
    lattice.first[:] = 20 * (np.indices(lattice.first.shape).sum(axis=0) % 3)
    cost, p2 = random_cost(lattice), random_p2(lattice.shape)
    found = dense(aggregated(cost, lattice, p2, 10), lattice, np.inf)
    np.testing.assert_array_equal(found, twin(cost, lattice, 10, p2))


def test_largest_costs_and_penalties_do_not_overflow():
    lattice = ragged_lattice((19, 23), 16)
    cost, p2 = random_cost(lattice, high=256), np.full((4, 19, 23), 4000, np.uint16)
    found = dense(aggregated(cost, lattice, p2, 1000), lattice, np.inf)
    np.testing.assert_array_equal(found, twin(cost, lattice, 1000, p2))


def test_an_even_cost_gives_even_sums():
    lattice = even_lattice(32, (37, 70), 16)
    total = aggregated(np.full(lattice.size, 50, np.uint8), lattice, random_p2((37, 70)), 20)
    assert (total == 8 * 50).all()


def test_whatever_index_heights_start_at():
    """Heights below the base surface have negative indices: the same sums."""
    lattice = ragged_lattice((37, 70), 16, seed=5, counts=(8, 16, 28))
    lower = replace(lattice, first=lattice.first - 20)
    cost, p2 = random_cost(lattice), random_p2((37, 70))
    np.testing.assert_array_equal(aggregated(cost, lower, p2, 20), aggregated(cost, lattice, p2, 20))


def test_a_quarter_turn_of_the_scene_turns_the_heights():
    """Directions are the same four times: turned costs and penalties give turned sums."""
    cost = np.random.default_rng(1).integers(0, 129, (16, 16, 12)).astype(np.uint8)
    lattice, p2 = even_lattice(12, (16, 16), 8), np.full((4, 16, 16), 200, np.uint16)
    plain = dense(aggregated(blocks(cost), lattice, p2, 20), lattice, np.inf)
    turned = dense(aggregated(blocks(np.rot90(cost)), lattice, p2, 20), lattice, np.inf)
    np.testing.assert_array_equal(turned, np.rot90(plain))


def blocks(cost):
    """A volume of one range for all cells, row after row, as kernels take it."""
    return np.ascontiguousarray(cost).ravel()


def test_false_minima_side_by_side_give_in():
    """Two paths that meet a run of false minima from across disagree with it."""
    lattice = even_lattice(16, (15, 15), 16)
    cost = np.full((15, 15, 16), 60, np.uint8)
    cost[..., 5] = 20
    cost[7, 5:10, 5], cost[7, 5:10, 11] = 30, 20
    p2 = np.full((4, 15, 15), 240, np.uint16)
    assert (heights_of_sums(aggregated(blocks(cost), lattice, p2, 20), lattice).best == 5).all()
