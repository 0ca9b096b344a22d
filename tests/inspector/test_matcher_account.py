"""What the inspector tells of the costs of a cell is what the run weighed."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import rasterio

from rendered_scenes import CENTRE
from zlocus.core.errors import ConfigError, GeometryError
from zlocus.inspector.matcher_account import matched_part, matcher_record

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
