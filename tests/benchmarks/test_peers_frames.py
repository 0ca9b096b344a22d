"""Scenes of frame cameras in the comparison with other programs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import judging
import rectifying
from peers import frames, matchers, running
from peers.environments import Environment
from peers.results import Results
from zlocus.sensors.frame import FrameModel, rotation_from_angles

CORE = min(os.sched_getaffinity(0))
# Level cameras at the same height, and heights around a plane; the parallax of the highest is a tenth too large.
FLYING_M, PLANE_M, BASE_M = 460.0, 400.0, 12.0
HEIGHTS_M = np.array([-6.0, -2.5, 0.0, 3.0, 6.0])
EXACT_M = 1e-6
# Two frames of a settlement from 61 m, matched on the plane in cells larger than their pixels.
LEAST_WITHIN = 0.75


def level(x: float, shape: tuple[int, int] = (400, 400)) -> SimpleNamespace:
    sensor = FrameModel((x, 0.0, FLYING_M), rotation_from_angles(0.0, 0.0, 0.0), 300.0, (199.5, 199.5))
    return SimpleNamespace(sensor=sensor, image=SimpleNamespace(shape=shape))


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A block of two small frames, which is rendered once."""
    return frames.FrameBlock(5, 1, 2, columns=240).scene("frames", tmp_path_factory.mktemp("scenes"))


def test_heights_follow_from_the_disparities_of_frames():
    """Exactly, although the parallax of frames is not linear in height; that of satellites is."""
    views, none = (level(-BASE_M / 2), level(BASE_M / 2)), np.zeros(2)
    area = SimpleNamespace(crs="EPSG:32632", bounds=(-10.0, -10.0, 10.0, 10.0))
    moved = rectifying.parallax(area, views, (none, none), PLANE_M)
    plane, above = rectifying.rectified(area, moved), rectifying.cameras_above(views, PLANE_M)
    assert above == FLYING_M - PLANE_M
    # The definition: where the rays through a point meet the plane, in the first view less in the second.
    parallax_m = BASE_M * HEIGHTS_M / (above - HEIGHTS_M)
    disparity = (parallax_m / rectifying.STEP_M)[None, :]
    xyz = rectifying.ground_points(disparity, views[0], none, plane, moved, PLANE_M, above)
    np.testing.assert_allclose(xyz[:, 2], PLANE_M + HEIGHTS_M, atol=EXACT_M)
    flat = rectifying.ground_points(disparity, views[0], none, plane, moved, PLANE_M)
    assert np.abs(flat[:, 2] - PLANE_M - HEIGHTS_M).max() > 0.1
    assert rectifying.cameras_above((SimpleNamespace(sensor=None),), PLANE_M) == np.inf


def test_only_what_both_frames_show_is_kept():
    views, none = (level(0.0), level(BASE_M)), np.zeros(2)
    plane = rectifying.Rectified(np.zeros(2), np.array([1.0, 0.0]), np.array([0.0, -1.0]), (1, 120))
    is_shown = rectifying.shown(views, (none, none), plane, PLANE_M)[0]
    # A pixel is 0.2 m on the plane: the first frame ends 39.9 m right of its centre, the second begins 27.9 m left.
    x = rectifying.STEP_M * np.arange(120)
    np.testing.assert_array_equal(is_shown, x <= 39.9)


def test_frames_are_matched_and_judged(pair, tmp_path, monkeypatch):
    """By programs that take frames: others are not run."""
    monkeypatch.setattr(judging, "JUDGE", tmp_path / "none")
    assert pair.inputs == [pair.cameras]
    assert len(pair.pairs) == 1
    opencv = matchers.opencv(Environment(Path(sys.prefix)))
    cars = SimpleNamespace(name="CARS", versions=dict, run=None)
    results = Results(tmp_path / "results.json", (CORE,))
    for program in (opencv, cars):
        results.describe("programs", program.name, program.versions())
    running.surfaces_of(pair, [opencv, cars], results, tmp_path, (CORE,))
    (row,) = results.found["surfaces"]
    assert row["program"] == "OpenCV SGBM"
    assert row["classes"]["all"]["within"] > LEAST_WITHIN
    assert results.found["scenes"]["frames, 2 views"]["kind"] == frames.FRAME


def test_blocks_of_frames_are_scenes_that_can_be_asked_for(monkeypatch, tmp_path):
    block = frames.FrameBlock(1, 1, 2)
    monkeypatch.setattr(running, "FRAMES", {"aerial": block})
    monkeypatch.setattr(frames.FrameBlock, "scene", lambda self, name, folder: (name, self.columns))
    asked = running.PeerComparison(["aerial"])
    assert list(running.scenes(asked, tmp_path)) == [("aerial", block.columns)]
    small = running.PeerComparison(["aerial"], side=64)
    assert list(running.scenes(small, tmp_path)) == [("aerial of 64 columns", 64)]
    assert list(running.scenes(running.PeerComparison(["kernels"]), tmp_path)) == []
