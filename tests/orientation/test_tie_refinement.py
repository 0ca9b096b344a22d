"""Ties measured again, and those that cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orientation_scenes import BASE_HEIGHT_M, GSD_M, hill, hill_scene, image_of
from zlocus.core.options import OrientationOptions
from zlocus.orientation import sift as features
from zlocus.orientation.shift_adjustment import adjust
from zlocus.orientation.tie_points import with_rough_ties
from zlocus.orientation.tie_refinement import MIN_REFINED_OF_VIEW, reference_rows, refine_ties, squares_around, warps
from zlocus.orientation.triangulate import Observations, ground_jacobian, project_points

OPTIONS = OrientationOptions()
# Of each coordinate: what is planted, and what may be left of it. A pixel of the nadir view is a pixel of the texture,
# and images of slopes are not those of level ground.
PLANTED_PX, LEFT_PX = 0.5, 0.08
INSIDE_PX = 60.0


def planted(scene, n=400, seed=1):
    """Observations of points of the hill that all views show well inside, wrong in all views but the first; their
    true places, and the points."""
    rng = np.random.default_rng(seed)
    reach = (280 / 2 - INSIDE_PX) * GSD_M
    xyz = np.column_stack([rng.uniform(-reach, reach, (n, 2)), np.full(n, BASE_HEIGHT_M)])
    xyz[:, 2] = hill(xyz[:, 0], xyz[:, 1])
    n_views = len(scene.views)
    seen = Observations(np.repeat(np.arange(n_views), n), np.tile(np.arange(n), n_views), np.zeros((n * n_views, 2)))
    sensors = [view.sensor for view in scene.views]
    true = project_points(sensors, seen, xyz)
    wrong = rng.normal(0.0, PLANTED_PX, true.shape) * (seen.view > 0)[:, None]
    return Observations(seen.view, seen.point, true + wrong), true, xyz, ground_jacobian(sensors, seen, xyz)


def errors(found, true, n_views=3):
    """Distances (m,) px of observations from true places, which are numbered view by view."""
    n = len(true) // n_views
    return np.hypot(*(found.xy - true[found.view * n + found.point]).T)


def test_errors_of_features_are_taken_off():
    """Views turned by up to 12 degrees against each other, with other exposures."""
    scene = hill_scene([(0.0, 0.0)] * 3)
    brighter = image_of(scene.views[1].image.pixels * 3.0 + 900.0)
    scene = replace(scene, views=(scene.views[0], replace(scene.views[1], image=brighter), scene.views[2]))
    seen, true, _, by_ground = planted(scene)
    found = refine_ties(scene.views, seen, by_ground, OPTIONS)
    assert len(found) > 0.9 * len(seen)
    moved = found.view > 0
    assert np.median(errors(seen, true)[seen.view > 0]) > 0.8 * PLANTED_PX
    assert np.median(errors(found, true)[moved]) < LEFT_PX
    assert (found.xy[~moved] == seen.xy[found.point[~moved]]).all()


def test_reading_part_by_part_changes_nothing(monkeypatch):
    scene = hill_scene([(0.0, 0.0)] * 3)
    seen, _, _, by_ground = planted(scene)
    whole = refine_ties(scene.views, seen, by_ground, OPTIONS)
    monkeypatch.setattr(features, "PART_PX", 70)
    parts = refine_ties(scene.views, seen, by_ground, OPTIONS)
    np.testing.assert_array_equal(whole.point, parts.point)
    np.testing.assert_array_equal(whole.xy, parts.xy)


def test_what_looks_different_or_is_not_valid_is_left_out():
    scene = hill_scene([(0.0, 0.0)] * 3)
    pixels, valid = scene.views[2].image.pixels.copy(), np.ones((280, 280), bool)
    pixels[:, :140] = 2000.0 + 300.0 * np.random.default_rng(3).normal(size=(280, 140))
    valid[:140] = False
    scene = replace(scene, views=(*scene.views[:2], replace(scene.views[2], image=image_of(pixels, valid))))
    seen, true, _, by_ground = planted(scene)
    found = refine_ties(scene.views, seen, by_ground, OPTIONS)
    kept = true[found.view * 400 + found.point][found.view == 2]
    assert (kept > 135.0).all()
    assert len(kept) >= MIN_REFINED_OF_VIEW
    assert np.bincount(found.point)[np.unique(found.point)].min() >= 2


def test_invalid_pixels_count_even_where_their_value_is_an_ordinary_one():
    scene = hill_scene([(0.0, 0.0)] * 3)
    seen, true, _, by_ground = planted(scene)
    pixels, valid = scene.views[2].image.pixels - 2000.0, np.ones((280, 280), bool)
    col, row = np.rint(true[seen.view == 2][:5]).astype(int).T
    valid[row, col] = False
    scene = replace(scene, views=(*scene.views[:2], replace(scene.views[2], image=image_of(pixels, valid))))
    found = refine_ties(scene.views, seen, by_ground, OPTIONS)
    kept = found.point[found.view == 2]
    assert len(kept) > MIN_REFINED_OF_VIEW
    assert (kept >= 5).all()


def test_a_view_of_another_season_keeps_what_sift_found():
    scene = hill_scene([(0.0, 0.0)] * 3)
    noise = image_of(np.random.default_rng(3).normal(size=(280, 280)))
    scene = replace(scene, views=(*scene.views[:2], replace(scene.views[2], image=noise)))
    seen, _, _, by_ground = planted(scene)
    found = refine_ties(scene.views, seen, by_ground, OPTIONS)
    last = found.view == 2
    assert last.sum() == 400
    assert (found.xy[last] == seen.xy[seen.view == 2]).all()


def test_nothing_seen_is_nothing_found():
    scene = hill_scene([(0.0, 0.0)] * 2)
    nothing = Observations(np.empty(0, int), np.empty(0, int), np.empty((0, 2)))
    assert len(refine_ties(scene.views, nothing, np.empty((0, 2, 3)), OPTIONS)) == 0


def test_the_reference_is_the_least_slanted_view_of_each_tie():
    scene = hill_scene([(0.0, 0.0)] * 3, looks=((0.3, 0.0), (0.25, 0.05), (0.0, 0.0)))
    view, point = np.array([0, 1, 2, 0, 1, 1]), np.array([0, 0, 0, 1, 1, 2])
    seen = Observations(view, point, np.full((6, 2), 140.0))
    xyz = np.tile([0.0, 0.0, BASE_HEIGHT_M], (3, 1))
    by_ground = ground_jacobian([v.sensor for v in scene.views], seen, xyz)
    assert reference_rows(seen, by_ground, 3).tolist() == [2, 2, 2, 4, 4, 5]


def test_level_ground_of_one_image_in_another():
    one, other = np.array([[[2.0, 0, 5], [0, -2, 7]]]), np.array([[[0.0, 2, 1], [2, 0, 1]]])
    assert warps(one, other)[0].tolist() == [[0, -1], [1, 0]]
    assert (warps(np.zeros((1, 2, 3)), other) == 0).all()
    assert (warps(np.full((1, 2, 3), np.nan), other) == 0).all()


def test_squares_are_the_pixels_around():
    pixels = np.random.default_rng(0).random((90, 120)).astype(np.float32)
    valid = np.ones(pixels.shape, bool)
    valid[50, 60] = False
    view = replace(hill_scene([(0.0, 0.0)], size=16).views[0], image=image_of(pixels, valid))
    whole = np.array([[60, 40], [63, 52], [2, 40], [117, 40], [116, 86]])
    found = {
        int(row): (square, usable)
        for part in squares_around(view, whole, np.arange(5), 3)
        for row, square, usable in zip(part.rows, part.pixels, part.valid, strict=True)
    }
    assert sorted(found) == [0, 1, 4]
    np.testing.assert_array_equal(found[0][0], pixels[37:44, 57:64])
    assert (found[0][1], found[1][1], found[4][1]) == (True, False, True)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.0, -2.0)])
def test_rough_ties_follow_the_measured_ones_and_do_not_move_them(shift):
    """Half of the ties were measured; the rest come with them, less exact, but without the wrong ones."""
    scene = hill_scene([(0.0, 0.0), shift, (0.0, 0.0)])
    _, true, xyz, _ = planted(scene)
    sensors, n = [v.sensor for v in scene.views], len(xyz)
    rng = np.random.default_rng(5)
    view, point = np.repeat(np.arange(3), n), np.tile(np.arange(n), 3)
    exact = true - np.asarray(shift) * (view == 1)[:, None]
    rough = point >= n // 2
    every = Observations(view, point, exact + rng.normal(0.0, 0.3, exact.shape) * rough[:, None])
    every.xy[(point >= n - 40) & (view == 2), 1] += 25.0
    adjusted = adjust(sensors, every.kept(~rough), xyz, OPTIONS)
    found = with_rough_ties(adjusted, sensors, every, xyz, 1.5)
    n_refined = len(adjusted.ground_points.xyz)
    assert n_refined == n // 2
    np.testing.assert_array_equal(found.xyz[:n_refined], adjusted.ground_points.xyz)
    more = found.xyz[n_refined:]
    assert 0.75 * (n // 2 - 40) < len(more) <= n // 2
    distance = np.hypot(*(more[:, None, :2] - xyz[None, n // 2 :, :2]).transpose(2, 0, 1)).min(axis=1)
    assert np.median(distance) < 0.5
    assert np.median(found.sigma_z_m[n_refined:]) > 3.0 * np.median(found.sigma_z_m[:n_refined])
    assert found.observations.point.max() == len(found.xyz) - 1
