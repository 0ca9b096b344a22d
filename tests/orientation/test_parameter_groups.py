"""Many images: each is compared with its neighbours only, in threads, with what does not fit in memory on disk."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS
from scipy.ndimage import gaussian_filter

from orientation_scenes import BASE_HEIGHT_M, GSD_M, AffineSensor, hill_scene, image_of
from reference.ties import neighbours_of_all_pairs
from zlocus.core.options import OrientationOptions
from zlocus.core.progress import SilentProgress
from zlocus.core.scene import View
from zlocus.matching.radiometry import MAX_POINTS, MIN_POINTS, grey_scales, greys_of
from zlocus.orientation import sift as features
from zlocus.orientation import ties as ties_module
from zlocus.orientation.epipolar import Sightlines, epipolar_curves
from zlocus.orientation.orientation import orient
from zlocus.orientation.tie_residuals import linked_pairs
from zlocus.orientation.ties import find_ties, neighbours
from zlocus.orientation.triangulate import Observations
from zlocus.pipeline.messages import MAX_NAMED, what_was_applied
from zlocus.pipeline.setup import orient_views
from zlocus.sensors.frame import FrameModel, rotation_from_angles

OPTIONS = OrientationOptions(features_per_mpx=20000)
UTM = CRS.from_epsg(32631)
Z_RANGE = (60.0, 200.0)
MARGIN_PX = 30.0
# Of grey scales that agree, in units of the ground's brightness.
ALBEDO, GAIN = 0.05, 0.05


def view_at(east_px, north_px, look, size=40, turn_deg=0.0):
    sensor = AffineSensor(*look, (size / 2 - east_px, size / 2 + north_px), turn_deg)
    return View(f"{east_px}_{north_px}", Path("v.tif"), image_of(np.zeros((size, size))), sensor)


def as_matrix(near):
    """Whether two images are neighbours, (i, i) bool."""
    matrix = np.zeros((len(near), len(near)), bool)
    for number, others in enumerate(near):
        matrix[number, others] = True
    return matrix


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.floats(-300, 300), st.floats(-300, 300), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-180, 180)
        ),
        min_size=2, max_size=5,
    )
)  # fmt: skip
def test_images_of_common_ground_are_neighbours(places):
    """Wherever a pixel's locus touches another image, with what its pointing may be wrong by."""
    views = [view_at(e, n, (a, b), turn_deg=turn) for e, n, a, b, turn in places]
    near = as_matrix(neighbours(views, Z_RANGE, MARGIN_PX))
    np.testing.assert_array_equal(near, near.T)
    assert not near.diagonal().any()
    corner = np.linspace(0.0, 39.0, 6)
    xy = np.stack(np.meshgrid(corner, corner), axis=-1).reshape(-1, 2)
    for a, b in combinations(range(len(views)), 2):
        loci = epipolar_curves(Sightlines.of(views[a].sensor, xy, Z_RANGE), views[b].sensor, Z_RANGE)
        ends = np.stack([loci.low, loci.high])
        inside = ((ends > -MARGIN_PX) & (ends < 40 + MARGIN_PX)).all(axis=2)
        assert near[a, b] or not inside.any()


def test_images_far_apart_are_no_neighbours():
    views = [view_at(60 * k, 0, (0.0, 0.0)) for k in range(20)]
    near = neighbours(views, Z_RANGE, MARGIN_PX)
    assert max(map(len, near)) <= 4
    assert 1 in near[0]
    assert near[0].max() < 5


def test_an_image_that_sees_the_horizon_may_see_any_ground():
    model = FrameModel((0.0, 0.0, 500.0), rotation_from_angles(75.0, 0.0, 0.0), 50.0, (20.0, 20.0))
    oblique = replace(view_at(0, 0, (0.0, 0.0)), sensor=model)
    near = neighbours([oblique, view_at(30_000, 0, (0.0, 0.0)), view_at(-30_000, 0, (0.0, 0.0))], Z_RANGE, 0.0)
    assert [each.tolist() for each in near] == [[1, 2], [0], [0]]


@settings(deadline=None, max_examples=80)
@given(
    st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6), st.floats(-0.5, 0.5)), min_size=1, max_size=12),
    st.lists(st.booleans(), min_size=12, max_size=12),
)
def test_the_index_finds_the_neighbours_that_all_pairs_give(places, horizons):
    """Also where boxes touch in a line, and where images see the horizon."""
    model = FrameModel((0.0, 0.0, 500.0), rotation_from_angles(75.0, 0.0, 0.0), 50.0, (20.0, 20.0))
    views = [view_at(40 * east, 40 * north, (look, 0.0)) for east, north, look in places]
    views = [replace(v, sensor=model) if sees else v for v, sees in zip(views, horizons, strict=False)]
    near = neighbours(views, Z_RANGE, 0.0)
    np.testing.assert_array_equal(as_matrix(near), neighbours_of_all_pairs(views, Z_RANGE, 0.0))
    assert all((np.diff(each) > 0).all() for each in near)


@pytest.fixture(scope="module")
def scene():
    return hill_scene([(0.0, 0.0), (3.0, -8.0), (-5.0, 4.0)])


@pytest.fixture(scope="module")
def ties(scene):
    return find_ties(scene, OPTIONS)


@pytest.fixture(scope="module")
def oriented(scene):
    return orient(scene, OPTIONS)


