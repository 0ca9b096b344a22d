"""One rendered ground and three kinds of sensor: exact cameras, and a surface from all, better than from each alone."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from zlocus.core.options import RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.dsm import run_dsm
from zlocus.synthetic.__main__ import main
from zlocus.synthetic.mixed import SENSORS, mixed_exposures, render_mixed_scene
from zlocus.synthetic.scenes import demo_spec

# What splines make of a shaken trajectory.
EXACT_PX = 1e-3
# Exact cameras need no correction; what is found is the noise of some hundred ties.
SHIFT_PX = 0.05
TWO_PIXELS_M = 0.42
# All nine images together find at least so much more of the ground than the best three of one sensor.
GAIN = 0.01


@pytest.fixture(scope="module")
def spec():
    # Houses and trees enough for sensors to differ: with the seed of the demo every sensor finds .999 of this ground.
    whole = replace(demo_spec(), seed=6)
    return replace(whole, size=240, hill_m=0.0, objects=replace(whole.objects, towers_per_ha=0.0))


@pytest.fixture(scope="module")
def scenes(spec, tmp_path_factory) -> dict[str, Path]:
    return render_mixed_scene(spec, tmp_path_factory.mktemp("mixed") / "scene")


def test_every_sensor_reads_back_as_its_exact_camera(spec, scenes):
    seen_by = mixed_exposures(spec)
    assert set(scenes) == {*SENSORS, "mixed"}
    assert len(open_scene([scenes["mixed"]]).views) == 9
    for kind, group in seen_by.items():
        views = open_scene([scenes[kind]]).views
        assert [view.name for view in views] == [exposure.view.name for exposure in group]
        for view, exposure in zip(views, group, strict=True):
            rows, cols = exposure.shape
            assert view.image.shape == (rows, cols)
            rng = np.random.default_rng(1)
            xy = rng.uniform((0, 0), (cols, rows), (300, 2))
            xyz = exposure.sensor.ground_from_image(xy, rng.uniform(*spec.height_range, 300))
            np.testing.assert_allclose(view.sensor.image_from_ground(xyz), xy, rtol=0, atol=EXACT_PX)


def judged(scenes: dict[str, Path], out: Path) -> tuple[dict[str, float], dict[str, float]]:
    """NMAD of the ground, and share of all blocks within two pixels, of the surface of each sensor and of all."""
    nmad, within = {}, {}
    for kind, scene in scenes.items():
        request = DsmRequest(inputs=(scene,), out=out / kind, resolution=0.2, report=False)
        run_dsm(request, RunConfig(), progress_for(io.StringIO()))
        truth, classes = (scene.parent / name for name in ("truth_dsm.tif", "truth_class.tif"))
        found = evaluate(out / kind / "dsm.tif", Comparison(truth, classes=classes, threshold_m=TWO_PIXELS_M))
        nmad[kind], within[kind] = found.class_statistics["ground"].nmad, found.statistics.within
    return nmad, within


def test_all_sensors_together_are_better_than_the_best_alone(scenes, tmp_path):
    nmad, within = judged(scenes, tmp_path)
    assert nmad["mixed"] <= min(nmad[kind] for kind in SENSORS)
    assert within["mixed"] >= max(within[kind] for kind in SENSORS) + GAIN
    views = json.loads((tmp_path / "mixed" / "run.json").read_text())["orientation"]["views"].values()
    assert max(np.abs(view["shift_px"]).max() for view in views) < SHIFT_PX


def test_of_one_house_no_block_more_is_lost_than_by_the_best_alone(spec, tmp_path):
    scenes = render_mixed_scene(replace(spec, seed=demo_spec().seed, size=160), tmp_path / "scene")
    _, within = judged(scenes, tmp_path)
    assert within["mixed"] >= max(within[kind] for kind in SENSORS)


def test_the_command(tmp_path):
    out = tmp_path / "scene"
    assert main(["--kind", "mixed", "--size", "60", "-o", str(out)]) == 0
    assert {path.name for path in out.glob("*.yaml")} == {"linescan.yaml", "frame.yaml", "rpc.yaml", "mixed.yaml"}
    assert main(["--kind", "mixed", "--size", "60", "-o", str(out)]) == 2
