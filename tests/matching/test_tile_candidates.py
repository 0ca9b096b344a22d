"""Candidates of a tile of close cameras: narrow strips that only two images share get both."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.scene import View
from zlocus.matching import tile_candidates
from zlocus.matching.tile_candidates import POINTS_OF_CLOSE_CAMERAS, candidates_of_tile
from zlocus.sensors.frame import FrameModel

CENTRE, Z = (500_000.0, 5_000_000.0), 100.0
TURN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
SIDE_M, CELL_M, LEVELS = 102.4, 0.1, 3
# Width of the ground that an image shows, and of the strip at the eastern rim that the last two images alone share.
WIDTH_M, STRIP_M = 40.0, 6.0


class Blank:
    """An image without pixels, which is never read."""

    shape = (300, 120)


def scene_of(easts: np.ndarray) -> SimpleNamespace:
    """Images of a strip of level ground at the height Z, with the functions of a match scene that are needed."""
    views = []
    for e in easts:
        sensor = FrameModel((CENTRE[0] + e, CENTRE[1], Z + 30.0), TURN, 90.0, (60.0, 150.0))
        views.append(View(f"v{e:g}", Path("x"), Blank(), sensor))

    def points_of(window: CellWindow, level: int, per_side: int = 5) -> np.ndarray:
        along = np.linspace(0.0, SIDE_M, per_side)
        return np.array([(CENTRE[0] + x, CENTRE[1] + (y - SIDE_M / 2) / 12) for x in along for y in along])

    return SimpleNamespace(
        views=views, levels=LEVELS, ground_height=Z, expected_range=(Z - 0.5, Z + 0.5), points_of=points_of,
        overlap_window=CellWindow(0, 0, 1024, 1024), are_in=lambda window, xy: np.ones(len(xy), bool),
    )  # fmt: skip


def test_a_strip_at_the_rim_that_two_images_share_gets_both(monkeypatch):
    """The strip is narrower than the distance of five points on a side: those would miss it."""
    monkeypatch.setattr(tile_candidates, "level_window", lambda *_: CellWindow(0, 0, 256, 256))
    inner = np.arange(0.0, 60.0, 3.0)
    end = SIDE_M - 2.0 - STRIP_M / 2
    pair = np.array([end - WIDTH_M / 2 + STRIP_M, end + WIDTH_M / 2])
    scene = scene_of(np.concatenate([inner, pair]))
    found = candidates_of_tile(scene, CellWindow(0, 0, 1024, 1024), list(range(len(scene.views))), RunConfig())
    assert {len(inner), len(inner) + 1} <= set(found)
    assert len(found) < len(scene.views)
    assert SIDE_M / (POINTS_OF_CLOSE_CAMERAS - 1) < STRIP_M < SIDE_M / 4


def test_few_views_are_all_candidates(monkeypatch):
    monkeypatch.setattr(tile_candidates, "level_window", lambda *_: CellWindow(0, 0, 256, 256))
    scene = scene_of(np.arange(0.0, 60.0, 12.0))
    numbers = list(range(len(scene.views)))
    assert candidates_of_tile(scene, CellWindow(0, 0, 1024, 1024), numbers, RunConfig()) == numbers
