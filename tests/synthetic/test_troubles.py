"""Painted troubles: each changes and marks its own cells, and the truth stays exact."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from zlocus.core.errors import ConfigError
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.objects import Footprint, Objects, add_objects
from zlocus.synthetic.painting import TruthArea
from zlocus.synthetic.scenes import SATELLITE_VIEWS, city_spec, trouble_spec
from zlocus.synthetic.terrain import BUILDING, WATER, SyntheticGround, analytic_ground
from zlocus.synthetic.troubles import BLINDING, TOWER_M, TROUBLES, with_trouble

STEP_M, CELLS, SEED = 0.5, 460, 3
AREA = TruthArea(10.0, 10.0, 210.0)
HEIGHT_M = 1e-4


@pytest.fixture(scope="module")
def town() -> SyntheticGround:
    bare = analytic_ground("tilt", (0.0, 0.0), STEP_M, (CELLS, CELLS))
    return add_objects(bare, Objects(100.0, 8.0, 0.0, 20.0), SEED)


@pytest.fixture(scope="module", params=TROUBLES)
def painted(request, town) -> tuple[str, SyntheticGround]:
    return request.param, with_trouble(town, request.param, AREA, SEED)


def test_nothing_is_changed_but_marked_cells(painted, town):
    _, ground = painted
    assert ground.marked.shape == ground.heights.shape
    assert 0.005 < ground.marked.mean() < 0.4
    beside = ~ground.marked
    np.testing.assert_array_equal(ground.heights[beside], town.heights[beside])
    np.testing.assert_array_equal(ground.classes[beside], town.classes[beside])
    assert len(np.unique(ground.materials[ground.material[ground.marked]])) < 60


def test_a_trouble_is_repeated_exactly(painted, town):
    name, ground = painted
    again = with_trouble(town, name, AREA, SEED)
    np.testing.assert_array_equal(again.planes, ground.planes)
    np.testing.assert_array_equal(again.material, ground.material)


@pytest.mark.parametrize("name", ["lake", "glitter", "calm-lake"])
def test_lakes_are_level(town, name):
    ground = with_trouble(town, name, AREA, SEED)
    assert np.ptp(ground.heights[ground.marked]) == 0.0
    assert (ground.classes[ground.marked] == WATER).all()


def test_towers_are_as_tall_as_they_say(town):
    ground = with_trouble(town, "towers", AREA, SEED)
    is_roof = ground.heights > town.heights.max() + 0.5 * TOWER_M
    assert (ground.classes[is_roof] == BUILDING).all()
    assert ground.heights[is_roof].min() > town.heights.min() + TOWER_M - HEIGHT_M
    assert (ground.marked[is_roof]).all()
    assert 0.4 < is_roof.sum() / ground.marked.sum() < 0.7


def test_rows_repeat_along_the_base_line(town):
    """Rows lie across the base line (north to south), so that a shift along it by their period changes nothing."""
    ground = with_trouble(town, "rows-2m", AREA, SEED)
    material = ground.materials[ground.material[ground.marked]][0]
    assert material["period"] == 2.0
    assert abs(material["sin"]) < 1e-9
    assert np.ptp(ground.heights[ground.marked]) == 0.0


def test_roofs_are_brighter_than_the_sensor_can_tell(town):
    ground = with_trouble(town, "roofs", AREA, SEED)
    assert (ground.materials[ground.material[ground.marked]]["albedo"] == BLINDING).all()
    np.testing.assert_array_equal(ground.marked, ground.classes == BUILDING)
    assert ground.marked.sum() > (town.classes == BUILDING).sum()


def test_an_unknown_trouble_is_refused():
    with pytest.raises(ConfigError, match="trouble = 'fog' is not one of lake, glitter"):
        city_spec(1, trouble="fog")


def test_files_of_a_trouble(tmp_path: Path):
    """The marks lie on the grid of the truth; saturated images end at the largest number of 12 bits."""
    views = tuple(replace(view, errors=trouble_spec("road").views[0].errors) for view in SATELLITE_VIEWS[:1])
    spec = replace(trouble_spec("road"), size=200, views=views)
    scene = render_scene(spec, tmp_path / "scene")
    with rasterio.open(scene.folder / "trouble.tif") as marks, rasterio.open(scene.truth_dsm) as truth:
        assert marks.transform == truth.transform
        assert set(np.unique(marks.read(1))) == {0, 1}
        assert np.isfinite(truth.read(1)).all()
        is_road = marks.read(1)[100:300, 100:300].any()
    assert is_road
    with rasterio.open(scene.images["n1"]) as image:
        numbers = image.read(1)
    assert numbers.max() == 4095
    assert 0.005 < (numbers == 4095).mean() < 0.5


def test_a_footprint_holds_its_cells(town):
    """The rectangle of a trouble has the area that its sides say."""
    ground = with_trouble(town, "square", AREA, SEED)
    side = np.sqrt(ground.marked.sum()) * STEP_M
    assert side == pytest.approx(Footprint(0, 0, 0.0, 96.0, 96.0).length, abs=2 * STEP_M)
