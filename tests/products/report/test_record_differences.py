"""What differs between the records of two runs."""

from __future__ import annotations

from copy import deepcopy

import pytest

from zlocus.core.options import RunConfig
from zlocus.io.config import config_as_dict
from zlocus.products.report import record_differences as records
from zlocus.products.report.text import NONE


@pytest.fixture
def run():
    view = {"shift_px": [1.0, -2.0], "n_ties": 50, "residual_after_px": {"median": 0.25}}
    return {
        "config": {
            "request": {"inputs": ["a.tif", "b.tif"], "out": "one", "views": "auto", "resolution": None},
            "options": config_as_dict(RunConfig()),
        },
        "versions": {"zlocus": "0.1.0", "numpy": "2.4.0"},
        "inputs": [{"path": "a.tif", "sha256": "1"}, {"path": "b.tif", "sha256": "2"}],
        "orientation": {"views": {"a": view, "b": deepcopy(view)}},
        "stages": [
            {"name": "open", "wall_s": 1.0, "cpu_s": 0.5, "peak_mb": 100.0},
            {"name": "match", "wall_s": 4.0, "cpu_s": 8.0, "peak_mb": 300.0},
        ],
    }  # fmt: skip


@pytest.fixture
def other(run):
    return deepcopy(run)


def test_equal_runs_differ_in_nothing(run, other):
    other["config"]["request"] |= {"out": "two", "inputs": ["moved/a.tif"]}
    assert records.option_differences(run, other) == []
    assert records.version_differences(run, other) == []
    assert records.input_differences(run, other) == []
    assert records.listed_values([]) == "none"


def test_options_that_differ(run, other):
    other["config"]["request"] |= {"views": "all", "resolution": 0.5}
    other["config"]["options"]["checks"]["max_sigma_m"] = 2.0
    other["config"]["request"]["added"] = True
    rows = records.option_differences(run, other)
    assert [(row.name, row.first, row.second) for row in rows] == [
        ("views", "auto", "all"), ("resolution", "not given", "0.5"), ("added", NONE, "yes"),
        ("checks.max_sigma_m", "not given", "2.0"),
    ]  # fmt: skip
    assert rows[0].meaning == records.OF_COMMAND
    assert "standard deviation" in rows[-1].meaning
    assert records.listed_values(rows[:2]) == "views: auto, all; resolution: not given, 0.5"


def test_versions_that_differ(run, other):
    other["versions"] = {"zlocus": "0.2.0", "numpy": "2.4.0", "scipy": "1.17"}
    found = [(row.name, row.first, row.second) for row in records.version_differences(run, other)]
    assert found == [("zlocus", "0.1.0", "0.2.0"), ("scipy", NONE, "1.17")]


def test_inputs_that_differ(run, other):
    other["inputs"] = [
        {"path": "a.tif", "sha256": "9"}, {"path": "elsewhere/b.tif", "sha256": "2"}, {"path": "c.tif", "sha256": "3"},
    ]  # fmt: skip
    found = [(row.name, row.first, row.second, row.meaning) for row in records.input_differences(run, other)]
    assert found == [("a.tif", "1", "9", "other content"), ("c.tif", "no", "yes", "only in B")]
    back = [(row.name, row.meaning) for row in records.input_differences(other, run)]
    assert back == [("a.tif", "other content"), ("c.tif", "only in A")]
    # Files on servers have no checksum: without one, another path is another file.
    run["inputs"], other["inputs"] = [{"path": "x", "sha256": None}], [{"path": "y", "sha256": None}]
    assert [row.meaning for row in records.input_differences(run, other)] == ["only in A", "only in B"]


def test_a_second_copy_of_an_input_is_one_more(run, other):
    run["inputs"] = [{"path": "order/a.tif", "sha256": "1"}]
    other["inputs"] = [{"path": f"{copy}/a.tif", "sha256": "1"} for copy in ("first", "second")]
    assert [(row.name, row.meaning) for row in records.input_differences(run, other)] == [("second/a.tif", "only in B")]
    assert [(row.name, row.meaning) for row in records.input_differences(other, run)] == [("second/a.tif", "only in A")]


def test_cameras_are_sorted_by_their_difference(run, other):
    other["orientation"]["views"]["b"]["shift_px"] = [4.0, 2.0]
    other["orientation"]["views"]["c"] = other["orientation"]["views"]["a"]
    rows = records.camera_rows(run, other)
    assert [(row.name, row.apart) for row in rows] == [("b", "5.000"), ("a", "0.000"), ("c", NONE)]
    assert rows[0].shift == ("+1.000, -2.000", "+4.000, +2.000")
    assert rows[0].after == ("0.250", "0.250")
    assert rows[2].n_ties == (NONE, "50")


def test_times_side_by_side(run, other):
    other["stages"] = [
        {"name": "match", "wall_s": 8.0, "cpu_s": 9.0, "peak_mb": 200.0},
        {"name": "curves", "wall_s": 2.0, "cpu_s": 1.0, "peak_mb": 250.0},
    ]
    rows = {row.name: row for row in records.stage_times(run, other)}
    assert list(rows) == ["open", "match", "curves", "all"]
    assert (rows["match"].wall, rows["match"].ratio, rows["match"].bars) == (("4.0 s", "8.0 s"), "2.00", (50.0, 100.0))
    assert (rows["open"].wall, rows["open"].ratio) == (("1.0 s", NONE), NONE)
    assert (rows["all"].wall, rows["all"].cpu, rows["all"].ratio) == (("5.0 s", "10.0 s"), ("8.5 s", "10.0 s"), "2.00")
    assert rows["all"].peak == ("300 MB", "250 MB")
    assert records.total_s(other) == 10.0
