"""Lakes with known levels: level to the last bit, and lower than all ground around them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt

from zlocus.synthetic.lakes import LAKES, SHORE_M, with_lake
from zlocus.synthetic.objects import Objects, add_objects
from zlocus.synthetic.painting import TruthArea
from zlocus.synthetic.terrain import TREE, WATER, SyntheticGround, analytic_ground

STEP_M, CELLS, SEED = 0.5, 460, 3
AREA = TruthArea(20.0, 10.0, 190.0)
# The shore of a cell beside the water rises over the distance between the centres of two cells, diagonally at most.
RISE_M = {"lake-beach": 0.08, "lake-bank": 1.0, "lake-quay": 1.7}


@pytest.fixture(scope="module")
def town() -> SyntheticGround:
    bare = analytic_ground("tilt", (0.0, 0.0), STEP_M, (CELLS, CELLS))
    return add_objects(bare, Objects(100.0, 8.0, 0.0, 20.0), SEED)


@pytest.mark.parametrize("name", LAKES)
def test_a_lake_is_level_and_lies_lowest(town, name):
    ground = with_lake(town, name, AREA, SEED)
    water = ground.marked & (ground.classes == WATER)
    (level,) = np.unique(ground.heights[water])
    assert (ground.slopes[water] == 0.0).all()
    away_m = STEP_M * distance_transform_edt(~ground.marked)
    near = ~ground.marked & (away_m < SHORE_M)
    assert ground.heights[near].min() > level
    is_tree = ground.classes[ground.marked] == TREE
    assert is_tree.any() == (name == "lake-wooded")
    assert water.sum() + is_tree.sum() == ground.marked.sum()
    if name != "lake-wooded":  # whose crowns may reach farther
        np.testing.assert_array_equal(ground.heights[away_m >= SHORE_M], town.heights[away_m >= SHORE_M])


@pytest.mark.parametrize("name", RISE_M)
def test_the_shore_has_its_slope(town, name):
    ground = with_lake(town, name, AREA, SEED)
    level = ground.heights[ground.marked].min()
    beside = binary_dilation(ground.marked) & ~ground.marked
    rise = ground.heights[beside] - level
    assert rise.max() < RISE_M[name] * (1.0 if name == "lake-quay" else np.sqrt(2.0) * STEP_M) + 1e-3
    assert rise.min() > 0.4 * RISE_M[name] * STEP_M


def test_a_lake_lies_across_the_border_of_the_area(town):
    ground = with_lake(town, "lake-cut", AREA, SEED)
    west = round(AREA.x / STEP_M)
    assert ground.marked[:, :west].any()
    assert ground.marked[:, west:].any()


def test_a_lake_is_repeated_exactly(town):
    one, two = (with_lake(town, "lake-wooded", AREA, SEED) for _ in range(2))
    np.testing.assert_array_equal(one.planes, two.planes)
    np.testing.assert_array_equal(one.material, two.material)
