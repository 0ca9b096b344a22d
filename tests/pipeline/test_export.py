"""`zlocus export` of cameras: other programs' own formulas see the ground where zlocus does, as well as it says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from pyproj import Transformer

from rendered_scenes import CENTRE, HEIGHTS
from rpc_fixtures import write_image
from zlocus.core.errors import ConfigError, GeometryError, InputError, OutputError
from zlocus.core.export_request import ExportRequest
from zlocus.core.options import RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import ImportRequest
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.importers.scene import import_scene
from zlocus.io.scene_file import open_scene
from zlocus.orientation import orientation as orientation_module
from zlocus.pipeline.export import run_export
from zlocus.pipeline.orient import run_orient
from zlocus.products import exported_images
from zlocus.products.adjust_files import adjust_file_name

SAME_PX, SAME_ON_A_MAP_PX = 1e-6, 1e-4
ROWS, COLS = 300, 400
# Grey values of a smooth picture after resampling, rounded.
SAME_GREY = 1.5
LENSES = {
    "ideal": {},
    "brown": {"distortion": {"kind": "brown", "k1": -0.05, "k2": 0.01, "p1": 1e-3, "p2": -5e-4}},
    "brown_k3": {"distortion": {"kind": "brown", "k1": -0.05, "k3": 0.004}},
    "rational": {"distortion": {"kind": "brown", "k1": 0.02, "k4": 0.05, "k5": -0.01}},
    "fisheye": {"distortion": {"kind": "fisheye", "k1": 0.02, "k2": -0.003}},
    "skewed": {"skew": 3.0},
    "skewed_brown": {"skew": -2.0, "distortion": {"kind": "brown", "k1": -0.04}},
}
COLMAP_MODEL = {
    "ideal": "PINHOLE", "brown": "OPENCV", "brown_k3": "FULL_OPENCV", "rational": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE", "skewed": "PINHOLE", "skewed_brown": "OPENCV",
}  # fmt: skip


def picture(col, row):
    """A smooth picture, 40 to 220."""
    return 130.0 + 60.0 * np.sin(col / 17.0) + 30.0 * np.cos(row / 13.0 + col / 50.0)


def frame_scene(folder, names, frame, centre, **camera):
    """A scene file of frame cameras 500 m above the ground with different lenses, and its path."""
    folder.mkdir(parents=True, exist_ok=True)
    col, row = np.meshgrid(np.arange(COLS), np.arange(ROWS))
    views = []
    for k, name in enumerate(names):
        write_image(folder / f"{name}.tif", np.rint(picture(col, row)).astype(np.uint8))
        at = [centre[0] + 20.0 * k, centre[1] - 5.0 * k, centre[2] + 500.0]
        interior = {"focal": [350.0, 352.0], "principal_point": [203.0, 148.5]} | LENSES[name] | camera
        views.append({
            "name": name, "image": f"{name}.tif",
            "camera": {"kind": "frame", **interior, "centre": at, "angles": [2.0 + k, -3.0, 25.0 * k]},
        })  # fmt: skip
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, "frame": frame, "views": views}))
    return path


PLACES = {"local": ({"local": True}, (3.0, 4.0, 0.0)), "map": ({"crs": "EPSG:32632"}, (*CENTRE, 400.0))}


def export(kind, inputs, out, **asked):
    inputs = inputs if isinstance(inputs, tuple) else (inputs,)
    return run_export(ExportRequest(kind, inputs, out, **asked), SilentProgress())


def record_of(out):
    return json.loads((out / "export.json").read_text())


def ground_of_local(record, local, crs="EPSG:32632"):
    """Ground points of local ones by the matrix in the record, and PROJ."""
    frame = record["frame"]
    points = np.column_stack([local, np.ones(len(local))])
    if "crs_from_local" in frame:
        return (points @ np.array(frame["crs_from_local"]).T)[:, :3]
    geocentric = (points @ np.array(frame["geocentric_from_local"]).T)[:, :3]
    lon, lat, height = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*geocentric.T)
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    return np.column_stack([x, y, height])


def colmap_projections(out, local):
    """Where COLMAP itself, by its file, sees local points: (n, 2) of its pixels by the name of the image."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: COLMAP's own eyes are not asked")
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    seen = {}
    for image in model.images.values():
        in_camera = image.cam_from_world() * local if callable(image.cam_from_world) else image.cam_from_world * local
        seen[image.name] = np.asarray(image.camera.img_from_cam(np.asarray(in_camera))).reshape(-1, 2)
    return model, seen


