"""The search for the nearest descriptors, against all pairs in plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from reference import ties as plain
from zlocus.orientation.kernels.descriptors import (
    CELL_PX,
    DESCRIPTOR_LENGTH_UNITS,
    SAME_PLACE_PX,
    UNRELATED_DISTANCE,
    CurveSegments,
    SecondFeatures,
    descriptor_distance,
    direction,
    is_clear,
    is_near,
    nearest_descriptors,
    sort_into_cells,
    span_in_row,
)

RNG = np.random.default_rng(7)
# Of a squared distance, in squared lengths of the descriptors, whose values are rounded to 1 / 2^14 of it.
SQUARES_TOLERANCE = 3e-4


def whole_rows(vectors):
    """Descriptors (n, d) of the directions of some vectors."""
    unit = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.rint(unit * DESCRIPTOR_LENGTH_UNITS).astype(np.int16)


def random_scene(n=60, k=300, length_px=300.0):
    """Segments of any direction and features, some of which have nearly the descriptor of a segment."""
    low = RNG.uniform(0, 700, (n, 2))
    angle = RNG.uniform(0, 2 * np.pi, n)
    high = low + RNG.uniform(0, length_px, n)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    xy = RNG.uniform(-50, 750, (k, 2))
    in_a, in_b = whole_rows(RNG.random((n, 128))), whole_rows(RNG.random((k, 128)))
    for i in range(n):
        at = low[i] + RNG.uniform(0, 1) * (high[i] - low[i])
        xy[2 * i], xy[2 * i + 1] = at + RNG.uniform(-3, 3, 2), at + RNG.uniform(-3, 3, 2)
        noise = RNG.normal(size=128) * RNG.choice([0.01, 0.05])
        in_b[2 * i] = whole_rows(in_a[i] / DESCRIPTOR_LENGTH_UNITS + noise)
    low[3], high[5, 0] = np.nan, np.inf
    high[7] = low[7]
    return low, high, in_a, xy, in_b


@pytest.mark.parametrize("max_px", [2.0, 30.0, 90.0])
def test_nearest_descriptors_are_those_of_all_pairs(max_px):
    low, high, in_a, xy, in_b = random_scene()
    best_a, best_b = np.empty(len(low), np.int64), np.empty(len(xy), np.int64)
    nearest_descriptors(CurveSegments(low, high, in_a), SecondFeatures(xy, in_b), max_px, 0.8, best_a, best_b)
    expected_a, expected_b = plain.nearest_descriptors(low, high, in_a, xy, in_b, max_px, 0.8)
    np.testing.assert_array_equal(best_a, expected_a)
    np.testing.assert_array_equal(best_b, expected_b)
    assert (expected_a >= 0).sum() > 20
    assert (expected_a < 0).sum() > 3


def test_nothing_to_compare_is_no_match():
    low, high, in_a, _, _ = random_scene(8, 16)
    best_a, best_b = np.empty(8, np.int64), np.empty(0, np.int64)
    nothing = SecondFeatures(np.empty((0, 2)), np.empty((0, 128), np.int16))
    nearest_descriptors(CurveSegments(low, high, in_a), nothing, 30.0, 0.8, best_a, best_b)
    assert (best_a == -1).all()


def distance_of(a, b):
    """Distance of two descriptors (d,)."""
    return descriptor_distance(a[None], np.uint64(0), b[None], np.uint64(0))


@pytest.mark.parametrize("n", [1, 7, 128])
def test_descriptor_distance(n):
    a, b = RNG.random((2, n))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    for other in (a, b):
        squares = ((a - other) ** 2).sum()
        assert distance_of(whole_rows(a), whole_rows(other)) ** 2 == pytest.approx(squares, abs=SQUARES_TOLERANCE)


def test_no_distance_overflows():
    """Of descriptors with one value only, of the same and of opposite signs."""
    one = whole_rows(np.eye(128)[0])
    assert distance_of(one, one) == 0.0
    assert distance_of(one, -one) == 2.0


def test_cells_hold_their_points():
    xy = RNG.uniform(0, 500, (200, 2))
    corner, n = xy.min(axis=0), int(500 / CELL_PX) + 1
    start, order = np.empty(n * n + 1, np.int64), np.empty(200, np.int64)
    sort_into_cells(xy, corner, n, n, start, order)
    assert sorted(order) == list(range(200))
    cell = ((xy - corner) // CELL_PX).astype(int)
    for c in range(n * n):
        assert sorted(order[start[c] : start[c + 1]]) == np.flatnonzero(cell[:, 1] * n + cell[:, 0] == c).tolist()


def test_a_row_of_cells_is_searched_where_the_segment_may_be():
    for _ in range(300):
        low, high = RNG.uniform(0, 300, (2, 2))
        point = low + RNG.uniform(0, 1) * (high - low) + RNG.uniform(-9, 9, 2)
        along, across = plain.distance_to_segment(low, high, point)
        is_here = is_near(*(point - low), direction(low, high), 7.0)
        assert is_here == (along <= 7.0 and across <= 7.0)
        if is_here:
            left, right = span_in_row(low, high, np.floor(point[1] / CELL_PX) * CELL_PX, 7.0)
            assert left <= point[0] <= right


def test_a_rival_at_the_same_place_is_none():
    xy = np.array([[0.0, 0.0], [SAME_PLACE_PX, 0.0], [SAME_PLACE_PX + 0.1, 0.0]])
    near, distance = np.arange(3), np.array([0.3, 0.31, 0.32], np.float32)
    assert not is_clear(xy, near, distance, 3, 0.8)
    assert is_clear(xy, near, distance, 2, 0.8)
    assert not is_clear(xy, near, np.array([0.8 * UNRELATED_DISTANCE + 0.01], np.float32), 1, 0.8)
