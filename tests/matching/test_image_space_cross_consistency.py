"""Matching back, on two images of a plane whose heights are planted."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from zlocus.core.scene import ImageWindow, Scene, View
from zlocus.matching.image_space import CrossConsistency, MatchedImage, check_cross_consistency, image_space
from zlocus.sensors.frame import FrameModel

LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SHAPE, FOCAL, DISPARITY = (40, 60), 400.0, 6.0
PATCH = (slice(10, 20), slice(30, 40))


@dataclass(frozen=True)
class Blank:
    shape: tuple[int, int] = SHAPE
    dtype: str = "uint8"

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        return ImageWindow(np.zeros((rows, cols), np.float32), np.ones((rows, cols), bool))


def images(*places: float) -> list[MatchedImage]:
    """Cameras along x before a plane at a disparity of 6 px per unit of base."""
    views = tuple(
        View(f"v{k}", Path(f"v{k}.tif"), Blank(), FrameModel((x, 0.0, 0.0), LEVEL, FOCAL, (29.5, 19.5)))
        for k, x in enumerate(places)
    )
    scene = Scene(views, CRS.from_epsg(32632))
    found = []
    for v in views:
        space = image_space(scene, v.name, (0.0, 0.0))
        z = space.rays.scale / FOCAL * DISPARITY
        found.append(MatchedImage(space, np.full(SHAPE, z, np.float32), z))
    return found


def whole(mine, others):
    """Counts of all rows, which come some after others."""
    rows, parts = zip(*check_cross_consistency(mine, others, 1.0), strict=True)
    assert np.concatenate([np.arange(len(mine.height))[r] for r in rows]).tolist() == list(range(len(mine.height)))
    return CrossConsistency(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(CrossConsistency)))


@pytest.fixture(autouse=True)
def few_rows_at_once(monkeypatch):
    monkeypatch.setattr("zlocus.matching.image_space.ROWS_AT_ONCE", 16)


def test_equal_heights_agree_where_both_see():
    left, right = images(0.0, 1.0)
    result = whole(left, [right])
    np.testing.assert_array_equal(result.agreeing[:, 6:], 1)
    np.testing.assert_array_equal(result.agreeing[:, :6], 0)  # left of the right image
    np.testing.assert_array_equal(result.is_consistent, result.agreeing == 1)
    assert not result.nearer.any()
    assert not result.farther.any()


@pytest.mark.parametrize(("by_px", "agrees"), [(0.9, True), (1.1, False), (-0.9, True), (-1.1, False)])
def test_the_tolerance_is_in_pixels(by_px, agrees):
    left, right = images(0.0, 1.0)
    left.height[PATCH] += by_px
    result = whole(left, [right])
    assert (result.agreeing[PATCH] == agrees).all()
    # What is too near is looked through, what is too far is hidden.
    assert ((result.farther if by_px > 0 else result.nearer)[PATCH] == (not agrees)).all()


def test_a_wrong_patch_is_not_confirmed():
    left, right = images(0.0, 1.0)
    left.height[PATCH] += 8.0
    confirmed = whole(left, [right]).is_consistent
    assert not confirmed[PATCH].any()
    confirmed[PATCH] = True
    assert confirmed[:, 6:].all()


def test_more_must_agree_than_look_through():
    first, *others = images(0.0, 1.0, 2.0, -1.0)
    for other in others[:1]:
        other.height[:] -= 2.0 * other.px_per_unit(first.image_space.reference_view.name) ** -1
    inside = (slice(None), slice(14, 50))
    result = whole(first, others)
    assert (result.farther[inside] == 1).all()
    assert (result.agreeing[inside] == 2).all()
    assert result.is_consistent[inside].all()
    assert not whole(first, others[:2]).is_consistent[inside].any()


def test_empty_pixels_have_no_say():
    left, right = images(0.0, 1.0)
    left.height[0], right.height[5] = np.nan, np.nan
    result = whole(left, [right])
    for counts in (result.agreeing, result.nearer, result.farther):
        assert not counts[[0, 5]].any()


def test_disparity_of_a_pair_is_that_of_its_own_base():
    first, near, far = images(0.0, 1.0, 4.0)
    assert first.px_per_unit(far.image_space.reference_view.name) == pytest.approx(1.0)
    assert first.px_per_unit(near.image_space.reference_view.name) == pytest.approx(0.25)