def values_at(path, xy):
    with rasterio.open(path) as source:
        pixels = source.read(1).astype(np.float32)
    at = np.asarray(xy, np.float32)
    return cv2.remap(pixels, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderValue=-1e3).ravel()


@pytest.fixture
def ground():
    return np.random.default_rng(6).uniform([-60, -60, -20], [60, 60, 60], (60, 3))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("place", PLACES)
def test_colmap_sees_what_frame_cameras_see(tmp_path, ground, place):
    frame, centre = PLACES[place]
    inputs = frame_scene(tmp_path / "in", LENSES, frame, centre)
    result = export("colmap", inputs, tmp_path / "out", points=False)
    assert f"{len(LENSES)} cameras are exact" in result.text
    record = record_of(tmp_path / "out")
    local = ground - np.array([0.0, 0.0, 0.0 if place == "local" else 500.0])
    truth = ground_of_local(record, local)
    model, seen = colmap_projections(tmp_path / "out", local)
    tolerance_px = SAME_PX if place == "local" else SAME_ON_A_MAP_PX
    for view in open_scene([inputs]).views:
        entry = record["images"][view.name]
        name = entry["file"].removeprefix("images/")
        (image,) = [each for each in model.images.values() if each.name == name]
        assert image.camera.model.name == COLMAP_MODEL[view.name]
        xy, theirs = view.sensor.image_from_ground(truth), seen[name] - 0.5
        if entry["pixels"] == "copied":
            np.testing.assert_allclose(theirs, xy, atol=tolerance_px)
            assert (tmp_path / "out" / entry["file"]).read_bytes() == view.path.read_bytes()
        inside = (xy > 3).all(axis=1) & (xy < [COLS - 4, ROWS - 4]).all(axis=1)
        inside &= (theirs > 3).all(axis=1) & (theirs < [COLS - 4, ROWS - 4]).all(axis=1)
        assert inside.sum() > 20
        found = values_at(tmp_path / "out" / entry["file"], theirs[inside])
        np.testing.assert_allclose(found, picture(*xy[inside].T), atol=SAME_GREY)
        assert (entry["pixels"] == "copied") == ("skewed" not in view.name)


def test_what_is_exported_can_be_imported(tmp_path, ground):
    inputs = frame_scene(tmp_path / "in", ["ideal", "brown", "fisheye"], *PLACES["local"])
    export("colmap", inputs, tmp_path / "out", points=False)
    import_scene(ImportRequest("colmap", tmp_path / "out", tmp_path / "again.yaml"))
    before, after = (open_scene([path]) for path in (inputs, tmp_path / "again.yaml"))
    for one in before.views:
        (other,) = [view for view in after.views if view.name == one.name]
        np.testing.assert_allclose(
            other.sensor.image_from_ground(ground), one.sensor.image_from_ground(ground), atol=SAME_PX
        )


