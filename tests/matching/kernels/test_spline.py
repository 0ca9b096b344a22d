"""Cubic B-spline coefficients against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter, spline_filter1d

from zlocus.matching.kernels.spline import filter_columns, spline_coefficients, transposed

# Float32 recursions on images with a spread of one grey value.
GREY = 2e-5
SHAPES = [(2, 3), (3, 2), (16, 17), (33, 5), (61, 97)]


def image_of(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("shape", SHAPES)
def test_coefficients(shape):
    image = image_of(shape)
    kept = image.copy()
    found = spline_coefficients(image)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, spline_filter(image, 3, output=float, mode="mirror"), rtol=0, atol=GREY)
    np.testing.assert_array_equal(image, kept)


@pytest.mark.parametrize("shape", SHAPES)
def test_filtered_columns(shape):
    found = image_of(shape)
    filter_columns(found)
    expected = spline_filter1d(image_of(shape), 3, axis=0, output=float, mode="mirror")
    np.testing.assert_allclose(found, expected, rtol=0, atol=GREY)


def test_one_row_has_nothing_to_filter():
    found = image_of((1, 9))
    filter_columns(found)
    np.testing.assert_array_equal(found, image_of((1, 9)))


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (17, 35), (50, 3)])
def test_transposed(shape):
    np.testing.assert_array_equal(transposed(image_of(shape)), image_of(shape).T)


def test_the_spline_passes_through_the_image():
    image = image_of((23, 31)) + 200
    row, col = np.indices(image.shape)
    through = map_coordinates(spline_coefficients(image), [row, col], order=3, prefilter=False, mode="mirror")
    np.testing.assert_allclose(through, image, rtol=0, atol=200 * GREY)
