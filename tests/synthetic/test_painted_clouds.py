from __future__ import annotations

import numpy as np
import pytest

from zlocus.synthetic.painted_clouds import with_clouds

SHAPE = (300, 400)
GROUND = np.random.default_rng(4).integers(200, 900, SHAPE).astype(np.uint16)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_clouds_cover_their_share_are_opaque_bright_and_textured_and_leave_the_rest_as_it_is(share):
    cloudy = with_clouds(GROUND, share, 0.5, seed=3)
    assert (cloudy.cover > 0.5).mean() == pytest.approx(share, abs=0.002)
    opaque, clear = cloudy.cover == 1.0, cloudy.cover == 0.0
    assert opaque.mean() > 0.5 * share
    np.testing.assert_array_equal(cloudy.numbers[clear], GROUND[clear])
    assert cloudy.numbers[opaque].min() > np.median(GROUND)
    assert np.corrcoef(cloudy.numbers[opaque], GROUND[opaque])[0, 1] < 0.05
    assert cloudy.numbers[opaque].std() > 0.05 * cloudy.numbers[opaque].mean()
    assert 0.02 < (~opaque & ~clear).mean() < 0.2
    assert cloudy.numbers.dtype == GROUND.dtype


def test_pixels_without_an_image_stay_so_and_a_seed_repeats_exactly():
    ground = GROUND.copy()
    ground[:, :50] = 0
    cloudy, again, other = (with_clouds(ground, 0.4, 0.5, seed) for seed in (3, 3, 4))
    assert not cloudy.numbers[:, :50].any()
    assert cloudy.numbers[:, 50:].all()
    np.testing.assert_array_equal(cloudy.numbers, again.numbers)
    assert (cloudy.cover != other.cover).any()
    assert with_clouds((GROUND // 4).astype(np.uint8), 0.4, 0.5, 3).numbers.max() == 255
