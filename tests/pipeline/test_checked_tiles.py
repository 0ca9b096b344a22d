"""Tiles of images checked as soon as possible: the heights are those of a check after all images were matched."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest

from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import SetupRequest
from zlocus.matching.quality import Quality
from zlocus.pipeline.checked_tiles import CheckedTiles, strip_by_strip
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.image_scenes import GroundArea, build_image_scenes, set_up_images
from zlocus.pipeline.image_tiles import (
    ImageMatching,
    cross_checked_images,
    match_images,
    matched_tiles,
    tiles_of_images,
)
from zlocus.pipeline.setup import open_inputs
from zlocus.pipeline.tile_run import MatchMethod

SEEDS = range(4)
# Less than all heights of the step, so that some lie beyond the range.
HEIGHTS = (40.0, 60.0)


@pytest.fixture(scope="module")
def matching(tmp_path_factory):
    spill_arrays = SpillArrays(tmp_path_factory.mktemp("files"), 0.0, 1 << 22)
    config = RunConfig(pyramid=PyramidOptions(tile=64))
    return ImageMatching(config, MatchMethod("gc3-sgm"), 1, spill_arrays)


@pytest.fixture(scope="module")
def image_scenes(images, matching):
    request = SetupRequest(images("step").inputs, crs="EPSG:32632", heights=HEIGHTS)
    scene = open_inputs(request, SilentProgress()).scene
    setup = set_up_images(scene, matching.config, SilentProgress())
    return build_image_scenes(setup, [view.name for view in scene.views], matching.config).image_scenes


@pytest.fixture(scope="module")
def products(image_scenes, matching):
    """All tiles of three images with their products."""
    image_tiles = tiles_of_images(image_scenes, matching.config, None)
    return list(matched_tiles(image_scenes, image_tiles, matching, SilentProgress()))


@pytest.fixture(scope="module")
def checked_at_the_end(image_scenes, matching):
    """The images, each checked after all of them were matched."""
    matched = match_images(image_scenes, matching, SilentProgress())
    return cross_checked_images(matched, SilentProgress(), matching.spill_arrays)


@pytest.mark.parametrize("seed", SEEDS)
def test_heights_do_not_depend_on_the_order_of_tiles(image_scenes, products, matching, checked_at_the_end, seed):
    image_tiles = strip_by_strip(image_scenes, [each.image_tile for each in products])
    shuffled = random.Random(seed).sample(products, len(products))
    checked_tiles = CheckedTiles(image_scenes, image_tiles, matching.spill_arrays)
    assert list(checked_tiles.final_tiles(shuffled)) == image_tiles
    assert any(((each.quality & np.uint16(Quality.RANGE_END)) != 0).any() for each in checked_at_the_end)
    for one, other in zip(checked_tiles.result(), checked_at_the_end, strict=True):
        np.testing.assert_array_equal(one.image.height, other.image.height)
        np.testing.assert_array_equal(one.quality, other.quality)
        assert ((one.quality & np.uint16(Quality.INCONSISTENT)) != 0).any()
        assert (one.evaluations, one.all_images) == (other.evaluations, other.all_images)


def test_a_tile_is_final_when_those_that_show_its_ground_are_there(image_scenes, products, matching):
    """In the order of the tiles: none is final before tiles of other images, and all are after the last one."""
    image_tiles = strip_by_strip(image_scenes, [each.image_tile for each in products])
    in_order = sorted(products, key=lambda each: image_tiles.index(each.image_tile))
    given = []

    def one_by_one():
        for each in in_order:
            given.append(each.image_tile)
            yield each

    checked_tiles = CheckedTiles(image_scenes, image_tiles, matching.spill_arrays)
    final = [(tile, len(given)) for tile in checked_tiles.final_tiles(one_by_one())]
    assert [tile for tile, _ in final] == image_tiles
    for tile, n_given in final:
        assert {each.number for each in given[:n_given]} == {0, 1, 2}, tile


def test_strips_follow_each_other_on_the_ground(image_scenes, products):
    """All tiles are there once, those of an image follow each other within a strip, and strips do not mix."""
    all_tiles = [each.image_tile for each in products]
    ordered = strip_by_strip(image_scenes, all_tiles)
    assert sorted(ordered, key=all_tiles.index) == all_tiles
    assert strip_by_strip(image_scenes, all_tiles[::-1])[0].number == 0
    numbers = [each.number for each in ordered]
    n_changes = sum(a != b for a, b in pairwise(numbers))
    assert n_changes == 5, "three images in two strips"


def test_an_area_shows_where_its_rays_end(image_scenes):
    """Without heights of its own an area asks for the hypotheses that are searched."""
    space, window = image_scenes[0].image_space, tiles_of_images(image_scenes, RunConfig(), None)[0].tile.kept_window
    x, y, _ = space.ground(0, np.zeros((1, 1), np.float32))[0, 0]
    here, away = (GroundArea((x - 1, y - 1 + by, x + 1, y + 1 + by), None) for by in (0.0, 120.0))
    assert here.may_show(space, window, (-1.0, 1.0))
    assert not away.may_show(space, window, (-1.0, 1.0))
    assert away.may_show(space, window, (-1000.0, 1000.0))
