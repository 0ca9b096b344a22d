"""A wider halo changes almost no cell, so heights do not depend on how the ground is divided into tiles."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rendered_scenes import read, run
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.objects import Objects
from zlocus.synthetic.scenes import CLEAR, SceneSpec, ViewSpec

SIDE = 400
VIEWS = tuple(ViewSpec(name, along, across, 2.0, optics=CLEAR) for name, along, across in
              (("n", 1.0, -4.0), ("f", 20.0, -4.0), ("b", -20.0, 3.0)))  # fmt: skip
SPEC = SceneSpec(kind="city", seed=5, size=SIDE, relief_m=10.0, views=VIEWS, objects=Objects(35.0, 22.0, 0.0, 20.0))
TILES = RunConfig(pyramid=PyramidOptions(tile=128, halo=32))
# Cells near the edge of the overlap of the views, which are not compared.
BORDER = 60
# Largest share of the other cells that may change by more than half a step. (2.6 % change if the slanted support
# surface and its edges are computed over the whole window of a tile.)
CHANGED, FILLED = 3e-3, 0.95


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return render_scene(SPEC, tmp_path_factory.mktemp("halo") / "scene")


def test_a_wider_halo_changes_almost_no_cell(town, tmp_path):
    heights, images = [], tuple(town.images[view.name] for view in VIEWS)
    for halo in (32, 64):
        config = replace(TILES, pyramid=replace(TILES.pyramid, halo=halo))
        found = run(images, tmp_path / str(halo), config, heights=(420.0, 480.0))
        heights.append(read(found.out / "dsm.tif")[0])
    usual, wide = (height[BORDER:-BORDER, BORDER:-BORDER] for height in heights)
    assert min(np.isfinite(height).mean() for height in (usual, wide)) > FILLED
    step_m = json.loads((found.out / "run.json").read_text())["heights"]["step_m"]
    changed = np.isfinite(usual) != np.isfinite(wide)
    changed |= np.abs(np.nan_to_num(usual) - np.nan_to_num(wide)) > step_m / 2
    assert changed.mean() < CHANGED
