"""What the inspector tells of each image beside a block, and where one image is falsified."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from block_scene import BLOCK_M, FALSE_AT, FALSIFIED, GROUND_M, OVER
from rendered_scenes import CENTRE
from zlocus.inspector.cell import WhatIf, match_record
from zlocus.inspector.image_accounts import summary_of

HEIGHT_M = 0.5


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


def test_images_that_the_selection_does_not_choose_say_why(block):
    """With --selection guided the match of a cell ends before the last image where the mean is good enough."""
    folder, scene = block
    request = folder.run["config"]["request"] | {"selection": "guided"}
    guided = replace(folder, run=folder.run | {"config": folder.run["config"] | {"request": request}})
    xy = folder.centre_of(*folder.cell_of(CENTRE[0] - 14.0, CENTRE[1] - 8.0))
    few = WhatIf(selection={"min_images": 1, "max_sigma_steps": 1000.0})
    record = match_record(guided, scene, xy, GROUND_M, few)
    stop = record["match"]["stop"]
    assert (stop["images"], stop["is_stopped"]) == (1, True)
    last = record["match"]["curves"][1]["image"]
    account = {each["image"]: each for each in record["accounts"]}[last]
    assert account["kind"] == "not chosen"
    assert account["says"].startswith(
        f"{last} is not chosen. It comes at place 2 of the search images, and the mean of those before it is good "
        "enough."
    )
    assert record["accounts_say"] == "Of 3 images 2 agree and 1 is not chosen."
    as_run = match_record(folder, scene, xy, GROUND_M, few)  # this run compares all images
    assert {each["kind"] for each in as_run["accounts"]} == {"agrees"}


def test_where_an_image_ends_it_says_on_which_side(block):
    folder, scene = block
    middle = folder.centre_of(*(n // 2 for n in folder.shape))
    bounds = {}
    for y in np.arange(middle[1], middle[1] + 60.0, 10.0):
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
