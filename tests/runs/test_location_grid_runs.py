"""Whole runs with the location grids of a physical model."""

from __future__ import annotations

import json

import numpy as np
import yaml

from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.evaluation.heights import read_heights
from zlocus.pipeline.dsm import run_dsm

GRIDS = {
    "img_01": ("GRID_PHR1B_P_201308051042194_SEN_690908101-001.tif", [5000, 5000]),
    "img_02": ("GRID_PHR1B_P_201308051042523_SEN_690908101-002.tif", [4915, 5162]),
}
BOUNDS = (675260.0, 4897075.0, 675340.0, 4897145.0)
# Both cameras agree to 0.001 px of half a metre, and the base is a third of the height.
SAME_M, SAME_PX = 0.02, 0.005


def test_a_surface_with_location_grids_is_that_with_the_rpc(shared_data, tmp_path):
    folder = shared_data / "pleiades_pair_ventoux"
    views = []
    for name, (file, first_pixel) in GRIDS.items():
        grid = str(folder / "physical_model_grids" / file)
        camera = {"kind": "location_grid", "file": grid, "first_pixel": first_pixel}
        views.append({"name": name, "image": str(folder / f"{name}.tif"), "camera": camera})
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "views": views}))
    inputs = {"grid": (tmp_path / "scene.yaml",), "rpc": tuple(folder / f"{name}.tif" for name in GRIDS)}
    found = {}
    for name, files in inputs.items():
        request = DsmRequest(files, tmp_path / name, bounds=BOUNDS, heights=(470.0, 560.0), resolution=1.0, workers=1)
        run_dsm(request, RunConfig(), SilentProgress())
        run = json.loads((tmp_path / name / "run.json").read_text())
        found[name] = read_heights(tmp_path / name / "dsm.tif").z, run["orientation"]["views"], run["inputs"]
    (with_grid, moved, files), (with_rpc, moved_rpc, _) = found["grid"], found["rpc"]
    both = np.isfinite(with_grid) & np.isfinite(with_rpc)
    assert both.sum() > 0.98 * np.isfinite(with_rpc).sum() > 3000
    assert np.median(np.abs(with_grid - with_rpc)[both]) < SAME_M
    for name in GRIDS:
        assert moved[name]["sensor"] == "location_grid"
        np.testing.assert_allclose(moved[name]["shift_px"], moved_rpc[name]["shift_px"], rtol=0, atol=SAME_PX)
    assert [file["path"].endswith("-001.tif") for file in files].count(True) == 1
