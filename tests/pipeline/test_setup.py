"""Heights at which a scene may have ground, where nobody names them: from cameras that know where they stood."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import CRS

from orientation_scenes import image_of
from zlocus.core.errors import GeometryError
from zlocus.core.footprints import is_shared
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import SetupRequest
from zlocus.core.scene import Scene, View
from zlocus.core.sensor_model import capped, lowest_station
from zlocus.orientation.ties import height_slabs
from zlocus.pipeline.height_range import (
    LOWEST_LAND_M,
    height_range_of_run,
    heights_below_cameras,
    possible_heights,
    range_below_cameras,
)
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.synthetic.cameras import SatelliteCamera

UTM = CRS.from_epsg(32631)
PLACE = (420_000.0, 4_790_000.0)
SHAPE = (800, 1200)
FOCAL = 1000.0


def frame(east, height=1500.0, omega=0.0, phi=0.0, earth=True):
    model = FrameModel(
        (PLACE[0] + east, PLACE[1], height), rotation_from_angles(omega, phi, 0.0), FOCAL,
        ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2),
    )  # fmt: skip
    return model.on_earth(UTM, UTM) if earth else model


def scene(*sensors):
    image = image_of(np.zeros(SHAPE))
    return Scene(tuple(View(str(k), Path(f"{k}.tif"), image, sensor) for k, sensor in enumerate(sensors)), UTM)


@pytest.mark.parametrize("earth", [True, False])
def test_ground_lies_where_two_footprints_meet(earth):
    """Two cameras 600 m apart that look straight down, 1.2 m wide per metre of depth: from 500 m below on."""
    low, high = heights_below_cameras(scene(frame(0.0, earth=earth), frame(600.0, earth=earth)))
    assert low == pytest.approx(LOWEST_LAND_M, abs=1.0)
    # The next of the depths, 17 % further apart each.
    assert 1500.0 - 500.0 / 0.83 < high <= 1000.0 + 1.0
    z = possible_heights(scene(frame(0.0), frame(600.0)), None)
    assert (z[0], z[-1]) == pytest.approx((low, high), abs=1.0)
    assert possible_heights(scene(frame(0.0), frame(600.0)), (0.0, 40.0)) == [0.0, 10.0, 20.0, 30.0, 40.0]


def test_the_lowest_camera_counts_and_corrections_do_not_hide_it():
    sensors = frame(0.0, 1500.0), ShiftedModel(frame(600.0, 1300.0), 0.5, 0.5)
    assert lowest_station(sensors) == pytest.approx(1300.0, abs=1e-6)
    assert heights_below_cameras(scene(*sensors))[1] < 1300.0
    assert lowest_station([*sensors, SatelliteCamera((*PLACE, 0.0), (0.0, 0.0), 0.5, 5.0, 0.0, 0.0, 30_000.0)]) is None
    assert capped((0.0, 2000.0), 1300.0, 0.25) == (0.0, 975.0)
    assert capped((0.0, 500.0), 1300.0, 0.25) == (0.0, 500.0)
    assert capped((0.0, 2000.0), None, 0.25) == (0.0, 2000.0)


class Notes(SilentProgress):
    """Keeps what is said."""

    def __init__(self):
        self.said = []

    def note(self, sentence):
        self.said.append(sentence)


def test_heights_asked_for_are_searched_up_to_the_cameras():
    """Those well below the lowest camera untouched, in silence; those that reach it up to an eighth of the depth."""
    views, notes = scene(frame(0.0, 1500.0), frame(600.0, 1300.0)), Notes()
    assert range_below_cameras(views, (100.0, 1140.0), notes) == (100.0, 1140.0)
    assert notes.said == []
    low, high = range_below_cameras(views, (100.0, 1250.0), notes)
    assert (low, high) == (100.0, pytest.approx(1150.0, abs=1e-6))
    assert len(notes.said) == 1
    assert "100 to 1250 m" in notes.said[0]
    assert "1300.0 m" in notes.said[0]
    assert "1150.0 m are searched" in notes.said[0]


@pytest.mark.parametrize(("method", "is_wider"), [("mvll-sgm", True), ("mvll", False), ("gc3-sgm", False)])
def test_only_costs_as_evidence_search_beyond_the_expected_heights(method, is_wider):
    rng = np.random.default_rng(1)
    xyz = np.column_stack([rng.uniform(0.0, 300.0, (200, 2)), rng.uniform(100.0, 130.0, 200)])
    ties = SimpleNamespace(xyz=xyz, sigma_z_m=np.full(200, 10.0), views=())
    request, views = SetupRequest((), method=method), Scene((), CRS.from_epsg(32632))
    found = height_range_of_run(request, views, ties, RunConfig(), SilentProgress())
    assert found.expected[0] < 100.0
    assert found.expected[1] > 130.0
    assert (found.searched != found.expected) == is_wider
    assert (found.searched[1] > found.expected[1] + 100.0) == is_wider


def test_what_cannot_be_told_is_asked_for():
    with pytest.raises(GeometryError, match="--heights ZMIN ZMAX"):
        heights_below_cameras(scene(frame(0.0), frame(600.0, phi=80.0)))  # sees the horizon
    with pytest.raises(GeometryError, match=r"anywhere below the lowest camera, which is 1500 m high.*--heights"):
        heights_below_cameras(scene(frame(0.0, phi=40.0), frame(600.0, phi=-40.0)))  # look away from each other
    satellite = SatelliteCamera((*PLACE, 0.0), (0.0, 0.0), 0.5, 5.0, 0.0, 0.0, 30_000.0)
    with pytest.raises(GeometryError, match="--heights ZMIN ZMAX"):
        heights_below_cameras(scene(satellite, satellite))


def test_slabs_of_depth_cover_the_heights_and_overlap():
    views = scene(frame(0.0), frame(600.0)).views
    found = height_slabs(views, (-500.0, 1400.0))
    assert found[0][0] == pytest.approx(-500.0, abs=1e-3)
    assert found[-1][1] == pytest.approx(1400.0, abs=1e-3)
    assert all(a[1] > b[0] for a, b in pairwise(found))
    assert all((1500.0 - low) / (1500.0 - high) < 2.26 for low, high in found)
    assert height_slabs(views, (0.0, 300.0)) == [(0.0, 300.0)]


def test_shared_ground_is_area_in_common():
    near, far = frame(0.0), frame(5000.0)
    assert is_shared(scene(near, frame(600.0)), 0.0)
    assert not is_shared(scene(near, far), 0.0)
