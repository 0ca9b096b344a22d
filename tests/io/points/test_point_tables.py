"""Tables of points: what is read from text, vector files and Parquet, and what is refused."""

from __future__ import annotations

import json
import sys
from contextlib import suppress

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from point_files import csv, gpkg
from zlocus.core.errors import ConfigError, InputError
from zlocus.io.points.ground_points import KnownPoints, PointOptions
from zlocus.io.points.open_points import open_points

XYZ = np.array([[461000.25, 5247000.5, 431.125], [461100.0, 5247010.0, 440.0], [461050.5, 5247100.0, 12.5]])
PLAIN = PointOptions()


def read(path, options=PLAIN):
    point_file = open_points([path], options)
    return point_file, KnownPoints.joined(list(point_file.chunks(None)))


def columns(xyz=XYZ, names=("x", "y", "z"), **more):
    return {**dict(zip(names, xyz.T.tolist(), strict=True)), **more}


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize(
    "names", [("x", "y", "z"), ("Easting", "NORTHING", "Height"), ("Rechtswert", "Hochwert", "Höhe"), ("E", "N", "H")]
)
def test_tables_are_read_by_the_usual_names(tmp_path, separator, names):
    point_file, points = read(csv(tmp_path / "p.csv", columns(names=names, note=["a", "b", "c"]), separator))
    assert points.xyz.tolist() == XYZ.tolist()
    assert point_file.crs is None
    assert np.isnan(points.sigma_m).all()


def test_all_that_a_table_may_say_is_read(tmp_path):
    more = {"sigma_z": [0.02, "", 0.05], "sigma_xy": [0.01, 0.01, 0.01], "class": ["road", "forest", "road"],
            "time": ["2023-05-31T12:30:00Z", "2023-05-31T12:30:01Z", ""], "measured_x": [1, 2, ""],
            "measured_y": [3, 4, 5]}  # fmt: skip
    point_file, points = read(csv(tmp_path / "p.txt", columns(**more), ";"))
    np.testing.assert_equal(points.sigma_m, [0.02, np.nan, 0.05])
    assert points.sigma_xy_m.tolist() == [0.01] * 3
    assert [point_file.cover_names[int(code)] for code in points.cover] == ["road", "forest", "road"]
    assert points.time_s[1] - points.time_s[0] == 1
    assert np.isnan(points.time_s[2])
    np.testing.assert_equal(points.measured_xy, [[1, 3], [2, 4], [np.nan, 5]])


def test_longitude_and_latitude_are_of_wgs84_unless_said(tmp_path):
    path = csv(tmp_path / "p.csv", {"lon": [8.5], "lat": [47.3], "h_te_best_fit": [410.0], "h_canopy": [9.0]})
    assert read(path)[0].crs.to_epsg() == 4326
    assert read(path, PointOptions(crs="EPSG:4979"))[0].crs.to_epsg() == 4979


def test_rows_without_a_height_and_repeated_ones_are_left_out_and_counted(tmp_path):
    xyz = np.vstack([XYZ, XYZ[0], [[1, 2, 3.4028235e38], [1, 2, -9999999]]])
    table = columns(xyz) | {"z": [*xyz[:4, 2], "NaN", ""]}
    point_file, points = read(csv(tmp_path / "p.csv", table))
    assert points.xyz.tolist() == XYZ.tolist()
    assert point_file.left_out == {"no height": 2, "given twice": 1}
    point_file, points = read(csv(tmp_path / "q.csv", columns(xyz)))
    assert len(points) == 3
    assert point_file.left_out == {"no height": 2, "given twice": 1}


def test_columns_can_be_named(tmp_path):
    path = csv(tmp_path / "p.csv", {"a": XYZ[:, 0], "b": XYZ[:, 1], "z": [0, 0, 0], "True Height": XYZ[:, 2]})
    _, points = read(path, PointOptions(columns={"x": "a", "y": "B", "z": "true height"}))
    assert points.xyz.tolist() == XYZ.tolist()
    with pytest.raises(ConfigError, match=r"--columns z=hh: .* has no such column. It has a, b, z, True Height"):
        read(path, PointOptions(columns={"x": "a", "y": "b", "z": "hh"}))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("1,2,3\n4,5,6\n", "begins with numbers, and its first line must name the columns"),
        ("x,y,z\n", "has a header and no points below it"),
        ("x,y,up\n1,2,3\n", "has no column that is known as z; it has x, y, up. Name it with --columns z=NAME"),
        ("x,y,z,h\n1,2,3,4\n", "has the columns z and h, each of which may be z"),
        ("x,y,z\n1,2\n", r"line 2: 2 values, but 3 columns \(x, y, z\)"),
        ("x,y,z\n1,two,3\n", "line 2: y is 'two', which is no number"),
        ("x;y;z\n1,5;2;3\n", "line 2: x is '1,5', which is no number. Mend it there. Write decimal points, not commas"),
        ("x,y,z\n1,nan,3\n", "line 2: y is missing or not finite"),
        ("x,y,z\n1,2,nan\n", "None of the 1 points of .* has a height in the column z"),
        ("x,y,z,time\n1,2,3,yesterday\n", "line 2: 'yesterday' is no time"),
        ("x,y,z\n1,2,3\n4,5,6.", "stops within line 3: it may be truncated"),
    ],
)
def test_a_table_that_is_not_understood_is_refused_in_a_sentence(tmp_path, text, sentence):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read(tmp_path / "p.csv")


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("any") / "p.csv"
    path.write_text(text, encoding="utf-8", errors="replace")
    with suppress(InputError, ConfigError):
        read(path)


