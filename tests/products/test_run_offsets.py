"""Vertical offsets between runs: found, with an uncertainty that knows that errors are correlated."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overlapping_surfaces import noise
from zlocus.io.surface_cells import SurfaceCells
from zlocus.products.run_offsets import (
    PairOffset,
    estimated_sigmas,
    offset_sigma,
    pair_offset,
    run_offsets,
    sampled_pairs,
)

SHAPE = (256, 256)


def run(z, sigma_m=0.3):
    z = np.asarray(z, np.float32)
    return SurfaceCells(z, np.full(z.shape, sigma_m, np.float32), np.ones(z.shape, bool), {})


def pair(first, second, offset_m, sigma_m=0.01, spread_m=0.5, usual_sigmas_m=(0.3, 0.3)):
    return PairOffset(first, second, offset_m, sigma_m, 1.0, spread_m, usual_sigmas_m, 50)


def test_an_offset_and_the_size_of_the_differences():
    rng = np.random.default_rng(1)
    z = 0.6 * noise(rng, SHAPE, 0)
    z[:40] += 30.0  # new houses
    ((numbers, sample),) = sampled_pairs({2: run(np.zeros(SHAPE)), 5: run(z + 0.25)}, 0, 0).items()
    assert numbers == (2, 5)
    found = pair_offset(*numbers, sample)
    assert found.offset_m == pytest.approx(0.25, abs=0.02)
    assert found.scale == pytest.approx(0.6 / math.hypot(0.3, 0.3), rel=0.25)
    assert found.usual_sigmas_m == pytest.approx((0.3, 0.3))
    assert found.n_blocks == 64


def test_the_uncertainty_of_an_offset_holds_for_correlated_errors():
    """Over many draws, errors of the median are as large as is said, within a factor; the naive value is far off."""
    errors, said = [], []
    for seed in range(14):
        rng = np.random.default_rng(seed)
        z = 0.3 * noise(rng, (320, 320), 25.0)
        z += 0.1 * rng.normal(size=z.shape)
        sample = sampled_pairs({0: run(np.zeros_like(z)), 1: run(z)}, 0, 0)[0, 1]
        errors.append(np.median(sample.median))
        said.append(offset_sigma(sample.median, sample.place))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(said)
    assert 0.5 < ratio < 1.6
    assert np.mean(said) > 10 * 0.3 / 320, "as of independent cells"


def test_offsets_of_a_ring_of_runs_are_adjusted():
    pairs = [pair(0, 1, 0.30), pair(1, 2, 0.21), pair(0, 2, 0.48)]
    offsets = run_offsets(3, pairs)
    assert offsets.offset_m == pytest.approx([0.0, 0.29, 0.49], abs=1e-9)
    assert offsets.largest_misclosure_m == pytest.approx(0.01)
    assert offsets.sigma_m[0] == 0.0
    assert offsets.is_significant
    assert list(offsets.group) == [0, 0, 0]


def test_runs_without_an_overlap_stay():
    offsets = run_offsets(4, [pair(2, 3, 0.005)])
    assert list(offsets.group) == [0, 1, 2, 2]
    assert not offsets.is_significant


def test_the_precision_of_a_run_that_states_none():
    """Two runs share the spread; beside a run that states its own, the rest is that of the silent one."""
    pairs = [pair(0, 1, 0.0, spread_m=0.5, usual_sigmas_m=(0.3, math.nan))]
    assert estimated_sigmas(3, pairs)[1] == pytest.approx(0.4)
    assert math.isnan(estimated_sigmas(3, pairs)[2])
    pairs = [pair(0, 1, 0.0, spread_m=0.5, usual_sigmas_m=(math.nan, math.nan))]
    assert estimated_sigmas(2, pairs) == pytest.approx([0.5 / math.sqrt(2)] * 2)
