"""Corrected cameras written as files are the same cameras when they are read back."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from flights import COLUMNS, FOCAL_MM, INTERVAL_S, ROWS, Flight, focal_line, on_earth
from location_grids import grid_of, written
from rendered_scenes import UTM
from rpc_fixtures import write_image
from zlocus.core.errors import ConfigError
from zlocus.io.cameras.linescan_files import write_calibration, write_trajectory
from zlocus.io.scene_file import open_scene
from zlocus.products import corrected_cameras
from zlocus.products.corrected_cameras import check_cameras_can_be_written, write_cameras
from zlocus.sensors.correction import AffinelyShiftedModel, ShiftedModel
from zlocus.sensors.trajectory import Drift

SAME_PX = 1e-6
FITTED_PX = 1e-3
FLIGHT = Flight(30.0, wobble_deg=0.2, wobble_m=0.5)


def rewritten(scene, folder, inputs, correct):
    """The scene with corrected sensors, and what its files give."""
    corrected = replace(scene, views=tuple(replace(view, sensor=correct(view.sensor)) for view in scene.views))
    out = folder / "deep" / "out"
    out.mkdir(parents=True)
    record = write_cameras(out, inputs, corrected)
    json.dumps(record)
    return corrected, open_scene([out / "scene.yaml"]), record


def assert_same(one, other, z_range, tolerance_px=SAME_PX):
    """Both scenes' cameras see the same ground at the same pixels, of the same images."""
    rng = np.random.default_rng(3)
    assert [view.name for view in one.views] == [view.name for view in other.views]
    for a, b in zip(one.views, other.views, strict=True):
        assert a.path.resolve() == b.path.resolve()
        rows, cols = a.image.shape
        xy = rng.uniform((0, 0), (cols - 1, rows - 1), (200, 2))
        xyz = a.sensor.ground_from_image(xy, rng.uniform(*z_range, 200))
        np.testing.assert_allclose(b.sensor.image_from_ground(xyz), xy, rtol=0, atol=tolerance_px)


def test_shifted_rpcs_are_exact(images, tmp_path):
    scene = open_scene(images("plane").inputs)
    corrected, again, record = rewritten(
        scene, tmp_path, images("plane").inputs, lambda sensor: ShiftedModel(ShiftedModel(sensor, 1.25, -3.5), 0.5, 0.0)
    )
    assert_same(corrected, again, (20.0, 90.0))
    assert record["nadir"] == {"kind": "rpc", "file": "cameras/nadir_RPC.TXT"}
    assert again.crs == scene.crs == UTM


def test_affine_rpcs_are_fitted_and_say_how_well(images, tmp_path):
    scene = open_scene(images("plane").inputs)
    corrected, again, record = rewritten(
        scene, tmp_path, images("plane").inputs,
        lambda sensor: AffinelyShiftedModel(sensor, (1.0, 2e-3, -3e-3), (-2.0, 1e-3, 4e-3)),
    )  # fmt: skip
    assert_same(corrected, again, (20.0, 90.0), FITTED_PX)
    assert 0.0 < record["fore"]["rpc_fit_max_px"] < FITTED_PX


def location_grid_scene(scene, folder):
    """Scene file of the first two views, with a location grid of each sensor in a folder beside it."""
    (folder / "grids").mkdir()
    views = []
    for view in scene.views[:2]:
        rows, cols = view.image.shape
        step = ((cols + 20.0) / 4, (rows + 20.0) / 4)
        location_grid = grid_of(view.sensor, scene.crs, (-20.0, 30.0, 80.0, 130.0), (-10.0, -10.0), step, (5, 5))
        written(folder / "grids" / f"{view.name}.tif", location_grid)
        camera = {"kind": "location_grid", "file": f"grids/{view.name}.tif", "shift": [0.25, 0.5]}
        views.append({"name": view.name, "image": str(view.path), "camera": camera})
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump({"schema": 1, "frame": {"crs": "EPSG:32632"}, "views": views}))
    return file


