"""Shifts solved jointly with the ground, and what must not be applied."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orientation_scenes import AffineSensor, observe, random_ground, translation_effect, without_translation
from zlocus.core.options import OrientationOptions
from zlocus.orientation.shift_adjustment import adjust
from zlocus.orientation.triangulate import Observations, triangulate
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel, rotation_from_angles

OPTIONS = OrientationOptions()
LOOKS = ((0.0, 0.0), (0.3, 0.05), (-0.25, 0.1), (0.1, 0.3))
PRIOR_PULL_PX = 0.002  # the prior of 20 px against some hundred ties


def block(shifts, n=200, noise_px=0.0, looks=LOOKS):
    """Models that need `shifts` (i, 2) px, what their cameras saw, and the ground."""
    exact = [AffineSensor(*look) for look in looks[: len(shifts)]]
    xyz = random_ground(n)
    delivered = [ShiftedModel(s, -column, -row) for s, (column, row) in zip(exact, shifts, strict=True)]
    return delivered, observe(exact, xyz, noise_px), xyz


@given(st.lists(st.floats(-10, 10), min_size=8, max_size=8))
def test_shifts_of_a_block_are_recovered_up_to_a_translation(numbers):
    planted = np.reshape(numbers, (4, 2))
    sensors, seen, xyz = block(planted, n=60)
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert found.n_determined == 5
    assert np.abs(without_translation(found.shift_px - planted, sensors)).max() < PRIOR_PULL_PX * 10
    assert np.hypot(*found.after_px.T).max() < 0.05


def test_one_tie_in_five_may_be_wrong():
    planted = np.array([[2.0, -3.0], [-4.0, 1.0], [0.5, 5.0], [1.0, 1.0]])
    sensors, seen, xyz = block(planted, n=300, noise_px=0.2)
    rng = np.random.default_rng(4)
    wrong = rng.choice(len(seen), len(seen) // 20, replace=False)
    seen.xy[wrong] += rng.uniform(-60.0, 60.0, (len(wrong), 2))
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert np.abs(without_translation(found.shift_px - planted, sensors)).max() < 0.05
    assert len(found.observations) < len(seen) - 0.8 * len(wrong)
    assert np.median(np.hypot(*found.before_px.T)) > 1.0
    assert np.median(np.hypot(*found.after_px.T)) < 0.3


def test_small_errors_on_one_side_hardly_pull():
    """One tie in seven of an image lies 0.9 px off, too little to be dropped: the plain mean would move by 0.13 px."""
    planted = np.array([[2.0, -3.0], [-4.0, 1.0], [0.5, 5.0], [1.0, 1.0]])
    sensors, seen, xyz = block(planted, n=700, noise_px=0.1)
    seen.xy[(seen.view == 1) & (seen.point % 7 == 0)] += np.array([0.0, 0.9])
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert len(found.observations) > 0.99 * len(seen)
    assert np.abs(without_translation(found.shift_px - planted, sensors)).max() < 0.03


def test_a_tight_prior_holds_shifts_back():
    sensors, seen, xyz = block(np.array([[0.0, 2.0], [0.0, -2.0]]), n=12, noise_px=0.5, looks=((-0.2, 0.0), (0.2, 0.0)))
    free = adjust(sensors, seen, xyz, OPTIONS)
    held = adjust(sensors, seen, xyz, OrientationOptions(sigma_shift_px=0.1))
    assert free.shift_px[:, 1] == pytest.approx([2.0, -2.0], abs=0.3)
    assert 0.05 < held.shift_px[0, 1] < 1.8


def test_two_images_get_no_shift_along_the_locus_and_heights_stay():
    along = np.array([1.0, 0.0])  # rays that lean east: the locus runs along the columns
    sensors, seen, xyz = block(
        np.array([[0.0, 0.0], 4.0 * along + np.array([0.0, 3.0])]), looks=((0.0, 0.0), (0.3, 0.0))
    )
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert found.n_determined == 1
    assert np.abs(found.shift_px[:, 0]).max() < 1e-9
    assert found.shift_px[:, 1] == pytest.approx([-1.5, 1.5], abs=PRIOR_PULL_PX)
    uncorrected = triangulate(sensors, seen, xyz)
    assert np.abs(found.ground_points.xyz[:, 2] - uncorrected.xyz[:, 2]).max() < 1e-6


def test_the_datum_is_the_smallest_shifts():
    sensors, seen, xyz = block(np.array([[2.0, -3.0], [-4.0, 1.0], [0.5, 5.0]]))
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert translation_effect(sensors).T @ found.shift_px.ravel() == pytest.approx(np.zeros(3), abs=1e-6)


@pytest.mark.parametrize("bend", [0.0, 1e-4, 2e-3])
def test_nearly_parallel_loci_do_not_amplify_noise(bend):
    """A pair whose loci turn a little over the image, as an RPC's do, and ties with a smooth error of 0.2 px."""

    class Bent(AffineSensor):
        def image_from_ground(self, xyz):
            flat = super().image_from_ground(xyz)
            return flat + np.column_stack([0.0 * flat[:, 0], bend * flat[:, 0] * (xyz[:, 2] - 130.0) / 30.0])

    sensors = [AffineSensor(0.0, 0.0), Bent(0.1, 0.0)]
    xyz = random_ground(300)
    seen = observe(sensors, xyz, noise_px=0.2)
    second = seen.view == 1
    seen.xy[second, 1] += 0.2 * np.sin(seen.xy[second, 0] / 60.0) * np.sign(xyz[:, 2] - 130.0)
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert found.n_determined == 1
    assert np.abs(found.shift_px).max() < 0.1


