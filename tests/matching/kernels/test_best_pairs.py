"""The mean of the best pairs against its slow twin, and what it must be whatever the pairs say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reference.evidence import mean_of_best
from zlocus.matching.evidence import MAX_LOG_RATIO
from zlocus.matching.kernels.best_pairs import HALF_SPAN, RATIO_OF_UNSEEN, add_best_pairs, empty_pair_ratios

N_CELLS = 400
HIGHEST = 4.5
# Natural units: sums of float32; and where several pairs lie in the interval that the limit is searched to.
ROUNDING, SAME_INTERVAL = 1e-5, 0.02
# Of all cells so few may be off by more than a thousandth of a natural unit.
OFF, FEW = 1e-3, 0.02


def some_pairs(n_pairs, seed=0, unseen=0.2):
    """Log ratios (k, p) between the least and the largest, some of them unseen, and weights (k,)."""
    rng = np.random.default_rng(seed)
    ratios = rng.uniform(HIGHEST - 2 * MAX_LOG_RATIO, HIGHEST, (n_pairs, N_CELLS)).astype(np.float32)
    ratios[rng.random(ratios.shape) < unseen] = RATIO_OF_UNSEEN
    return ratios, rng.uniform(0.2, 3.0, n_pairs).astype(np.float32)


def best(ratios, weights, share):
    """The mean of the best pairs (p,), and the weight of those that see each cell (p,)."""
    pairs = empty_pair_ratios(len(ratios), N_CELLS)
    pairs.of_pairs[:], pairs.weights[:] = ratios, weights
    pairs.seen[:] = (weights[:, None] * (ratios > RATIO_OF_UNSEEN)).sum(axis=0)
    total = np.zeros(N_CELLS, np.float32)
    add_best_pairs(pairs, np.uint64(len(ratios)), np.float32(share), np.float32(HIGHEST), N_CELLS, total)
    return np.divide(total, pairs.seen, out=np.zeros(N_CELLS), where=pairs.seen > 0), pairs.seen


@pytest.mark.parametrize("n_pairs", [1, 2, 3, 12, 38])
@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_it_is_the_mean_of_the_sorted_ratios(n_pairs, share):
    ratios, weights = some_pairs(n_pairs)
    found, seen = best(ratios, weights, share)
    is_seen = ratios > RATIO_OF_UNSEEN
    expected = [mean_of_best(ratios[:, j], weights * is_seen[:, j], share) for j in range(N_CELLS)]
    error = found - expected
    assert (seen == 0).any() == (n_pairs < 4)
    assert (np.abs(error) <= (ROUNDING if n_pairs == 1 or share == 1 else SAME_INTERVAL)).all()
    assert (np.abs(error) > OFF).mean() < FEW
    # The formula has its least value at the right limit.
    assert (error > -ROUNDING * MAX_LOG_RATIO).all()


@given(st.integers(2, 20), st.floats(0.1, 1.0), st.integers(0, 1000))
def test_a_larger_share_has_a_lower_mean_and_no_pair_is_above_it(n_pairs, share, seed):
    ratios, weights = some_pairs(n_pairs, seed, unseen=0.0)
    of_share, of_all = (best(ratios, weights, s)[0] for s in (share, 1.0))
    assert (of_share >= of_all - ROUNDING * MAX_LOG_RATIO).all()
    assert (of_share <= ratios.max(axis=0) + SAME_INTERVAL).all()


def test_the_span_holds_every_log_ratio_of_a_table():
    assert HALF_SPAN == MAX_LOG_RATIO