def nerf_projection(entry, local):
    """Where nerfstudio sees local points, in its pixels, by the formulas of its documentation."""
    pose = np.array(entry["transform_matrix"])
    x, y, z = pose[:3, :3].T @ (local - pose[:3, 3]).T
    x, y = x / -z, -y / -z
    k = [entry.get(f"k{n}", 0.0) for n in (1, 2, 3, 4)]
    r2 = x * x + y * y
    if entry["camera_model"] == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        t = np.arctan(r)
        scale = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) / r
        x, y = x * scale, y * scale
    else:
        radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * k[3])))
        p1, p2 = entry.get("p1", 0.0), entry.get("p2", 0.0)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        )
    return np.column_stack([entry["fl_x"] * x + entry["cx"], entry["fl_y"] * y + entry["cy"]])


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_nerf_tools_see_what_frame_cameras_see(tmp_path, ground):
    inputs = frame_scene(tmp_path / "in", LENSES, *PLACES["local"])
    export("nerf", inputs, tmp_path / "out", points=False)
    document = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for view in open_scene([inputs]).views:
        (entry,) = [each for each in document["frames"] if Path(each["file_path"]).stem == view.name]
        assert (entry["w"], entry["h"]) == (COLS, ROWS)
        xy, theirs = view.sensor.image_from_ground(ground), nerf_projection(entry, ground) - 0.5
        if "skewed" not in view.name and view.name != "rational":
            np.testing.assert_allclose(theirs, xy, atol=SAME_PX)
            continue
        inside = (xy > 3).all(axis=1) & (xy < [COLS - 4, ROWS - 4]).all(axis=1)
        inside &= (theirs > 3).all(axis=1) & (theirs < [COLS - 4, ROWS - 4]).all(axis=1)
        found = values_at(tmp_path / "out" / entry["file_path"], theirs[inside])
        np.testing.assert_allclose(found, picture(*xy[inside].T), atol=SAME_GREY)


def test_images_are_resampled_block_by_block(tmp_path, monkeypatch):
    inputs = frame_scene(tmp_path / "in", ["skewed", "ideal"], *PLACES["local"])
    pixels = []
    for block in (exported_images.BLOCK_PX, 64):
        monkeypatch.setattr(exported_images, "BLOCK_PX", block)
        export("colmap", inputs, tmp_path / str(block), points=False)
        pixels.append(cv2.imread(str(tmp_path / str(block) / "images" / "skewed.png"), cv2.IMREAD_UNCHANGED))
    assert pixels[0].shape == (ROWS, COLS)
    assert np.abs(pixels[0].astype(int) - pixels[1]).max() <= 1  # rounding


def test_a_rolling_shutter_is_approximated_and_says_so(tmp_path):
    motion = {"rolling_shutter": {"readout_s": 0.02, "velocity_m_s": [12.0, 3.0, 0.0]}}
    inputs = frame_scene(tmp_path / "in", ["ideal", "brown"], *PLACES["map"], **motion)
    asked = {"points": False, "heights": (380.0, 420.0), "bounds": (*np.add(CENTRE, -50), *np.add(CENTRE, 50))}
    export("colmap", inputs, tmp_path / "out", **asked)
    error = record_of(tmp_path / "out")["images"]["ideal"]
    # Half of the motion, 0.124 m, at 480 to 520 m with 350 px.
    assert error["max_px"] == pytest.approx(0.5 * 0.02 * np.hypot(12.0, 3.0) * 350.0 / 480.0, rel=0.1)
    with pytest.raises(
        GeometryError, match=r"ideal differs .* more than 0\.05 px, as do 1 more of 2 images.*--max-error"
    ):
        export("colmap", inputs, tmp_path / "no", **asked, max_error=0.05)
    with pytest.raises(GeometryError, match="No area is known over which brown could be fitted"):
        export("colmap", inputs, tmp_path / "no", points=False)
    assert not (tmp_path / "no").exists()


