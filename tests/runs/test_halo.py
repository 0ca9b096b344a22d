"""What a wider halo changes: next to nothing, so that heights do not depend on how the ground is cut into tiles."""

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
# Cells that are near where the ground that views share ends, about.
BORDER = 60
# Of the others, those that may move by more than half a step. (With the base surface of a level integrated over the
# whole window of a tile, and what counts as an edge taken from it: 2.6 %.)
CHANGED, FILLED = 3e-3, 0.95


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return render_scene(SPEC, tmp_path_factory.mktemp("halo") / "scene")


def test_a_wider_halo_changes_next_to_nothing(town, tmp_path):
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
