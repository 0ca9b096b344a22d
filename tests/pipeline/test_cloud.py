"""`zlocus cloud` on rendered scenes: heights of pixels against the truth, matching back, products, bad input."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
import yaml
from typer.testing import CliRunner

from copc_format import checked_nodes
from glb_files import meshes
from las_format import check_laz
from places import ROOT
from rendered_scenes import CENTRE, FIELD, GSD_M, HEIGHTS, LOOKS, QUIET, camera
from zlocus.cli.app import app
from zlocus.core.errors import CoverageError, InputError, OutputError
from zlocus.core.export_request import ExportRequest
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import CloudRequest
from zlocus.io.open_raster import open_raster
from zlocus.matching.quality import Quality, is_empty
from zlocus.pipeline import cloud, image_scenes, pixel_products
from zlocus.pipeline.checked_tiles import CheckedTiles
from zlocus.pipeline.export import run_export
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.synthetic.render import Sun, expose, render, visible_ground_points
from zlocus.synthetic.terrain import analytic_ground, analytic_height

sys.path.insert(0, str(ROOT / "benchmarks"))
import middlebury

WITHIN_M = 1.0
# At the walls of the step a pixel's window shows two heights.
LEAST_WITHIN, LEAST_KEPT = 0.98, 0.9
MEDIAN_M = 0.05
LEAST_WITHIN_FRAMES = 0.96
# The middle camera shares nearly all it sees, the outer ones about half.
# Standard deviations are calibrated on scenes with more noise than these have.
LEAST_SPREAD, MOST_SPREAD = 0.15, 1.2
LEAST_FOUND = {"a": 0.4, "b": 0.85, "c": 0.4}
RIG_HEIGHT_M, RIG_BASE_M, FOCAL_PX, RIG_SHAPE = 120.0, 30.0, 240.0, (140, 150)


def read(path: Path) -> np.ndarray:
    with open_raster(path) as source:
        return source.read(1)


def true_height(kind: str, sensor, shape: tuple[int, int]) -> np.ndarray:
    """Height of what each pixel shows, (r, c) m."""
    ground = analytic_ground(kind, CENTRE, GSD_M / 2, FIELD, seed=5)
    col, row = np.meshgrid(np.arange(shape[1], dtype=float), np.arange(shape[0], dtype=float))
    return visible_ground_points(ground, sensor, np.column_stack([col.ravel(), row.ravel()]))[:, 2].reshape(shape)


def run(inputs, out, config=None, **asked):
    return cloud.run_cloud(
        CloudRequest(inputs=tuple(inputs), out=out, **asked), config or RunConfig(), SilentProgress()
    )


@pytest.fixture(scope="module")
def of_step(images, tmp_path_factory):
    out = tmp_path_factory.mktemp("cloud") / "out"
    with pytest.MonkeyPatch.context() as patch:
        # Several strips.
        patch.setattr(pixel_products, "ROWS_AT_ONCE", 40)
        return run(images("step").inputs, out, crs="EPSG:32632", heights=HEIGHTS)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A scene file of three frame cameras over the step, the third turned by half a circle, and their models."""
    folder = tmp_path_factory.mktemp("rig")
    ground, sun = analytic_ground("step", CENTRE, GSD_M / 2, FIELD, seed=5), Sun(150.0, 50.0)
    cameras = {}
    for index, (name, x, kappa) in enumerate((("a", -RIG_BASE_M, 0.0), ("b", 0.0, 5.0), ("c", RIG_BASE_M, 180.0))):
        centre = (CENTRE[0] + x, CENTRE[1] + 2.0 * index, 50.0 + RIG_HEIGHT_M)
        angles = (1.0, -0.1 * x, kappa)
        cameras[name] = FrameModel(centre, rotation_from_angles(*angles), FOCAL_PX, (74.5, 69.5))
        numbers = expose(render(ground, cameras[name], RIG_SHAPE, sun), QUIET, np.random.default_rng([4, index]))
        with open_rgb(folder / f"{name}.tif", numbers.shape, numbers.dtype) as file:
            file.write(np.stack([numbers, numbers // 2, numbers // 4]))
    views = [
        {"name": name, "image": f"{name}.tif", "camera": {
            "kind": "frame", "focal": m.focal, "principal_point": list(m.principal_point), "centre": list(m.centre),
            "rotation": [list(row) for row in m.camera_from_ground]}}
        for name, m in cameras.items()
    ]  # fmt: skip
    scene = {"schema": 1, "frame": {"local": True}, "views": views}
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return folder / "scene.yaml", cameras


def read_points(path: Path) -> laspy.LasData:
    """The points of a cloud image by image, and tile by tile as they were written within an image."""
    points = laspy.read(path)
    points.points = points.points[np.argsort(points.point_source_id, kind="stable")]
    return points


def open_rgb(path, shape, dtype):
    return rasterio.open(path, "w", driver="GTiff", height=shape[0], width=shape[1], count=3, dtype=dtype,
                         photometric="RGB", transform=rasterio.Affine.translation(0.5, 0.5), nodata=0)  # fmt: skip


@pytest.fixture(scope="module")
def of_rig(rig, tmp_path_factory):
    return run([rig[0]], tmp_path_factory.mktemp("rig") / "out", fill="interpolate")


def test_heights_of_satellite_pixels_are_true(of_step):
    for index, name in enumerate(LOOKS):
        height = read(of_step.out / f"{name}_height.tif")
        error = height - true_height("step", camera(name), (150 - 3 * index, 150))
        found = np.isfinite(error)
        assert found.mean() > LEAST_KEPT
        assert (np.abs(error[found]) < WITHIN_M).mean() > LEAST_WITHIN
        assert abs(np.median(error[found])) < MEDIAN_M


def test_quality_says_why_a_pixel_is_empty(of_step):
    for name in LOOKS:
        quality = read(of_step.out / f"{name}_quality.tif")
        np.testing.assert_array_equal(is_empty(quality), np.isnan(read(of_step.out / f"{name}_height.tif")))
        assert (quality & Quality.INCONSISTENT).any()


def test_the_cloud_holds_every_height_once(of_step):
    points = read_points(of_step.out / "cloud.laz")
    heights = [read(of_step.out / f"{name}_height.tif") for name in sorted(LOOKS)]
    counts = [int(np.isfinite(h).sum()) for h in heights]
    assert of_step.n_points == len(points) == sum(counts)
    assert np.bincount(points.point_source_id).tolist() == [0, *counts]
    np.testing.assert_allclose(points.z, np.concatenate([h[np.isfinite(h)] for h in heights]), atol=1e-3)
    assert points.header.parse_crs().to_epsg() == 32632
    # Walls too: points between the two levels of the step.
    assert ((points.z > 53.0) & (points.z < 62.0)).any()
    np.testing.assert_array_equal(points.red, points.blue)


def spread(points, errors):
    """NMAD of errors in their own standard deviations."""
    ratio = errors / np.asarray(points["sigma_m"])
    return 1.4826 * np.median(np.abs(ratio - np.median(ratio)))


def test_points_say_how_precise_they_are_and_how_many_images_saw_them(of_step):
    check_laz(of_step.out / "cloud.laz")
    points = read_points(of_step.out / "cloud.laz")
    names = sorted(LOOKS)
    true = [true_height("step", camera(name), (150 - 3 * list(LOOKS).index(name), 150)) for name in names]
    found = [np.isfinite(read(of_step.out / f"{name}_height.tif")) for name in names]
    errors = np.asarray(points.z) - np.concatenate([z[at] for z, at in zip(true, found, strict=True)])
    sigma_m, n_images = np.asarray(points["sigma_m"]), np.asarray(points["n_images"])
    assert np.isfinite(sigma_m).all()
    assert sigma_m.min() > 0
    assert LEAST_SPREAD < spread(points, errors) < MOST_SPREAD
    # Where they are said to be ten times less precise, they are worse.
    poor = sigma_m > 10 * np.median(sigma_m)
    assert poor.sum() > 500
    assert np.percentile(np.abs(errors[poor]), 80) > 10 * np.percentile(np.abs(errors[~poor]), 80)
    assert set(np.unique(n_images)) == {2, 3}
    assert (n_images == 3).mean() > 0.9


def test_points_are_seen_where_their_pixel_is(of_step):
    points = read_points(of_step.out / "cloud.laz")
    first = sorted(LOOKS).index("nadir") + 1
    xy = camera("nadir").image_from_ground(np.asarray(points.xyz)[points.point_source_id == first])
    height = read(of_step.out / "nadir_height.tif")
    rows, cols = np.nonzero(np.isfinite(height))
    # The orientation moves what it cannot know: a fraction of a pixel.
    np.testing.assert_allclose(xy, np.column_stack([cols, rows]), atol=0.3)


def test_run_json_holds_what_was_done(of_step):
    record = json.loads((of_step.out / "run.json").read_text())
    assert record["points"] == of_step.n_points
    assert set(record["images"]) == set(LOOKS)
    assert [s["name"] for s in record["stages"]] == ["open", "orient", "setup", "match", "write", "styles"]
    assert len(record["inputs"]) == 3
    assert sum(v["points"] for v in record["images"].values()) == of_step.n_points


def test_frame_cameras_without_heights_given(rig, of_rig):
    """Depths from the ties, a local frame, colours, and gaps filled."""
    n_own, errors = 0, []
    for name, model in rig[1].items():
        truth = true_height("step", model, RIG_SHAPE)
        height, quality = (read(of_rig.out / f"{name}_{what}.tif") for what in ("height", "quality"))
        own = np.isfinite(height) & ((quality & Quality.FILLED) == 0) & np.isfinite(truth)
        error = (height - truth)[own]
        n_own += own.sum()
        errors.append(error)
        assert own.mean() > LEAST_FOUND[name]
        assert (np.abs(error) < WITHIN_M).mean() > LEAST_WITHIN_FRAMES
        depth = read(of_rig.out / f"{name}_depth.tif")
        col, row = np.meshgrid(np.arange(150.0), np.arange(140.0))
        ray = model.ray_from_image(np.column_stack([col.ravel(), row.ravel()]))[:, 2].reshape(RIG_SHAPE)
        np.testing.assert_allclose((model.centre[2] + depth * ray)[own], height[own], atol=0.3)
        assert (quality & Quality.FILLED).any()
        np.testing.assert_array_equal(is_empty(quality), np.isnan(height))
    points = read_points(of_rig.out / "cloud.laz")
    assert points.header.parse_crs() is None
    assert len(points) == of_rig.n_points == n_own
    assert np.median(points.green / points.red) == pytest.approx(0.5, abs=0.02)
    assert np.median(points.blue / points.red) == pytest.approx(0.25, abs=0.02)
    check_laz(of_rig.out / "cloud.laz")
    assert LEAST_SPREAD < spread(points, np.concatenate(errors)) < MOST_SPREAD
    assert set(np.unique(points["n_images"])) == {2, 3}


def test_matching_back_removes_a_planted_wrong_patch(images, tmp_path, monkeypatch):
    patch = (slice(60, 90), slice(60, 90))
    put = CheckedTiles._put

    def planted(self, image_tile, tile_product):
        put(self, image_tile, tile_product)
        matched = self._matched[image_tile.number]
        if matched.image.image_space.reference_view.name == "nadir":
            matched.image.height[patch] += 20.0

    monkeypatch.setattr(CheckedTiles, "_put", planted)
    run(images("plane").inputs, tmp_path / "out", crs="EPSG:32632", heights=HEIGHTS)
    height, quality = (read(tmp_path / "out" / f"nadir_{what}.tif") for what in ("height", "quality"))
    assert np.isnan(height[patch]).all()
    assert ((quality[patch] & Quality.INCONSISTENT) != 0).mean() > 0.95
    assert np.isfinite(height[100:130, 60:90]).mean() > 0.95


def test_levels_are_left_out_where_no_block_fits(images, tmp_path, monkeypatch):
    offered = iter([None, 16])
    monkeypatch.setattr(image_scenes, "MIN_LEVELS", 2)
    monkeypatch.setattr(image_scenes, "fitting_block", lambda scenes, block: next(offered))
    asked = {"crs": "EPSG:32632", "heights": HEIGHTS, "references": ("nadir",)}
    result = run(images("plane").inputs, tmp_path / "out", **asked)
    record = json.loads((result.out / "run.json").read_text())
    assert record["images"]["nadir"]["levels"] == 2
    assert record["config"]["options"]["pyramid"]["block"] == 16
    assert np.nanmedian(read(result.out / "nadir_height.tif")) == pytest.approx(50.0, abs=MEDIAN_M)


def test_one_reference_is_kept_unconfirmed(images, tmp_path):
    asked = {"crs": "EPSG:32632", "heights": HEIGHTS, "references": ("fore",)}
    result = run(images("plane").inputs, tmp_path / "out", copc=True, **asked)
    assert sorted(p.name for p in result.out.iterdir()) == [
        "cloud.copc.laz", "cloud.copc.qml", "cloud.laz", "cloud.ply", "cloud.qml", "finished.json", "fore_height.qml",
        "fore_height.sld", "fore_height.tif", "fore_quality.qml", "fore_quality.sld", "fore_quality.tif",
        "fore_quality.tif.aux.xml", "fore_reasons.vrt", "observations.npz", "run.json",
    ]  # fmt: skip
    assert not (read(result.out / "fore_quality.tif") & Quality.INCONSISTENT).any()
    assert "cloud.copc.laz" in json.loads((result.out / "finished.json").read_text())["products"]


def test_copc_is_made_of_a_finished_cloud(of_step, images, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(of_step.out, out)
    (out / "fore_quality.sld").unlink()
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    asked = {"crs": "EPSG:32632", "heights": HEIGHTS}
    assert run(images("step").inputs, out, copc=True, **asked).was_finished
    changed = {path.name for path in out.iterdir() if before.get(path.name) != path.stat().st_mtime_ns}
    assert changed == {"cloud.copc.laz", "cloud.copc.qml", "fore_quality.sld", "finished.json"}
    checked_nodes(out / "cloud.copc.laz")
    check_laz(out / "cloud.copc.laz")
    one, other = (laspy.read(out / name).points.array for name in ("cloud.laz", "cloud.copc.laz"))
    assert sorted(point.tobytes() for point in one) == sorted(point.tobytes() for point in other)
    (out / "cloud.copc.laz").unlink()
    assert run(images("step").inputs, out, **asked).was_finished
    assert not (out / "cloud.copc.laz").exists()
    assert run(images("step").inputs, out, copc=True, **asked).was_finished
    (out / "cloud.copc.laz").write_bytes(b"other")
    with pytest.raises(OutputError, match=r"cloud\.copc\.laz is not what the run wrote"):
        run(images("step").inputs, out, **asked)


def test_workers_change_nothing(images, tmp_path):
    config = RunConfig()
    config = replace(config, pyramid=replace(config.pyramid, tile=64))
    asked = {"crs": "EPSG:32632", "heights": HEIGHTS}
    one, two = (run(images("sine").inputs, tmp_path / str(n), config, workers=n, **asked) for n in (1, 2))
    for path in [*sorted(one.out.glob("*.tif")), one.out / "cloud.ply"]:
        assert path.read_bytes() == (two.out / path.name).read_bytes(), path.name


def test_too_few_heights_are_no_success(images, tmp_path, monkeypatch):
    monkeypatch.setattr(cloud, "SUFFICIENT_COVERAGE", 1.1)
    asked = {"crs": "EPSG:32632", "heights": HEIGHTS}
    with pytest.raises(CoverageError, match="--partial") as failure:
        run(images("plane").inputs, tmp_path / "out", **asked)
    assert failure.value.exit_status == 3
    assert (tmp_path / "out" / "cloud.laz").exists()
    run(images("plane").inputs, tmp_path / "out", partial=True, overwrite=True, **asked)


def said(arguments) -> str:
    result = CliRunner().invoke(app, ["cloud", *map(str, arguments)])
    assert result.exit_code == 2, result.output
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("zlocus: ")]
    assert "Traceback" not in result.stderr
    return sentence


def test_bad_input_is_refused_in_a_sentence(images, rig, tmp_path):
    paths, out = images("plane").inputs, tmp_path / "out"
    to = ["-o", out, "--crs", "EPSG:32632", "--heights", *HEIGHTS]
    assert "--reference nobody" in said([*paths, *to, "--reference", "nobody"])
    assert "given twice" in said([*paths, *to, "--reference", "fore", "--reference", "fore"])
    assert "two images or more" in said([paths[0], *to])
    assert "--fill dem" in said([*paths, *to, "--fill", "dem"])
    assert "--workers 0" in said([*paths, *to, "--workers", "0"])
    assert "--bounds 3 0 1 5 holds no area" in said([*paths, *to, "--bounds", "3", "0", "1", "5"])
    assert "--memory 0 is not a size" in said([*paths, *to, "--memory", "0"])
    assert "empty range" in said([*paths, "-o", out, "--heights", "5", "5"])
    assert "--crs" in said([rig[0], *to])
    alone = yaml.safe_load(rig[0].read_text())
    for view in alone["views"]:
        view["image"] = str(rig[0].parent / view["image"])
    alone["views"] = alone["views"][:1]
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(alone))
    assert "two images or more" in said([tmp_path / "one.yaml", "-o", out])
    assert not out.exists()
    out.mkdir()
    (out / "cloud.laz").touch()
    assert "another run" in said([*paths, *to])


def test_options_reach_the_run(monkeypatch, tmp_path):
    class Recorder:
        def run_cloud(self, request, config, progress):
            self.request = request
            return cloud.CloudResult(request.out, 12, 0.5)

    recorder = Recorder()
    monkeypatch.setitem(sys.modules, "zlocus.pipeline.cloud", recorder)
    arguments = ["cloud", "a.tif", "b.tif", "-o", tmp_path / "o", "--reference", "a", "--reference", "b", "--crs",
                 "EPSG:32631", "--heights", -3, 9, "--fill", "interpolate", "--partial", "--workers", 2,
                 "--overwrite", "--bounds", 1, 2, 3, 4, "--area", "area.gpkg", "--memory", 3,
                 "--no-resume", "--copc"]  # fmt: skip
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    assert "12 points" in result.stdout
    assert recorder.request == CloudRequest(
        (Path("a.tif"), Path("b.tif")), tmp_path / "o", ("a", "b"), "EPSG:32631", (-3, 9), "interpolate", True, 2, True,
        bounds=(1, 2, 3, 4), area=Path("area.gpkg"), memory_gb=3, resume=False, copc=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("case", "most_bad"), [("cones, 2 views", 4.0), ("cones, 3 views", 4.0), ("teddy, 2 views", 7.0)]
)
def test_photographs_with_ground_truth(shared_data, tmp_path, case, most_bad):
    """Percent of the pixels not occluded that are wrong by more than a pixel of disparity, gaps filled."""
    found = middlebury.judge(shared_data / "middlebury_multiview", case, tmp_path)
    assert found.zlocus <= most_bad
    assert found.zlocus < found.opencv


def test_a_cloud_becomes_a_mesh_with_walls(of_step, tmp_path):
    """As another image would show it, and where the ground is."""
    run_export(ExportRequest("mesh", (of_step.out,), tmp_path / "mesh"), SilentProgress())
    record, reads = meshes(tmp_path / "mesh")
    assert record["cloud"] == str(of_step.out)
    assert record["crs"] == "EPSG:32632"
    points = np.concatenate([read.xyz for read in reads]) + np.array(record["origin"])
    away = np.abs(points[:, 2] - analytic_height("step", *(points[:, :2] - CENTRE).T))
    beside = np.abs(points[:, 0] - CENTRE[0]) > 2 * record["cell_m"]
    assert (away[beside] < WITHIN_M).mean() > LEAST_WITHIN
    assert ((points[~beside, 2] > 53.0) & (points[~beside, 2] < 62.0)).sum() > 100
    (tmp_path / "part").mkdir()
    for name in ("run.json", "fore_height.tif", "fore_quality.tif"):
        shutil.copy(of_step.out / name, tmp_path / "part" / name)
    with pytest.raises(InputError, match=r"lacks aft_height.tif"):
        run_export(ExportRequest("mesh", (tmp_path / "part",), tmp_path / "other"), SilentProgress())
    assert not (tmp_path / "other").exists()
