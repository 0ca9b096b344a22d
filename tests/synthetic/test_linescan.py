"""Rendered line scanners: files read back as the exact camera, and noise has the stated size."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from zlocus.core.errors import ConfigError
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest
from zlocus.io.open_raster import open_raster
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.dsm import run_dsm
from zlocus.sensors.linescan import LineScanModel, RectifiedModel
from zlocus.synthetic.__main__ import main
from zlocus.synthetic.files import RenderedScene, render_scene
from zlocus.synthetic.linescan import TrajectoryNoise, sampled_trajectory, with_noise, write_linescan_views, write_scene
from zlocus.synthetic.rectify import rectified
from zlocus.synthetic.scenes import SceneSpec, city_spec, demo_spec, exposures_of, with_ads40

# Cubic splines through exact samples at 200 Hz (rows are 3 ms apart).
READ_PX = 1e-6
# A shake of 24 rows' period has 14 samples.
SHAKEN_PX = 1e-3
# A tenth and a half of the pixel on the ground: roofs, trees and coarse textures, which the cameras have no part in.
MEDIAN_M, NMAD_M = 0.02, 0.1
AROUND_PX = 300


@pytest.fixture(scope="module")
def spec() -> SceneSpec:
    return replace(with_ads40(city_spec(1)), size=120)


@pytest.fixture(scope="module")
def rendered(spec, tmp_path_factory) -> RenderedScene:
    return render_scene(spec, tmp_path_factory.mktemp("linescan") / "scene", noise=TrajectoryNoise())


def assert_exact(scene, spec, tolerance_px):
    for view, exposure in zip(scene.views, exposures_of(spec), strict=True):
        rows, cols = exposure.shape
        rng = np.random.default_rng(0)
        low, high = (-AROUND_PX, -AROUND_PX), (cols + AROUND_PX, rows + AROUND_PX)
        xy = rng.uniform(low, high, (2000, 2))
        xyz = exposure.sensor.ground_from_image(xy, rng.uniform(*spec.height_range, 2000))
        assert isinstance(view.sensor, LineScanModel)
        np.testing.assert_allclose(view.sensor.image_from_ground(xyz), xy, rtol=0, atol=tolerance_px)
        np.testing.assert_allclose(view.sensor.ground_from_image(xy, xyz[:, 2]), xyz, rtol=0, atol=tolerance_px)


def test_what_is_read_is_the_exact_camera(spec, rendered):
    (scene_file,) = rendered.inputs
    scene = open_scene([scene_file])
    assert scene.crs == spec.crs
    assert scene.heights == spec.height_range
    assert_exact(scene, spec, READ_PX)
    with open_raster(rendered.images["n1"]) as image:
        assert not image.tags(ns="RPC")
    assert json.loads((rendered.folder / "scene.json").read_text())["views"]["f2"]["rpc_fit_max_px"] is None


def test_the_demo_block_as_line_scanners(tmp_path):
    """Six images of three lines in two strips (Ji et al. 2014, table 2), written without rendering."""
    spec = demo_spec()
    entries = write_linescan_views(spec, exposures_of(spec), tmp_path, TrajectoryNoise())
    write_scene(spec, entries, tmp_path / "scene.yaml")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"ads40.csv", "scene.yaml", *(f"trajectory_{view.name}.csv" for view in spec.views)}
    lines = {line.split(",")[0] for line in (tmp_path / "ads40.csv").read_text().splitlines()[2:]}
    assert lines == {"nadir", "forward", "backward"}


def test_level_1_of_an_unsteady_flight_is_read_as_it_was_flown(spec, tmp_path):
    unsteady = replace(spec, shaken=True, level=1)
    seen_by = exposures_of(unsteady)
    rendered = render_scene(replace(unsteady, views=unsteady.views[:2]), tmp_path / "scene", noise=TrajectoryNoise())
    scene = open_scene(rendered.inputs)
    for view, exposure in zip(scene.views, seen_by, strict=False):
        rows, cols = exposure.shape
        assert isinstance(view.sensor, RectifiedModel)
        assert view.image.shape == (rows, cols)
        rng = np.random.default_rng(0)
        xy = rng.uniform((-AROUND_PX, -AROUND_PX), (cols + AROUND_PX, rows + AROUND_PX), (500, 2))
        xyz = exposure.sensor.ground_from_image(xy, rng.uniform(*spec.height_range, 500))
        np.testing.assert_allclose(view.sensor.image_from_ground(xyz), xy, rtol=0, atol=SHAKEN_PX)
        with open_raster(rendered.images[view.name]) as image:
            assert (image.read(1) > 0).all()
    # The three lines of a strip fly together; the strips do not.
    shakes = [exposure.taken.sensor.shake for exposure in seen_by]
    assert shakes[0] == shakes[1] == shakes[2] != shakes[3]


def test_a_level_1_image_shows_what_the_raw_one_shows(spec):
    exposure = exposures_of(replace(spec, shaken=True, level=1))[1]
    row, col = np.mgrid[: exposure.taken.shape[0], : exposure.taken.shape[1]]

    def grey(row, col):
        return 3000.0 + 900.0 * np.sin(row / 9.0) + 900.0 * np.cos(col / 7.0)

    raw = np.rint(grey(row, col)).astype(np.uint16)
    raw[40, 50] = 0
    found = rectified(raw, exposure.sensor, exposure.shape)
    row, col = np.mgrid[: exposure.shape[0], : exposure.shape[1]]
    at = exposure.sensor.raw_from_image(np.column_stack([col.ravel(), row.ravel()])).reshape(*exposure.shape, 2)
    hole = (np.abs(at - (50, 40)) < 1.0).all(axis=2)
    near = (np.abs(at - (50, 40)) < 6.0).all(axis=2)
    assert (found[hole] == 0).all()
    assert (found[~near] > 0).all()
    assert np.abs(found.astype(float) - grey(at[..., 1], at[..., 0]))[~near].max() < 3.0


def test_a_surface_from_line_scanners(rendered, spec, tmp_path):
    """The whole way: files, tie points, tables, matching; against the truth."""
    request = DsmRequest(inputs=rendered.inputs, out=tmp_path / "out", resolution=0.2, report=False)
    run_dsm(request, RunConfig(pyramid=PyramidOptions(tile=128)), progress_for(io.StringIO()))
    with rasterio.open(tmp_path / "out" / "dsm.tif") as dsm, rasterio.open(rendered.truth_dsm) as truth:
        window = rasterio.windows.from_bounds(*truth.bounds, dsm.transform)
        found = dsm.read(1, window=window.round_offsets().round_lengths())
        # Cells are twice as wide as the truth's, so that their centres are where four of those meet: one of the four
        # would be 0.07 m aside, which on slopes is as much as the errors.
        exact = np.mean([truth.read(1)[i::2, j::2] for i in (0, 1) for j in (0, 1)], axis=0)
    n = min(len(found), len(exact))
    error = (found[:n, :n] - exact[:n, :n])[np.isfinite(found[:n, :n])]
    assert error.size > 0.8 * n * n
    median = float(np.median(error))
    assert abs(median) < MEDIAN_M
    assert 1.4826 * np.median(np.abs(error - median)) < NMAD_M


def test_noise_is_as_large_as_it_says(spec):
    camera = exposures_of(spec)[0].sensor
    exact = sampled_trajectory(camera, 300)
    rng = np.random.default_rng(1)
    np.testing.assert_array_equal(with_noise(exact, TrajectoryNoise(), rng).rotations, exact.rotations)
    found = with_noise(exact, TrajectoryNoise(offset_m=0.1, turn_deg=0.002, every_s=1.0), rng)
    assert np.std(found.centres - exact.centres) == pytest.approx(0.1, rel=0.35)
    turns = found.rotations @ exact.rotations.swapaxes(-1, -2)
    assert np.rad2deg(np.std(turns[:, [0, 0, 1], [1, 2, 2]])) == pytest.approx(0.002, rel=0.35)
    # Slow: from sample to sample (5 ms) little changes; jitter does.
    assert np.abs(np.diff(found.centres - exact.centres, axis=0)).max() < 0.01
    jitter = with_noise(exact, TrajectoryNoise(jitter_m=0.1, jitter_deg=0.001), rng)
    assert np.std(np.diff(jitter.centres - exact.centres, axis=0)) == pytest.approx(0.1 * np.sqrt(2), rel=0.1)


def test_scenes_without_line_scanners(tmp_path, spec):
    satellites = city_spec(1, size=40)
    with pytest.raises(ConfigError, match="'satellite' is no line scanner"):
        render_scene(satellites, tmp_path / "a", noise=TrajectoryNoise())
    biased = replace(spec, views=(replace(spec.views[0], bias_row_px=1.0),))
    with pytest.raises(ConfigError, match="view n1 is one of RPCs"):
        render_scene(biased, tmp_path / "a", noise=TrajectoryNoise())
    aside = replace(spec, views=(replace(spec.views[0], across_deg=35.0),))
    with pytest.raises(ConfigError, match=r"View n1 needs the columns 1\d{4} to"):
        render_scene(aside, tmp_path / "a", noise=TrajectoryNoise())
    assert not (tmp_path / "a").exists()


def test_the_command(tmp_path: Path):
    out = tmp_path / "scene"
    arguments = ["--kind", "city", "--size", "40", "--views", "2", "--cameras", "linescan", "-o", str(out)]
    assert main([*arguments, "--trajectory-noise", "0.05", "0.001"]) == 0
    scene = open_scene([out / "scene.yaml"])
    assert [view.name for view in scene.views] == ["n1", "f1"]
    spec = replace(with_ads40(city_spec(1)), size=40)
    with pytest.raises(AssertionError):
        assert_exact(scene, replace(spec, views=spec.views[:2]), READ_PX)
    assert_exact(scene, replace(spec, views=spec.views[:2]), 5.0)