def test_vector_files_of_points_are_read(tmp_path):
    point_file, points = read(gpkg(tmp_path / "p.gpkg", XYZ, {"class": ["road", "road", "tree"], "sigma": [0.1] * 3}))
    assert points.xyz.tolist() == XYZ.tolist()
    assert point_file.crs.to_epsg() == 32632
    assert points.sigma_m.tolist() == [0.1] * 3
    assert sorted(point_file.cover_names.values()) == ["road", "tree"]
    flat = gpkg(tmp_path / "flat.gpkg", XYZ[:, :2], {"elevation": XYZ[:, 2]}, geometry_type="Point")
    assert read(flat)[1].xyz.tolist() == XYZ.tolist()
    other = gpkg(tmp_path / "other.gpkg", XYZ, {"elevation": [1.0, 2.0, 3.0]})
    assert read(other)[1].xyz[:, 2].tolist() == XYZ[:, 2].tolist(), "the points' own heights go before an attribute"


def test_vector_files_without_points_are_refused(tmp_path):
    from pyogrio.raw import write as write_vector

    line = shapely.to_wkb(np.array([shapely.LineString([(0, 0), (1, 1)])], object))
    write_vector(tmp_path / "l.gpkg", line, [], [], geometry_type="LineString", crs="EPSG:32632")
    with pytest.raises(InputError, match="holds features of the kind LineString, not points"):
        read(tmp_path / "l.gpkg")
    with pytest.raises(InputError, match="no column that is known as z"):
        read(gpkg(tmp_path / "flat.gpkg", XYZ[:, :2], geometry_type="Point"))
    (tmp_path / "bad.gpkg").write_bytes(b"SQLite format 3\x00" + bytes(200))
    with pytest.raises(InputError, match=r"bad.gpkg cannot be read as a file of points"):
        read(tmp_path / "bad.gpkg")
    with pytest.raises(InputError, match="There is no table of points"):
        read(tmp_path / "none.gpkg")


def test_parquet_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "p.parquet").write_bytes(b"PAR1")
    with pytest.raises(
        InputError, match=r"pyarrow, which reads it, is not installed. Install it \(pip install pyarrow"
    ):
        read(tmp_path / "p.parquet")


def test_parquet_is_read(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table(columns(note=["a", "b", "c"])), tmp_path / "plain.parquet")
    point_file, points = read(tmp_path / "plain.parquet")
    assert points.xyz.tolist() == XYZ.tolist()
    assert point_file.crs is None
    geo = {"version": "1.0.0", "primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB"}}}
    for declared, expected in ((..., "OGC:CRS84"), (None, None), ("EPSG:32632", "EPSG:32632")):
        if declared is not ...:
            geo["columns"]["geometry"]["crs"] = declared
        table = pyarrow.table({"geometry": shapely.to_wkb(shapely.points(XYZ)), "class": ["a", "b", "c"]})
        table = table.replace_schema_metadata({"geo": json.dumps(geo)})
        parquet.write_table(table, tmp_path / "geo.parquet")
        point_file, points = read(tmp_path / "geo.parquet")
        assert points.xyz.tolist() == XYZ.tolist()
        assert (None if point_file.crs is None else point_file.crs.to_string()) == expected
    geo["columns"]["geometry"]["encoding"] = "point"
    parquet.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), tmp_path / "geo.parquet")
    with pytest.raises(InputError, match="stores its geometry as 'point', and WKB is read"):
        read(tmp_path / "geo.parquet")
    (tmp_path / "cut.parquet").write_bytes((tmp_path / "plain.parquet").read_bytes()[:300])
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read(tmp_path / "cut.parquet")


@pytest.mark.parametrize(
    ("column", "value", "options", "is_vegetated"),
    [
        ("class", "Forest", PLAIN, True), ("class", "road", PLAIN, False), ("class", "5", PLAIN, True),
        ("class", "2", PLAIN, False), ("class", "5.0", PLAIN, True), ("vegetated", "1", PLAIN, True),
        ("vegetated", "0", PLAIN, False), ("vegetated", "yes", PLAIN, True), ("vegetated", "False", PLAIN, False),
        ("class", "VVA", PLAIN, True), ("class", "NVA", PLAIN, False), ("class", "", PLAIN, False),
        ("class", "heath", PointOptions(vegetated=("heath",)), True),
        ("class", "forest", PointOptions(vegetated=("none",)), False),
        ("class", "5", PointOptions(vegetated=("2", "5")), True),
    ],
)  # fmt: skip
def test_kinds_of_ground_are_vegetated_or_not(tmp_path, column, value, options, is_vegetated):
    path = csv(tmp_path / "p.csv", {"x": [1], "y": [2], "z": [3], column: [value]})
    point_file, points = read(path)
    assert options.is_vegetated(point_file.cover_names[int(points.cover[0])]) is is_vegetated


@pytest.mark.parametrize("value", ["heath", "311", "40"])
def test_kinds_of_ground_that_may_be_either_are_asked_for(value):
    with pytest.raises(ConfigError, match=f"The kind of ground '{value}' may be vegetated or not"):
        PLAIN.is_vegetated(value)
