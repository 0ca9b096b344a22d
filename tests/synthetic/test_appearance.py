"""What changes from image to image: brightness, waves, cars. The ground of the truth does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from zlocus.synthetic.appearance import CAR_HEIGHT_M, CAR_M, Changes, Moment, brightness, ground_in_view
from zlocus.synthetic.objects import Footprint
from zlocus.synthetic.painting import Painter, plain_road, water
from zlocus.synthetic.terrain import BUILDING, GROUND, ROAD, WATER, SyntheticGround, analytic_ground

NADIR, FORWARD = Moment(0.0, 0.0, 0, 0), Moment(17.0, 0.0, 0, 1)
NEXT_DAY = Moment(0.0, 0.0, 1, 2)
STEP_M, SEED = 0.25, 7


@pytest.fixture(scope="module")
def ground() -> SyntheticGround:
    """A plane with a road along the base line and a pond."""
    painter = Painter.on(analytic_ground("plane", (0.0, 0.0), STEP_M, (320, 240)))
    painter.road(np.full(320, 20.0), 8.0, plain_road(0.4))
    painter.lake(painter.disc(45.0, 30.0, 9.0), water(0.05, 0.3))
    return painter.painted()


def test_nothing_changes_without_a_reason(ground):
    seen = ground_in_view(ground, Changes(), FORWARD, SEED)
    np.testing.assert_array_equal(seen.planes, ground.planes)
    np.testing.assert_array_equal(seen.materials["albedo"], ground.materials["albedo"])


def test_brightness_depends_on_direction_and_on_the_day():
    changes = Changes(directional=0.1, daily=0.2)
    by_view = brightness(4000, changes, FORWARD, SEED) / brightness(4000, changes, NADIR, SEED)
    assert np.log(by_view).std() == pytest.approx(0.1 * np.tan(np.deg2rad(17.0)) / 0.3, rel=0.1)
    by_day = brightness(4000, changes, NEXT_DAY, SEED) / brightness(4000, changes, NADIR, SEED)
    assert np.log(by_day).std() == pytest.approx(0.2 * np.sqrt(2.0), rel=0.1)
    # Images of one day from one direction look alike.
    again = brightness(4000, changes, Moment(0.0, 0.0, 0, 9), SEED)
    np.testing.assert_array_equal(again, brightness(4000, changes, NADIR, SEED))


def test_waves_are_elsewhere_in_every_image(ground):
    is_water = ground.materials["kind"] == WATER
    first, second = (
        ground_in_view(ground, Changes(directional=0.01), moment, SEED).materials for moment in (NADIR, FORWARD)
    )
    assert (first["x"][is_water] != second["x"][is_water]).all()
    np.testing.assert_array_equal(first["x"][~is_water], second["x"][~is_water])


def test_cars_stand_on_lanes_elsewhere_in_every_image(ground):
    changes = Changes(cars_per_km=100.0)
    seen = [ground_in_view(ground, changes, moment, SEED) for moment in (NADIR, FORWARD)]
    raised = [one.heights - ground.heights > 0.5 * CAR_HEIGHT_M for one in seen]
    assert (ground.classes[raised[0]] == ROAD).all()
    assert not np.array_equal(*raised)
    n_cars = raised[0].sum() * STEP_M**2 / (CAR_M[0] * CAR_M[1])
    assert 2 < n_cars < 40
    # The truth is not changed, and bounds of blocks are those of the cars too.
    assert np.ptp(ground.heights[ground.classes == ROAD]) == 0.0
    assert seen[0].block_tops.max() >= seen[0].heights.max()


def test_lanes_follow_the_road_on_both_sides(ground):
    x, _, east, south = ground.lanes.T
    assert set(np.round(x, 6)) == {18.0, 22.0}
    np.testing.assert_allclose(np.hypot(east, south), 1.0)
    assert set(np.sign(south)) == {-1.0, 1.0}


def test_greenhouses_are_gables_side_by_side():
    painter = Painter.on(analytic_ground("plane", (0.0, 0.0), STEP_M, (200, 200)))
    where = painter.greenhouses(Footprint(25.0, 25.0, 0.0, 30.0, 16.0))
    ground = painter.painted()
    assert (ground.classes[where] == BUILDING).all()
    assert (ground.classes[~where] == GROUND).all()
    assert 52.9 < ground.heights[where].min() < ground.heights[where].max() < 54.3
    # A plane continues in the next cell of its side of the gable: heights agree with slopes.
    column = np.flatnonzero(where.any(axis=0))[10]
    rows = np.flatnonzero(where[:, column])[2:6]
    by_row = np.diff(ground.heights[rows, column])
    np.testing.assert_allclose(by_row, ground.slopes[rows[:-1], column, 1], rtol=0, atol=1e-3)


def test_a_lake_is_level_and_below_its_rim():
    painter = Painter.on(analytic_ground("tilt", (0.0, 0.0), STEP_M, (200, 200)))
    before = painter.ground.heights.copy()
    lake = painter.disc(25.0, 25.0, 8.0)
    painter.lake(lake, water(0.05, 0.3))
    heights = painter.painted().heights
    assert np.ptp(heights[lake]) == 0.0
    assert heights[lake][0] < np.percentile(before[lake], 2.0)
    np.testing.assert_array_equal(heights[~lake], before[~lake])


def test_clearing_takes_objects_away():
    ground = analytic_ground("plane", (0.0, 0.0), STEP_M, (200, 200))
    painter = Painter.on(ground)
    tower = painter.tower((25.0, 25.0), 10.0, 130.0)
    assert painter.painted().heights.max() == pytest.approx(180.0)
    painter.clear(tower)
    cleared = painter.painted()
    np.testing.assert_array_equal(cleared.heights, ground.heights)
    assert (cleared.classes == GROUND).all()
    assert (replace(cleared).material == 0).all()
