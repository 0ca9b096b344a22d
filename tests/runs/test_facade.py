"""A wall photographed from the side, in a local frame: imported cameras, turned by --up and --north, to a surface."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from facade_scene import ALONG, FILE_FROM_WALL, KIND, OUT, STATIONS, photographed
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.core.requests import ImportRequest
from zlocus.io.scene_file import open_scene
from zlocus.orientation.orientation import OrientationRequest, orient
from zlocus.sensors.frame_axes import rotation_to_axes
from zlocus.synthetic.terrain import analytic_height

MIN_COVERAGE, WITHIN_M, MIN_WITHIN = 0.9, 0.25, 0.95


@pytest.fixture(scope="module")
def facade(tmp_path_factory):
    return photographed(tmp_path_factory.mktemp("facade"), KIND)


def command(*arguments):
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert "Traceback" not in result.output
    return result


def imported(facade, out, *more):
    result = command("import", "colmap", facade, "--up", *OUT, "-o", out, *more)
    assert result.exit_code == 0, result.output
    return out


@pytest.fixture(scope="module")
def surface(facade, tmp_path_factory):
    """No option but the frame's directions."""
    folder = tmp_path_factory.mktemp("surface")
    scene = imported(facade, folder / "scene.yaml", "--north", *ALONG)
    result = command("dsm", scene, "-o", folder / "out")
    assert result.exit_code == 0, result.output
    return folder / "out"


def errors(out):
    """Heights less those of the wall, (r, c) m, and x, y of the cells."""
    with rasterio.open(out / "dsm.tif") as file:
        transform, z = file.transform, file.read(1)
    col, row = np.meshgrid(np.arange(z.shape[1]) + 0.5, np.arange(z.shape[0]) + 0.5)
    x, y = transform * (col, row)
    return z - analytic_height(KIND, x, y), x, y


def test_the_surface_is_the_wall(surface):
    """Coordinates are those of the wall: x along it, y up it, z out of it."""
    error, *_ = errors(surface)
    found = np.isfinite(error)
    record = json.loads((surface / "run.json").read_text())
    assert record["coverage"] > MIN_COVERAGE
    assert (np.abs(error[found]) < WITHIN_M).mean() > MIN_WITHIN
    assert abs(np.median(error[found])) < 0.05


def test_the_report_names_the_local_frame(surface):
    text = (surface / "report.html").read_text(encoding="utf-8")
    assert "of a local frame, which has no place on the Earth" in text
    assert "y is up" in text
    assert "z of the local frame, m" in text
    assert not re.search("ellipsoid, m|north is up|°|no footprints|no match curves", text)
    assert text.count("<polygon") == len(STATIONS) + 1
    assert len(re.findall(r"<h3>Typical", text)) == 3


def test_the_area_is_what_two_images_show_near_the_tie_points(surface):
    """Not the many times larger ground far behind the wall that two images share at the lowest heights."""
    error, *_ = errors(surface)
    assert np.isfinite(error).mean() > 0.5
    with rasterio.open(surface / "ortho.tif") as file:
        assert file.bounds == rasterio.open(surface / "dsm.tif").bounds


def test_cameras_of_a_local_frame_stay_as_they_are(surface):
    record = json.loads((surface / "run.json").read_text())
    assert record["orientation"]["model"] == "none"
    assert all(view["shift_px"] == [0.0, 0.0] for view in record["orientation"]["views"].values())
    # They agree, and their residuals are told.
    assert all(view["residual_after_px"]["median"] < 0.3 for view in record["orientation"]["views"].values())


def test_a_local_frame_has_no_place_on_the_earth(facade, surface, tmp_path):
    scene = imported(facade, tmp_path / "scene.yaml")
    polygons = tmp_path / "area.geojson"
    polygons.write_text("{}")
    for name in ("area", "mask", "dem"):
        result = command("dsm", scene, "-o", tmp_path / "out", f"--{name}", polygons)
        assert result.exit_code == 2
        assert f"Leave --{name} out" in result.stderr
        assert not (tmp_path / "out").exists()
    with rasterio.open(surface / "dsm.tif") as file:
        assert file.crs is None or not (file.crs.is_projected or file.crs.is_geographic)


def test_joint_corrections_are_made_where_they_are_asked_for(facade, tmp_path):
    scene = open_scene([imported(facade, tmp_path / "scene.yaml")])
    assert orient(scene, OrientationOptions(), OrientationRequest((40.0, 60.0))).model == "none"
    asked = OrientationOptions(model="joint", bundle_adjustment=BundleAdjustmentOptions(sigma_position_m=0.01))
    assert orient(scene, asked, OrientationRequest((40.0, 60.0))).model == "joint"


def test_north_turns_the_frame_about_its_up():
    rotation = rotation_to_axes(tuple(OUT), tuple(ALONG + 0.7 * OUT))
    np.testing.assert_allclose(rotation @ FILE_FROM_WALL, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation_to_axes((0.0, 0.0, 2.0), (0.0, 5.0, 1.0)), np.eye(3), atol=1e-12)


def test_doctor_names_the_wall(tmp_path):
    """A flat one. From a frame that is 30 degrees off, in the axes of the files; nothing where it is right."""
    facade = photographed(tmp_path / "flat", "plane")
    turned = np.cos(np.deg2rad(30.0)) * OUT - np.sin(np.deg2rad(30.0)) * np.cross(ALONG, OUT)
    scene = command("import", "colmap", facade, "--up", *turned, "--north", *ALONG, "-o", tmp_path / "scene.yaml")
    assert scene.exit_code == 0
    command("doctor", tmp_path / "scene.yaml", "-o", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "doctor.json").read_text())["findings"]
    (sentence,) = [each["sentence"] for each in found if "lie on a plane" in each["sentence"]]
    named = np.array(json.loads(sentence[sentence.index("up: ") + 4 : sentence.index("}")]))
    np.testing.assert_allclose(named, OUT, atol=0.01)
    command("doctor", imported(facade, tmp_path / "right.yaml", "--north", *ALONG), "-o", tmp_path / "right")
    assert "lie on a plane" not in (tmp_path / "right" / "doctor.json").read_text()


def test_invalid_norths_are_refused(facade, tmp_path):
    for axes in ((OUT, 2 * OUT), (OUT, -OUT)):
        up, north = axes
        result = command("import", "colmap", facade, "--up", *up, "--north", *north, "-o", tmp_path / "s.yaml")
        assert result.exit_code == 2
        assert "neither along up nor 0" in result.stderr
    for options, says in (({"north": (0.0, 1.0, 0.0)}, "Give --up too"), ({"up": (0.0, 0.0, 1.0), "north": (0.0,) * 3},
                          "--north 0 0 0 is no direction")):  # fmt: skip
        with pytest.raises(ConfigError, match=says):
            ImportRequest("colmap", facade, tmp_path / "s.yaml", **options)
    assert not (tmp_path / "s.yaml").exists()
