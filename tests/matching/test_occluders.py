"""What a block beside level ground occludes, by trigonometry and by the kernel of the matching."""

from __future__ import annotations

import numpy as np
import pytest

from rendered_scenes import CENTRE
from zlocus.matching.kernels.occlusion import lowest_visible
from zlocus.matching.occluders import occluder_of
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.terrain import analytic_height

CELL_M, GROUND_M, BLOCK_M, TOP_M = 0.5, 50.0, 65.0, 70.0
# Places are compared half a cell apart.
PLACE_M = CELL_M
ACROSS_DEG = 20.0


def camera(across):
    """A satellite camera far to one side of the scene, which looks at it at this angle off the vertical."""
    return SatelliteCamera((*CENTRE, GROUND_M), (75.0, 75.0), CELL_M, 0.0, across)


def block(xy):
    """The block: all that lies east of the centre, on cells."""
    cells = np.floor(np.array(xy) / CELL_M) * CELL_M + CELL_M / 2
    return analytic_height("step", cells[:, 0] - CENTRE[0], cells[:, 1] - CENTRE[1])


def moves_east(sensor):
    """Metres that the ray through the centre moves east for each metre that it rises."""
    here = np.array([[*CENTRE, GROUND_M]])
    above = sensor.ground_from_image(sensor.image_from_ground(here), np.array([GROUND_M + 1.0]))
    return float((above - here)[0, 0])


def seen_over_the_block():
    """The camera whose rays rise over the block."""
    sensor = next(each for each in map(camera, (ACROSS_DEG, -ACROSS_DEG)) if moves_east(each) > 0)
    assert moves_east(sensor) == pytest.approx(np.tan(np.radians(ACROSS_DEG)), rel=0.02)
    return sensor


def test_an_image_that_looks_over_the_block_does_not_see_the_ground_behind_it():
    sensor, before_wall = seen_over_the_block(), 1.0
    xyz = np.array([CENTRE[0] - before_wall, CENTRE[1] + 0.25, GROUND_M])
    found = occluder_of(sensor, xyz, block, TOP_M, CELL_M)
    per_metre = moves_east(sensor)
    assert found.xyz[2] == BLOCK_M
    # The image shows the place of the roof through which the ray leaves the block.
    assert found.distance_m == pytest.approx((BLOCK_M - GROUND_M) * per_metre, abs=PLACE_M)
    assert found.xyz[0] - xyz[0] == pytest.approx(found.distance_m, abs=0.1)
    # It sees past the upper edge of the wall.
    assert found.lowest_visible_m == pytest.approx(BLOCK_M - before_wall / per_metre, abs=PLACE_M / per_metre)


def test_the_lowest_visible_height_is_that_of_the_matching():
    """On every cell of a row from the wall to beyond its shadow."""
    sensor, per_metre = seen_over_the_block(), moves_east(seen_over_the_block())
    n_cols, first = 60, -30
    x = CENTRE[0] + (np.arange(first, first + n_cols) + 0.5) * CELL_M
    surface = np.tile(block(np.column_stack([x, np.full(n_cols, CENTRE[1])])), (5, 1)).astype(np.float32)
    lowest = np.empty_like(surface)
    lowest_visible(surface, per_metre / CELL_M, 0.0, lowest)
    occluded = 0
    for col in range(5, -first):
        found = occluder_of(sensor, np.array([x[col], CENTRE[1], GROUND_M]), block, TOP_M, CELL_M)
        if abs(lowest[2, col] - GROUND_M) > PLACE_M / per_metre:  # not at the very edge of the shadow
            assert (found is None) == (lowest[2, col] < GROUND_M)
        if found is not None:
            occluded += 1
            assert found.lowest_visible_m == pytest.approx(lowest[2, col], abs=PLACE_M / per_metre)
    assert occluded == pytest.approx((BLOCK_M - GROUND_M) * per_metre / CELL_M, abs=1)


def test_what_is_free_has_no_occluder():
    xyz = np.array([CENTRE[0] - 1.0, CENTRE[1], GROUND_M])
    away = next(each for each in map(camera, (ACROSS_DEG, -ACROSS_DEG)) if moves_east(each) < 0)
    assert occluder_of(away, xyz, block, TOP_M, CELL_M) is None
    sensor = seen_over_the_block()
    assert occluder_of(sensor, xyz, block, GROUND_M, CELL_M) is None  # nothing is higher
    on_roof = np.array([CENTRE[0] + 3.0, CENTRE[1], BLOCK_M])
    assert occluder_of(sensor, on_roof, block, TOP_M, CELL_M) is None
    assert occluder_of(sensor, xyz, lambda xy: np.full(len(xy), np.nan), TOP_M, CELL_M) is None


def test_less_than_the_margin_occludes_nothing():
    sensor = seen_over_the_block()
    xyz = np.array([CENTRE[0] - 1.0, CENTRE[1], GROUND_M])
    above_m = occluder_of(sensor, xyz, block, TOP_M, CELL_M).lowest_visible_m - GROUND_M
    assert occluder_of(sensor, xyz, block, TOP_M, CELL_M, above_m + 0.01) is None
    assert occluder_of(sensor, xyz, block, TOP_M, CELL_M, above_m - 0.01) is not None
