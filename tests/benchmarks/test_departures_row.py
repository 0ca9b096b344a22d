"""The row on departures from the papers: how departures are taken back, and how runs are compared."""

from __future__ import annotations

import tomllib

import pytest

from rendered_scenes import HEIGHTS, PART, rendered
from rows.departures import DEFAULT, DEPARTURES, RUNS, Departure, paired, surface, toml_of
from zlocus.io.config import read_config
from zlocus.matching import tile


def test_all_departures_are_taken_back_together():
    together = RUNS["all of these"]
    assert {name for each in DEPARTURES.values() for name in each.patches} == set(together.patches)
    for each in DEPARTURES.values():
        for section, values in each.options.items():
            assert values.items() <= together.options[section].items()
    assert list(together.words) == ["--selection", "guided"]


@pytest.mark.parametrize("name", RUNS)
def test_options_are_those_of_zlocus(name, tmp_path):
    file = tmp_path / "options.toml"
    file.write_text(toml_of(RUNS[name].options))
    read_config(file)
    assert set(tomllib.loads(file.read_text())) == set(RUNS[name].options)


def test_a_function_is_replaced_while_the_surface_is_made(tmp_path):
    scene = rendered(tmp_path / "images", "sine")
    asked, learns = [], tile.learns_evidence
    words = [*map(str, scene.inputs), "--crs", "EPSG:32632", "--resolution", "0.5", "--bounds", *map(str, PART),
             "--heights", *map(str, HEIGHTS)]  # fmt: skip

    class Watched:
        def __bool__(self):
            asked.append(1)
            return False

    made = surface(
        tmp_path / "out" / "run", words, Departure(patches={"zlocus.matching.tile.learns_evidence": Watched()})
    )
    assert made.is_file()
    assert asked
    assert tile.learns_evidence is learns


def test_differences_are_those_of_the_same_scenes():
    """A run that loses .01 on each scene loses it clearly, however different the scenes are."""
    base = [(0.9, 1.0), (0.5, 3.0), (0.7, 2.0)]
    found = {DEFAULT: base, "all of these": [(within - 0.01, rmse + 0.1) for within, rmse in base]}
    figures = {figure.what: figure for figure in paired("towns", found)}
    assert figures["towns, without all of these: lost within 1 m"].value == pytest.approx(0.01)
    assert figures["towns, without all of these: lost within 1 m"].at_least == 0.0
    assert figures["towns, without all of these: RMSE added"].value == pytest.approx(0.1)
    assert figures["towns, without all of these: standard error of what is lost"].value < 1e-6
    assert figures["towns, without all of these: scenes that lose"].value == 3
    assert figures["towns, default: within 1 m"].value == pytest.approx(0.7)