def test_shifted_location_grids_are_exact(images, tmp_path):
    inputs = [location_grid_scene(open_scene(images("plane").inputs), tmp_path)]
    check_cameras_can_be_written(inputs)
    scene = open_scene(inputs)
    corrected, again, record = rewritten(scene, tmp_path, inputs, lambda sensor: ShiftedModel(sensor, 1.25, -3.5))
    assert_same(corrected, again, (20.0, 90.0))
    file = "../../grids/nadir.tif"
    assert record["nadir"] == {"kind": "location_grid", "file": file, "first_pixel": [0.0, 0.0], "shift": [1.5, -3.0]}


def test_location_grids_with_affine_corrections_become_rpcs(images, tmp_path):
    inputs = [location_grid_scene(open_scene(images("plane").inputs), tmp_path)]
    corrected, again, record = rewritten(
        open_scene(inputs), tmp_path, inputs,
        lambda sensor: AffinelyShiftedModel(sensor, (1.0, 2e-3, -3e-3), (-2.0, 1e-3, 4e-3)),
    )  # fmt: skip
    assert_same(corrected, again, (20.0, 90.0), FITTED_PX)
    assert record["nadir"]["kind"] == "rpc"


FRAME_CAMERA = {
    "kind": "frame", "focal": [850.0, 851.0], "principal_point": [399.0, 301.0], "skew": 0.2,
    "distortion": {"kind": "brown", "k1": -0.05, "k2": 0.01, "p1": 1e-4}, "angles": [1.0, -2.0, 30.0],
}  # fmt: skip
# 7 px from the first to the last row.
MOTION = {"rolling_shutter": {"readout_s": 0.1, "velocity_m_s": [40.0, 15.0, -5.0]}}


def calibrated(sensor):
    """The camera with changes of all that a self-calibration changes."""
    sensor = replace(sensor, focal=sensor.focal + 3.0, distortion=replace(sensor.distortion, k1=0.02, p2=-2e-4))
    motion = sensor.rolling_shutter
    return sensor if motion is None else replace(sensor, rolling_shutter=replace(motion, readout_s=0.07))


@pytest.mark.parametrize(
    ("frame", "camera", "centre"),
    [
        ({"crs": "EPSG:32632"}, {}, [462_000.0, 5_247_000.0, 900.0]),
        ({"crs": "EPSG:32632"}, {"crs": "EPSG:32631"}, [920_000.0, 5_260_000.0, 900.0]),
        ({"crs": "EPSG:32632"}, {"earth": "flat"}, [462_000.0, 5_247_000.0, 900.0]),
        ({"local": True}, {}, [3.0, 4.0, 500.0]),
        ({"local": True, "up": [0.1, 0.2, 1.0]}, {}, [3.0, 4.0, 500.0]),
        ({"crs": "EPSG:32632"}, {"crs": "EPSG:32631"} | MOTION, [920_000.0, 5_260_000.0, 900.0]),
        ({"crs": "EPSG:32632"}, {"earth": "flat"} | MOTION, [462_000.0, 5_247_000.0, 900.0]),
        ({"local": True, "up": [0.1, 0.2, 1.0]}, MOTION, [3.0, 4.0, 500.0]),
    ],
)
def test_frame_cameras(tmp_path, frame, camera, centre):
    views = []
    for k, name in enumerate("ab"):
        write_image(tmp_path / f"{name}.tif", np.arange(600 * 800, dtype=np.uint16).reshape(600, 800))
        at = [centre[0] + 30.0 * k, *centre[1:]]
        views.append({"name": name, "image": f"{name}.tif", "camera": FRAME_CAMERA | camera | {"centre": at}})
    document = {"schema": 1, "frame": frame, "heights": [0, 100], "views": views}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(document))
    inputs = (tmp_path / "scene.yaml",)
    scene = open_scene(inputs)
    turn = np.array([1e-3, -2e-3, 5e-3])
    corrected, again, _ = rewritten(
        scene, tmp_path, inputs, lambda s: calibrated(s.corrected(np.array([0.3, -0.2, 0.1]), turn))
    )
    assert_same(corrected, again, (0.0, 100.0))
    assert again.heights == (0.0, 100.0)
    assert again.crs == scene.crs


