"""Patches measured to fractions of a pixel, against plain versions and planted shifts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from reference import ties as plain
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
