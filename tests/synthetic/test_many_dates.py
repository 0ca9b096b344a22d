"""Images of many dates: their names, suns and tags, and the ground that is changed between two of them."""

from __future__ import annotations

import datetime
import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import shapely

from zlocus.core.errors import ConfigError
from zlocus.io.image_acquisition import acquisition_of, sun_altitude_deg
from zlocus.synthetic.acquisitions import FIRST_DAY
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.many_dates import WORKS_DAY, many_dates_spec, sun_of_day
from zlocus.synthetic.terrain import WATER
from zlocus.synthetic.works import HEAP_M, HEAP_RADIUS_M, PIT_M

SUN_DEG, ANGLE_DEG = 1.5, 0.06
# The cone of the heap, less what stood there.
HEAP_M3 = np.pi / 3 * HEAP_RADIUS_M**2 * HEAP_M
CELL_M2 = 0.25**2


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two of the dates, one before the works and one after."""
    spec = many_dates_spec(1, 4)
    spec = replace(spec, size=160, views=spec.views[1:3])
    return spec, render_scene(spec, tmp_path_factory.mktemp("dates") / "scene")


def read(path):
    with rasterio.open(path) as file:
        return file.read(1), file.transform


def test_every_image_has_its_day():
    views = many_dates_spec(1).views
    assert len(views) == 19
    days = [view.day for view in views]
    assert days == sorted(set(days))
    assert [view.name for view in views] == [f"{FIRST_DAY + datetime.timedelta(days=day):%Y%m%d}" for day in days]
    assert 6 <= sum(day < WORKS_DAY for day in days) <= 13
    assert len({view.along_deg for view in views}) == 19
    for n_images in (3, 101):
        with pytest.raises(ConfigError, match="--views"):
            many_dates_spec(1, n_images)
    for view in many_dates_spec(2, 4).views:
        assert (view.day < WORKS_DAY) == (view.name < "2015")


def test_the_sun_follows_the_season():
    """As the almanac says, at the longitude at which the hour is that of the pass."""
    for day in (0, 80, 140, 230, 300):
        date = FIRST_DAY + datetime.timedelta(days=day)
        noon = datetime.datetime(date.year, date.month, date.day, 10, 48, tzinfo=datetime.UTC)
        best = max(sun_altitude_deg(noon, lon, 47.0) for lon in np.arange(-10.0, 10.0))
        assert sun_of_day(day).elevation_deg < best + SUN_DEG
        assert 100.0 < sun_of_day(day).azimuth_deg < 180.0
    assert sun_of_day(300).elevation_deg > sun_of_day(140).elevation_deg + 35.0


def test_the_tags_say_when_and_how(scene):
    spec, rendered = scene
    for view in spec.views:
        with rasterio.open(rendered.images[view.name]) as image:
            found = acquisition_of(image)
        assert found.date == FIRST_DAY + datetime.timedelta(days=view.day)
        assert found.time is not None
        assert abs(found.sun_direction.altitude_deg - view.sun.elevation_deg) < ANGLE_DEG
        tangent = np.hypot(*np.tan(np.deg2rad([view.along_deg, view.across_deg])))
        assert abs(found.incidence_deg - np.rad2deg(np.arctan(tangent))) < 0.15 * found.incidence_deg + ANGLE_DEG


def test_the_ground_is_changed_inside_the_polygons_only(scene):
    spec, rendered = scene
    before, transform = read(rendered.folder / "truth_dsm.tif")
    after, _ = read(rendered.folder / "truth_dsm_after.tif")
    classes, _ = read(rendered.folder / "truth_class_after.tif")
    document = json.loads((rendered.folder / "works.geojson").read_text())
    assert document["crs"]["properties"]["name"].endswith(f"::{spec.epsg}")
    named = {each["properties"]["name"]: shapely.geometry.shape(each["geometry"]) for each in document["features"]}
    assert list(named) == ["pit", "heap"]
    rows, cols = np.indices(before.shape)
    x, y = transform * (cols + 0.5, rows + 0.5)
    inside = {name: shapely.contains_xy(polygon, x, y) for name, polygon in named.items()}
    change = np.nan_to_num(after - before)
    assert not change[~(inside["pit"] | inside["heap"])].any()
    assert (classes[(change != 0)] != WATER).all()
    pit = (change[inside["pit"]] < -1.0).sum() * CELL_M2
    assert 0.9 * np.prod(PIT_M) < pit < 1.01 * np.prod(PIT_M)
    assert 0.3 * HEAP_M3 < change[inside["heap"]].sum() * CELL_M2 < 1.1 * HEAP_M3


def test_images_show_the_works_from_their_day_on(scene):
    """The heap hides what lies behind it, and both have soil in place of what grew there."""
    spec, rendered = scene
    unchanged = replace(spec, works_day=None)
    again = render_scene(unchanged, rendered.folder.with_name("unchanged"))
    (early, late) = (view.name for view in spec.views)
    np.testing.assert_array_equal(read(rendered.images[early])[0], read(again.images[early])[0])
    assert (read(rendered.images[late])[0] != read(again.images[late])[0]).mean() > 0.01
