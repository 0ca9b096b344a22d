"""Of many views, those that are read for a tile."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rendered_scenes import CENTRE
from zlocus.core.options import SelectionOptions
from zlocus.core.scene import Acquisition, View
from zlocus.matching.view_selection import IMAGES_OF_HALO, candidates_of_points, preselected
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.cameras import SatelliteCamera

Z = 50.0


@dataclass(frozen=True)
class Blank:
    shape: tuple[int, int] = (101, 121)
    dtype: str = "uint8"


def view(name, along=0.0, day=None, east=0.0):
    sensor = SatelliteCamera((CENTRE[0] + east, CENTRE[1], Z), (60.0, 50.0), 0.5, along, 0.0)
    date = None if day is None else datetime.date(2026, 1, 1) + datetime.timedelta(days=day)
    return View(name, Path(name), Blank(), sensor, (), Acquisition(date))


def corners():
    return np.array([(CENTRE[0] + e, CENTRE[1] + n) for e in np.linspace(-10, 10, 5) for n in np.linspace(-8, 8, 5)])


def chosen(views, n):
    return [views[i].name for i in preselected(views, corners(), Z, SelectionOptions(max_candidates=n))]


def test_a_hundred_images_leave_a_reference_and_its_candidates():
    views = [view(f"v{i}", along=0.4 * i) for i in range(100)]
    names = chosen(views, 6)
    assert len(names) == 7
    assert names[0] == "v0"
    angles = [0.4 * int(name[1:]) for name in names[1:]]
    assert np.abs(np.array(angles) - 20.0).max() < 2.0


@pytest.mark.parametrize(
    "other", [view("other", 20.0, day=300), view("other", 3.0, day=0), view("other", 20.0, day=0, east=30.0)],
    ids=["a far date", "a small angle", "half of the ground"],
)  # fmt: skip
def test_worse_images_come_last(other):
    good = [view(f"g{i}", 19.0 + i, day=2) for i in range(3)]
    assert "other" not in chosen([view("nadir", day=0), other, *good], 3)
    assert "other" in chosen([view("nadir", day=0), other, *good], 4)


def test_directions_are_those_at_the_patch():
    """All cameras look straight down; the patch is seen from the angle at which they stand aside."""
    turn = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    views = []
    for name, east in (("above", 0.0), ("near", 5.0), ("good", 36.0), ("far", 90.0)):
        sensor = FrameModel((CENTRE[0] + east, CENTRE[1], Z + 100.0), turn, 50.0, (60.0, 50.0))
        views.append(View(name, Path(name), Blank(), sensor))
    assert chosen(views, 1) == ["above", "good"]


def test_the_reference_shows_the_whole_ground():
    names = chosen([view("beside", east=100.0), view("nadir", 1.0), view("fore", 20.0)], 2)
    assert names == ["nadir", "fore"]


def test_points_want_a_number_of_images_each():
    inside = np.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 0], [0, 0, 0, 1]], bool)
    best_first = np.array([3, 1, 2, 0, 4])
    assert candidates_of_points(best_first, inside, np.full(4, 1)).tolist() == [3, 4]
    assert candidates_of_points(best_first, inside, np.full(4, 2)).tolist() == [3, 1, 2, 4]
    assert candidates_of_points(best_first, inside, np.array([2, 2, 2, 0])).tolist() == [3, 1, 2]
    assert candidates_of_points(best_first, inside, np.full(4, 9)).tolist() == best_first.tolist()


def test_close_cameras_are_chosen_for_each_point_of_a_tile():
    """A strip of forty images of a drone, 40 m wide each, over a tile of 100 m: points get six others, where there are
    so many, and those around the core three."""
    turn = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    easts = np.arange(-80, 80, 4.0)
    sensors = [FrameModel((CENTRE[0] + e, CENTRE[1], Z + 30.0), turn, 90.0, (60.0, 50.0)) for e in easts]
    views = [View(f"v{e:g}", Path("x"), Blank(), one) for e, one in zip(easts, sensors, strict=True)]
    east, north = (a.ravel() for a in np.meshgrid(np.linspace(-50, 50, 21), np.linspace(-6, 6, 5)))
    ground, is_core = np.column_stack([CENTRE[0] + east, CENTRE[1] + north]), np.abs(east) < 30
    options = SelectionOptions()
    chosen_views = [easts[i] for i in preselected(views, ground, Z, options, is_core)]
    n_showing = np.array([sum(abs(at - e) < 20 for at in chosen_views) for e in east])
    assert n_showing[is_core].min() >= options.max_images_of_point
    assert n_showing[~is_core].min() >= IMAGES_OF_HALO
    assert len(chosen_views) < len(views) * 0.7


def test_a_tile_may_be_shown_by_more_images_than_a_block_compares():
    """300 images of a drone, each of a part of a tile: more than the option `max_candidates` may ask for."""
    turn = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    easts = np.linspace(-60.0, 60.0, 300)
    sensors = [FrameModel((CENTRE[0] + e, CENTRE[1], Z + 30.0), turn, 90.0, (60.0, 50.0)) for e in easts]
    views = [View(f"v{k}", Path("x"), Blank(), one) for k, one in enumerate(sensors)]
    east, north = (a.ravel() for a in np.meshgrid(np.linspace(-50, 50, 21), np.linspace(-6, 6, 5)))
    ground = np.column_stack([CENTRE[0] + east, CENTRE[1] + north])
    found = preselected(views, ground, Z, SelectionOptions(), np.ones(len(ground), bool))
    assert 6 < len(found) < 200


def test_images_of_close_cameras_are_chosen_at_all_heights_of_the_ground():
    """On a hill of 12 m an image shows less than at its foot: points there get others."""
    turn = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    easts = np.arange(-40, 40, 2.0)
    sensors = [FrameModel((CENTRE[0] + e, CENTRE[1], Z + 30.0), turn, 90.0, (60.0, 50.0)) for e in easts]
    views = [View(f"v{e:g}", Path("x"), Blank(), one) for e, one in zip(easts, sensors, strict=True)]
    east, north = (a.ravel() for a in np.meshgrid(np.linspace(-20, 20, 33), np.linspace(-4, 4, 5)))
    ground = np.column_stack([CENTRE[0] + east, CENTRE[1] + north])
    options, is_core, top_m = SelectionOptions(), np.ones(len(ground), bool), 12.0
    least = {}
    for heights in ((), (Z + top_m,)):
        chosen_views = [easts[i] for i in preselected(views, ground, Z, options, is_core, heights)]
        half_width = 60.0 / 90.0 * (30.0 - top_m)
        least[heights] = min(sum(abs(at - e) < half_width for at in chosen_views) for e in east)
    assert least[()] < options.max_images_of_point <= least[(Z + top_m,)]
