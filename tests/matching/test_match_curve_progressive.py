"""Progressive matching: the mean built image by image, its stop, and images that are never evaluated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from reference import selection as plain
from zlocus.core.options import SelectionOptions
from zlocus.matching.match_curve import FAIR, GOOD, POOR, ProgressiveMean, SearchPlan, match_progressively
from zlocus.matching.view_ranking import FeaturePoints, order_images

OPTIONS = SelectionOptions()
# No correlation is above 1, so nothing is ever good.
NEVER = SelectionOptions(rho1_high=1.0, rho1_middle=1.0, rho1_low=1.0)
N_HEIGHTS, STEP_PX = 81, 0.5
# A mean of a few numbers of size 1, in any order.
ROUNDING = 1e-14


def curve(*peaks, floor=-0.5):
    """A curve with one-sample peaks (sample, value) on an even floor."""
    values = np.full(N_HEIGHTS, floor)
    for at, value in peaks:
        values[at] = value
    return values


class Volume:
    """NCC of every image at every cell, (i, n, h), and a record of what was asked for."""

    def __init__(self, ncc):
        self.ncc = np.asarray(ncc, float)
        self.asked = []

    def __call__(self, cells, images):
        self.asked += list(zip(cells.tolist(), images.tolist(), strict=True))
        return self.ncc[images, cells]


def plan_of(order, seen, step_px=STEP_PX, block=None, sample=None):
    n, i = np.shape(seen)
    return SearchPlan(
        order=np.asarray(order),
        block=np.arange(n) if block is None else np.asarray(block),
        covered=np.asarray(seen),
        step_px=np.broadcast_to(np.asarray(step_px, float), i),
        sample=np.ones(n, bool) if sample is None else np.asarray(sample),
    )


def matched(volume, plan, options=OPTIONS):
    return match_progressively(volume, volume.ncc.shape[2], plan, options)


# --- equation (3) ---

# Some samples are not valid, and some images nowhere.
VOLUMES = arrays.arrays(
    np.float64,
    st.tuples(st.integers(1, 7), st.integers(1, 4), st.integers(1, 9)),
    elements=st.one_of(st.floats(-1, 1), st.just(np.nan)),
)


@given(VOLUMES, st.randoms(use_true_random=False))
def test_equation_3_is_equation_2_in_any_order(ncc, random):
    n = ncc.shape[1]
    mean = ProgressiveMean.empty(n, ncc.shape[2])
    for image in random.sample(range(len(ncc)), len(ncc)):
        mean.add(np.arange(n), ncc[image])
    count = (~np.isnan(ncc)).sum(axis=0)
    expected = np.where(count > 0, np.nansum(ncc, axis=0) / np.maximum(count, 1), np.nan)
    np.testing.assert_allclose(mean.of(np.arange(n)), expected, rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(mean.count, count)


@given(VOLUMES, st.randoms(use_true_random=False))
def test_all_images_are_used_where_nothing_stops(ncc, random):
    n_images, n = ncc.shape[:2]
    order = [random.sample(range(n_images), n_images) for _ in range(n)]
    found = matched(Volume(ncc), plan_of(order, np.ones((n, n_images), bool)), NEVER)
    count = (~np.isnan(ncc)).sum(axis=0)
    expected = np.where(count > 0, np.nansum(ncc, axis=0) / np.maximum(count, 1), np.nan)
    np.testing.assert_allclose(found.mean_ncc, expected, rtol=0, atol=ROUNDING)
    assert not found.is_stopped.any()
    assert found.evaluations == found.evaluations_all == ncc.size
    assert found.saved == 0.0
    assert found.n_images.tolist() == (~np.isnan(ncc)).any(axis=2).sum(axis=0).tolist()


def test_an_image_adds_to_its_cells_only():
    mean = ProgressiveMean.empty(3, 2)
    mean.add(np.array([2, 0]), np.array([[0.5, np.nan], [0.25, 0.75]]))
    mean.add(np.array([2]), np.array([[1.0, -1.0]]))
    expected = [[0.25, 0.75], [np.nan, np.nan], [0.75, -1.0]]
    np.testing.assert_array_equal(mean.of(np.arange(3)), expected)


# --- stop ---


def test_the_selected_images_of_the_paper_are_enough():
    """Ji et al. 2014, table 3 orders the images, and the mean of two has the rho1 and rho2 of figure 6: stop there.

    The single curves of figure 6 are not printed: these share its mean, and neither is good alone.
    """
    around = np.array([[-3.0, -2.0], [4.0, -1.0], [0.0, 5.0]])
    labels = np.array([[1, 0, 1, 0, 0], [1, 1, 1, 1, 1], [0, 1, -1, -1, -1]], np.int8)
    order = order_images(FeaturePoints(around, labels), np.zeros((1, 2)), OPTIONS).images
    b1 = curve((40, 0.70), (55, 0.66), floor=-0.4)
    f1 = curve((40, 2 * 0.7322 - 0.70), (55, 2 * 0.1618 - 0.66), (20, 0.5), floor=-0.4)
    poor = curve((10, 0.4), (70, 0.39))
    volume = Volume(np.array([b1, f1, poor, poor, poor])[:, None])
    found = matched(volume, SearchPlan.by_cell(order, np.ones((1, 5), bool), np.full(5, STEP_PX)))
    assert sorted(volume.asked) == [(0, 0), (0, 1)]
    assert (found.n_images.tolist(), found.n_added.tolist()) == ([2], [2])
    assert found.label.tolist() == [GOOD]
    assert found.is_stopped.all()
    assert found.mean_ncc[0, [40, 55]] == pytest.approx([0.7322, 0.1618], abs=1e-12)
    assert (found.evaluations, found.evaluations_all) == (2 * N_HEIGHTS, 5 * N_HEIGHTS)
    assert found.saved == pytest.approx(0.6)


GOOD_ALONE, NOT_ALONE, BAD = curve((40, 0.95)), curve((40, 0.7), (60, 0.6)), curve((10, 0.4), (70, 0.39))


def test_each_cell_stops_by_itself():
    """A cell that one image is enough for, one that needs the second, one that nothing is enough for."""
    ncc = np.array([[GOOD_ALONE, NOT_ALONE, BAD], [BAD, GOOD_ALONE, BAD]])
    volume = Volume(ncc)
    found = matched(volume, plan_of([[0, 1]] * 3, np.ones((3, 2), bool)))
    assert volume.asked == [(0, 0), (1, 0), (2, 0), (1, 1), (2, 1)]
    assert found.n_images.tolist() == [1, 2, 2]
    assert found.is_stopped.tolist() == [True, True, False]
    assert found.label.tolist() == [GOOD, GOOD, POOR]
    np.testing.assert_array_equal(found.mean_ncc[0], GOOD_ALONE)


def test_images_that_do_not_cover_a_cell_are_not_evaluated():
    ncc = np.array([[BAD, GOOD_ALONE], [GOOD_ALONE, BAD], [BAD, BAD]])
    volume = Volume(ncc)
    seen = np.array([[False, True, True], [False, False, False]])
    found = matched(volume, plan_of([[0, 1, 2]] * 2, seen))
    assert volume.asked == [(0, 1)]
    assert found.n_images.tolist() == [1, 0]
    assert found.evaluations_all == 2 * N_HEIGHTS
    assert np.isnan(found.mean_ncc[1]).all()
    assert found.label.tolist() == [GOOD, POOR]


def test_occluded_heights_of_an_image_do_not_lower_the_mean():
    hidden = curve((40, 0.1))
    hidden[:50] = np.nan
    found = matched(Volume(np.array([[hidden], [curve((40, 0.95))]])), plan_of([[0, 1]], np.ones((1, 2), bool)))
    assert found.mean_ncc[0, 40] == 0.95
    assert found.n_images.tolist() == [2]
    nowhere = np.full(N_HEIGHTS, np.nan)
    found = matched(Volume(np.array([[nowhere], [GOOD_ALONE]])), plan_of([[0, 1]], np.ones((1, 2), bool)))
    assert found.n_images.tolist() == [1]
    assert found.evaluations == 2 * N_HEIGHTS


def test_second_peaks_are_judged_by_the_most_sensitive_image_of_the_mean():
    """Eight steps are a pixel in the narrow image, and four in the wide one, which resolves the rival."""
    twin = curve((40, 0.95), (48, 0.93))
    ncc = np.array([[twin], [twin]])
    narrow_first, wide_first = ([[0, 1]], [[1, 0]])
    seen, step_px = np.ones((1, 2), bool), [0.125, 0.5]
    assert matched(Volume(ncc), plan_of(narrow_first, seen, step_px)).n_images.tolist() == [1]
    found = matched(Volume(ncc), plan_of(wide_first, seen, step_px))
    assert found.n_images.tolist() == [2]
    assert found.label.tolist() == [FAIR]


@given(
    arrays.arrays(
        np.float64, st.tuples(st.integers(1, 4), st.integers(1, 4), st.integers(3, 12)),
        elements=st.one_of(st.integers(-8, 16).map(lambda v: v / 16), st.just(np.nan)),
    ),
    st.randoms(use_true_random=False),
)  # fmt: skip
def test_as_in_plain_loops(ncc, random):
    n_images, n, n_heights = ncc.shape
    order = [random.sample(range(n_images), n_images) for _ in range(n)]
    seen = np.array([[random.random() < 0.8 for _ in range(n_images)] for _ in range(n)])
    step_px = np.array([random.choice([0.5, 1.0]) for _ in range(n_images)])
    volume = Volume(ncc)
    found = matched(volume, plan_of(order, seen, step_px))
    for cell in range(n):
        values, used, is_stopped = plain.matched(
            ncc[:, cell].tolist(), order[cell], seen[cell].tolist(), step_px.tolist(), OPTIONS
        )
        np.testing.assert_allclose(found.mean_ncc[cell], values, rtol=0, atol=ROUNDING)
        assert [image for at, image in volume.asked if at == cell] == used
        assert found.is_stopped[cell] == is_stopped == (found.label[cell] == GOOD)
    assert found.evaluations == len(volume.asked) * n_heights
    assert found.evaluations_all == seen.sum() * n_heights


# --- blocks ---


def block_volume(n_good, n_cells, n_images=3):
    """Cells of which the first are good after any image, the others after none."""
    row = [GOOD_ALONE] * n_good + [BAD] * (n_cells - n_good)
    return Volume(np.array([row] * n_images))


@pytest.mark.parametrize(("n_good", "n_added"), [(20, 1), (19, 1), (18, 3)])
def test_a_block_stops_when_95_of_100_cells_have(n_good, n_added):
    volume, options = block_volume(n_good, 20), SelectionOptions(stopped_share=0.95)
    found = matched(volume, plan_of([[2, 0, 1]], np.ones((20, 3), bool), block=np.zeros(20, int)), options)
    assert found.n_added.tolist() == [n_added]
    assert found.n_images.tolist() == [n_added] * 20
    assert found.evaluations == n_added * 20 * N_HEIGHTS
    assert {image for _, image in volume.asked} == set([2, 0, 1][:n_added])


def test_blocks_have_their_own_order_and_stop():
    volume = block_volume(4, 8)
    found = matched(volume, plan_of([[0, 1, 2], [2, 1, 0]], np.ones((8, 3), bool), block=[0] * 4 + [1] * 4))
    assert found.n_added.tolist() == [1, 3]
    assert volume.asked[:8] == [(cell, 0) for cell in range(4)] + [(cell, 2) for cell in range(4, 8)]


def test_the_share_is_an_option():
    plan = plan_of([[0, 1, 2]], np.ones((20, 3), bool), block=np.zeros(20, int))
    assert matched(block_volume(10, 20), plan, SelectionOptions(stopped_share=0.5)).n_added.tolist() == [1]
    assert matched(block_volume(9, 20), plan, SelectionOptions(stopped_share=0.5)).n_added.tolist() == [3]


def test_the_sample_decides_for_its_block():
    sample = np.zeros(20, bool)
    sample[:4] = True
    block = np.repeat([0, 1], 10)
    found = matched(block_volume(4, 20), plan_of([[0, 1, 2]] * 2, np.ones((20, 3), bool), block=block, sample=sample))
    assert found.n_added.tolist() == [1, 3], "a block without a sample adds all"
    assert found.is_stopped.sum() == 4


def test_cells_outside_the_sample_do_not_decide():
    """14 of 20 cells are good, and 3 are seen by nothing, but the sample is none of them."""
    sample, seen = np.arange(20) >= 17, np.ones((20, 3), bool)
    seen[14:17] = False
    found = matched(block_volume(14, 20), plan_of([[0, 1, 2]], seen, block=np.zeros(20, int), sample=sample))
    assert found.n_added.tolist() == [3]
    assert not found.is_stopped.any()


def test_a_cell_that_has_stopped_stays_stopped():
    """The first image is enough for one cell, the second for the other, and spoils the first."""
    ncc = np.array([[GOOD_ALONE, BAD], [curve((10, 0.9), floor=0.0), curve((10, 0.99), floor=-0.9)], [BAD, BAD]])
    found = matched(Volume(ncc), plan_of([[0, 1, 2]], np.ones((2, 3), bool), block=[0, 0]))
    assert found.is_stopped.tolist() == [True, True]
    assert found.n_added.tolist() == [2]
    assert found.label[0] != GOOD


def test_cells_without_further_images_do_not_delay_their_block():
    seen = np.ones((4, 3), bool)
    seen[3, 1:] = False
    seen[2] = False
    volume = block_volume(2, 4)
    found = matched(volume, plan_of([[0, 1, 2]], seen, block=np.zeros(4, int)))
    assert found.n_added.tolist() == [1]
    assert found.n_images.tolist() == [1, 1, 0, 1]


def test_a_block_that_no_image_covers_adds_none():
    found = matched(block_volume(1, 3), plan_of([[0, 1, 2]], np.zeros((3, 3), bool), block=np.zeros(3, int)))
    assert (found.n_added.tolist(), found.evaluations, found.saved) == ([0], 0, 0.0)


def test_an_order_of_some_images_only():
    volume = block_volume(0, 2, n_images=5)
    found = matched(volume, plan_of([[4, 1]] * 2, np.ones((2, 5), bool)))
    assert {image for _, image in volume.asked} == {4, 1}
    assert found.evaluations_all == 2 * 2 * N_HEIGHTS
