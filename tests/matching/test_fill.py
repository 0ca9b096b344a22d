"""Gaps filled from the heights around them."""

from __future__ import annotations

import numpy as np

from zlocus.matching.fill import filled, filled_from
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface

REACH = 6


def plane_with_gaps() -> tuple[Surface, np.ndarray]:
    """A tilted plane with a hole of 5 x 5 cells, a corner that no two images cover, and its exact heights."""
    rows, cols = np.indices((37, 41))
    exact = (0.5 * rows - 0.25 * cols).astype(np.float32)
    height, quality = exact.copy(), np.zeros(exact.shape, np.uint16)
    height[10:15, 20:25], quality[10:15, 20:25] = np.nan, Quality.NO_MATCH
    height[-4:, -4:], quality[-4:, -4:] = np.nan, Quality.UNSEEN
    views = np.where(np.isnan(height), 0, 3).astype(np.uint8)
    return Surface(height, 0 * height, quality, views, exact), exact


def test_a_hole_in_a_plane_is_filled_and_marked():
    surface, exact = plane_with_gaps()
    out = filled(surface, REACH)
    hole = np.s_[10:15, 20:25]
    # The centre sees its neighbours symmetrically; elsewhere inverse distances pull towards the nearer side.
    assert abs(out.height[12, 22] - exact[12, 22]) < 1e-4
    assert np.abs(out.height[hole] - exact[hole]).max() < 0.75
    assert (out.quality[hole] == Quality.NO_MATCH | Quality.FILLED).all()
    assert (out.views[hole] == 0).all()
    assert np.isnan(out.sigma[hole]).all()


def test_heights_and_unseen_cells_stay():
    surface, _ = plane_with_gaps()
    out = filled(surface, REACH)
    known = np.isfinite(surface.height)
    np.testing.assert_array_equal(out.height[known], surface.height[known])
    assert np.isnan(out.height[-4:, -4:]).all()
    assert (out.quality[-4:, -4:] == Quality.UNSEEN).all()


def test_a_gap_beyond_reach_stays_empty():
    height = np.full((5, 60), np.nan, np.float32)
    height[:, 0] = 7.0
    quality = np.where(np.isnan(height), np.uint16(Quality.NO_MATCH), np.uint16(0))
    out = filled(Surface(height, height, quality, np.zeros(height.shape, np.uint8), height), REACH)
    np.testing.assert_allclose(out.height[:, 1 : REACH + 1], 7.0)
    assert np.isnan(out.height[:, REACH + 1 :]).all()
    assert (out.quality[:, REACH + 1 :] == Quality.NO_MATCH).all()


def test_other_heights_fill_what_was_asked_for():
    """Everything empty but what is outside; what has a height keeps it."""
    height = np.array([[1.0, np.nan, np.nan, np.nan]], np.float32)
    quality = np.array([[0, Quality.NO_MATCH, Quality.UNSEEN, Quality.OUTSIDE]], np.uint16)
    none = np.full((1, 4), np.nan, np.float32)
    surface = Surface(height, none, quality, np.array([[3, 0, 0, 0]], np.uint8), none)
    found = filled_from(surface, np.array([[9.0, 5.0, 6.0, 7.0]], np.float32))
    np.testing.assert_array_equal(found.height, [[1.0, 5.0, 6.0, np.nan]])
    expected = [0, Quality.NO_MATCH | Quality.FILLED, Quality.UNSEEN | Quality.FILLED, Quality.OUTSIDE]
    np.testing.assert_array_equal(found.quality, [expected])
    np.testing.assert_array_equal(found.views, surface.views)
    unknown = filled_from(surface, none)
    np.testing.assert_array_equal(unknown.height, height)
    np.testing.assert_array_equal(unknown.quality, quality)


def test_a_filled_cell_is_not_flagged_as_a_plane_too():
    """Both flags together mean water."""
    nothing = np.full((1, 3), np.nan, np.float32)
    height = np.array([[1.0, np.nan, 1.0]], np.float32)
    quality = np.array([[Quality.PLANE, Quality.PLANE | Quality.NO_MATCH, Quality.PLANE]], np.uint16)
    surface = Surface(height, nothing, quality, np.ones((1, 3), np.uint8), nothing)
    for closed in (filled(surface, 5), filled_from(surface, np.full((1, 3), 2.0, np.float32))):
        expected = [Quality.PLANE, Quality.NO_MATCH | Quality.FILLED, Quality.PLANE]
        np.testing.assert_array_equal(closed.quality[0], expected)
