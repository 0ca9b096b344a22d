"""Choice of images in whole runs with more images than needed, one of them bad: which are used, saving, accuracy."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import rasterio

import zlocus.matching.tile
import zlocus.matching.view_selection
import zlocus.pipeline.setup
from rendered_scenes import read, run
from zlocus.core.options import PyramidOptions, RunConfig, SelectionOptions
from zlocus.matching.occlusion import covers
from zlocus.synthetic.files import RenderedScene, render_scene
from zlocus.synthetic.objects import Objects
from zlocus.synthetic.render import Optics
from zlocus.synthetic.scenes import AFTERNOON, CLEAR, SceneSpec, ViewSpec

GOOD_VIEWS = ("n1", "f1", "b1", "n2", "f2")
BAD = "bad"
# The view nearest to the nadir: chosen by geometry, it would be the reference image of every block.
OTHER_DAY = Optics(gain=500.0, haze=300.0, blur_px=1.3, noise=0.15, noise_floor=120.0)
VIEWS = (
    ViewSpec("n1", 1.0, -4.0, 2.0, optics=CLEAR),
    ViewSpec("f1", 20.0, -4.0, 2.0, optics=CLEAR),
    ViewSpec("b1", -20.0, -4.0, 2.0, optics=CLEAR),
    ViewSpec("n2", 0.0, 12.0, -1.5, optics=CLEAR),
    ViewSpec("f2", 22.0, 13.0, -1.5, optics=CLEAR),
    ViewSpec(BAD, 0.0, 0.5, 0.0, sun=AFTERNOON, optics=OTHER_DAY),
)
SIDE = 176
SPEC = SceneSpec(
    kind="city", seed=11, size=SIDE, relief_m=4.0, views=VIEWS,
    objects=Objects(35.0, 22.0, 0.0, 10.0, plain_roofs=1.0),
)  # fmt: skip
# Small blocks, so that the small town has several.
SMALL_BLOCKS = RunConfig(pyramid=PyramidOptions(block=16))
USE_ALL = replace(SMALL_BLOCKS, selection=SelectionOptions(min_images=254, max_images=254))
# Almost no block has a tie point within this radius.
FAR_FROM_TIES = replace(SMALL_BLOCKS, selection=SelectionOptions(radius_px=3.0, max_radii=1.0))
WITHIN_M, ROAD, BUILDING = 1.0, 1, 2
# Largest share of cells that the choice of images may leave empty.
COVERAGE = 0.005
PRODUCTS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")


@dataclass(frozen=True)
class Town:
    """truth, kind : (r, c) on the cells of 0.5 m, NaN and 255 where a cell holds an edge."""

    scene: RenderedScene
    bounds: tuple[float, float, float, float]
    truth: np.ndarray
    kind: np.ndarray


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    scene = render_scene(SPEC, tmp_path_factory.mktemp("town") / "scene")
    with rasterio.open(scene.truth_dsm) as truth, rasterio.open(scene.truth_class) as classes:
        bounds = tuple(truth.bounds)
        cells = (SIDE, 2, SIDE, 2)
        parts, kinds = (file.read(1).reshape(cells).swapaxes(1, 2).reshape(SIDE, SIDE, 4) for file in (truth, classes))
    clear = (np.ptp(parts, axis=2) < 0.5) & (np.ptp(kinds, axis=2) == 0)
    return Town(scene, bounds, np.where(clear, parts.mean(axis=2), np.nan), np.where(clear, kinds[..., 0], 255))


def surface(town, out, config=SMALL_BLOCKS, names=(*GOOD_VIEWS, BAD), **request):
    """Run over the town on its cells, with a choice of the images unless a request asks otherwise. The bad image takes
    part, although no tie point supports it."""
    inputs = tuple(town.scene.images[name] for name in names)
    asked = {"bounds": town.bounds, "heights": (425.0, 470.0), "selection": "guided"} | request
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(zlocus.pipeline.setup, "supported_views", lambda scene, orientation: scene)
        return run(inputs, out, config, **asked).out


@pytest.fixture
def blocks_used(monkeypatch):
    """Share of the blocks of the finest level that are matched with each view, by its name."""
    found, choose = {}, zlocus.matching.tile.choose_views
    names, match = [], zlocus.matching.tile.match_tile

    def matched(match_scene, *rest):
        names[:] = [view.name.removeprefix("img_") for view in match_scene.views]
        return match(match_scene, *rest)

    def choose_and_count(level, lattice, visible, *rest):
        chosen = choose(level, lattice, visible, *rest)
        if level.number == 0:
            for name, takes, might in zip(names, covers(chosen.matched), covers(visible), strict=True):
                by_block = [
                    (takes[r : r + lattice.block, c : c + lattice.block].any())
                    for r in range(0, lattice.shape[0], lattice.block)
                    for c in range(0, lattice.shape[1], lattice.block)
                    if might[r : r + lattice.block, c : c + lattice.block].any()
                ]
                found[name] = float(np.mean(by_block))
        return chosen

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", matched)
    monkeypatch.setattr(zlocus.matching.tile, "choose_views", choose_and_count)
    return found


@pytest.fixture(scope="module")
def guided(town, tmp_path_factory):
    """A run with the choice of images, and a run with all images."""
    folder = tmp_path_factory.mktemp("guided")
    return surface(town, folder / "some"), surface(town, folder / "all", USE_ALL)


def evaluations(out):
    return json.loads((out / "run.json").read_text())["evaluations"]


def test_a_bad_image_is_used_by_fewer_blocks_than_any_other(town, tmp_path, blocks_used):
    surface(town, tmp_path / "out")
    assert set(blocks_used) == {*GOOD_VIEWS, BAD}
    assert blocks_used[BAD] < 0.5 * min(blocks_used[name] for name in GOOD_VIEWS)
    assert blocks_used[BAD] < 0.2


def test_the_choice_saves_evaluations(guided):
    some, every = (evaluations(out) for out in guided)
    assert some["done"] < 0.9 * some["all_images"]
    assert every["done"] == every["all_images"]


def test_by_default_no_image_is_left_out(town, tmp_path, blocks_used):
    out = surface(town, tmp_path / "out", selection="default")
    assert blocks_used == {}
    assert evaluations(out)["done"] == evaluations(out)["all_images"]


def test_no_cell_that_all_images_see_is_left_empty_by_the_choice(guided, town):
    (some, _), (every, _) = (read(out / "dsm.tif") for out in guided)
    n_views = read(guided[1] / "views.tif")[0]
    by_all = n_views == len(VIEWS)
    assert by_all.mean() > 0.5
    assert np.isfinite(some[by_all]).mean() > 1 - COVERAGE
    assert abs(np.isfinite(some).mean() - np.isfinite(every).mean()) < COVERAGE


def test_the_choice_does_not_lower_the_accuracy(guided, town):
    near = [np.abs(read(out / "dsm.tif")[0] - town.truth) < WITHIN_M for out in guided]
    judged = np.isfinite(town.truth)
    assert near[0][judged].mean() > near[1][judged].mean() - 0.005
    assert near[0][judged].mean() > 0.9


def test_plain_roofs_and_roads_that_no_feature_point_covers_still_get_a_height(town, tmp_path, monkeypatch):
    """With a radius of three cells, blocks take the order of the scene, and cells without texture still get heights."""
    rows, order = [], zlocus.matching.view_selection.order_views

    def watched(ranking, share, at, options):
        apart = np.hypot(*(at[:, None] - ranking.xy[None]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        rows.append((apart > options.max_radii * options.radius_px).mean())
        found = order(ranking, share, at, options)
        assert (np.sort(np.column_stack([found.reference, found.search])) == np.arange(len(share))).all()
        return found

    monkeypatch.setattr(zlocus.matching.view_selection, "order_views", watched)
    height, _ = read(surface(town, tmp_path / "out", FAR_FROM_TIES) / "dsm.tif")
    assert rows[-1] > 0.8, "no feature point near most blocks"
    for kind, share in ((ROAD, 0.97), (BUILDING, 0.7)):
        cells = town.kind == kind
        assert cells.sum() > 500
        assert np.isfinite(height[cells]).mean() > 0.99
        assert (np.abs(height - town.truth)[cells] < WITHIN_M).mean() > share


def test_of_three_images_none_is_left_out(town, tmp_path, blocks_used):
    names = ("n1", "f1", "b1")
    plain = surface(town, tmp_path / "plain", names=names)
    every = surface(town, tmp_path / "every", USE_ALL, names=names)
    assert not blocks_used, "there is nothing to choose"
    for product in PRODUCTS:
        assert (plain / product).read_bytes() == (every / product).read_bytes(), product
    done = evaluations(plain)
    assert done["done"] == done["all_images"]


def test_the_order_of_tie_points_changes_nothing(guided, town, tmp_path, monkeypatch):
    build = zlocus.pipeline.setup.build_match_scene

    def shuffled(*arguments):
        match_scene = build(*arguments)
        order = np.random.default_rng(3).permutation(len(match_scene.ties))
        return replace(match_scene, ties=match_scene.ties[order])

    monkeypatch.setattr(zlocus.pipeline.setup, "build_match_scene", shuffled)
    again = surface(town, tmp_path / "out")
    for product in PRODUCTS:
        assert (again / product).read_bytes() == (guided[0] / product).read_bytes(), product


def test_a_part_of_the_area_has_the_same_heights(guided, town, tmp_path):
    west, south, east, north = town.bounds
    whole, _ = read(guided[0] / "dsm.tif")
    part, _ = read(surface(town, tmp_path / "out", bounds=(west + 20, south + 30, east - 30, north - 10)) / "dsm.tif")
    np.testing.assert_array_equal(part, whole[20:-60, 40:-60])
