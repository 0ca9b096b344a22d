"""Units of edges and of texture: from a tile's own cells, and blind to small differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.matching.local_contrast import STEPS_PER_DOUBLING, edge_unit, rounded, texture_unit

# Share by which a unit may miss what it stands for: half of a step of powers.
HALF_A_STEP = 2 ** (0.5 / STEPS_PER_DOUBLING) * (1 + 1e-9)


def image(shape=(40, 50), seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@given(st.floats(1e-6, 1e6))
def test_a_unit_is_a_power_of_two_nearby(value):
    found = rounded(value)
    assert 1 / HALF_A_STEP <= found / value <= HALF_A_STEP
    assert STEPS_PER_DOUBLING * np.log2(found) == pytest.approx(round(STEPS_PER_DOUBLING * np.log2(found)), abs=1e-9)
    assert rounded(found) == pytest.approx(found, rel=1e-12)


def test_small_differences_make_none():
    grey = image()
    assert edge_unit(grey) == edge_unit(grey * np.float32(1.0001))
    assert texture_unit(grey) == texture_unit(grey * np.float32(1.0001))


@pytest.mark.parametrize("unit", [edge_unit, texture_unit])
def test_cells_beside_the_core_do_not_count(unit):
    grey, core = image(), (slice(10, 30), slice(5, 45))
    other = grey * np.float32(50.0)
    other[core] = grey[core]
    assert unit(other, core) == unit(grey, core)
    assert unit(other) > 2 * unit(grey)


@pytest.mark.parametrize("unit", [edge_unit, texture_unit])
def test_cells_that_show_nothing_do_not_count(unit):
    grey = image()
    grey[:, 30:] = np.nan
    assert unit(grey) == pytest.approx(unit(grey[:, :30]), rel=0.2)
    assert unit(np.full((5, 5), np.nan, np.float32)) == 0.0


def test_an_even_image_and_a_single_column_have_no_edges():
    assert edge_unit(np.ones((6, 7), np.float32)) == 0.0
    assert edge_unit(image((6, 1))) == 0.0
