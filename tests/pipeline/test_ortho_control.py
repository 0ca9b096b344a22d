"""`zlocus orient --control-ortho` through the command line: cameras that point 10 px past a rendered ortho-photo."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
from affine import Affine
from typer.testing import CliRunner

from ortho_scenes import NAMES, PIXEL_M, town, write_photo, write_terrain, write_view
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError
from zlocus.core.orient_request import OrientRequest
from zlocus.io.control_points import read_control
from zlocus.io.scene_file import open_scene

PLAN_PX = 0.5
PHOTO_M, REBUILT = 0.3, 0.25
# Places of an image agree so well with a photo of other light; and so few of the points are check points.
LEAST_RMS_PX, MOST_RMS_PX, MOST_CHECK_SHARE = 0.02, 1.0, 0.35


def orient(*arguments):
    return CliRunner().invoke(app, ["orient", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    scene = town(tmp_path_factory.mktemp("town"))
    for name in NAMES:
        write_view(scene, name)
    write_terrain(scene, scene.folder / "terrain.tif")
    write_photo(scene, scene.folder / "photo.tif", pixel_m=PHOTO_M, rebuilt=REBUILT)
    return scene


def control_of(scene, photo="photo.tif", terrain="terrain.tif"):
    return ("--control-ortho", scene.folder / photo, "--control-dem", scene.folder / terrain)


@pytest.fixture(scope="module")
def images(made):
    return [made.folder / f"{name}.tif" for name in NAMES]


@pytest.fixture(scope="module")
def oriented(made, images):
    out = made.folder / "oriented"
    result = orient(*images, "-o", out, "--crs", "EPSG:32632", *control_of(made))
    assert result.exit_code == 0, result.output
    said = " ".join(result.stderr.split())
    assert "in 3 of 3 images, whose cameras point 9." in said or "in 3 of 3 images, whose cameras point 10." in said
    return out


def test_cameras_are_right_in_plan(made, images, oriented):
    rng, side = np.random.default_rng(1), made.spec.size * PIXEL_M
    xyz = np.column_stack([
        made.spec.west_m + rng.uniform(0, side, 200), made.spec.north_m - rng.uniform(0, side, 200),
        rng.uniform(435, 460, 200),
    ])  # fmt: skip
    views = {view.path.stem: view for view in open_scene([oriented / "scene.yaml"]).views}
    before = {view.name: view for view in open_scene(images, made.spec.crs).views}
    for name in NAMES:
        at = made.exposure(name).sensor.image_from_ground(xyz)
        error = (views[name].sensor.ground_from_image(at, xyz[:, 2]) - xyz)[:, :2].mean(axis=0)
        assert np.hypot(*error) / PIXEL_M < PLAN_PX
        delivered = (before[name].sensor.ground_from_image(at, xyz[:, 2]) - xyz)[:, :2].mean(axis=0)
        assert np.hypot(*delivered) / PIXEL_M > 9.0


def test_what_was_found_is_reported(made, images, oriented):
    report = json.loads((oriented / "orientation.json").read_text())
    assert set(report["control_ortho"]) == set(NAMES)
    for name in NAMES:
        found = report["control_ortho"][name]
        assert 12 <= found["n_points"] <= found["n_windows"]
        assert np.hypot(*found["offset_px"]) == pytest.approx(10.0, abs=0.5)
        assert LEAST_RMS_PX < found["rms_px"] < MOST_RMS_PX
    n_check, n_control = (report["control"][kind]["n"] for kind in ("check", "control"))
    assert n_check > 3
    assert n_check < MOST_CHECK_SHARE * n_control
    files = {each["path"] for each in json.loads((oriented / "run.json").read_text())["inputs"]}
    assert {str(made.folder / name) for name in ("photo.tif", "terrain.tif")} <= files
    views = open_scene(images).views
    again = read_control(oriented / "control_points.csv", views)
    assert len(again) == n_check + n_control


def test_an_ortho_photo_of_another_place_is_refused(made, images, tmp_path):
    other = town(tmp_path / "other", 6)
    write_photo(other, other.folder / "photo.tif")
    control = ("--control-ortho", other.folder / "photo.tif", "--control-dem", made.folder / "terrain.tif")
    result = orient(*images, "-o", tmp_path / "out", *control)
    assert result.exit_code == 2
    assert "seems to show another place than the images" in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_an_ortho_photo_far_away_is_refused(made, images, tmp_path):
    photo = eastwards(made.folder / "photo.tif", tmp_path / "photo.tif")
    terrain = eastwards(made.folder / "terrain.tif", tmp_path / "terrain.tif")
    control = ("--control-ortho", photo, "--control-dem", terrain)
    result = orient(*images, "-o", tmp_path / "out", "--crs", "EPSG:32632", *control)
    assert result.exit_code == 2
    assert "shows another place than the images: it covers E 467000" in " ".join(result.stderr.split())


def eastwards(path, moved):
    """A copy of a raster 5 km farther east."""
    with rasterio.open(path) as file:
        at = file.transform
        place = Affine(at.a, at.b, at.c + 5000.0, at.d, at.e, at.f)
        with rasterio.open(moved, "w", **file.profile | {"transform": place}) as copy:
            copy.write(file.read())
    return moved


def test_both_rasters_are_needed(images, tmp_path):
    with pytest.raises(ConfigError, match="without --control-dem"):
        OrientRequest(tuple(images), tmp_path, control_ortho=tmp_path / "photo.tif")
    with pytest.raises(ConfigError, match="without --control-ortho"):
        OrientRequest(tuple(images), tmp_path, control_dem=tmp_path / "terrain.tif")


def test_a_terrain_model_beside_the_ortho_photo_is_refused(made, images, tmp_path):
    terrain = eastwards(made.folder / "terrain.tif", tmp_path / "terrain.tif")
    control = ("--control-ortho", made.folder / "photo.tif", "--control-dem", terrain)
    result = orient(*images, "-o", tmp_path / "out", "--crs", "EPSG:32632", *control)
    assert result.exit_code == 2
    assert "has no height where the ortho-photo" in " ".join(result.stderr.split())
