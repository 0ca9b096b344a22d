"""What is learned from the images: tables of log-likelihood ratios, noise, and the heights that teach them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zlocus.core.grid import CellWindow
from zlocus.matching import evidence
from zlocus.matching.evidence import (
    BEST_SHARE,
    BEST_SHARE_OF_MANY,
    MAX_LOG_RATIO,
    best_share_of,
    grey_units,
    heights_to_learn_from,
    log_of_sampling,
    log_ratios,
    noise_variance,
    rough_ratios,
    rough_share,
    sampled_blocks,
    smoothed_counts,
    worth_of_pairs,
)
from zlocus.matching.kernels.evidence import N_LIKENESS, TABLE_SHAPE
from zlocus.matching.occlusion import MANY_VIEWS

# Relative: a low quantile of variances of 25 values is below that of the noise, and is rounded.
NOISE_SHARE = 0.6
# Natural units.
MORE_LIKELY = 0.5


def counts(seed, total=200_000):
    share = np.random.default_rng(seed).gamma(0.3, size=TABLE_SHAPE)
    return np.rint(share / share.sum() * total).astype(np.int64)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_mean_of_wrong_heights_is_nothing(seed):
    wrong = counts(seed)
    ratios, neutral = log_ratios(counts(seed + 1), wrong, 20.0)
    smooth = smoothed_counts(wrong)
    assert (smooth * ratios).sum() / smooth.sum() == pytest.approx(0.0, abs=1e-4)
    assert np.abs(ratios - np.float32(neutral)).max() <= MAX_LOG_RATIO + 1e-4


def test_bins_as_frequent_at_wrong_heights_say_nothing():
    """The plain windows of a road look the same at all heights; windows with texture do not."""
    right, wrong = np.zeros(TABLE_SHAPE, np.int64), np.zeros(TABLE_SHAPE, np.int64)
    right[1], wrong[1] = 40, 400
    right[10, :, :, 15:], wrong[10, :, :, 5:15] = 300, 1500
    ratios, neutral = log_ratios(right, wrong, 20.0)
    plain = ratios[1] - neutral
    assert np.abs(plain - plain.mean()).max() < 0.05
    assert ratios[10, :, :, N_LIKENESS - 2].min() > neutral + 2
    assert ratios[10, :, :, 8].max() < neutral - 2


def test_of_two_heights_of_a_tree_the_more_alike_is_the_more_likely():
    """Counted right heights are those of smooth ground, and a few that are wrong after all.

    Below the likeness of smooth ground their frequencies fall like those of wrong heights, so that they alone do not
    tell a likeness that a tree has at its height from one that it has elsewhere.
    """
    right, wrong = np.zeros(TABLE_SHAPE, np.int64), np.zeros(TABLE_SHAPE, np.int64)
    wrong[:] = np.rint(6000 * np.exp(-0.5 * ((np.arange(N_LIKENESS) - 8) / 3.0) ** 2))
    right[:, :, :, -3:] = 4000
    right += wrong // 20
    ratios, _ = log_ratios(right, wrong, 20.0)
    textured, plain = ratios[11, 0, 3], ratios[2, 0, 3]
    assert textured[13] - textured[8] > MORE_LIKELY
    assert plain[13] - plain[8] < MORE_LIKELY / 2


def test_rough_surfaces_of_plain_windows_say_nothing():
    """Where right and wrong heights look the same, rough surfaces do so too."""
    alike = counts(3).astype(float)
    assert np.abs(rough_ratios(alike, 3 * alike, 20.0) - 1).max() < 1e-9
    assert rough_share()[:5].max() == 0
    assert 0 < rough_share()[8:].min() <= rough_share().max() < 1


def test_bins_that_no_image_filled_say_nothing():
    right, wrong = np.zeros(TABLE_SHAPE, np.int64), np.zeros(TABLE_SHAPE, np.int64)
    right[5, 0, 3, 10], wrong[5, 0, 3, 4] = 5000, 5000
    ratios, neutral = log_ratios(right, wrong, 20.0)
    assert ratios[0, 2, 12] == pytest.approx(np.full(N_LIKENESS, neutral), abs=1e-5)


def test_pairs_are_worth_what_their_likeness_tells():
    """Likeness of two Gauss distributions d standard deviations apart has the divergence d squared."""
    likeness, rng = np.arange(N_LIKENESS) + 0.5, np.random.default_rng(8)
    right, wrong = np.zeros((3, 3, N_LIKENESS), np.int64), np.zeros((3, 3, N_LIKENESS), np.int64)
    for (a, b), apart in {(0, 1): 1.5, (0, 2): 0.0}.items():
        for counts, middle in ((right, 10.0 + 3.0 * apart / 2), (wrong, 10.0 - 3.0 * apart / 2)):
            drawn = np.clip(rng.normal(middle, 3.0, 500_000), likeness[0], likeness[-1])
            counts[a, b] = np.histogram(drawn, N_LIKENESS, (0, N_LIKENESS))[0]
    worth = worth_of_pairs(right, wrong)
    np.testing.assert_array_equal(worth, worth.T)
    assert worth[0, 1] == pytest.approx(1.5**2, rel=0.05)
    assert worth[0, 2] < 0.01
    # Nothing was counted of this pair: it is worth what all pairs together are.
    assert worth[1, 2] == pytest.approx(
        worth_of_pairs(*(c.sum(axis=(0, 1)) * np.ones((2, 2, 1), int) for c in (right, wrong)))[0, 1], rel=0.02
    )


def test_the_usual_grey_difference_of_a_pair_is_its_unit():
    """Pairs that were often counted have their own, and pairs that were never counted that of all pairs."""
    n, roots = np.zeros((3, 3), int), np.zeros((3, 3))
    n[0, 1], n[0, 2] = 10**6, 10**6
    roots[0, 1], roots[0, 2] = 0.2 * 10**6, 0.6 * 10**6
    unit = grey_units(roots, n)
    np.testing.assert_array_equal(unit, unit.T)
    np.testing.assert_allclose(unit[np.triu_indices(3, 1)], [0.5**2, 1.5**2, 1.0], rtol=0.01)
    np.testing.assert_array_equal(grey_units(np.zeros((3, 3)), n), np.ones((3, 3)))


def views_of(*images):
    """What `noise_variance` reads of the views of a tile."""
    layout, start = [], 0
    for image in images:
        layout.append((start, *image.shape))
        start += image.size
    pixels = np.concatenate([image.ravel() for image in images]).astype(np.float32)
    return SimpleNamespace(layout=np.array(layout), arrays=SimpleNamespace(pixels=pixels))


def test_noise_is_what_the_plainest_windows_show():
    rng, deviation = np.random.default_rng(3), 0.05
    image = rng.normal(0.0, deviation, (200, 200))
    image[:150] += rng.normal(0.0, 1.0, (150, 200))
    found = float(noise_variance(views_of(image, image[::-1].copy())))
    assert NOISE_SHARE * deviation**2 < found <= deviation**2


def test_images_of_one_grey_value_have_the_least_noise():
    assert float(noise_variance(views_of(np.full((20, 20), 2.0)))) == pytest.approx(evidence.LEAST_VARIANCE)


@pytest.mark.parametrize(
    ("side", "n_views", "share"),
    [(100, 3, 1.0), (420, 2, 0.5), (800, 12, 0.125), (1600, 3, 1 / 16), (4000, 3, 1 / 16), (420, 24, 1 / 8)],
)
def test_a_part_of_the_blocks_of_large_levels_is_counted(side, n_views, share):
    reference = np.ones((side, side), np.float32)
    taken = np.isfinite(sampled_blocks(reference, 8, log_of_sampling(reference.size, n_views)))
    assert taken.mean() == pytest.approx(share, abs=0.01)
    for quarter in (taken[: side // 2], taken[:, : side // 2]):
        assert quarter.mean() == pytest.approx(share, abs=0.02)


def test_a_part_of_the_counts_with_its_part_of_the_prior_says_the_same():
    right, wrong = counts(5), counts(6)
    whole, of_quarter = log_ratios(4 * right, 4 * wrong, 40.0), log_ratios(right, wrong, 10.0)
    np.testing.assert_allclose(whole[0], of_quarter[0], rtol=0, atol=1e-5)
    assert whole[1] == pytest.approx(of_quarter[1], abs=1e-6)


def result_with(height, number=1):
    window = CellWindow(0, 0, *height.shape)
    level = SimpleNamespace(number=number, window=window)
    return SimpleNamespace(level=level, heights=SimpleNamespace(vertex=height.astype(np.float32)))


def test_heights_at_jumps_teach_nothing():
    height = np.full((200, 200), 10.0)
    height[:, 100:] = 30.0
    level = SimpleNamespace(number=0, window=CellWindow(0, 0, 400, 400), shape=(400, 400), core=np.s_[40:360, :])
    slope = SimpleNamespace(cells=np.full((400, 400), 3.0, np.float32))
    found = heights_to_learn_from(result_with(height), level, slope).height
    assert np.isnan(found[:, 198:202]).all()
    assert np.isnan(found[:40]).all()
    assert np.isnan(found[360:]).all()
    assert (found[40:360, :198] == 17.0).all()
    assert (found[40:360, 202:] == 57.0).all()
    again = SimpleNamespace(number=1, window=CellWindow(0, 0, 200, 200), shape=(200, 200), core=np.s_[:, :])
    slope = SimpleNamespace(cells=np.zeros((200, 200), np.float32))
    assert (heights_to_learn_from(result_with(height), again, slope).height[:, :99] == 10.0).all()


def test_few_cells_teach_nothing():
    level = SimpleNamespace(number=1, window=CellWindow(0, 0, 140, 140), shape=(140, 140), core=np.s_[:, :])
    slope = SimpleNamespace(cells=np.zeros((140, 140), np.float32))
    assert heights_to_learn_from(result_with(np.zeros((140, 140))), level, slope) is None


def test_of_many_views_a_smaller_share_of_the_pairs_counts():
    assert best_share_of(2) == best_share_of(MANY_VIEWS - 1) == BEST_SHARE
    assert best_share_of(MANY_VIEWS) == BEST_SHARE_OF_MANY < BEST_SHARE
