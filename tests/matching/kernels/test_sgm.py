"""The semi-global kernels against their slow twins, on cells with ranges of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kernel_scene import even_lattice, ragged_lattice, random_cost, random_p2
from reference.semiglobal import dense, path_sums, winner
from zlocus.matching.kernels.sgm import sweep
from zlocus.matching.kernels.winners import winner_takes_all, winners

NO_RIVAL = 65535
# A parabola through three whole numbers, in float32.
VERTEX = 1e-5


def aggregated(cost, lattice, p1, p2):
    total = np.zeros(lattice.size, np.uint16)
    for sign in (1, -1):
        sweep(cost, lattice.layout, p2, np.uint16(p1), sign, total)
    return total


def picked(total, lattice):
    best, second = np.empty(lattice.shape, np.int32), np.empty(lattice.shape, np.int32)
    margin, vertex = np.empty(lattice.shape, np.uint16), np.empty(lattice.shape, np.float32)
    winners(total, lattice.layout, best, second, margin, vertex)
    return best, second, margin, vertex


@pytest.mark.parametrize(
    ("shape", "block", "counts"),
    [
        ((37, 70), 32, (16, 32, 48)),
        ((33, 21), 16, (16, 32)),
        ((9, 11), 32, (16,)),
        ((17, 1), 8, (16, 32)),
        ((21, 40), 16, (4, 12, 28)),
    ],
)
@pytest.mark.parametrize("p1", [20, 0])
def test_path_sums(shape, block, counts, p1):
    lattice = ragged_lattice(shape, block, seed=4, counts=counts)
    cost, p2 = random_cost(lattice), random_p2(shape)
    expected = path_sums(dense(cost, lattice, np.inf), p1, p2)
    np.testing.assert_array_equal(dense(aggregated(cost, lattice, p1, p2), lattice, np.inf), expected)


def test_ranges_that_do_not_meet():
    """Neighbouring blocks without a common height: each is reached by a jump."""
    lattice = even_lattice(16, (20, 30), 8)
    lattice.first[:] = 20 * (np.indices(lattice.first.shape).sum(axis=0) % 3)
    cost, p2 = random_cost(lattice), random_p2(lattice.shape)
    expected = path_sums(dense(cost, lattice, np.inf), 10, p2)
    np.testing.assert_array_equal(dense(aggregated(cost, lattice, 10, p2), lattice, np.inf), expected)


def test_largest_costs_and_penalties_do_not_overflow():
    lattice = ragged_lattice((19, 23), 16)
    cost = random_cost(lattice, high=256)
    p2 = np.full((4, 19, 23), 4000, np.uint16)
    expected = path_sums(dense(cost, lattice, np.inf), 1000, p2)
    np.testing.assert_array_equal(dense(aggregated(cost, lattice, 1000, p2), lattice, np.inf), expected)


def test_an_even_cost_gives_even_sums():
    lattice = even_lattice(32, (37, 70), 16)
    total = aggregated(np.full(lattice.size, 50, np.uint8), lattice, 20, random_p2((37, 70)))
    assert (total == 8 * 50).all()


def test_without_penalties_the_plain_winner_is_kept():
    lattice = even_lattice(16, (37, 70), 16)
    cost = random_cost(lattice)
    total = aggregated(cost, lattice, 0, np.zeros((4, 37, 70), np.uint16))
    np.testing.assert_array_equal(picked(total, lattice)[0], picked(cost.astype(np.uint16), lattice)[0])


def test_penalties_join_a_noisy_plane():
    """One cell with a false minimum among cells that agree: with penalties it gives in, without it does not."""
    lattice = even_lattice(16, (15, 15), 16)
    cost = np.full((15, 15, 16), 60, np.uint8)
    cost[..., 5] = 20
    cost[7, 7, 5], cost[7, 7, 11] = 30, 20
    alone = picked(cost.ravel().astype(np.uint16), lattice)[0]
    joined = picked(aggregated(cost.ravel(), lattice, 20, np.full((4, 15, 15), 240, np.uint16)), lattice)[0]
    assert alone[7, 7] == 11
    assert (joined == 5).all()


@pytest.mark.parametrize("levels", [4, 400, 40000])
def test_winners(levels):
    """Few levels give many ties, of which the lowest height wins."""
    lattice = ragged_lattice((37, 70), 16, seed=2, counts=(4, 12, 20, 32))
    total = np.random.default_rng(8).integers(0, levels, lattice.size).astype(np.uint16)
    best, second, margin, vertex = picked(total, lattice)
    sums, (first, count) = dense(total, lattice, np.inf), lattice.cell_ranges()
    for r, c in np.ndindex(lattice.shape):
        mine = sums[r, c, first[r, c] : first[r, c] + count[r, c]]
        at, other, place = winner(mine)
        assert (best[r, c], second[r, c]) == (first[r, c] + at, first[r, c] + other)
        assert margin[r, c] == (NO_RIVAL if other == at else mine[other] - mine[at])
        assert vertex[r, c] == pytest.approx(first[r, c] + place, abs=VERTEX)


def test_a_minimum_at_an_end_is_a_winner_without_a_fraction():
    lattice = even_lattice(16, (1, 2), 8, first=3)
    total = np.full((2, 16), 100, np.uint16)
    total[0, 0], total[1, 15] = 10, 10
    best, second, margin, vertex = picked(total.ravel(), lattice)
    np.testing.assert_array_equal(best, [[3, 18]])
    np.testing.assert_array_equal(vertex, [[3, 18]])
    # A level stretch counts as a minimum of its own.
    assert (margin == 90).all()
    assert (np.abs(second - best) >= 3).all()


@pytest.mark.parametrize("levels", [3, 255])
def test_least_costs(levels):
    """Few levels give many ties, of which the height found wins, else the lowest."""
    lattice = ragged_lattice((37, 70), 16, seed=3, counts=(4, 12, 20, 32))
    rng, (first, count) = np.random.default_rng(9), lattice.cell_ranges()
    cost = random_cost(lattice, high=levels)
    best = (first + rng.integers(0, count)).astype(np.int32)
    lone = np.empty(lattice.shape, np.int32)
    winner_takes_all(cost, lattice.layout, best, lone)
    costs = dense(cost, lattice, np.inf)
    for r, c in np.ndindex(lattice.shape):
        mine = costs[r, c, first[r, c] : first[r, c] + count[r, c]]
        has_least = mine[best[r, c] - first[r, c]] == mine.min()
        assert lone[r, c] == (best[r, c] if has_least else first[r, c] + mine.argmin())


def test_whatever_index_heights_start_at():
    """Heights below the base surface have negative indices: the same sums, the same heights 20 lower."""
    lattice = ragged_lattice((37, 70), 16, seed=5, counts=(8, 16, 28))
    lower = replace(lattice, first=lattice.first - 20)
    cost, p2 = random_cost(lattice), random_p2((37, 70))
    total = aggregated(cost, lattice, 20, p2)
    np.testing.assert_array_equal(aggregated(cost, lower, 20, p2), total)
    plain, moved = picked(total, lattice), picked(total, lower)
    assert (moved[0] < 0).any()
    for k, (shift, rounding) in enumerate(((20, 0), (20, 0), (0, 0), (20, VERTEX))):
        np.testing.assert_allclose(moved[k] + shift, plain[k], rtol=0, atol=rounding)
