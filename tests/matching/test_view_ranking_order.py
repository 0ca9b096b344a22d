"""The order of search images from feature points nearby, dense or sparse, and the images considered at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from reference import selection as plain
from zlocus.core.errors import ConfigError
from zlocus.core.options import SelectionOptions
from zlocus.matching.view_ranking import (
    FEW_CELLS,
    FeaturePoints,
    NeighbourSearch,
    OrderSource,
    SearchGeometry,
    candidate_images,
    order_images,
    scene_labels,
    triangulated,
)

RADIUS_PX = 10.0
OPTIONS = SelectionOptions(radius_px=RADIUS_PX, nearest=3, max_radii=4.0)
COUNT = SelectionOptions(radius_px=RADIUS_PX, nearest=3, max_radii=4.0, accumulate="count")
TIN = SelectionOptions(radius_px=RADIUS_PX, nearest=3, max_radii=4.0, neighbours="tin")
B1, F1, B2, N2, F2 = range(5)
# Ji et al. 2014, table 3, labels of B1, F1, B2, N2, F2 at P1, P2, P3; table 4, their sums.
TABLE_3 = np.array([[1, 0, 1, 0, 0], [1, 1, 1, 1, 1], [0, 1, -1, -1, -1]], np.int8)
TABLE_4 = [2, 2, 1, 0, 0]
# The paper does not print where the points are.
AROUND = np.array([[-3.0, -2.0], [4.0, -1.0], [0.0, 5.0]])


def features(xy, labels):
    return FeaturePoints(np.asarray(xy, float).reshape(-1, 2), np.asarray(labels, np.int8))


def order_of(points, *at, options=OPTIONS):
    return order_images(points, np.array(at, float).reshape(-1, 2), options)


@pytest.mark.parametrize("options", [OPTIONS, TIN], ids=["radius", "tin"])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (500000.0, 5200000.0)])
def test_the_printed_ranking(options, shift):
    found = order_of(features(AROUND + shift, TABLE_3), shift, options=options)
    assert found.accumulated.tolist() == [TABLE_4]
    assert found.order_source == OrderSource.NEIGHBOURS
    order = found.images[0].tolist()
    assert [set(order[:2]), set(order[2:3]), set(order[3:])] == [{B1, F1}, {B2}, {N2, F2}]


def test_the_count_is_an_option():
    """The count of good labels puts B2 beside B1 and F1."""
    found = order_of(features(AROUND, TABLE_3), (0, 0), options=COUNT)
    assert found.accumulated.tolist() == [[2, 2, 2, 1, 1]]


@pytest.mark.parametrize(
    ("at", "first"),
    # Nearest to P1, B1 is better there; to P3, F1; to P2, both are good, and P1 or P3 decides.
    [(AROUND[0], B1), (AROUND[2], F1), (AROUND[1] + (0, -2), B1), (AROUND[1] + (0, 2), F1)],
)
def test_equal_images_are_ordered_at_the_nearest_point_then_the_next(at, first):
    found = order_of(features(AROUND, TABLE_3), at)
    assert found.images[0, :2].tolist() == [first, F1 + B1 - first]


def test_images_equal_everywhere_keep_the_order_of_the_scene():
    xy = np.vstack([AROUND, [[1000.0, 0.0]]])
    found = order_of(features(xy, np.vstack([TABLE_3, [0, 0, 0, 0, 1]])), (0, 0))
    assert found.images[0, 3:].tolist() == [F2, N2]
    assert order_of(features(AROUND, TABLE_3), (0, 0)).images[0, 3:].tolist() == [N2, F2]


def test_a_label_beyond_the_radius_does_not_count():
    points = features([[9.9, 0], [0, -10.1]], [[1, 0], [-1, 1]])
    assert order_of(points, (0, 0)).accumulated.tolist() == [[1, 0]]
    assert order_of(features([[10.0, 0], [0, -10.0]], points.labels), (0, 0)).accumulated.tolist() == [[0, 1]]


def test_many_neighbours_do_not_overflow():
    """Twice the labels that fit into a key; the far ones still accumulate."""
    n = 100
    labels = np.ones((n, 2), np.int8)
    labels[0], labels[1] = (0, 1), (1, 0)
    xy = np.column_stack([np.linspace(1, 9, n), np.zeros(n)])
    found = order_of(features(xy, labels), (0, 0), (9.9, 0))
    assert found.accumulated.tolist() == [[n - 1, n - 1]] * 2
    assert found.images.tolist() == [[1, 0], [0, 1]]


def test_equal_images_are_ordered_by_the_nearest_forty_points():
    n = 42
    labels = np.zeros((n, 2), np.int8)
    labels[39:41, 1] = 1, -1
    xy = np.column_stack([np.linspace(1, 9, n), np.zeros(n)])
    assert order_of(features(xy, labels), (0, 0)).images.tolist() == [[1, 0]]
    assert order_of(features(xy, np.roll(labels, 1, axis=0)), (0, 0)).images.tolist() == [[0, 1]]


def test_of_points_at_the_same_distance_the_first_counts_as_nearer():
    assert order_of(features([[3, 0], [0, 3]], [[0, 1], [1, 0]]), (0, 0)).images.tolist() == [[1, 0]]
    assert order_of(features([[3, 0], [0, 3]], [[1, 0], [0, 1]]), (0, 0)).images.tolist() == [[0, 1]]


# --- sparse features, the paper's open problem ---


def test_plain_ground_takes_the_nearest_features():
    """No feature within the radius: the three nearest, as far as four radii."""
    points = features([[15, 0], [0, 20], [-25, 0], [0, -28]], [[0, 1], [0, 1], [1, 0], [1, -1]])
    found = order_of(points, (0, 0))
    assert found.order_source == OrderSource.NEAREST
    assert found.accumulated.tolist() == [[1, 2]]
    assert found.images.tolist() == [[1, 0]]
    further = features([[15, 0], [0, 41], [-25, 0]], [[0, 1], [0, 1], [1, 0]])
    assert order_of(further, (0, 0)).accumulated.tolist() == [[1, 1]]


def test_far_from_all_features_the_order_of_the_scene_holds():
    points = features([[0, 0], [5, 0], [10, 0]], [[1, 1, 0], [-1, 1, 1], [0, 1, -1]])
    found = order_of(points, (10, 40.1), (10, 39.9))
    assert found.order_source.tolist() == [OrderSource.SCENE, OrderSource.NEAREST]
    assert found.images[0].tolist() == [1, 0, 2]
    assert found.accumulated[0].tolist() == scene_labels(points.labels, OPTIONS).tolist() == [0, 3, 0]


@pytest.mark.parametrize("options", [OPTIONS, TIN], ids=["radius", "tin"])
def test_a_scene_without_features_keeps_the_given_order(options):
    found = order_of(features([], np.zeros((0, 4))), (0, 0), (3, 4), options=options)
    assert found.images.tolist() == [[0, 1, 2, 3]] * 2
    assert (found.order_source == OrderSource.SCENE).all()


@pytest.mark.parametrize("accumulate", ["sum", "count"])
def test_the_order_of_the_scene(accumulate):
    labels = np.array([[1, 1, 0], [-1, 0, 1], [1, 1, 1], [-1, 0, 0]], np.int8)
    options = SelectionOptions(accumulate=accumulate)
    sums = {"sum": [0, 2, 2], "count": [2, 2, 2]}[accumulate]
    assert scene_labels(labels, options).tolist() == sums
    far = order_of(FeaturePoints(np.arange(8.0).reshape(4, 2), labels), (1e5, 0), options=options)
    assert far.images.tolist() == [{"sum": [1, 2, 0], "count": [0, 1, 2]}[accumulate]]


# --- TIN ---


def test_the_corners_of_the_triangle_by_distance():
    xy = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [6.0, 6.0]])
    near = NeighbourSearch(xy, TIN).of(np.array([[4.0, 1.0], [1.0, 4.0], [8.0, 2.1]]))
    assert near.index.reshape(3, 3).tolist() == [[0, 3, 1], [0, 3, 2], [1, 3, 0]]
    assert near.start.tolist() == [0, 3, 6, 9]


@pytest.mark.parametrize(
    "xy", [np.zeros((0, 2)), [[0.0, 0.0]], [[0.0, 0.0], [4.0, 0.0]], [[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]],
           [[3.0, 3.0]] * 5],
    ids=["none", "one", "two", "a line", "one place"],
)  # fmt: skip
def test_points_without_a_triangle_count_as_the_nearest(xy):
    xy = np.array(xy)
    assert triangulated(xy) is None
    found = order_of(features(xy, np.ones((len(xy), 2))), (1, 1), options=TIN)
    assert found.order_source == (OrderSource.NEAREST if len(xy) else OrderSource.SCENE)
    assert sorted(found.images[0]) == [0, 1]


def test_outside_all_triangles_the_nearest_features_count():
    points = features([[0, 0], [10, 0], [0, 10], [10, 10]], [[0, 1], [0, 1], [1, 0], [1, 0]])
    found = order_of(points, (5, -30), (5, -50), (5, 5.5), options=TIN)
    assert found.order_source.tolist() == [OrderSource.NEAREST, OrderSource.SCENE, OrderSource.NEIGHBOURS]
    assert found.accumulated[0, 1] == 2


@given(arrays.arrays(np.float64, (8, 2), elements=st.integers(0, 60).map(float)),
       arrays.arrays(np.float64, (4, 2), elements=st.integers(-5, 65).map(float)))  # fmt: skip
def test_the_triangle_contains_the_cell_and_is_delaunay(xy, at):
    near = NeighbourSearch(xy, TIN).of(at)
    assume((near.order_source == OrderSource.NEIGHBOURS).any())
    for cell in np.flatnonzero(near.order_source == OrderSource.NEIGHBOURS):
        corners = xy[near.index[near.start[cell] : near.start[cell + 1]]]
        assert len(corners) == 3
        assert (np.diff(np.hypot(*(corners - at[cell]).T)) >= -1e-9).all()
        share = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [*at[cell], 1.0])
        assert (share >= -1e-9).all()
        # No other feature point lies in the circle through the corners.
        centre = np.linalg.solve(2 * (corners[1:] - corners[0]), (corners[1:] ** 2 - corners[0] ** 2).sum(axis=1))
        assert (np.hypot(*(xy - centre).T) >= np.hypot(*(corners[0] - centre)) - 1e-6).all()


# --- against plain loops ---

WHOLE = st.integers(-30, 30).map(float)
SCENES = st.tuples(st.integers(1, 30), st.integers(1, 5)).flatmap(
    lambda size: st.tuples(
        arrays.arrays(np.float64, (size[0], 2), elements=WHOLE),
        arrays.arrays(np.int8, size, elements=st.integers(-1, 1)),
    )
)


@given(SCENES, arrays.arrays(np.float64, (6, 2), elements=WHOLE), st.sampled_from([OPTIONS, COUNT]),
       st.sampled_from([2.0, 5.0, 20.0]))  # fmt: skip
def test_as_in_plain_loops(scene, at, base, radius_px):
    options = SelectionOptions(radius_px=radius_px, nearest=3, max_radii=2.0, accumulate=base.accumulate)
    xy, labels = scene
    # Whole positions are kept whole, so that equal distances are equal.
    xy = np.vstack([xy, -xy])
    labels = np.vstack([labels, labels[::-1]])
    found = order_of(features(xy, labels), *at, options=options)
    for cell, place in enumerate(at.tolist()):
        order_source, neighbours = plain.radius_neighbours(xy.tolist(), place, options)
        assert found.order_source[cell] == order_source
        assert found.images[cell].tolist() == plain.order(labels.tolist(), neighbours, options)


def test_cells_do_not_depend_on_each_other():
    """More cells than are looked up at a time, in the order given."""
    rng = np.random.default_rng(4)
    points = features(rng.uniform(0, 300, (400, 2)), rng.integers(-1, 2, (400, 6)))
    at = rng.uniform(-50, 350, (20500, 2))
    found = order_images(points, at, OPTIONS)
    assert found.images.shape == found.accumulated.shape == (20500, 6)
    some = [0, 19999, 20000, 20499]
    alone = order_images(points, at[some], OPTIONS)
    for name in ("images", "accumulated", "order_source"):
        np.testing.assert_array_equal(getattr(found, name)[some], getattr(alone, name))
    np.testing.assert_array_equal(np.sort(found.images, axis=1), np.broadcast_to(np.arange(6), (20500, 6)))
    assert set(found.order_source.tolist()) == set(OrderSource)


@pytest.mark.parametrize("n_points", [0, 1, 2, 7, 400])
def test_few_cells_find_the_neighbours_that_many_find(n_points):
    """With all distances, and with a tree; also at distances of the radius, and at points of equal distance."""
    rng = np.random.default_rng(n_points)
    xy = np.round(rng.uniform(0, 60, (n_points, 2)))
    at = np.concatenate([np.round(rng.uniform(-20, 80, (2 * FEW_CELLS, 2))), xy[:3] + np.array([RADIUS_PX, 0.0])])
    together = NeighbourSearch(xy, OPTIONS).of(at)
    for cell in range(len(at)):
        alone = NeighbourSearch(xy, OPTIONS).of(at[cell : cell + 1])
        np.testing.assert_array_equal(alone.index, together.index[together.start[cell] : together.start[cell + 1]])
        assert alone.order_source[0] == together.order_source[cell]


def test_no_cells_at_all():
    assert order_images(features(AROUND, TABLE_3), np.zeros((0, 2)), OPTIONS).images.shape == (0, 5)


# --- candidates ---


def geometry(overlap, angle_deg, days):
    return SearchGeometry(*np.broadcast_arrays(*(np.asarray(v, float) for v in (overlap, angle_deg, days))))


def candidates(overlap=1.0, angle_deg=20.0, days=0.0, **options):
    return candidate_images(geometry(overlap, angle_deg, days), SelectionOptions(**options)).tolist()


def test_each_number_alone_ranks_the_candidates():
    assert candidates(overlap=[0.5, 1.0, 0.8]) == [1, 2, 0]
    assert candidates(angle_deg=[30.0, 19.0, 8.0, 22.0]) == [1, 3, 0, 2]
    assert candidates(days=[-100.0, 0.0, 99.0]) == [1, 2, 0]
    assert candidates(days=[np.nan, 10.0, 20.0, 5.0]) == [3, 1, 0, 2]
    assert candidates(days=[np.nan, np.nan]) == [0, 1]


def test_a_year_is_worth_less_than_another_angle():
    assert candidates(angle_deg=[20.0, 10.0], days=[365.0, 0.0]) == [1, 0]
    assert candidates(angle_deg=[20.0, 10.0], days=[30.0, 0.0]) == [0, 1]
    assert candidates(angle_deg=[20.0, 10.0], days=[30.0, 0.0], half_days=20.0) == [1, 0]


def test_candidates_outside_the_limits_come_last_and_blind_ones_not_at_all():
    assert candidates(overlap=[0.1, 0.3, 0.0], days=[0.0, 500.0, 0.0]) == [1, 0]
    assert candidates(angle_deg=[4.0, 50.0, 6.0, 44.0, 0.0], days=[0, 0, 500, 600, 0]) == [2, 3, 1, 0]
    assert candidates(angle_deg=[4.0, 3.0]) == [0, 1]


def test_a_hundred_images():
    rng = np.random.default_rng(8)
    given_numbers = geometry(rng.uniform(0, 1, 100), rng.uniform(0, 80, 100), rng.uniform(0, 900, 100))
    chosen = candidate_images(given_numbers, SelectionOptions())
    assert len(set(chosen.tolist())) == 24
    assert (given_numbers.overlap[chosen] >= 0.2).all()
    assert ((given_numbers.angle_deg[chosen] >= 5) & (given_numbers.angle_deg[chosen] <= 45)).all()
    assert chosen.tolist() == candidate_images(given_numbers, SelectionOptions(max_candidates=50)).tolist()[:24]


def test_angles_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match=r"best_angle_deg = 4\.0 is outside min_angle_deg to max_angle_deg"):
        SelectionOptions(best_angle_deg=4.0)
