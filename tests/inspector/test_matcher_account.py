"""What the inspector tells of the costs of a cell is what the run weighed."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from rendered_scenes import CENTRE
from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow
from zlocus.inspector.matcher_account import (
    MatchedPart,
    WeighedCell,
    coarser_level,
    constraint,
    evidence,
    matched_part,
    matcher_record,
    repeated,
)
from zlocus.matching.cell_costs import CellCosts, PairEvidence

BESIDE_THE_BLOCK = (CENTRE[0] - 2.25, CENTRE[1] + 0.25)


@pytest.fixture(scope="module")
def part(block):
    """The tile beside the block, matched again with evidence, although it is small."""
    folder, scene = block
    return matched_part(folder, scene, middle(folder))


def middle(folder):
    return folder.centre_of(*folder.cell_of(*BESIDE_THE_BLOCK))


def test_a_tile_that_is_matched_again_gives_the_heights_of_the_run(block, part):
    """Every cell of it, to the last bit."""
    folder, scene = block
    assert part.is_whole
    window, grid = part.core_window, scene.run.grid.window
    again = part.matched_costs.height_m[window.slices_in(part.matched_costs.level.window)]
    with rasterio.open(folder.path("dsm")) as file:
        z = file.read(1)
    shared = window.within(grid)
    assert shared.rows * shared.cols > 1000
    np.testing.assert_array_equal(again[shared.slices_in(window)], z[shared.slices_in(grid)])


def test_what_is_said_is_what_the_costs_are(block, part):
    folder, scene = block
    record = matcher_record(scene, part, folder, middle(folder))
    text, heights, chosen = " ".join(record["says"]), np.array(record["heights_m"]), record["chosen"]
    z = folder.cell(*folder.cell_of(*BESIDE_THE_BLOCK))["dsm"]
    assert abs(heights[chosen] - z) <= scene.run.match_scene.height_step
    assert record["says"][0].endswith("The cell gets the height of the surface again.")
    assert f"So {len(heights)} heights, from {heights[0]:.2f} m to {heights[-1]:.2f} m, were searched" in text
    assert f"height of {heights[chosen]:.2f} m" in text
    least = np.argmin(record["cost"])
    said = re.search(r"The cost of the cell itself is least at (?:the chosen height of )?([\d.]+) m: (\d+)", text)
    assert float(said[1]) == pytest.approx(heights[least if record["cost"][chosen] > min(record["cost"]) else chosen],
                                           abs=0.006)  # fmt: skip
    assert int(said[2]) == min(record["cost"])
    # The tile is too small for evidence, and says so.
    assert record["pairs"] == []
    assert "The costs are those of correlation." in text


def test_evidence_is_told_of_each_pair(block, monkeypatch):
    folder, scene = block
    monkeypatch.setattr("zlocus.matching.tile.MIN_CELLS_OF_TILE", 0)
    monkeypatch.setattr("zlocus.matching.evidence.MIN_TRUSTED_CELLS", 500)
    record = matcher_record(scene, matched_part(folder, scene, middle(folder)), folder, middle(folder))
    text = " ".join(record["says"])
    pairs = {frozenset(pair["images"]): pair for pair in record["pairs"]}
    assert set(pairs) == {frozenset(names) for names in (("nadir", "fore"), ("nadir", "aft"), ("fore", "aft"))}
    n_seeing, n_for, n_against = (0, 0, 0)
    for pair in pairs.values():
        value = pair["evidence"]
        if not np.isfinite(value):
            assert pair["says"] == "does not see the cell at this height"
            continue
        n_seeing, n_for, n_against = n_seeing + 1, n_for + (value > 0.22), n_against + (value < -0.22)
        if abs(value) > 0.22:
            times, side = re.match(r"windows so alike are ([\d.]+) times more frequent at (right|wrong)",
                                   pair["says"]).groups()  # fmt: skip
            assert float(times) == pytest.approx(np.exp(abs(value)), rel=0.06)
            assert side == ("right" if value > 0 else "wrong")
    assert f"Of 3 pairs of images {n_seeing} see the cell at the chosen height." in text
    assert f"{n_for or 'None'} speak" in text
    assert f"{n_against or 'none'} against it." in text
    assert "adds no cost to it." in text


def weighed(*log_ratios):
    """A cell of one height, with the evidence of each pair of three images."""
    pairs = tuple(
        PairEvidence(views, np.array([ratio]), 1.0, np.array([np.isfinite(ratio) and ratio > 0]))
        for views, ratio in zip(((0, 1), (0, 2), (1, 2)), log_ratios, strict=True)
    )
    costs = CellCosts(
        np.array([50.0]), np.array([40], np.uint8), np.array([7], np.uint8), 0, np.nan, 65535, np.full(3, 51.0), 1.0,
        50.0, pairs, (0, 1, 2), np.ones(3, bool),
    )  # fmt: skip
    scene = SimpleNamespace(height_step=0.5, views=[SimpleNamespace(name=name) for name in "abc"])
    part = MatchedPart(CellWindow(0, 0, 300, 300), False, None)
    return WeighedCell(costs, part, scene, 10.0, 40.0, "mvll-sgm", 30.0)


def test_pairs_are_counted_by_what_they_say():
    said = evidence(weighed(2.5, 0.1, -0.5))
    assert "Of 3 pairs of images 3 see the cell" in said
    assert "1 speaks for this height and 1 against it. 1 says nothing." in said
    assert said.endswith(
        "That of a and b is the strongest: windows so alike are 12 times more frequent at right heights."
    )
    said = evidence(weighed(np.nan, -0.1, -1.5))
    assert "Of 3 pairs of images 2 see the cell" in said
    assert "None speaks for this height and 1 against it." in said
    assert "No pair of images sees the cell" in evidence(weighed(np.nan, np.nan, np.nan))


def test_prior_and_constraint_are_told_above_the_vertical_datum():
    cell = weighed(1.0, 1.0, 1.0)
    found, prior = coarser_level(cell)
    assert found == (
        "The coarser level, with cells of 1 m, found 41.00 m here. So 1 heights, from 40.00 m to 40.00 m, were "
        "searched in this cell."
    )
    assert "adds a cost of 7 to it, of 30 at most" in prior
    assert constraint(cell) == ["The cost of the cell itself is least at the chosen height of 40.00 m: 40."]
    assert repeated(cell).endswith("The cell gets the height of the surface again.")
    assert "0.50 m from that of the surface. Evidence" in repeated(replace(cell, surface_m=40.5))


def test_runs_that_weighed_no_costs_of_cells_say_so(block):
    folder, scene = block
    request = folder.run["config"]["request"]
    for change, says in (({"method": "gc3-sgm"}, "pixels of its images"), ({"selection": "paper"}, "by itself")):
        run = folder.run | {"config": folder.run["config"] | {"request": request | change}}
        with pytest.raises(ConfigError, match=says):
            matched_part(replace(folder, run=run), scene, middle(folder))


def test_where_no_two_images_see_the_cell_nothing_was_weighed(block, part):
    folder, scene = block
    with pytest.raises(GeometryError, match="No two images"):
        matcher_record(scene, replace(part, matched_costs=None), folder, middle(folder))
