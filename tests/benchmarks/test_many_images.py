"""Rows on stacks of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from rows import choice_of_images
from rows.choice_of_images import DEFAULT, GUIDED, STEPS, Judged, behind_the_best, surface
from rows.many_images import BUILDING, GROUND, n_false_on_ground, step_up
from workplace import Usage


def write(path, values):
    profile = {"driver": "GTiff", "width": values.shape[1], "height": values.shape[0], "count": 1}
    place = {"crs": "EPSG:32617", "transform": from_origin(0, 20, 0.5, 0.5)}
    with rasterio.open(path, "w", dtype=values.dtype.name, **profile, **place) as file:
        file.write(values, 1)
    return path


def test_false_heights_on_ground_away_from_buildings_are_counted(tmp_path):
    """One false height counts. Not those beside a building, on it, on trees, too small, or without truth."""
    truth, kind = np.zeros((30, 40), np.float32), np.full((30, 40), GROUND, np.uint8)
    kind[:, :5], kind[20:] = BUILDING, 5
    truth[10, 30] = np.nan
    heights = truth + 3.0
    heights[10, [2, 8, 20, 25, 30]] = 60.0, 60.0, 60.0, 20.0, 60.0
    heights[25, 20] = 60.0
    judged = {"shift_cells_row_col": [0.0, 0.0], "shift_m": 3.0}
    paths = [write(tmp_path / f"{name}.tif", v) for name, v in (("dsm", heights), ("lidar", truth), ("kind", kind))]
    assert n_false_on_ground(*paths, judged) == 1
    assert n_false_on_ground(*paths, judged | {"shift_m": -40.0}) > 100
    assert n_false_on_ground(*paths, judged | {"shift_cells_row_col": [0.0, -25.0]}) == 0


def test_the_largest_step_up_of_an_error():
    assert step_up({2: 4.0, 3: 2.0, 5: 2.5, 7: 2.4}) == pytest.approx(1.25)
    assert step_up({2: 4.0, 3: 3.0}) == pytest.approx(0.75)


def test_a_step_of_the_choice_takes_its_options_and_its_configuration(monkeypatch, tmp_path):
    """The rule of the paper is a configuration of the choice by labels."""
    commands = []

    def ran(command, accept):
        commands.append(command)
        return Usage(7.0, 1.0, 0)

    monkeypatch.setattr(choice_of_images, "run", ran)
    for step in ("its rule with the semi-global constraint", GUIDED, "geometry alone"):
        assert surface([tmp_path / "scene.yaml"], tmp_path / "out" / "run", step, "--resolution", 0.5) == 7.0
    with_rule, guided, geometry = (list(map(str, command)) for command in commands)
    for command in (with_rule, guided):
        assert command[command.index("--selection") + 1] == "guided"
    file = Path(with_rule[with_rule.index("--config") + 1])
    assert file.parent == tmp_path / "out"
    assert "--config" not in guided
    assert "--config" in geometry
    assert "--selection" not in geometry


def test_the_default_is_compared_with_the_best_of_the_others():
    """By the least error of any, and by the largest share of any, which need not be of the same one."""
    found = {step: Judged(2.0, 0.7, 20.0) for step in STEPS}
    found |= {
        "the paper": Judged(1.0, 0.6, 99.0),
        GUIDED: Judged(1.5, 0.8, 10.0),
        DEFAULT: Judged(1.1, 0.79, 5.0),
    }
    figures = {figure.what: figure for figure in behind_the_best("town", found)}
    assert figures["town: error over the best"].value == pytest.approx(1.1)
    assert figures["town: within 1 m below the best"].value == pytest.approx(0.01)
    assert figures["town: CPU over that of the choice by labels"].value == pytest.approx(0.5)
    assert len(behind_the_best("facade", {step: Judged(1.0, None, 1.0) for step in STEPS})) == 2