def test_a_shift_of_a_frame_camera_moves_its_principal_point(tmp_path):
    views = []
    for k, name in enumerate("ab"):
        write_image(tmp_path / f"{name}.tif", np.arange(600 * 800, dtype=np.uint16).reshape(600, 800))
        views.append(
            {"name": name, "image": f"{name}.tif", "camera": FRAME_CAMERA | {"centre": [30.0 * k, 0.0, 500.0]}}
        )
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "frame": {"local": True}, "views": views}))
    inputs = (tmp_path / "scene.yaml",)
    corrected, again, _ = rewritten(open_scene(inputs), tmp_path, inputs, lambda s: ShiftedModel(s, 2.0, -1.0))
    assert_same(corrected, again, (0.0, 100.0))


def scan_scene(folder, **changes):
    """Two lines of one flight, 0.2 s apart on their strip."""
    image = np.arange(ROWS * 100, dtype=np.uint16).reshape(ROWS, 100)
    for name in "ab":
        write_image(folder / f"{name}.tif", image)
    write_calibration(folder / "ads40.csv", {"nadir": focal_line(2.0), "forward": focal_line(26.0)}, "two lines")
    views = []
    for name, line in zip("ab", ("nadir", "forward"), strict=True):
        camera = {
            "kind": "linescan", "calibration": "ads40.csv", "line": line, "focal_mm": FOCAL_MM,
            "first_column": COLUMNS // 2, "trajectory": "path.csv", "rays": "frame",
            "times": {"start": 0.0, "interval": INTERVAL_S}, "lever_arm": [0.5, -0.2, 0.1],
            "boresight": [0.1, -0.2, 0.3],
        } | changes  # fmt: skip
        views.append({"name": name, "image": f"{name}.tif", "camera": camera})
    (folder / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "frame": {"crs": "EPSG:32632"}, "views": views}))
    return (folder / "scene.yaml",)


def drifted(sensor):
    values = np.array([[0.5, -0.3, 0.2, 1e-4, -2e-4, 1e-4], [-0.2, 0.4, 0.1, -1e-4, 1e-4, 2e-4]])
    return sensor.corrected(Drift(np.array([0.0, ROWS * INTERVAL_S]), values))


PLANE = {"height": 440.0, "transform": [0.5, 0.1, 461_950.0, -0.1, -0.5, 5_247_060.0], "rows": ROWS}


@pytest.mark.parametrize("changes", [{}, {"rectification": PLANE, "line": "nadir"}])
def test_line_scanners_in_the_frame(tmp_path, changes):
    write_trajectory(tmp_path / "path.csv", FLIGHT.trajectory(), "in the frame")
    inputs = scan_scene(tmp_path, **changes)
    corrected, again, _ = rewritten(open_scene(inputs), tmp_path, inputs, drifted)
    assert_same(corrected, again, (400.0, 500.0))
    twice, again, _ = rewritten(again, tmp_path / "two", (tmp_path / "deep" / "out" / "scene.yaml",), drifted)
    assert_same(twice, again, (400.0, 500.0))


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:32632"])
def test_line_scanners_on_the_earth(tmp_path, crs):
    """The trajectory written is geocentric, whatever the one given was."""
    flight = FLIGHT.trajectory() if crs == "EPSG:32632" else on_earth(20.0, 2.0, 440.0, 8.5, 47.4)[0].trajectory
    write_trajectory(tmp_path / "path.csv", flight, "in its CRS", quaternions=crs == "EPSG:4978")
    inputs = scan_scene(tmp_path, rays="earth", crs=crs)
    corrected, again, _ = rewritten(open_scene(inputs), tmp_path, inputs, drifted)
    assert_same(corrected, again, (400.0, 500.0))


def test_a_shift_of_a_line_scanner_cannot_be_written(tmp_path):
    write_trajectory(tmp_path / "path.csv", FLIGHT.trajectory(), "in the frame")
    inputs = scan_scene(tmp_path)
    with pytest.raises(ConfigError, match=r"orientation\.model = joint"):
        rewritten(open_scene(inputs), tmp_path, inputs, lambda s: ShiftedModel(s, 1.0, 0.0))


def test_a_camera_of_a_new_kind_is_refused_before_any_work(tmp_path, monkeypatch):
    """Its corrected form could be written as no known kind of camera."""

    class Affine:
        kind = "affine"

    monkeypatch.setattr(corrected_cameras, "given_cameras", lambda inputs: {"a": (Affine(), tmp_path)})
    with pytest.raises(ConfigError, match=r"camera of a in .*scene\.yaml is of the kind affine"):
        check_cameras_can_be_written([tmp_path / "scene.yaml"])