@pytest.fixture(scope="module")
def of_satellites(images, tmp_path_factory):
    """An export of satellite images for COLMAP, with tie points."""
    out = tmp_path_factory.mktemp("colmap") / "out"
    return images("step").inputs, out, export("colmap", images("step").inputs, out, crs="EPSG:32632", heights=HEIGHTS)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_satellites_are_seen_as_well_as_is_said(of_satellites):
    inputs, out, result = of_satellites
    record = record_of(out)
    assert "3 fitted cameras differ from their sensor models by" in result.text
    west, south, east, north = record["area"]["bounds"]
    local_low = -np.array([(east - west) / 2, (north - south) / 2, (HEIGHTS[1] - HEIGHTS[0]) / 2]) * 0.95
    local = np.random.default_rng(8).uniform(local_low, -local_low, (400, 3))
    truth = ground_of_local(record, local)
    model, seen = colmap_projections(out, local)
    for view in open_scene(inputs, rasterio_crs()).views:
        entry = record["images"][view.name]
        name = entry["file"].removeprefix("images/")
        (image,) = [each for each in model.images.values() if each.name == name]
        assert image.camera.model.name == "PINHOLE"
        assert entry["max_px"] < 0.1
        # Each row of the image that is written is one of the source, shifted.
        first = np.array(entry["first_pixel_in_source"])
        theirs = seen[name] - 0.5
        xy = np.column_stack([theirs[:, 0] + first[0] + entry["skew_removed_px"] / image.camera.focal_length_x
                              * theirs[:, 1], theirs[:, 1] + first[1]])  # fmt: skip
        truth_xy = view.sensor.image_from_ground(truth)
        inside = (truth_xy > 2).all(axis=1) & (truth_xy < np.array(view.image.shape[::-1]) - 3).all(axis=1)
        away = np.hypot(*(xy - truth_xy)[inside].T)
        assert inside.sum() > 50
        assert away.max() <= entry["max_px"] + 2e-3
        grey = values_at(view.path, truth_xy[inside])
        shown = values_at(out / entry["file"], theirs[inside])
        assert np.corrcoef(grey, shown)[0, 1] > 0.99


def rasterio_crs():
    from pyproj import CRS

    return CRS.from_epsg(32632)


def test_tie_points_fit_the_cameras(of_satellites):
    _, out, result = of_satellites
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert len(model.points3D) == result.values["points"] > 50
    for point in model.points3D.values():
        assert len(point.track.elements) >= 2
        errors = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            assert image.points2D[element.point2D_idx].has_point3D()
            errors.append(np.hypot(*(image.project_point(point.xyz) - image.points2D[element.point2D_idx].xy)))
        assert np.mean(errors) == pytest.approx(point.error, abs=0.01)
        assert point.error < 1.0
    ground = ground_of_local(record_of(out), np.array([point.xyz for point in model.points3D.values()]))
    assert np.median(ground[:, 2]) == pytest.approx(55.0, abs=15.0)


def test_points_of_nerf_tools(images, of_satellites, tmp_path):
    export("nerf", images("step").inputs, tmp_path / "out", crs="EPSG:32632", heights=HEIGHTS)
    content = (tmp_path / "out" / "sparse_pc.ply").read_bytes()
    header, points = content.split(b"end_header\n", 1)
    n = of_satellites[2].values["points"]
    assert f"element vertex {n}".encode() in header
    assert len(points) == 15 * n
    document = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert document["ply_file_path"] == "sparse_pc.ply"
    assert {frame["camera_model"] for frame in document["frames"]} == {"PINHOLE"}


def test_orient_keeps_its_tie_points_for_an_export(images, tmp_path, monkeypatch):
    oriented = tmp_path / "oriented"
    run_orient(OrientRequest(images("step").inputs, oriented, crs="EPSG:32632"), RunConfig(),
               SilentProgress())  # fmt: skip
    monkeypatch.setattr(orientation_module, "find_ties", None)  # they are read
    export("colmap", oriented, tmp_path / "out")
    record = record_of(tmp_path / "out")
    assert record["points"] > 50
    # The area of the heights of tie points, where no others are given.
    assert 25.0 < record["area"]["heights"][0] < record["area"]["heights"][1] < 80.0
    # Of a scene file from which a view was taken out, the numbers of the views are no longer those of the tie points.
    document = yaml.safe_load((oriented / "scene.yaml").read_text())
    document["views"] = document["views"][1:]
    (oriented / "scene.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(TypeError, match="not callable"):
        export("colmap", oriented, tmp_path / "other")


def shifted_scene(images, folder):
    """A scene file that shifts the RPCs of images."""
    views = [
        {"name": name, "image": str(path), "camera": {"kind": "rpc", "shift": [2.5 + k, -4.0]}}
        for k, (name, path) in enumerate(images("step").paths.items())
    ]
    (folder / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "frame": {"crs": "EPSG:32632"}, "views": views}))
    return folder / "scene.yaml"


