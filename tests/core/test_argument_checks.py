"""What Python callers pass: values of the right kind come through, others are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from rasterio.coords import BoundingBox
from rasterio.crs import CRS as RasterCRS

from zlocus.core import argument_checks as arguments
from zlocus.core.errors import ConfigError, InputError


class Named:
    """A path that is neither text nor pathlib's."""

    def __fspath__(self) -> str:
        return "a.tif"


def test_paths_come_through():
    assert arguments.input_paths("f", ("a.tif", Path("b.tif"), Named())) == (
        Path("a.tif"),
        Path("b.tif"),
        Path("a.tif"),
    )
    assert arguments.path_of("out", Named()) == Path("a.tif")
    assert arguments.path_or_none("out", None) is None


def test_numbers_come_through():
    assert arguments.bounds_or_none(BoundingBox(1, 2, 3, 4)) == (1.0, 2.0, 3.0, 4.0)
    assert arguments.bounds_or_none(np.array([1, 2, 3, 4], np.float32)) == (1.0, 2.0, 3.0, 4.0)
    assert arguments.heights_or_none(range(5, 7)) == (5.0, 6.0)
    assert all(type(value) is float for value in arguments.heights_or_none(np.array([1, 2])))
    assert type(arguments.number_or_none("n", np.float32(2))) is float
    assert type(arguments.count_or_none("n", np.int8(2))) is int
    assert arguments.flag_of("n", np.True_) is True


def test_texts_come_through():
    assert arguments.crs_or_none("EPSG:32632") == "EPSG:32632"
    assert arguments.crs_or_none(CRS.from_epsg(32632)) == "EPSG:32632"
    assert CRS.from_user_input(arguments.crs_or_none(RasterCRS.from_epsg(32632))) == CRS.from_epsg(32632)
    assert arguments.names_of("products", "laz, dtm") == ("laz", "dtm")
    assert arguments.names_of("products", "none") == arguments.names_of("products", []) == ()
    assert arguments.text_or_none("vertical", Path("geoid.tif")) == "geoid.tif"


@pytest.mark.parametrize(
    ("check", "value", "said"),
    [
        (lambda v: arguments.path_of("out", v, "folder"), 3, r"out is an int \(3\)\. Give the path of a folder"),
        (lambda v: arguments.number_or_none("n", v), True, r"n is a bool \(True\)\. Give a number"),
        (lambda v: arguments.count_or_none("n", v), 2.0, r"n is a float \(2.0\)\. Give a whole number"),
        (arguments.bounds_or_none, {1: 2}, r"bounds is a dict of 1\. Give 4 numbers"),
        (arguments.bounds_or_none, np.zeros((4, 2)), "bounds holds a NumPy array"),
        (arguments.heights_or_none, (1, None), "heights holds None"),
        (lambda v: arguments.flag_of("n", v), 1, r"n is an int \(1\)\. Give True or False"),
        (arguments.crs_or_none, 32632, r'crs is an int \(32632\)\. Give a text such as "EPSG:32632"'),
        (lambda v: arguments.names_of("n", v), ["a", 3], r"A value of n is an int \(3\)"),
        (lambda v: arguments.names_of("n", v), None, "n is None. Give a list of names"),
        (lambda v: arguments.text_of("n", v), b"a" * 99, r"n is a bytes\. Give a text"),
        (lambda v: arguments.positive_number("n", v, "m"), float("inf"), "n is inf, which is no size"),
        (lambda v: arguments.positions("n", v, "rows"), [np.inf], "n holds values that are not finite"),
        (lambda v: arguments.numeric_array("n", v, "rows"), [object()], "n holds values of type object"),
    ],
)
def test_values_of_another_kind_are_named(check, value, said):
    with pytest.raises(ConfigError, match=said):
        check(value)


def test_inputs_of_another_kind_are_named():
    with pytest.raises(InputError, match=r"^Input 2 of f is a list of 1, and every image is an argument of its own"):
        arguments.input_paths("f", ("a.tif", ["b.tif"]))
