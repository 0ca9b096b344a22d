"""The block of frames of large.py, at the size of a toy: files, cameras, truth, plan, and a part that is matched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import frame_block
import large
from benchmark_scripts import printed_table, run_script
from zlocus.io.images import open_image
from zlocus.io.scene_file import open_scene

# Frames of the block whose repetition is looked at, and of the one that is planned and matched.
PERIOD_PX, N_FRAMES, N_MATCHED = 128, 18, 10
# Written positions are wrong by 0.1 m and attitudes by 0.005 degrees: 0.2 px and 0.09 px, on each axis.
CAMERA_PX = 1.5
SAME_PX = 1e-6


@pytest.fixture(scope="module")
def survey():
    town = large.town(PERIOD_PX)
    return frame_block.Survey(town.ground, town.west_m, town.north_m, large.GSD_M, PERIOD_PX)


@pytest.fixture(scope="module")
def block(survey, tmp_path_factory):
    return frame_block.write_frames(tmp_path_factory.mktemp("block"), survey, N_FRAMES)


def test_frames_a_period_apart_show_the_same_pixels(survey, block):
    """They are one file by two names, and their exact cameras differ by the period alone."""
    view = {view.name: view for view in open_scene([block]).views}
    assert len(view) == N_FRAMES
    assert view["s00_000"].path.samefile(view["s00_004"].path)
    assert view["s00_000"].path.samefile(view["s02_000"].path)
    assert not view["s00_000"].path.samefile(view["s01_000"].path)
    near, far = survey.camera(1, 1), survey.camera(3, 5)
    xyz = np.array([[survey.west_m + 20.0, survey.north_m - 30.0, 440.0]])
    step = np.array([survey.period_m, -survey.period_m, 0.0])
    np.testing.assert_allclose(far.image_from_ground(xyz + step), near.image_from_ground(xyz), rtol=0, atol=SAME_PX)


def test_written_cameras_are_those_of_the_frames_but_for_their_errors(survey, block):
    xyz = np.array([[survey.west_m + 0.5 * survey.period_m, survey.north_m - 0.5 * survey.period_m, 440.0]])
    off = []
    for view, (strip, number) in zip(open_scene([block]).views, frame_block.strips_of(N_FRAMES), strict=True):
        off.append(view.sensor.image_from_ground(xyz) - survey.camera(strip, number).image_from_ground(xyz))
    assert 0.05 < np.abs(off).max() < CAMERA_PX
    assert len(np.unique(np.round(off, 6), axis=0)) == N_FRAMES


def test_enlarged_frames_show_the_same_ground_in_more_pixels(survey, tmp_path):
    twice = replace(survey, enlarged=2)
    plain, enlarged = (frame_block.entry("a", each, 0, 1) for each in (survey, twice))
    sensors = []
    for found in (plain, enlarged):
        camera = found.camera.read(tmp_path, tmp_path / "a.tif")
        sensors.append(camera.sensor_in_own_crs)
    xyz = np.array([[survey.west_m + 30.0, survey.north_m + 10.0, 450.0]])
    one, two = (sensor.image_from_ground(xyz) for sensor in sensors)
    # The edges of pixels are enlarged, and (0, 0) is the centre of the first one.
    np.testing.assert_allclose(two + 0.5, 2.0 * (one + 0.5), rtol=0, atol=1e-6)
    frame_block.write_frame(tmp_path / "a.tif", np.arange(12, dtype=np.uint16).reshape(3, 4), 2)
    assert open_image(tmp_path / "a.tif").shape == (6, 8)


def test_heights_of_the_repeated_town_are_those_of_its_ground(survey):
    ground = survey.ground
    row, col = 700, 650
    x, y = ground.x0 + (col + 0.5) * ground.step, ground.y0 - (row + 0.5) * ground.step
    for east, south in ((0, 0), (3, 0), (-2, 5)):
        at = np.array([x + east * survey.period_m]), np.array([y - south * survey.period_m])
        assert frame_block.true_heights(survey, *at) == ground.heights[row, col]


def test_a_block_is_planned_and_a_part_of_it_matched(tmp_path, monkeypatch, capfd):
    """Only frames that may show the part are read for it."""
    asked = ["--period", PERIOD_PX, "--frames", N_MATCHED, "--part", 24, "--workers", 1, "--scratch", tmp_path]
    run_script(monkeypatch, large, "frames", *asked)
    printed = capfd.readouterr().out
    (plan,), (part,) = (printed_table(printed, number) for number in range(2))
    assert plan["frames of the whole block"] == part["frames"] == str(N_MATCHED)
    assert int(plan["tiles"]) >= 1
    assert float(plan["orientation, CPU s"]) > 0
    assert 100 < float(plan["memory, MB"]) < 4000
    assert 2 <= int(part["read for the part"]) < N_MATCHED
    assert float(part["M cells"]) == pytest.approx(48**2 / 1e6, rel=0.1)
    assert float(part["NMAD, m"]) < 3.0
    assert float(part["filled, %"]) > 50
    assert not list(tmp_path.iterdir())
