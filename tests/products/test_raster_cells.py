"""Cells that are blended: heights that agree pass over, of others one is taken, and nothing else changes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from zlocus.matching.quality import Quality
from zlocus.products.raster_cells import RasterCells, SurfaceReader, blended, with_fixed

SHAPE = (3, 4)
NOTHING = np.float32(np.nan)


def cells(height, sigma=0.5, quality=0, views=3, grey=7, water=0):
    """Cells of one kind."""
    return RasterCells(
        np.full(SHAPE, height, np.float32), np.full(SHAPE, sigma, np.float32), np.full(SHAPE, quality, np.uint16),
        np.full(SHAPE, views, np.uint8), np.full((1, *SHAPE), grey, np.uint16), np.ones(SHAPE, bool),
        np.full(SHAPE, water, np.uint8),
    )  # fmt: skip


def weights(value):
    return np.full(SHAPE, value, np.float32)


def same(one, other):
    return not one.differs_from(other).any()


def test_outside_the_area_nothing_changes():
    old = cells(10.0)
    assert same(blended(old, cells(30.0, quality=64, views=2, grey=9), weights(0)), old)
    gap = cells(np.nan, np.nan, Quality.NO_MATCH, 0)
    assert same(blended(gap, cells(30.0), weights(0)), gap)


def test_beyond_the_ramp_everything_is_new():
    new = cells(30.0, 0.1, 64, 2, 9)
    assert same(blended(cells(10.0), new, weights(1)), new)


def test_heights_that_agree_pass_from_the_old_to_the_new_ones():
    found = blended(cells(10.0, 0.5), cells(11.0, 0.3), weights(0.25))
    assert (found.height == 10.25).all()
    assert found.sigma == pytest.approx(0.45)
    assert (found.views == 3).all()


@pytest.mark.parametrize(("weight", "height"), [(0.25, 10.0), (0.49, 10.0), (0.5, 30.0), (0.75, 30.0)])
def test_of_heights_that_do_not_agree_one_is_taken(weight, height):
    found = blended(cells(10.0), cells(30.0, views=2), weights(weight))
    assert (found.height == height).all()
    assert (found.views == (3 if height == 10.0 else 2)).all()


def test_a_gap_is_filled_and_a_new_gap_counts_where_the_new_surface_does():
    gap = cells(np.nan, np.nan, Quality.NO_MATCH, 0)
    assert (blended(gap, cells(5.0), weights(0.1)).height == 5.0).all()
    assert (blended(cells(5.0), gap, weights(0.1)).height == 5.0).all()
    assert np.isnan(blended(cells(5.0), gap, weights(0.9)).height).all()


def test_cells_that_were_not_asked_for_and_levelled_water_stay():
    for quality in (Quality.OUTSIDE, Quality.WATER):
        old = cells(10.0, quality=quality, water=1)
        assert same(blended(old, cells(11.0), weights(1)), old)


def test_possible_water_is_land_where_there_is_a_height_now():
    old = cells(np.nan, np.nan, Quality.NO_MATCH, 0, water=3)
    assert (blended(old, cells(5.0), weights(1)).water == 0).all()
    assert (blended(old, cells(np.nan, np.nan, Quality.NO_MATCH, 0), weights(1)).water == 3).all()


@given(
    npst.arrays(np.float32, SHAPE, elements=st.floats(-500, 9000, width=32)),
    npst.arrays(np.float32, SHAPE, elements=st.floats(0, 1, width=32)),
)
def test_a_surface_blended_with_itself_keeps_its_bytes(height, weight):
    old = cells(0.0)
    old = RasterCells(height, *old.arrays[1:])
    assert same(blended(old, old, weight), old)


@given(st.floats(0, 1, width=32), st.floats(-2, 2, width=32))
def test_a_blended_height_is_between_both(weight, apart):
    found = blended(cells(10.0, 1.0), cells(10.0 + apart, 1.0), weights(weight)).height
    assert (found >= min(10.0, np.float32(10 + apart)) - 1e-5).all()
    assert (found <= max(10.0, np.float32(10 + apart)) + 1e-5).all()


def test_a_given_height_has_no_standard_deviation_and_counts_as_filled():
    heights = np.full(SHAPE, np.nan)
    heights[1, 2] = 4.5
    old = cells(10.0)
    found = with_fixed(old, heights)
    assert found.height[1, 2] == 4.5
    assert np.isnan(found.sigma[1, 2])
    assert found.quality[1, 2] == Quality.FILLED
    assert found.views[1, 2] == 0
    assert found.differs_from(old).sum() == 1
    assert same(with_fixed(cells(10.0, quality=Quality.OUTSIDE), heights), cells(10.0, quality=Quality.OUTSIDE))


def test_cells_are_read_as_they_were_written(small_surface):
    with SurfaceReader(small_surface) as reader:
        rows, cols = reader.geobox.shape
        whole, part = reader.read(0, 0, (rows, cols)), reader.read(3, 5, (7, 9))
    assert same(part, RasterCells(*(array[..., 3:10, 5:14] for array in whole.arrays)))
    assert whole.height.dtype == np.float32
    assert np.isfinite(whole.height).any()