def assert_same(found, expected):
    for name in ("view", "point", "xy"):
        np.testing.assert_array_equal(getattr(found.observations, name), getattr(expected.observations, name))
    np.testing.assert_array_equal(found.z, expected.z)
    assert [pair.views for pair in found.pairs] == [pair.views for pair in expected.pairs]


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_nothing(scene, ties, oriented, threads, monkeypatch):
    """However late the first pairs come."""
    plain = ties_module.match_pair

    def late(views, found, pair, *rest):
        time.sleep(0.3 if pair[0] == 0 else 0.0)
        return plain(views, found, pair, *rest)

    monkeypatch.setattr(ties_module, "match_pair", late)
    assert_same(find_ties(scene, OPTIONS, threads=threads), ties)
    several = orient(scene, OPTIONS, threads=threads)
    np.testing.assert_array_equal(oriented.xyz, several.xyz)
    assert oriented.as_dict() == several.as_dict()


def test_descriptors_on_disk_are_the_same(scene, ties, monkeypatch):
    written = []
    plain = features.on_disk
    monkeypatch.setattr(features, "on_disk", lambda array, what: written.append(array.shape) or plain(array, what))
    monkeypatch.setattr(features, "HELD_BYTES", 0.0)
    assert_same(find_ties(scene, OPTIONS), ties)
    assert len(written) == len(scene.views)


@settings(deadline=None, max_examples=40)
@given(st.integers(2, 9), st.integers(1, 60), st.integers(0, 2**31))
def test_pairs_are_those_that_see_a_point_together(n_views, n_points, seed):
    rng = np.random.default_rng(seed)
    sees = rng.random((n_views, n_points)) < 0.2
    view, point = np.nonzero(sees)
    shuffled = rng.permutation(len(view))
    seen = Observations(view[shuffled], point[shuffled], np.zeros((len(view), 2)))
    expected = [[a, b] for a, b in combinations(range(n_views), 2) if (sees[a] & sees[b]).any()]
    assert linked_pairs(seen, n_views).tolist() == expected


class WatchedProgress(SilentProgress):
    """Remembers by how much its stages advanced."""

    def __init__(self):
        self.shares = []

    def stage(self, *_):
        return self

    def advance(self, by=1.0):
        self.shares.append(by)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def test_progress_only_grows(scene):
    watched = WatchedProgress()
    orient_views(scene, OPTIONS, watched, threads=2)
    assert min(watched.shares) >= 0.0
    assert 0.5 < sum(watched.shares) <= 1.0 + 1e-9


def test_corrections_of_many_images_are_told_in_short(oriented):
    few = what_was_applied(oriented)
    assert "view1 (" in few
    many = replace(oriented, views=tuple(replace(oriented.views[1], name=f"v{k}") for k in range(MAX_NAMED + 1)))
    assert len(what_was_applied(many)) < 120
    assert "up to " in what_was_applied(many)


SIZE_PX, STEP_PX, N_VIEWS = 120, 40, 40


@pytest.fixture(scope="module")
def strip():
    """A strip of views, each a third of an image further than the one before, and darker or brighter, and all of their
    ground, (n, 3) m."""
    ground = gaussian_filter(np.random.default_rng(5).normal(size=(SIZE_PX, SIZE_PX + STEP_PX * N_VIEWS)), 4)
    ground /= ground.std()
    rng = np.random.default_rng(6)
    exposures = np.column_stack([rng.uniform(100, 900, N_VIEWS), rng.uniform(20, 200, N_VIEWS)])
    views = []
    for k, (offset, gain) in enumerate(exposures):
        pixels = offset + gain * ground[:, k * STEP_PX : k * STEP_PX + SIZE_PX]
        sensor = AffineSensor(0.0, 0.0, (-k * STEP_PX, SIZE_PX / 2))
        views.append(View(f"v{k:02d}", Path("v.tif"), image_of(pixels), sensor))
    east = rng.uniform(0, STEP_PX * (N_VIEWS - 1) + SIZE_PX, 20_000)
    north = rng.uniform(-SIZE_PX / 2, SIZE_PX / 2, 20_000)
    at = np.column_stack([east * GSD_M, north * GSD_M, np.full(20_000, BASE_HEIGHT_M)])
    return tuple(views), exposures, at


def test_every_image_of_a_long_strip_gets_enough_points(strip):
    views, _, at = strip
    n_seen = np.bincount(greys_of(views, at).view, minlength=N_VIEWS)
    assert n_seen.min() > 3 * MIN_POINTS
    assert n_seen.max() < 3 * MAX_POINTS


def test_neighbours_of_a_long_strip_agree(strip):
    """Each with those that see the same ground; from end to end a little is left."""
    views, exposures, at = strip
    scales = grey_scales(views, at)
    zero = (np.array([scale.mean for scale in scales]) - exposures[:, 0]) / exposures[:, 1]
    unit = np.array([scale.contrast for scale in scales]) / exposures[:, 1]
    assert np.abs(np.diff(zero)).max() < ALBEDO
    assert np.abs(np.diff(np.log(unit))).max() < GAIN


@pytest.mark.parametrize("n_points", [40, 60, 100])
def test_points_that_tell_little_are_no_fault(strip, n_points):
    """Views that agree on their few points to the bit leave no noise to weigh the prior by, and nothing but the prior
    holds one that shares none."""
    views, _, at = strip
    ground = at[:: len(at) // n_points]
    same = tuple(replace(view, image=views[0].image, sensor=views[0].sensor) for view in views[:8])
    inside = ground * [SIZE_PX / ((N_VIEWS - 1) * STEP_PX + SIZE_PX), 0.8, 1.0]
    scales = grey_scales((*same, views[-1]), inside)
    assert all(np.isfinite(scale.mean) and scale.trend is None for scale in scales)
