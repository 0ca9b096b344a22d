"""Medians beside NumPy's, to the last bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from zlocus.matching.median import median


@given(arrays(np.float32, array_shapes(min_dims=1, max_dims=3, max_side=9), elements=st.floats(-1e6, 1e6, width=32)))
def test_medians_of_the_last_axis(values):
    found = median(values)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.median(values, axis=-1))


def test_medians_of_many_values():
    values = np.random.default_rng(0).normal(size=100_001).astype(np.float32)
    assert median(values) == np.median(values)
    assert median(values[1:]) == np.median(values[1:])
