"""The kernels that match features and patches, against plain versions and planted truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from reference import ties as plain
from zlocus.orientation.kernels.descriptors import (
    CELL_PX,
    SAME_PLACE_PX,
    UNRELATED_DISTANCE,
    dot,
    is_clear,
    is_near,
    nearest_descriptors,
    sort_into_cells,
    span_in_row,
)
from zlocus.orientation.kernels.patches import (
    correlation,
    covariance,
    fine_shift,
    patch_shifts,
    sample_cubic,
    sample_linear,
    whole_shift,
)

RNG = np.random.default_rng(7)
# Of smooth noise, between least squares on cubic convolution and the best correlation on a spline.
SHIFT_PX = 0.06
# Of smooth noise sampled by cubic convolution, in standard deviations.
CONVOLUTION = 0.02
FLOAT32 = 1e-5


def unit_rows(n, length=128):
    vectors = RNG.random((n, length)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def random_scene(n=60, k=300, length_px=300.0):
    """Segments of any direction and features, some of which have nearly the descriptor of a segment."""
    low = RNG.uniform(0, 700, (n, 2))
    angle = RNG.uniform(0, 2 * np.pi, n)
    high = low + RNG.uniform(0, length_px, n)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    xy = RNG.uniform(-50, 750, (k, 2))
    in_a, in_b = unit_rows(n), unit_rows(k)
    for i in range(n):
        at = low[i] + RNG.uniform(0, 1) * (high[i] - low[i])
        xy[2 * i], xy[2 * i + 1] = at + RNG.uniform(-3, 3, 2), at + RNG.uniform(-3, 3, 2)
        noisy = in_a[i] + RNG.normal(size=128) * RNG.choice([0.01, 0.05])
        in_b[2 * i] = noisy / np.linalg.norm(noisy)
    low[3], high[5, 0] = np.nan, np.inf
    high[7] = low[7]
    return low, high, in_a, xy, in_b


@pytest.mark.parametrize("max_px", [2.0, 30.0, 90.0])
def test_nearest_descriptors_are_those_of_all_pairs(max_px):
    low, high, in_a, xy, in_b = random_scene()
    best_a, best_b = np.empty(len(low), np.int64), np.empty(len(xy), np.int64)
    nearest_descriptors(low, high, in_a, xy, in_b, max_px, 0.8, best_a, best_b)
    expected_a, expected_b = plain.nearest_descriptors(low, high, in_a, xy, in_b, max_px, 0.8)
    np.testing.assert_array_equal(best_a, expected_a)
    np.testing.assert_array_equal(best_b, expected_b)
    assert (expected_a >= 0).sum() > 20
    assert (expected_a < 0).sum() > 3


def test_nothing_to_compare_is_no_match():
    low, high, in_a, _, _ = random_scene(8, 16)
    best_a, best_b = np.empty(8, np.int64), np.empty(0, np.int64)
    nearest_descriptors(low, high, in_a, np.empty((0, 2)), np.empty((0, 128), np.float32), 30.0, 0.8, best_a, best_b)
    assert (best_a == -1).all()


@pytest.mark.parametrize("n", [1, 4, 7, 128])
def test_dot(n):
    a, b = RNG.random((2, n)).astype(np.float32)
    assert dot(a, b) == pytest.approx(float(np.dot(a.astype(float), b)), rel=FLOAT32)


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
        assert is_near(low, high, point, 7.0) == (along <= 7.0 and across <= 7.0)
        if is_near(low, high, point, 7.0):
            left, right = span_in_row(low, high, np.floor(point[1] / CELL_PX) * CELL_PX, 7.0)
            assert left <= point[0] <= right


def test_a_rival_at_the_same_place_is_none():
    xy = np.array([[0.0, 0.0], [SAME_PLACE_PX, 0.0], [SAME_PLACE_PX + 0.1, 0.0]])
    near, distance = np.arange(3), np.array([0.3, 0.31, 0.32], np.float32)
    assert not is_clear(xy, near, distance, 3, 0.8)
    assert is_clear(xy, near, distance, 2, 0.8)
    assert not is_clear(xy, near, np.array([0.8 * UNRELATED_DISTANCE + 0.01], np.float32), 1, 0.8)


def smooth(shape, sigma=1.8, seed=0):
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma, mode="wrap")
    return noise / noise.std()


def planted(warp, shift, seed, half=4, side=41):
    """A patch with its border and the square that shows it, warped and `shift` off the middle of the square."""
    patch = smooth((60, 60), seed=seed)
    cols, rows = np.meshgrid(np.arange(side), np.arange(side))
    offset = np.stack([cols, rows], axis=-1) - side // 2 - np.asarray(shift)
    in_patch = offset @ np.linalg.inv(warp).T
    square = map_coordinates(patch, [in_patch[..., 1] + 30, in_patch[..., 0] + 30], order=3, mode="wrap")
    cut = slice(30 - half - 1, 30 + half + 2)
    return patch[cut, cut].astype(np.float32), (500.0 + 40.0 * square).astype(np.float32)


WARPS = [
    np.eye(2),
    np.array([[0.9, 0.1], [-0.05, 1.1]]),
    np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]]),
]


@pytest.mark.parametrize("warp", WARPS)
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.3), (-2.3, 1.6)])
def test_patches_are_found_where_they_were_planted(warp, shift):
    """Whatever the gain and the offset; on average to a few hundredths of a pixel."""
    cases = [planted(warp, shift, seed) for seed in range(12)]
    patches, squares = (np.stack(arrays) for arrays in zip(*cases, strict=True))
    out = np.empty((12, 3))
    patch_shifts(patches, squares, np.tile(warp, (12, 1, 1)), np.full((12, 2), 20.0), 3, out)
    assert (out[:, 2] > 0.95).mean() > 0.8
    good = out[:, 2] > 0.95
    np.testing.assert_allclose(out[good, :2], np.tile(shift, (good.sum(), 1)), rtol=0, atol=SHIFT_PX)
    for patch, square, found in zip(patches[good], squares[good], out[good], strict=True):
        expected = plain.patch_shift(patch, square, warp, (20.0, 20.0), 3)
        np.testing.assert_allclose(found[:2], expected[:2], rtol=0, atol=SHIFT_PX)
        assert found[2] == pytest.approx(expected[2], abs=0.01)


def test_what_cannot_be_measured_has_no_correlation():
    patch, square = planted(np.eye(2), (0.2, 0.1), 1)
    flat = np.ones_like(patch)
    edge = np.tile(np.arange(patch.shape[1], dtype=np.float32), (patch.shape[0], 1))
    out = np.empty((5, 3))
    patches, squares = np.stack([patch, flat, edge, patch, patch]), np.stack([square] * 5)
    warps, centres = np.tile(np.eye(2), (5, 1, 1)), np.full((5, 2), 20.0)
    warps[3], centres[4] = 0.0, 7.0
    patch_shifts(patches, squares, warps, centres, 2, out)
    assert out[0, 2] > 0.95
    assert (out[1:, 2] == 0.0).all()


def test_samples_and_their_correlation():
    square, n = smooth((30, 30)).astype(np.float32), 50
    x, y = RNG.uniform(5, 24, (2, n))
    linear, cubic, shift = np.empty(n), np.empty(n), np.array([0.7, -1.2])
    sample_linear(square, x, y, shift, linear)
    expected = map_coordinates(square.astype(float), [y - 1.2, x + 0.7], order=1)
    np.testing.assert_allclose(linear, expected, rtol=0, atol=FLOAT32)
    sample_cubic(square, x, y, shift, cubic)
    spline = map_coordinates(square.astype(float), [y - 1.2, x + 0.7], order=3)
    assert np.sqrt(np.mean((cubic - spline) ** 2)) < CONVOLUTION
    assert correlation(linear, cubic) == pytest.approx(plain.correlation(linear, cubic))
    assert covariance(linear, cubic) == pytest.approx(n * np.cov(linear, cubic, bias=True)[0, 1])
    assert correlation(linear, np.ones(n)) == 0.0


def test_whole_pixels_first_then_fractions():
    square = smooth((40, 40), seed=4).astype(np.float32)
    x, y = (v.ravel().astype(float) for v in np.meshgrid(np.arange(14, 23), np.arange(15, 24)))
    values = map_coordinates(square.astype(float), [y + 1.7, x - 2.2], order=3)
    shift = np.empty(2)
    whole_shift(square, values, x, y, 3, shift)
    assert shift.tolist() == [-2.0, 2.0]
    across = map_coordinates(square.astype(float), [y + 1.7, x - 1.7], order=3) - map_coordinates(
        square.astype(float), [y + 1.7, x - 2.7], order=3
    )
    down = map_coordinates(square.astype(float), [y + 2.2, x - 2.2], order=3) - map_coordinates(
        square.astype(float), [y + 1.2, x - 2.2], order=3
    )
    ncc = fine_shift(square, values, np.column_stack([across, down]), x, y, shift)
    assert ncc > 0.98
    np.testing.assert_allclose(shift, (-2.2, 1.7), rtol=0, atol=SHIFT_PX)
    assert fine_shift(square, values, np.column_stack([across, across]), x, y, shift) == 0.0
