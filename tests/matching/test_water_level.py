"""The level of a water surface from confident heights, and which cells lie at a shore."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from zlocus.core.options import WaterOptions
from zlocus.matching.quality import Quality
from zlocus.matching.water_level import (
    SHORE_QUANTILE,
    WaterHeights,
    is_confident,
    shore_cells,
    tells_level,
    water_level,
    weighted_quantile,
)

LEVEL_M, EXACT_M = 431.5, 1e-4
OPTIONS = WaterOptions()
NONE = np.zeros(0, np.float32)


def heights(shore=NONE, beyond=NONE, inside=NONE, n_inside=1000, sigma=0.1):
    shore, beyond, inside = (np.asarray(each, np.float32) for each in (shore, beyond, inside))
    return WaterHeights(n_inside, inside, shore, np.full(shore.shape, sigma, np.float32), beyond)


def test_the_quantile_is_that_of_repeated_values():
    """A weight of 4 counts as four equal values."""
    z, sigma = np.array([3.0, 1.0, 2.0], np.float32), np.array([0.5, 1.0, 1.0], np.float32)
    repeated = np.sort([3.0, 3.0, 3.0, 3.0, 1.0, 2.0])
    for share in (0.1, 0.25, 0.4, 0.9):
        assert weighted_quantile(z, sigma, share) == repeated[int(np.ceil(share * 6)) - 1]


def test_the_level_is_that_of_the_shore_below_banks():
    """Most of the shore is a bank: its heights are too high, and those at the level are most of the low ones."""
    shore = np.r_[np.full(60, LEVEL_M), np.linspace(LEVEL_M + 0.01, LEVEL_M + 2.0, 240)]
    found = water_level(heights(shore, np.full(300, LEVEL_M + 1.0)), OPTIONS)
    assert (found.source, found.n_used) == ("rim", 300)
    assert found.height_m == pytest.approx(LEVEL_M, abs=EXACT_M)
    # Half of the rise of the ground at the shore; the lowest heights agree.
    assert found.sigma_m == pytest.approx(0.5, abs=EXACT_M)
    assert water_level(heights(shore), OPTIONS, share=0.45).height_m > LEVEL_M + 0.5


def test_heights_that_differ_make_the_level_uncertain():
    shore = LEVEL_M + np.linspace(0.0, 1.0, 401)
    found = water_level(heights(shore), OPTIONS)
    assert found.height_m == pytest.approx(LEVEL_M + SHORE_QUANTILE, abs=0.01)
    assert found.sigma_m == pytest.approx(SHORE_QUANTILE, abs=0.01)


def test_a_precise_height_counts_more():
    shore = np.r_[np.full(50, LEVEL_M), np.full(50, LEVEL_M - 3.0)]
    known = heights(shore)
    noisy = replace(known, shore_sigma=np.r_[np.full(50, 0.1), np.full(50, 2.0)].astype(np.float32))
    assert water_level(known, OPTIONS).height_m == pytest.approx(LEVEL_M - 3.0, abs=EXACT_M)
    assert water_level(noisy, OPTIONS).height_m == pytest.approx(LEVEL_M, abs=EXACT_M)


def test_still_water_with_texture_has_its_median():
    inside = LEVEL_M + np.array([-0.2, 0.0, 0.2] * 200)
    found = water_level(heights(np.full(200, LEVEL_M + 0.5), inside=inside), OPTIONS)
    assert (found.source, found.n_used, found.inside_share) == ("inside", 600, 0.6)
    assert found.height_m == pytest.approx(LEVEL_M, abs=EXACT_M)
    assert found.sigma_m == pytest.approx(1.4826 * 0.2, abs=EXACT_M)
    # Of moving water a small share is confident by chance, and does not count.
    few = water_level(heights(np.full(200, LEVEL_M), inside=np.full(300, LEVEL_M + 5.0)), OPTIONS)
    assert (few.source, few.height_m) == ("rim", pytest.approx(LEVEL_M, abs=EXACT_M))


def test_too_few_heights_tell_no_level():
    few = OPTIONS.min_shore_cells - 1
    assert water_level(heights(np.full(few, LEVEL_M), np.full(few, LEVEL_M)), OPTIONS) is None
    assert water_level(heights(), OPTIONS) is None
    assert water_level(heights(inside=np.full(few, LEVEL_M), n_inside=few), OPTIONS) is None
    assert water_level(heights(np.full(few, LEVEL_M)), replace(OPTIONS, min_shore_cells=few)) is not None


def test_doubtful_heights_do_not_count():
    flags = [0, Quality.UNREFINED, Quality.IMAGE_EXCLUDED, *(flag for flag in Quality if flag not in (
        Quality.UNREFINED, Quality.IMAGE_EXCLUDED))]  # fmt: skip
    quality = np.array([flags], np.uint16)
    sure = is_confident(np.ones(quality.shape, np.float32), quality)
    np.testing.assert_array_equal(sure[0], [True] * 3 + [False] * (len(flags) - 3))
    assert not is_confident(np.full((1, 1), np.nan, np.float32), np.zeros((1, 1), np.uint16)).any()


def test_imprecise_heights_of_several_pairs_tell_no_level():
    sigma, views = np.array([[0.1, 0.25, 0.26, 0.26]], np.float32), np.array([[3, 3, 3, 2]], np.uint8)
    is_sure = np.ones(sigma.shape, bool)
    np.testing.assert_array_equal(tells_level(is_sure, sigma, views, 0.5), [[True, True, False, True]])
    assert not tells_level(~is_sure, sigma, views, 0.5).any()


@pytest.mark.parametrize("width", [1.0, 2.5, 3.0])
def test_shores_are_those_of_a_slow_twin(width):
    rng = np.random.default_rng(4)
    any_water = np.zeros((30, 37), bool)
    any_water[5:20, 8:30] = True
    any_water[9:12, 14:18] = False  # an island
    any_water[0:4, 30:] = True  # a pond at the border of the arrays
    surface = any_water & (np.arange(37) < 20 + rng.integers(0, 3, (30, 1)))  # of two that touch, the western one
    found = shore_cells(surface, any_water, width)
    rows, cols = np.indices(any_water.shape)
    for row, col in np.ndindex(any_water.shape):
        near = np.hypot(rows - row, cols - col) <= width
        assert found.water[row, col] == (surface[row, col] and bool((near & ~any_water).any()))
        assert found.land[row, col] == (not any_water[row, col] and bool((near & surface).any()))
