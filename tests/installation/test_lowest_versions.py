"""The lower bounds of pyproject.toml, against the first versions that have wheels. No network is asked."""

from __future__ import annotations

import subprocess
import sys

import pytest
from packaging.version import Version

from lowest_versions import lowest_versions
from places import ROOT, SUPPORT

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# First versions with wheels of CPython 3.11, 3.12, 3.13 and 3.14 for Linux on x86_64, as the package index lists them.
FIRST_WHEELS = {
    "numpy": ("1.23.2", "1.26.0", "2.1.0", "2.3.2"),
    "numba": ("0.57.0", "0.59.0", "0.61.0", "0.63.0"),
    "scipy": ("1.9.2", "1.11.2", "1.14.1", "1.16.1"),
}
# Bounds above the first wheels, and the reason.
RAISED = {("numpy", "3.11"): ("1.24.0", "rasterio 1.4.3 needs it")}
# NumPy that each Numba was built for: from, and below which. Its metadata say so.
NUMPY_OF_NUMBA = {
    "0.57.0": ("1.21", "1.25"), "0.59.0": ("1.22", "1.27"), "0.61.0": ("1.24", "2.2"), "0.63.0": ("1.22", "2.4"),
}  # fmt: skip


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("name", FIRST_WHEELS)
def test_the_bounds_are_the_first_wheels(name, python):
    first = FIRST_WHEELS[name][PYTHONS.index(python)]
    expected, _ = RAISED.get((name, python), (first, ""))
    assert lowest_versions(python)[name] == expected
    assert Version(expected) >= Version(first)


@pytest.mark.parametrize("python", PYTHONS)
def test_numba_knows_the_lowest_numpy(python):
    lowest = lowest_versions(python)
    low, below = NUMPY_OF_NUMBA[lowest["numba"]]
    assert Version(low) <= Version(lowest["numpy"]) < Version(below)


def test_the_bounds_rise_with_python():
    of_python = [lowest_versions(python) for python in PYTHONS]
    assert all(set(lowest) == set(of_python[0]) for lowest in of_python)
    for name in of_python[0]:
        versions = [Version(lowest[name]) for lowest in of_python]
        assert versions == sorted(versions), name


def test_make_takes_the_bounds_of_the_python_it_is_given():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "tests/support/lowest_versions.py" in makefile
    script = [sys.executable, str(SUPPORT / "lowest_versions.py")]
    for python in ("3.11", "3.14"):
        said = subprocess.run([*script, python], capture_output=True, text=True, check=True).stdout.splitlines()
        assert f"numpy=={lowest_versions(python)['numpy']}" in said
        assert all(line.count("==") == 1 for line in said)
