"""Requests that do not fit the images are refused with the value that is wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pyproj import Transformer

from location_grids import grid_of
from zlocus.core.errors import ConfigError, CoverageError, GeometryError
from zlocus.core.footprints import shared_ground
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import SetupRequest
from zlocus.io.scene_file import open_scene
from zlocus.pipeline import setup
from zlocus.pipeline.height_range import possible_heights
from zlocus.pipeline.request_fit import check_bounds_in_metres, check_heights_of_cameras
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.location_grid import LocationGridModel

# A rendered town in UTM zone 32, about 9.00 degrees east and 47.00 degrees north.
VIEWS = ("img_n1.tif", "img_f1.tif")


@pytest.fixture(scope="module")
def images(small_town):
    return tuple(small_town / name for name in VIEWS)


@pytest.fixture(scope="module")
def scene(images):
    return open_scene(images)


def test_bounds_in_degrees_are_recognised_and_converted(scene):
    z = possible_heights(scene, None)
    seen = shared_ground(scene, (z[0], z[-1]))
    degrees = Transformer.from_crs(scene.crs, "EPSG:4326", always_xy=True).transform_bounds(*seen)
    with pytest.raises(ConfigError, match="are degrees, and bounds are in metres") as caught:
        check_bounds_in_metres(degrees, scene)
    told = [float(word) for word in str(caught.value).rstrip(".").split()[-4:]]
    assert told == pytest.approx(seen, abs=30.0)  # the box around a box that is turned
    check_bounds_in_metres(seen, scene)
    check_bounds_in_metres((120.0, -40.0, 121.0, -39.0), scene)  # no place of these images: another check refuses it


def test_bounds_in_degrees_elsewhere_look_like_degrees(images):
    request = SetupRequest(images, bounds=(120.0, -40.0, 121.0, -39.0))
    with pytest.raises(GeometryError, match=r"lies outside the ground that two images see.* look like degrees"):
        open_inputs(request, SilentProgress())


def test_heights_beyond_the_cameras_are_refused(scene, images):
    low, high = scene.views[0].sensor.height_bounds()
    check_heights_of_cameras((low - 10.0, low + 1.0), scene)
    for wrong in ((high + 1.0, high + 100.0), (low - 100.0, low - 1.0)):
        with pytest.raises(GeometryError, match=r"The heights asked for, .* lie outside those of the images' cameras"):
            check_heights_of_cameras(wrong, scene)
    with pytest.raises(GeometryError, match="1000 to 2000 m, lie outside"):
        open_inputs(SetupRequest(images, heights=(1000.0, 2000.0)), SilentProgress())


def test_heights_beyond_a_location_grid_are_refused(scene):
    """A grid is extended by the distance of its outermost heights, and maps nothing beyond."""
    first, second = scene.views
    (rows, cols), (low, high) = first.image.shape, first.sensor.height_bounds()
    heights, step = (low, low + 10.0, high), (cols - 1.0, rows - 1.0)
    location_grid = grid_of(first.sensor, scene.crs, heights, (0.0, 0.0), step, (2, 2))
    sensor = ShiftedModel(LocationGridModel(location_grid, scene.crs), 1.0, 0.0)
    tabulated = replace(scene, views=(second, replace(first, sensor=sensor)))
    check_heights_of_cameras((low - 9.0, high + 1.0), tabulated)
    for wrong in ((low - 11.0, high), (low, 2 * high - low)):
        with pytest.raises(GeometryError, match=rf"reach beyond the location grid of {first.name}, which maps"):
            check_heights_of_cameras(wrong, tabulated)
        check_heights_of_cameras(wrong, scene)


def test_heights_without_ground_are_blamed_where_ties_lie_elsewhere(images, monkeypatch):
    """Where no tie point is found between the heights asked for, they are searched at all heights."""
    request, config = SetupRequest(images, heights=(400.0, 500.0)), RunConfig()
    opened = open_inputs(request, SilentProgress())
    orientation = orient_views(opened.scene, config.orientation, SilentProgress())
    low, high = orientation.xyz[:, 2].min(), orientation.xyz[:, 2].max()

    def nothing_matched(scene, orientation):
        raise CoverageError("nothing was matched.")

    monkeypatch.setattr(setup, "supported_views", nothing_matched)
    with pytest.raises(GeometryError, match=r"No tie point has one of the heights asked for, 400 to 500 m") as caught:
        set_up_run(request, opened, orientation, config, SilentProgress())
    told = [float(word) for word in str(caught.value).split("lie between ")[1].split()[:3:2]]
    assert low - 1.0 <= told[0] < told[1] <= high + 1.0
    with pytest.raises(CoverageError, match=r"nothing was matched"):
        set_up_run(SetupRequest(images), opened, orientation, config, SilentProgress())


def test_a_crs_made_for_another_part_of_the_earth_is_refused(images, scene):
    says = (
        r"UTM zone 55S\) is made for 144 to 150 degrees east, 80 to 0 degrees south, and is not true to scale where "
        r"the images lie, at .* Use EPSG:32632"
    )
    with pytest.raises(ConfigError, match=says):
        open_inputs(SetupRequest(images, crs="EPSG:32755"), SilentProgress())
    for fits in ("EPSG:32633", "EPSG:25832", "EPSG:3035"):
        assert open_inputs(SetupRequest(images, crs=fits), SilentProgress()).scene.crs.to_string() == fits
