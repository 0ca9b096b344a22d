"""`zlocus orient` and `zlocus ties` through the real command line, on rendered images with planted errors."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyogrio
import pytest
import rasterio
from typer.testing import CliRunner

from orientation_scenes import without_translation
from rendered_scenes import CENTRE, LOOKS, SIZE_PX, camera, read, rendered, run
from zlocus.cli.app import app
from zlocus.core.options import OrientationOptions
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.orient import options_of_command, terrain_heights
from zlocus.synthetic.terrain import analytic_height

PLANTED = {"nadir": (1.5, -2.0), "fore": (-3.0, 1.0), "aft": (2.0, 2.5)}
KIND = "sine"
HEIGHTS = ("--heights", 25, 80)
RECOVERED_PX = 0.15  # images of 150 pixels hold few ties
SAME_M = 0.02


@pytest.fixture(scope="module")
def flawed(tmp_path_factory):
    return rendered(tmp_path_factory.mktemp("flawed"), KIND, PLANTED)


def invoke(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def oriented(flawed, tmp_path_factory):
    out = tmp_path_factory.mktemp("oriented") / "out"
    result = invoke("orient", *flawed.inputs, "-o", out, *HEIGHTS, "--crs", "EPSG:32632")
    assert result.exit_code == 0, result.output
    assert "3 cameras" in result.stdout
    return out


def shifts(before, after):
    """Pixels by which the cameras of one scene moved, (i, 2)."""
    xyz = np.array([[*CENTRE, 50.0]])
    return np.concatenate(
        [a.sensor.image_from_ground(xyz) - b.sensor.image_from_ground(xyz) for a, b in zip(after, before, strict=True)]
    )


def test_planted_errors_are_gone_from_the_cameras_written(flawed, oriented):
    before = {view.name: view for view in open_scene(flawed.inputs).views}
    after = {view.name: view for view in open_scene([oriented / "scene.yaml"]).views}
    names = list(LOOKS)
    moved = shifts([before[name] for name in names], [after[name] for name in names])
    left = without_translation(moved + np.array([PLANTED[name] for name in names]), [camera(name) for name in names])
    assert np.abs(left).max() < RECOVERED_PX


def test_the_report(oriented):
    report = json.loads((oriented / "orientation.json").read_text())
    assert report["model"] == "joint"
    assert report["sensors"]["rpc"]["n_views"] == 3
    after, before = (report["sensors"]["rpc"][f"residual_{when}_px"]["rms"] for when in ("after", "before"))
    assert after < 0.5 * before
    assert 0.01 < report["sigma0_px"] < 0.5
    assert report["n_parameters"] == 6
    assert report["n_parameters_determined"] == 3
    assert [block["views"] for block in report["corrections"]] == [["aft"], ["fore"], ["nadir"]]
    for block in report["corrections"]:
        name = block["views"][0]
        added = [block["added"][axis] for axis in ("column_px", "row_px")]
        assert added == pytest.approx(report["views"][name]["shift_px"], abs=1e-3)
        assert block["sigma_before"] == {"column_px": 20.0, "row_px": 20.0}
    assert "3 of 6 directions" in report["unobservable"]
    assert set(report["cameras"]) == set(LOOKS)
    assert sorted(path.name for path in oriented.iterdir()) == [
        "cameras", "observations.npz", "orientation.json", "run.json", "scene.yaml", "ties.gpkg", "ties.qml",
        "ties.sld",
    ]  # fmt: skip


def test_the_surface_is_that_of_the_images_oriented_on_the_way(flawed, oriented, tmp_path):
    run(flawed, tmp_path / "images")
    run((oriented / "scene.yaml",), tmp_path / "scene")
    one, other = (read(tmp_path / name / "dsm.tif")[0] for name in ("images", "scene"))
    assert np.isfinite(one).mean() > 0.5
    assert np.nanmedian(np.abs(one - other)) < SAME_M
    assert (np.isfinite(one) == np.isfinite(other)).mean() > 0.98


def test_ties_alone(flawed, tmp_path):
    result = invoke("ties", *flawed.inputs, "-o", tmp_path / "out", *HEIGHTS)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "orientation.json", "run.json", "ties.gpkg", "ties.qml", "ties.sld",
    ]  # fmt: skip
    report = json.loads((tmp_path / "out" / "orientation.json").read_text())
    assert report["model"] == "none"
    assert pyogrio.read_info(tmp_path / "out" / "ties.gpkg")["features"] == report["n_ties"]
    assert "tie points" in result.stdout


def control_rows(points):
    """A table of points as the exact cameras see them, for images whose RPCs are flawed; role : of each."""
    rows = ["name,x,y,z,sigma,role,image,column,row"]
    for k, (x, y, role) in enumerate(points):
        xyz = np.array([[CENTRE[0] + x, CENTRE[1] + y, analytic_height(KIND, np.array(x), np.array(y))]])
        for index, name in enumerate(LOOKS):
            (column, row), size = camera(name).image_from_ground(xyz)[0], (SIZE_PX, SIZE_PX - 3 * index)
            assert 0 < column < size[0] - 1
            assert 0 < row < size[1] - 1
            rows.append(f"p{k},{xyz[0, 0]!r},{xyz[0, 1]!r},{xyz[0, 2]!r},0.02,{role},{name},{column!r},{row!r}")
    return "\n".join(rows).replace("np.float64(", "").replace(")", "") + "\n"


def test_control_puts_the_scene_where_it_is(flawed, tmp_path):
    points = [(-10, -8, "control"), (9, -9, "control"), (8, 9, "control"), (-9, 8, "control"), (0.5, 1.0, "check")]
    (tmp_path / "points.csv").write_text(control_rows(points))
    out = tmp_path / "out"
    result = invoke("orient", *flawed.inputs, "-o", out, *HEIGHTS, "--control", tmp_path / "points.csv")
    assert result.exit_code == 0, result.output
    found = json.loads((out / "orientation.json").read_text())["control"]
    assert (found["control"]["n"], found["check"]["n"]) == (4, 1)
    assert np.abs(found["check"]["rms_m"]).max() < 0.3
    before = open_scene(flawed.inputs).views
    after = {view.name: view for view in open_scene([out / "scene.yaml"]).views}
    moved = shifts(before, [after[view.name] for view in before])
    # Without a translation to be fitted.
    assert np.abs(moved + [PLANTED[view.name] for view in before]).max() < 2 * RECOVERED_PX


def test_a_terrain_model_holds_the_heights(flawed, tmp_path):
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=60, height=60, count=1, dtype="float32", crs="EPSG:32632",
        transform=rasterio.Affine(10, 0, CENTRE[0] - 300, 0, -10, CENTRE[1] + 300),
    ) as raster:  # fmt: skip
        raster.write(np.full((1, 60, 60), 60.0, np.float32))
    (tmp_path / "mine.toml").write_text("[orientation.bundle_adjustment]\nsigma_dem_m = 0.1\n")
    out = tmp_path / "out"
    options = ["--dem", tmp_path / "dem.tif", "--config", tmp_path / "mine.toml", "--crs", "EPSG:32632"]
    result = invoke("orient", *flawed.inputs, "-o", out, *HEIGHTS, *options)
    assert result.exit_code == 0, result.output
    found = json.loads((out / "orientation.json").read_text())
    assert abs(found["terrain"]["median_m"]) < 1.0
    terrain = terrain_heights(tmp_path / "dem.tif", replace(open_scene(flawed.inputs), heights=(25.0, 80.0)))
    assert terrain.at(np.array([CENTRE]))[0] == pytest.approx(60.0)


def test_what_stands_alone_is_joint_unless_it_is_said_otherwise():
    assert options_of_command(OrientationOptions(), True).model == "joint"
    assert options_of_command(OrientationOptions(model="shift"), True).model == "shift"
    assert options_of_command(OrientationOptions(), False).model == "none"


def test_another_run_is_not_replaced(oriented, flawed):
    result = invoke("orient", *flawed.inputs, "-o", oriented, *HEIGHTS)
    assert result.exit_code == 2
    assert "--overwrite" in result.stderr


@pytest.mark.parametrize(
    ("text", "says"),
    [("name,x\n", "holds no rows"), ("name,x,y,z,image,column,row\na,1,2,3,elsewhere,4,5\n", "elsewhere")],
)
def test_a_malformed_table_of_control_points_is_one_sentence(flawed, tmp_path, text, says):
    (tmp_path / "points.csv").write_text(text)
    result = invoke("orient", *flawed.inputs, "-o", tmp_path / "out", "--control", tmp_path / "points.csv")
    assert result.exit_code == 2
    (said,) = [line for line in result.stderr.splitlines() if line.startswith("zlocus: ")]
    assert says in said
    assert "points.csv" in said
    assert said.endswith(".")
    assert not (tmp_path / "out").exists()


def test_a_missing_table_and_dem(flawed, tmp_path):
    for option in ("--control", "--dem"):
        result = invoke("orient", *flawed.inputs, "-o", tmp_path / "out", *HEIGHTS, option, "nowhere.csv")
        assert result.exit_code == 2
        assert "nowhere.csv" in result.stderr
    assert not (tmp_path / "out").exists()
