"""Water polygons: one surface for each part, and levels from an attribute."""

from __future__ import annotations

import json

import numpy as np
import pytest
import shapely
from pyproj import CRS

from grid_input_files import write_water
from zlocus.core.errors import InputError
from zlocus.io.water_polygons import read_water

UTM = CRS.from_epsg(32632)
POND, LAKE = shapely.box(100, 100, 110, 110), shapely.box(200, 100, 260, 140)
BOTH = shapely.multipolygons([POND, LAKE])


def test_every_part_is_a_surface_of_its_own(tmp_path):
    path = write_water(tmp_path / "water.gpkg", [BOTH, LAKE], level=[12.5, None])
    found = read_water(path, UTM, "level")
    assert found.names == ("polygon 1, part 1", "polygon 1, part 2", "polygon 2")
    np.testing.assert_array_equal(found.levels_m, [12.5, 12.5, np.nan])
    np.testing.assert_allclose(shapely.area(found.polygons), [100.0, 2400.0, 2400.0], rtol=1e-12)
    kept = found.only(np.array([False, True, True]))
    assert kept.names == found.names[1:]
    np.testing.assert_array_equal(kept.levels_m, [12.5, np.nan])


def test_without_a_field_no_level_is_known(tmp_path):
    found = read_water(write_water(tmp_path / "water.gpkg", [POND], level=[3.0]), UTM, None)
    assert np.isnan(found.levels_m).all()


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        (["431.25", "", "-2"], [431.25, np.nan, -2.0]),
        ([431.25, None, -9999.0], [431.25, np.nan, np.nan]),
        ([0.0, -0.5, 8800.0], [0.0, -0.5, 8800.0]),
    ],
)
def test_levels_are_numbers_texts_of_numbers_or_empty(tmp_path, values, levels):
    path = write_water(tmp_path / "water.gpkg", [POND, LAKE, POND], level=values)
    np.testing.assert_array_equal(read_water(path, UTM, "level").levels_m, levels)


@pytest.mark.parametrize(
    ("value", "said"), [("high", "'high'"), (99999.0, "'99999.0'"), (np.inf, "'inf'"), ("1_0", "'1_0'")]
)
def test_what_is_no_level_is_refused(tmp_path, value, said):
    filler = "2.5" if isinstance(value, str) else 2.5
    path = write_water(tmp_path / "water.gpkg", [POND, LAKE], level=[filler, value])
    with pytest.raises(InputError, match=rf"Polygon 2 of .*water.gpkg has {said} in level, which is no water level"):
        read_water(path, UTM, "level")


def test_an_unknown_field_is_refused_with_those_there_are(tmp_path):
    path = write_water(tmp_path / "water.gpkg", [POND], level=[1.0], name=["pond"])
    with pytest.raises(InputError, match=r"water\.gpkg has level, name, and no attribute depth\. Check the name\."):
        read_water(path, UTM, "depth")
    bare = write_water(tmp_path / "bare.gpkg", [POND])
    with pytest.raises(InputError, match=r"bare\.gpkg has no attributes, and no attribute depth"):
        read_water(bare, UTM, "depth")


def test_polygons_in_degrees_are_converted(tmp_path):
    """As GeoJSON has them; a place on the central meridian, whose easting is exactly 500 km."""
    ring = [[9.0, 47.0], [9.001, 47.0], [9.001, 47.001], [9.0, 47.001], [9.0, 47.0]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path = tmp_path / "water.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (polygon,) = read_water(path, UTM, None).polygons
    assert shapely.bounds(polygon)[0] == pytest.approx(500_000.0, abs=1e-6)


@pytest.mark.parametrize("content", [b"", b"{", b"GPKG?", b'{"type": "FeatureCollection", "features": []}'])
def test_a_damaged_file_is_one_sentence(tmp_path, content):
    path = tmp_path / "water.geojson"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"water\.geojson"):
        read_water(path, UTM, None)


def test_lines_are_refused(tmp_path):
    path = tmp_path / "river.geojson"
    line = {"type": "LineString", "coordinates": [[9.0, 47.0], [9.1, 47.1]]}
    feature = {"type": "Feature", "properties": {}, "geometry": line}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    with pytest.raises(InputError, match="not polygons"):
        read_water(path, UTM, None)
