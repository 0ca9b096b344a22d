"""Planted gains and offsets of images are found in their overlaps."""

from __future__ import annotations

import numpy as np
import pytest

from zlocus.matching.colour_levels import ColourLevels, colour_levels, overlap_of

GAIN, OFFSET = (1.0, 1.5, 0.8), (0.0, 40.0, -25.0)
NOISE = 2.0


def overlaps(share_changed=0.0):
    rng = np.random.default_rng(4)
    found = []
    for first, second in ((0, 1), (1, 2)):
        ground = rng.normal(300.0, 60.0, (2, 3000))
        values = np.stack([(ground - OFFSET[k]) / GAIN[k] for k in (first, second)])
        values += rng.normal(0.0, NOISE, values.shape)
        changed = rng.random(3000) < share_changed
        values[1, :, changed] += 400.0
        found.append(overlap_of(first, second, values))
    return found


@pytest.mark.parametrize("share_changed", [0.0, 0.15])
def test_images_agree_after_levelling(share_changed):
    levels = colour_levels(3, 2, overlaps(share_changed))
    ground = np.full((2, 1, 1), 300.0)
    levelled = [levels.levelled((ground - OFFSET[k]) / GAIN[k], k) for k in range(3)]
    assert np.ptp(levelled) < 3 * NOISE
    assert (levels.gain / np.array(GAIN)[:, None]).std() < 0.02


def test_a_small_overlap_tells_nothing_and_leaves_images_as_they_are():
    assert overlap_of(0, 1, np.ones((2, 1, 5))) is None
    levels, none = colour_levels(2, 1, []), ColourLevels.none(2, 1)
    assert (levels.gain == none.gain).all()
    assert (levels.offset == none.offset).all()