def test_a_triplet_on_one_line_shows_three_components():
    planted = np.array([[1.0, 0.5], [-0.7, -1.2], [0.4, 0.3]])
    looks = ((-0.06, 0.0), (0.0, 0.0005), (0.055, 0.0))
    sensors, seen, xyz = block(planted, n=800, noise_px=0.3, looks=looks)
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert found.n_determined == 3
    assert np.abs(without_translation(found.shift_px - planted, sensors)).max() < 0.05


def test_a_long_chain_keeps_its_slow_bends():
    n_views, planted = 12, np.column_stack([np.zeros(12), np.linspace(-3.0, 3.0, 12) ** 2])
    exact = [AffineSensor(0.15 * (-1) ** i, 0.0) for i in range(n_views)]
    sensors = [ShiftedModel(s, *(-shift)) for s, shift in zip(exact, planted, strict=True)]
    xyz = random_ground(40 * (n_views - 1))
    point = np.concatenate([np.arange(40) + 40 * k for k in range(n_views - 1)])
    rows = observe(exact, xyz)
    keep = (rows.point // 40 == rows.view) | (rows.point // 40 == rows.view - 1)
    assert len(point) * 2 == keep.sum()
    found = adjust(sensors, rows.kept(keep), xyz, OPTIONS)
    difference = np.diff(found.shift_px[:, 1] - planted[:, 1])
    assert np.abs(difference).max() < 0.05


def test_an_image_without_ties_keeps_its_model():
    planted = np.array([[2.0, 1.0], [-1.0, 3.0], [4.0, 4.0]])
    sensors, seen, xyz = block(planted)
    found = adjust(sensors, seen.kept(seen.view < 2), xyz, OPTIONS)
    assert found.shift_px[2].tolist() == [0.0, 0.0]
    assert np.abs(found.shift_px[:2]).max() > 0.5


def test_no_correction_and_no_ties():
    planted = np.array([[2.0, 1.0], [-1.0, 3.0], [4.0, 4.0]])
    sensors, seen, xyz = block(planted)
    as_delivered = adjust(sensors, seen, xyz, OrientationOptions(model="none", inlier_px=10.0))
    assert not as_delivered.shift_px.any()
    assert as_delivered.after_px == pytest.approx(as_delivered.before_px, abs=1e-6)
    nothing = Observations(np.empty(0, int), np.empty(0, int), np.empty((0, 2)))
    assert not adjust(sensors, nothing, np.empty((0, 3)), OPTIONS).shift_px.any()


def test_sensors_of_several_kinds_do_not_move_the_ground():
    """The scales of frame images beside those of parallel rays tell a height to a tenth of a metre, the cameras better:
    shifts of exact cameras are those of the noise, a hundredth of a pixel, and planted ones come back."""
    planted = np.zeros((6, 2))
    planted[4] = 1.0, -2.0
    frames = [
        FrameModel((0.0, north, 3500.0), rotation_from_angles(0.5, -0.7, 0.0), 7000.0, (0.0, 0.0))
        for north in (-1300.0, 0.0, 1300.0)
    ]
    exact = [*frames, *(AffineSensor(*look) for look in ((0.02, 0.36), (0.0, 0.0), (0.05, -0.35)))]
    xyz = random_ground(600)
    sensors = [ShiftedModel(s, *(-shift)) for s, shift in zip(exact, planted, strict=True)]
    seen = observe(exact, xyz, noise_px=0.1)
    found = adjust(sensors, seen, xyz, OPTIONS)
    assert found.n_determined == 2 * len(exact) - 3
    true = adjust(exact, seen, xyz, OPTIONS)
    assert np.abs(true.shift_px).max() < 0.02
    assert abs(np.median(true.ground_points.xyz[:, 2] - xyz[true.numbers, 2])) < 0.02
    assert np.abs(without_translation(found.shift_px - planted, exact)).max() < 0.02
