"""The pointing of a pair among wrong matches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orientation_scenes import AffineSensor, observe, random_ground
from zlocus.orientation.epipolar import EpipolarOffsets, Sightlines, epipolar_offsets
from zlocus.orientation.ransac import find_shift

N = 400


def matches(shift, wrong_share, normal, noise_px=0.0, seed=3):
    """Distances from loci after a shift (2,) px; a share of the matches lies anywhere within 30 px."""
    rng = np.random.default_rng(seed)
    across = normal @ np.asarray(shift) + rng.normal(0.0, 1.0, len(normal)) * noise_px
    wrong = rng.permutation(len(normal)) < wrong_share * len(normal)
    across[wrong] = rng.uniform(-30.0, 30.0, wrong.sum())
    return EpipolarOffsets(np.zeros(len(normal)), across, normal), wrong


@pytest.mark.parametrize("wrong_share", [0.0, 0.5, 0.8])
def test_the_part_across_parallel_loci_is_found_and_the_rest_is_not(wrong_share):
    across, along = np.array([0.6, 0.8]), np.array([0.8, -0.6])
    found, wrong = matches(5.0 * across + 7.0 * along, wrong_share, np.tile(across, (N, 1)))
    pair = find_shift(found, 30.0, 1.0)
    assert pair.inliers[~wrong].all()
    assert pair.shift_px @ along == pytest.approx(0.0, abs=1e-9)
    assert pair.shift_px @ across == pytest.approx(5.0, abs=0.3)  # chance inliers within a pixel pull a little


def test_loci_of_many_directions_show_both_components():
    angle = np.linspace(0.0, 1.5, N)
    found, wrong = matches((4.0, -6.0), 0.8, np.column_stack([np.cos(angle), np.sin(angle)]))
    pair = find_shift(found, 30.0, 0.5)
    assert pair.shift_px == pytest.approx([4.0, -6.0], abs=0.2)
    assert pair.inliers[~wrong].all()


@given(st.floats(-20, 20))
def test_without_wrong_matches_the_shift_is_exact(offset):
    normal = np.tile([0.0, 1.0], (50, 1))
    found, _ = matches((0.0, offset), 0.0, normal)
    assert find_shift(found, 30.0, 1.0).shift_px == pytest.approx([0.0, offset], abs=1e-9)


@pytest.mark.parametrize("n", [100, 1000, 5000])
def test_matches_of_unrelated_images_are_not_taken_for_a_shift(n):
    """Best of all shifts, some matches always agree: chance is told from truth by how many lie elsewhere."""
    normal = np.tile([0.6, 0.8], (n, 1))
    for seed in range(10):
        unrelated, _ = matches((0.0, 0.0), 1.0, normal, seed=seed)
        assert not find_shift(unrelated, 30.0, 1.0).is_certain(12)
        related, _ = matches((3.0, 4.0), 0.6, normal, seed=seed)
        assert find_shift(related, 30.0, 1.0).is_certain(12)


def test_the_same_matches_give_the_same_answer():
    found, _ = matches((3.0, 1.0), 0.7, np.tile([1.0, 0.0], (N, 1)), noise_px=0.3)
    one, two = find_shift(found, 30.0, 1.0), find_shift(found, 30.0, 1.0)
    assert (one.shift_px == two.shift_px).all()
    assert (one.inliers == two.inliers).all()


def test_matches_without_a_locus_or_beyond_the_pointing_limit_are_never_right():
    found, _ = matches((0.0, 2.0), 0.0, np.tile([0.0, 1.0], (20, 1)))
    found.distance_px[:5] = np.nan
    found.distance_px[5:10] = 31.0
    assert find_shift(found, 30.0, 1.0).inliers.tolist() == [False] * 10 + [True] * 10
    assert not find_shift(EpipolarOffsets(np.zeros(1), np.zeros(1), np.ones((1, 2))), 30.0, 1.0).inliers.any()


def test_distance_and_height_are_those_of_the_planted_point():
    sensors = [AffineSensor(0.1, -0.05), AffineSensor(-0.2, 0.1, (9.0, 4.0), 25.0)]
    xyz = random_ground(60)
    seen = observe(sensors, xyz)
    in_a, in_b = seen.xy[:60], seen.xy[60:]
    lines = Sightlines.of(sensors[0], in_a, (0.0, 300.0))
    exact = epipolar_offsets(lines, sensors[1], in_b, (0.0, 300.0))
    assert np.abs(exact.z - xyz[:, 2]).max() < 1e-6
    assert np.abs(exact.distance_px).max() < 1e-6
    moved = epipolar_offsets(lines, sensors[1], in_b + 2.5 * exact.normal, (0.0, 300.0))
    assert np.abs(moved.distance_px - 2.5).max() < 1e-6
    assert np.abs(moved.z - xyz[:, 2]).max() < 1e-6


def test_parallel_rays_have_no_locus():
    sensors = [AffineSensor(0.1, 0.0), AffineSensor(0.1, 0.0, (5.0, 5.0))]
    xy = np.zeros((3, 2))
    lines = Sightlines.of(sensors[0], xy, (0.0, 300.0))
    assert np.isnan(epipolar_offsets(lines, sensors[1], xy, (0.0, 300.0)).distance_px).all()
