"""Overlap of the images, and the area to match."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from orientation_scenes import image_of
from rendered_scenes import CENTRE, UTM
from zlocus.core.errors import GeometryError
from zlocus.core.footprints import (
    AREA_MARGIN,
    MIN_TIES_FOR_AREA,
    area_to_match,
    matched_area,
    parallax_rate_at,
    shared_ground,
)
from zlocus.core.grid import CellWindow, grid_from_bounds
from zlocus.core.scene import Scene, View
from zlocus.synthetic.cameras import SatelliteCamera

LOCAL = CRS.from_wkt('LOCAL_CS["frame",UNIT["metre",1]]')
Z_RANGE = (49.0, 51.0)


def view(name, along=0.0, across=0.0, east=0.0, shape=(120, 160)):
    """An image with ground pixels of 0.5 m: 80 m by 60 m."""
    rows, cols = shape
    sensor = SatelliteCamera((CENTRE[0] + east, CENTRE[1], 50.0), ((cols - 1) / 2, (rows - 1) / 2), 0.5, along, across)
    return View(name, Path(f"{name}.tif"), image_of(np.zeros(shape)), sensor)


def scene(*views):
    return Scene(views, UTM)


def test_shared_ground_is_what_two_views_see():
    """80 m wide images 30 and 200 m apart: the third sees nothing of the others' ground."""
    views = scene(view("a"), view("b", east=30.0), view("c", east=200.0))
    xmin, ymin, xmax, ymax = shared_ground(views, (49.0, 51.0))
    assert (xmin, xmax) == pytest.approx((CENTRE[0] - 10, CENTRE[0] + 40), abs=0.1)
    assert (ymin, ymax) == pytest.approx((CENTRE[1] - 30, CENTRE[1] + 30), abs=0.1)
    with pytest.raises(GeometryError, match="No two images"):
        shared_ground(scene(view("a"), view("c", east=200.0)), (49.0, 51.0))


def test_the_area_of_the_scene_file_is_matched():
    bounds = (1.0, 2.0, 3.0, 4.0)
    assert area_to_match(replace(scene(view("a"), view("b")), bounds=bounds), Z_RANGE, np.zeros((0, 3))) == bounds


def test_in_a_local_frame_the_area_is_that_of_the_tie_points():
    """Extended on all sides, and never beyond what two views see."""
    views = scene(view("a"), view("b"))
    low, high = np.array([CENTRE[0] - 10, CENTRE[1] - 5]), np.array([CENTRE[0] + 500, CENTRE[1] + 5])
    ties = np.column_stack([np.random.default_rng(0).uniform(low, high, (2000, 2)), np.full(2000, 50.0)])
    shared = shared_ground(views, Z_RANGE)
    assert area_to_match(views, Z_RANGE, ties) == shared
    local = replace(views, crs=LOCAL)
    assert area_to_match(local, Z_RANGE, ties[: MIN_TIES_FOR_AREA - 1]) == shared
    xmin, ymin, xmax, ymax = area_to_match(local, Z_RANGE, ties)
    assert xmin == pytest.approx(CENTRE[0] - 10 - AREA_MARGIN * 510, abs=4.0)
    assert xmax == shared[2]
    assert (ymin, ymax) == pytest.approx((CENTRE[1] - 5.5, CENTRE[1] + 5.5), abs=0.3)


def test_the_matched_area_is_the_part_of_the_grid_that_two_images_see():
    grid = grid_from_bounds((100.0, 200.0, 110.0, 205.0), 0.5, UTM)
    first = grid.window
    assert matched_area(grid, CellWindow(first.row + 4, first.col - 100, 200, 110)) == (100.0, 200.0, 105.0, 203.0)
    with pytest.raises(GeometryError, match=r"E 100 to 110 m, N 200 to 205 m\) lies outside .*E 200 to 205 m"):
        matched_area(grid, CellWindow(first.row, first.col + 200, 10, 10))


def test_the_parallax_rate_at_a_place_is_the_tangent_of_the_view_angle():
    east, north = parallax_rate_at(view("v", along=20, across=-10), np.array([*CENTRE, 50.0]))
    assert -north == pytest.approx(np.tan(np.deg2rad(20)), rel=1e-3)
    assert -east == pytest.approx(np.tan(np.deg2rad(-10)), rel=1e-3)
