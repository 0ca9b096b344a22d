"""Where a surface lies, and how much of the area asked for two images see."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
from pyproj import CRS
from shapely import box

from zlocus.core.errors import ConfigError
from zlocus.core.grid import grid_from_bounds
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.pipeline.dry_run import plan_dsm
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.extent import Extent, crs_text, seen_sentence, seen_share

UTM = CRS.from_epsg(32632)
# The estimate of the share is made at one height of the ground, m, of a town of 56 m with roofs of some metres.
SHARE_TOLERANCE = 0.06


class Notes(SilentProgress):
    def __init__(self):
        self.said = []

    def note(self, sentence):
        self.said.append(sentence)


def test_the_extent_is_in_the_crs_and_in_degrees():
    # The zone's middle is 9 degrees east, and 500 000 m there.
    extent = Extent.of(grid_from_bounds((499_990.0, 5_200_000.0, 500_010.0, 5_200_020.0), 1.0, UTM), UTM)
    assert extent.crs_text == "EPSG:32632 (WGS 84 / UTM zone 32N)"
    west, south, east, north = extent.degrees
    assert (west + east) / 2 == pytest.approx(9.0, abs=1e-6)
    assert (south, north) == pytest.approx((46.95353, 46.95371), abs=1e-5)
    assert str(extent).startswith("bounds 499990.00 5200000.00 500010.00 5200020.00 (xmin ymin xmax ymax, m), in deg")
    assert extent.as_dict()["bounds"] == [499990.0, 5200000.0, 500010.0, 5200020.0]


def test_a_crs_without_a_code_has_a_name():
    local = CRS.from_wkt('LOCAL_CS["facade",UNIT["metre",1]]')
    assert crs_text(local) == "facade"
    extent = Extent.of(grid_from_bounds((0.0, 0.0, 2.0, 2.0), 1.0, local), local)
    assert extent.degrees is None
    assert str(extent) == "bounds 0.00 0.00 2.00 2.00 (xmin ymin xmax ymax, m of the local frame)"


def test_the_share_is_that_of_the_ground_that_two_images_see(monkeypatch):
    # Three images of 10 x 10 m: the first two share 5 x 10 m, the third shares 1 x 10 m with the second.
    outlines = {"a": (0, 10), "b": (5, 15), "c": (14, 24)}
    corners = {name: box(low, 0, high, 10).exterior.coords[:-1] for name, (low, high) in outlines.items()}
    monkeypatch.setattr("zlocus.core.footprints.footprint", lambda view, z: list(corners[view]))
    scene = SimpleNamespace(views=tuple(outlines))
    assert seen_share(scene, 0.0, box(0, 0, 24, 10)) == pytest.approx(6 / 24, abs=1e-6)
    assert seen_share(scene, 0.0, box(0, 0, 4, 10)) == 0.0
    assert seen_share(scene, 0.0, box(6, 1, 9, 2)) == 1.0


def test_nearly_all_is_not_worth_a_sentence():
    assert seen_sentence(None) == seen_sentence(0.999) == ""
    assert seen_sentence(0.3, "about ").startswith("Two images or more see about 30 % of the area asked for;")


def test_a_run_says_how_much_of_its_area_two_images_see(small_town, tmp_path):
    inputs = tuple(small_town / name for name in ("img_n1.tif", "img_f1.tif"))
    whole = plan_dsm(DsmRequest(inputs, tmp_path / "out"), RunConfig(), SilentProgress()).values
    assert whole["area_seen"] is None
    xmin, ymin, xmax, ymax = whole["extent"]["bounds"]
    beyond = (xmin + (xmax - xmin) / 2, ymin + 10, xmax + (xmax - xmin) / 2, ymax - 10)
    request = DsmRequest(inputs, tmp_path / "out", bounds=beyond, resolution=1.0, report=False, products=())
    said = Notes()
    result = run_dsm(request, RunConfig(), said)
    share = json.loads((tmp_path / "out" / "run.json").read_text())["area_seen"]
    assert 0.3 < share < 0.7
    assert result.sentence.endswith(seen_sentence(share))
    (note,) = (sentence for sentence in said.said if sentence.startswith("Two images or more see about"))
    assert float(note.split(" %")[0].split()[-1]) == pytest.approx(100 * share, abs=100 * SHARE_TOLERANCE)
    assert run_dsm(request, RunConfig(), SilentProgress()).sentence.endswith(seen_sentence(share))


@pytest.mark.parametrize("resolution", [40.0, 5000.0])
def test_a_resolution_larger_than_what_images_share_is_the_reason_given(small_town, tmp_path, resolution):
    inputs = tuple(small_town / name for name in ("img_n1.tif", "img_f1.tif"))
    request = DsmRequest(inputs, tmp_path / "out", resolution=resolution)
    with pytest.raises(ConfigError, match=f"--resolution {resolution:g} m is too coarse .* windows of 3 x 3 cells"):
        plan_dsm(request, RunConfig(), SilentProgress())
