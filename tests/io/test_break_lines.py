"""Break lines from vector files."""

import json

import numpy as np
import pytest
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.io.break_lines import points_along, read_break_lines

UTM = CRS.from_epsg(32632)


@pytest.fixture
def lines_file(tmp_path):
    """`lines_file(features, crs)`: a GeoJSON file; features : kind and coordinates of each."""

    def made(features, crs="urn:ogc:def:crs:EPSG::32632"):
        path = tmp_path / "lines.geojson"
        listed = [
            {"type": "Feature", "properties": {}, "geometry": {"type": kind, "coordinates": coordinates}}
            for kind, coordinates in features
        ]
        named = {"crs": {"type": "name", "properties": {"name": crs}}}
        path.write_text(json.dumps({"type": "FeatureCollection", **named, "features": listed}))
        return path

    return made


def test_lines_with_heights_hold_and_lines_without_let_jump(lines_file):
    path = lines_file(
        [
            ("LineString", [[10, 10], [20, 10], [20, 30]]),
            ("LineString", [[10, 10, 5], [11, 10, 6]]),
            ("MultiLineString", [[[0, 0], [1, 1]], [[2, 2], [3, 3]]]),
        ]
    )
    found = read_break_lines(path, UTM, 0.5)
    assert found.jumps.tolist() == [
        [[10, 10], [20, 10]], [[20, 10], [20, 30]], [[0, 0], [1, 1]], [[2, 2], [3, 3]]
    ]  # fmt: skip
    assert found.held[0].tolist() == [10, 10, 5]
    assert found.held[-1].tolist() == [11, 10, 6]
    assert found.held[:, 2] == pytest.approx(5 + found.held[:, 0] - 10)


def test_points_along_a_line_are_close_together():
    nodes = np.array([[0.0, 0, 1], [3, 4, 2], [3, 4.1, 2]])
    points = points_along(nodes, 0.125)
    gaps = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert gaps.max() <= 0.125 + 1e-12
    assert gaps.sum() == pytest.approx(5.1)


def test_lines_in_degrees_are_converted_and_keep_their_heights(lines_file):
    path = lines_file([("LineString", [[9.0, 47.0, 12.5], [9.001, 47.0, 13.5]])], "urn:ogc:def:crs:OGC:1.3:CRS84")
    found = read_break_lines(path, UTM, 0.5)
    assert found.held[0] == pytest.approx([500000.0, 5205278.0, 12.5], abs=1000.0)
    assert found.held[0][0] == pytest.approx(500000.0, abs=0.01)
    assert (found.held[0][2], found.held[-1][2]) == (12.5, 13.5)


def test_files_without_lines_are_refused(lines_file):
    with pytest.raises(InputError, match="not lines"):
        read_break_lines(lines_file([("Point", [1, 2])]), UTM, 0.5)
    with pytest.raises(InputError, match="holds no lines"):
        read_break_lines(lines_file([]), UTM, 0.5)


def test_coordinates_that_are_no_degrees_are_refused(lines_file):
    path = lines_file([("LineString", [[500000, 1], [500001, 1]])], "urn:ogc:def:crs:OGC:1.3:CRS84")
    with pytest.raises(InputError, match="no longitudes and latitudes"):
        read_break_lines(path, UTM, 0.5)
