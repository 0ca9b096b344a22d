"""What the inspector tells of each image beside a block, and where one image is falsified."""

from __future__ import annotations

import re

import numpy as np
import pytest
import rasterio

import rendered_scenes
from rendered_scenes import CENTRE, GSD_M, SMALL_TILES, camera, rendered, run
from zlocus.inspector.cell import WhatIf, match_record
from zlocus.inspector.folder import surface_folder
from zlocus.inspector.image_accounts import summary_of
from zlocus.inspector.matcher_account import matched_part, matcher_record
from zlocus.inspector.restored_run import restored

GROUND_M, BLOCK_M = 50.0, 65.0
# The image that looks over the block, and the one whose pixels are moved around a place of the ground.
OVER, FALSIFIED = "aft", "fore"
PLACE_M, HEIGHT_M = 2 * GSD_M, 0.5
FALSE_AT, FALSE_PX, MOVED_PX = (CENTRE[0] - 18.0, CENTRE[1] + 6.0), 16, 7


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """The folder and the scene of a run over a block beside level ground."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rendered_scenes.LOOKS, OVER, (-10.0, over_deg()))
        images = rendered(tmp_path_factory.mktemp("block"), "step")
        col, row = camera(FALSIFIED).image_from_ground(np.array([[*FALSE_AT, GROUND_M]]))[0].round().astype(int)
    with rasterio.open(images.paths[FALSIFIED], "r+") as file:
        pixels = file.read(1)
        part = np.s_[row - FALSE_PX : row + FALSE_PX, col - FALSE_PX : col + FALSE_PX]
        pixels[part] = np.roll(pixels, MOVED_PX, axis=0)[part]
        file.write(pixels, 1)
    out = run(images, tmp_path_factory.mktemp("block") / "out", SMALL_TILES).out
    folder = surface_folder(out)
    return folder, restored(out, folder.run)


def over_deg():
    """Angle across the flight from which the rays rise over the block, to the east."""
    for across in (22.0, -22.0):
        sensor = rendered_scenes.SatelliteCamera((*CENTRE, 50.0), (75.0, 75.0), GSD_M, -10.0, across, 3.0)
        here = np.array([[*CENTRE, GROUND_M]])
        above = sensor.ground_from_image(sensor.image_from_ground(here), np.array([BLOCK_M]))
        if above[0, 0] > here[0, 0]:
            return across
    raise AssertionError("one of them looks over the block")


def told(block, x, y):
    """What is told of a cell, and of its images by name."""
    folder, scene = block
    row, col = folder.cell_of(x, y)
    record = match_record(folder, scene, folder.centre_of(row, col), folder.cell(row, col)["dsm"], WhatIf())
    return record, {account["image"]: account for account in record["accounts"]}


def test_an_image_behind_the_block_is_occluded_by_it(block):
    record, accounts = told(block, CENTRE[0] - 2.25, CENTRE[1] + 0.25)
    assert accounts["nadir"]["kind"] == accounts[FALSIFIED]["kind"] == "agrees"
    account = accounts[OVER]
    assert account["kind"] == "occluded"
    occluder = account["occluder"]
    assert occluder["height_m"] == pytest.approx(BLOCK_M, abs=HEIGHT_M)
    assert occluder["x"] > CENTRE[0]
    away = np.hypot(occluder["x"] - record_xy(block, record)[0], occluder["y"] - record_xy(block, record)[1])
    assert occluder["distance_m"] == pytest.approx(away, abs=1e-6)
    assert GROUND_M < occluder["lowest_visible_m"] < BLOCK_M
    said = account["says"]
    assert said.startswith(f"{OVER} is occluded. It shows the surface {occluder['distance_m']:.2f} m away to the ")
    assert "east, at E" in said
    assert f"is {occluder['height_m']:.2f} m high" in said
    assert record["accounts_say"] == "Of 3 images 2 agree and 1 is occluded."


def record_xy(block, record):
    return np.array(record["match"]["cell"]["middle"])


def test_it_sees_the_ground_beyond_the_shadow_and_the_roof(block):
    for x in (CENTRE[0] - 14.0, CENTRE[0] + 8.0):
        _, accounts = told(block, x, CENTRE[1] - 8.0)
        assert {account["kind"] for account in accounts.values()} == {"agrees"}


def test_a_falsified_image_is_out_voted_by_the_others(block):
    record, accounts = told(block, *FALSE_AT)
    assert accounts["nadir"]["kind"] == accounts[OVER]["kind"] == "agrees"
    account = accounts[FALSIFIED]
    assert account["kind"] == "out-voted"
    here, best_m, there, n_others, others, others_there = map(float, re.search(
        r"is (-?[\d.]+) here\. It would match best at ([\d.]+) m, with ([\d.]+)\. The other (\d+) images agree here "
        r"with ([\d.]+), and there with (-?[\d.]+)\.", account["says"]).groups())  # fmt: skip
    assert here < 0.5 < there
    assert n_others == 2
    assert others > 0.8 > others_there
    # Its pixels were moved along the flight, so that it matches where the parallax is as large.
    assert abs(best_m - GROUND_M) > 3.0
    assert record["accounts_say"] == "Of 3 images 2 agree and 1 is out-voted."


def test_where_an_image_ends_it_says_on_which_side(block):
    folder, scene = block
    middle = folder.centre_of(*(n // 2 for n in folder.shape))
    bounds = {}
    for y in np.arange(middle[1], middle[1] + 60.0, GSD_M):
        _, accounts = told_anywhere(folder, scene, middle[0], y)
        for name, account in accounts.items():
            if account["kind"] == "outside" and name not in bounds:
                bounds[name] = account["says"]
    assert bounds
    assert all(re.search(r"(upper|lower) edge", said) for said in bounds.values())


def told_anywhere(folder, scene, x, y):
    record = match_record(folder, scene, np.array([x, y]), GROUND_M, WhatIf())
    return record, {account["image"]: account for account in record["accounts"]}


def test_the_summary_counts_images_that_are_not_near():
    accounts = [{"kind": "agrees"}, {"kind": "agrees"}, {"kind": "masked"}]
    assert summary_of(accounts, 3) == "Of 3 images 2 agree and 1 is masked."
    assert summary_of(accounts, 5) == "Of 5 images 2 agree, 1 is masked and 2 do not show it."


def test_a_tile_that_is_matched_again_gives_the_heights_of_the_run(block):
    """Every cell, to the last bit; and what is told of a cell is what its costs say."""
    folder, scene = block
    xy = folder.centre_of(*folder.cell_of(CENTRE[0] - 2.25, CENTRE[1] + 0.25))
    part = matched_part(folder, scene, xy)
    assert part.is_whole
    window, grid = part.core_window, scene.run.grid.window
    again = part.matched_costs.height_m[window.slices_in(part.matched_costs.level.window)]
    with rasterio.open(folder.path("dsm")) as file:
        z = file.read(1)
    shared = window.within(grid)
    np.testing.assert_array_equal(again[shared.slices_in(window)], z[shared.slices_in(grid)])
    record = matcher_record(scene, part, folder, xy)
    assert record["says"][0].endswith("The cell gets the height of the surface again.")
    assert record["says"][-2].startswith("The costs are those of correlation.") or "least at" in record["says"][-2]
    assert set(record["takes_part"]) <= {"nadir", "fore", "aft"}
    heights, chosen = np.array(record["heights_m"]), record["chosen"]
    assert heights[chosen] == pytest.approx(folder.cell(*folder.cell_of(*xy))["dsm"], abs=HEIGHT_M)
    assert f"at the chosen height of {heights[chosen]:.2f} m" in " ".join(record["says"]) or str(
        record["cost"][chosen]
    ) in " ".join(record["says"])
