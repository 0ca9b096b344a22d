"""Each reason, and nothing else, where it applies."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.core.options import CheckOptions
from zlocus.matching.height_checks import judge, mean_around
from zlocus.matching.quality import Quality
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.subpixel import RefinedHeights

OPTIONS = CheckOptions(min_ncc=0.2, weak_ncc=0.5, min_uniqueness=64)
AT = (3, 4)


def judged(**changed):
    """Reasons of 7 x 9 good cells, of which the one at AT differs."""
    values = {
        "best": 50,
        "uniqueness": 500,
        "height": 50.2,
        "ncc": 0.9,
        "refined": True,
        "covering": 3,
        "seeing": 3,
        "group_distance": 0.5,
        "sigma_steps": 1.01,
    }
    arrays = {name: np.full((7, 9), value) for name, value in values.items()}
    for name, value in changed.items():
        if np.ndim(value):
            arrays[name] = value
        else:
            arrays[name][AT] = value
    best = arrays["best"].astype(np.int32)
    heights = SemiGlobalHeights(best, best, arrays["uniqueness"].astype(np.uint16), best.astype(np.float32))
    height, nothing = arrays["height"].astype(np.float32), np.zeros((7, 9), np.float32)
    refined = RefinedHeights(
        height,
        arrays["ncc"].astype(np.float32),
        arrays["refined"].astype(bool),
        height,
        nothing,
        nothing,
        nothing,
        nothing.astype(bool),
    )
    group_distance, sigma_steps = arrays["group_distance"].astype(np.float32), arrays["sigma_steps"].astype(np.float32)
    return judge(heights, refined, arrays["covering"], arrays["seeing"], group_distance, sigma_steps, 99, OPTIONS)


def test_good_cells_have_no_reason():
    assert (judged() == 0).all()


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"covering": 1, "seeing": 1}, Quality.UNSEEN),
        ({"seeing": 1}, Quality.OCCLUDED),
        ({"best": 0}, Quality.RANGE_END),
        ({"best": 99}, Quality.RANGE_END),
        ({"best": 110}, Quality.RANGE_END),
        ({"ncc": 0.19}, Quality.WEAK),
        ({"ncc": 0.49}, Quality.WEAK),
        ({"group_distance": 1.01}, Quality.DISPUTED),
        ({"uniqueness": 63}, Quality.AMBIGUOUS),
        ({"refined": False}, Quality.UNREFINED),
    ],
)
def test_a_reason(changed, reason):
    quality = judged(**changed)
    assert quality[AT] == reason
    quality[AT] = 0
    assert (quality == 0).all()


@pytest.mark.parametrize("changed", [{"group_distance": 3.0}, {"refined": False}])
def test_signs_of_a_wrong_height_warn_of_nothing_where_the_height_is_precise(changed):
    assert (judged(sigma_steps=np.full((7, 9), 0.99), **changed) == 0).all()


@pytest.mark.parametrize("changed", [{"best": 1}, {"best": 98}, {"ncc": 0.51}, {"uniqueness": 64}, {"seeing": 2}])
def test_just_good_enough(changed):
    assert (judged(**changed) == 0).all()


def test_a_cell_whose_images_do_not_agree_has_no_height_next_to_a_jump_only():
    quality = judged(ncc=0.19, height=53.3)
    assert quality[AT] == Quality.NO_MATCH | Quality.WEAK | Quality.JUMP
    assert (quality & Quality.NO_MATCH != 0).sum() == 1


def test_cells_have_no_height_where_the_images_do_not_agree_in_the_mean_around_them():
    agreement = np.tile(np.array([0.3, -0.2], np.float32), (7, 5))[:, :9]
    assert (judged(ncc=agreement) & Quality.NO_MATCH != 0).all()
    assert not (judged(ncc=agreement + 0.2) & Quality.NO_MATCH).any()


def test_the_mean_around_a_cell_leaves_out_what_does_not_count():
    values, is_counted = np.full((12, 20), 0.8, np.float32), np.ones((12, 20), bool)
    values[:, 10:], is_counted[:, 10:] = -1.0, False
    found = mean_around(values, is_counted)
    np.testing.assert_allclose(found[:, :14], 0.8, atol=1e-6)
    assert (found[:, 16:] == 0).all()


def test_cells_next_to_a_jump():
    quality = judged(height=53.3)
    near = np.zeros((7, 9), bool)
    near[2:5, 3:6] = True
    np.testing.assert_array_equal(quality == Quality.JUMP, near)
    assert (judged(height=53.1) == 0).all()
