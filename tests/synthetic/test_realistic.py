"""Scenes of the realistic recipe: what they hold, and that seeds decide all of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from zlocus.io.scene_file import open_scene
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.painting import TruthArea
from zlocus.synthetic.realistic import MAX_POINTING_PX, realistic_spec
from zlocus.synthetic.realistic_ground import RARE, Cover, realistic_ground
from zlocus.synthetic.scenes import SceneSpec, build_ground, exposures_of
from zlocus.synthetic.terrain import FIELD, GROUND, ROAD, TREE, WATER, SyntheticGround, analytic_ground

SEED, SMALL_PX = 12, 240
AREA = TruthArea(0.0, 0.0, 200.0)


def small(seed: int = SEED, n_views: int = 2) -> SceneSpec:
    spec = realistic_spec(seed)
    return replace(spec, size=SMALL_PX, views=spec.views[:n_views])


@pytest.fixture(scope="module")
def ground() -> SyntheticGround:
    spec = small()
    return build_ground(spec, exposures_of(spec))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_scene(small(), tmp_path_factory.mktemp("realistic") / "scene").folder


def test_a_realistic_ground_has_all_classes(ground):
    shares = np.bincount(ground.classes.ravel(), minlength=6) / ground.classes.size
    for kind, low, high in ((GROUND, 0.3, 0.85), (ROAD, 0.02, 0.25), (TREE, 0.05, 0.4), (FIELD, 0.005, 0.3)):
        assert low < shares[kind] < high, kind
    assert len(ground.lanes) > 50
    assert (np.hypot(*ground.lanes[:, 2:].T) > 0.999).all()


def test_trees_have_gaps_and_rough_crowns(ground):
    """Neighbouring cells of a crown differ by decimetres to metres, and ground shows through."""
    is_crown = (ground.classes == TREE)[:, 1:] & (ground.classes == TREE)[:, :-1]
    steps = np.abs(np.diff(ground.heights, axis=1))[is_crown]
    assert 0.3 < np.median(steps) < 1.5


def test_water_has_no_truth_and_other_cells_have(folder):
    with rasterio.open(folder / "truth_dsm.tif") as truth, rasterio.open(folder / "truth_class.tif") as classes:
        heights, kinds = truth.read(1), classes.read(1)
        assert np.isnan(truth.nodata)
    np.testing.assert_array_equal(np.isnan(heights), kinds == WATER)


def test_images_are_of_twelve_bits_with_saturation(folder):
    for path in sorted(folder.glob("img_*.tif")):
        with rasterio.open(path) as image:
            numbers = image.read(1)
        assert 200 < np.median(numbers) < 2500
        assert numbers.max() <= 4095


def test_cameras_are_wrong_by_no_more_than_the_recipe_says(folder):
    """The RPC differ from the true cameras by the pointing error and the waves."""
    spec, scene = small(), open_scene(sorted(folder.glob("img_*.tif")))
    views = {view.name: view.sensor for view in scene.views}
    to_scene = Transformer.from_crs("EPSG:32632", scene.crs, always_xy=True)
    for exposure in exposures_of(spec):
        rows, cols = exposure.shape
        xy = np.array([(c, r) for r in np.linspace(0, rows - 1.0, 9) for c in np.linspace(0, cols - 1.0, 5)])
        xyz = exposure.sensor.ground_from_image(xy, np.full(len(xy), 450.0))
        in_scene = np.column_stack([*to_scene.transform(xyz[:, 0], xyz[:, 1]), xyz[:, 2]])
        by = views[f"img_{exposure.view.name}"].image_from_ground(in_scene) - xy
        mean = by.mean(axis=0)
        planted = exposure.view.bias_col_px, exposure.view.bias_row_px
        np.testing.assert_allclose(mean, planted, rtol=0, atol=exposure.view.wave_px + 0.01)
        assert 0.01 < by.std(axis=0).max() < exposure.view.wave_px
        assert max(map(abs, planted)) <= MAX_POINTING_PX


def test_equal_seeds_give_equal_scenes_and_others_do_not(folder, tmp_path):
    again = render_scene(small(), tmp_path / "again").folder
    for path in sorted(folder.iterdir()):
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name
    assert realistic_spec(SEED + 1) != realistic_spec(SEED)


@pytest.mark.parametrize("name", RARE)
def test_each_rare_thing_can_be_asked_for(name):
    bare = analytic_ground("tilt", (0.0, 0.0), 0.5, (400, 400))
    without, present = (
        realistic_ground(bare, Cover(rare_objects=rare, n_terraces=0, houses_per_ha=0.0), AREA, SEED)
        for rare in ((), (name,))
    )
    assert len(present.materials) > 0
    assert not np.array_equal(without.material, present.material)
    if name == "tower":
        assert (present.heights - bare.heights).max() > 55.0
    if name == "masts":
        assert 0 < (present.heights - bare.heights > 18.0).sum() < 200