def test_copies_hold_the_corrected_rpc(images, tmp_path):
    scene = shifted_scene(images, tmp_path)
    result = export("rpc", scene, tmp_path / "out")
    assert "0.000 px at most" in result.text
    for view in open_scene([scene]).views:
        copy, (column, row) = read_rpc(tmp_path / "out" / f"{view.name}.tif"), (view.sensor.column, view.sensor.row)
        delivered = read_rpc(view.path)
        assert copy.samp_off == pytest.approx(delivered.samp_off + column, abs=1e-9)
        assert copy.line_off == pytest.approx(delivered.line_off + row, abs=1e-9)
    # The copies alone are the corrected scene.
    again = open_scene(sorted((tmp_path / "out").glob("*.tif")), rasterio_crs())
    xy = np.random.default_rng(2).uniform(0, 140, (50, 2))
    for one, other in zip(sorted(open_scene([scene]).views, key=lambda v: v.name), again.views, strict=True):
        xyz = one.sensor.ground_from_image(xy, np.full(50, 60.0))
        np.testing.assert_allclose(other.sensor.image_from_ground(xyz), xy, atol=SAME_PX)


def test_frame_cameras_get_a_fitted_rpc(tmp_path):
    inputs = frame_scene(tmp_path / "in", ["ideal", "brown"], *PLACES["map"])
    with pytest.raises(ConfigError, match=r"No heights are known over which brown could be fitted\. Give --heights"):
        export("rpc", inputs, tmp_path / "out")
    result = export("rpc", inputs, tmp_path / "out", heights=(380.0, 480.0))
    error = record_of(tmp_path / "out")["images"]["brown"]
    assert 0.0 < error["rms_px"] < error["max_px"] < 0.05
    assert f"{max(error['max_px'], 0):.3f}"[:3] in result.text


def test_adjustments_stand_against_the_image_s_own_rpc(images, tmp_path):
    scene = shifted_scene(images, tmp_path)
    export("asp", scene, tmp_path / "out")
    record = record_of(tmp_path / "out")
    for view in open_scene([scene]).views:
        entry = record["images"][view.name]
        assert entry["file"] == adjust_file_name(view.path)
        assert entry["max_px"] < 0.01
        numbers = (tmp_path / "out" / entry["file"]).read_text().split()
        assert np.linalg.norm([float(n) for n in numbers[:3]]) > 0.5


def test_wrong_input_leaves_nothing(images, tmp_path):
    paths, out = images("step").inputs, tmp_path / "out"
    far = (CENTRE[0] + 9000.0, CENTRE[1], CENTRE[0] + 9100.0, CENTRE[1] + 100.0)
    asked = {"crs": "EPSG:32632", "heights": HEIGHTS, "points": False}
    local = frame_scene(tmp_path / "in", ["ideal", "brown"], *PLACES["local"])
    on_map = frame_scene(tmp_path / "map", ["ideal", "brown"], *PLACES["map"])
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    for kind, inputs, options, error, said in (
        ("colmap", paths, asked | {"bounds": far}, GeometryError, "None of the images .* shows the area"),
        ("nerf", paths, asked | {"max_error": 1e-6}, GeometryError, "more than 1e-06 px, as do 2 more of 3 images"),
        ("colmap", paths, {"points": False}, GeometryError, "No area is known"),
        ("asp", local, {}, ConfigError, "frame is local"),
        ("asp", on_map, {}, InputError, "has a frame camera"),
        ("rpc", local, {"heights": (0.0, 9.0)}, ConfigError, "frame is local"),
        ("rpc", tmp_path / "run", {}, InputError, "without cameras that can be exported"),
        ("rpc", tmp_path / "none.tif", {}, InputError, "There is no file"),
    ):
        with pytest.raises(error, match=said):
            export(kind, inputs, out, **options)
        assert not out.exists()
    export("colmap", paths, out, **asked)
    with pytest.raises(OutputError, match="another export"):
        export("nerf", paths, out, **asked)
    run_export(replace(ExportRequest("nerf", paths, out, **asked), overwrite=True), SilentProgress())
    assert not (out / "sparse").exists()
    assert (out / "transforms.json").exists()
