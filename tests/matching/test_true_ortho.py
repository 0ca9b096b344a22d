from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp

from places import ROOT
from rendered_scenes import CENTRE, HEIGHTS, PART, SMALL_TILES, rendered_in_colours, run
from zlocus.core.grid import CellWindow
from zlocus.core.options import ProductOptions, RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.io.images import open_image
from zlocus.io.scene_file import open_scene
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.occlusion import covered_heights, mark_occlusions
from zlocus.matching.radiometry import GreyScale
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.true_ortho import (
    CoarserHeights,
    Surroundings,
    best_view,
    ortho_image,
    pixels_per_cell,
    surroundings_of_tile,
    true_ortho,
)
from zlocus.matching.view_pixels import ViewPixels
from zlocus.pipeline.dsm import run_dsm
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.cameras import SatelliteCamera

sys.path.insert(0, str(ROOT / "benchmarks"))
from double_mapping import double_mapped

CELL_M, STEP_M, BLOCK, SHAPE = 0.5, 0.5, 16, (40, 60)
ORIGIN_M, N_STEPS = 40.0, 64
LOW, HIGH = 4.0, 28.0  # steps: a tower of 12 m
TOWER = np.s_[14:26, 24:36]
RIM = 1  # cells beside an edge that other views may show, for its place is not known better
GREY = 2.0
# Of a town, as benchmarks/acceptance.py has it; 0.0038 of the ground and 0.0024 of the roofs of this part, and 0.0145
# of the ground where nothing hides.
MOST_HIDDEN = 0.005
PART_OF_TOWN = (500170, 5205710, 500370, 5205910)


def sensor(along=0.0, across=0.0, gsd=0.5):
    return SatelliteCamera((*CENTRE, 50.0), (100.0, 100.0), gsd, along, across)


def tile(sensors, greys=None, contrast=1.0, mean=0.0, shape=SHAPE, col=0):
    """Views of a grid around the scene's centre, each of one grey value, and what they cover. col : where it begins."""
    transform = Affine(CELL_M, 0, CENTRE[0] - 15.0 + col * CELL_M, 0, -CELL_M, CENTRE[1] + 10.0)
    greys = range(len(sensors)) if greys is None else greys
    mask, scale = np.ones((201, 201), bool), GreyScale(mean, contrast)
    pixels = [
        ViewPixels(s, (0, 0), np.full((201, 201), g, np.float32), mask, scale)
        for s, g in zip(sensors, greys, strict=True)
    ]
    blocks = (-(-shape[0] // BLOCK), -(-shape[1] // BLOCK))
    lattice = HeightLattice(
        ORIGIN_M, STEP_M, shape, BLOCK, np.zeros(blocks, np.int64), np.full(blocks, N_STEPS, np.int64)
    )
    z = (ORIGIN_M, ORIGIN_M + N_STEPS * STEP_M)
    views = tile_views(pixels, TileGrid(0, transform, shape, BLOCK, ORIGIN_M, STEP_M), z, 2)
    return views, covered_heights(views, SlopeSurface.flat(shape, BLOCK), lattice)


def tower() -> np.ndarray:
    surface = np.full(SHAPE, LOW, np.float32)
    surface[TOWER] = HIGH
    return surface


def test_pixels_of_a_cell():
    """A camera in the air that looks aside shows a level cell on fewer, by its cosine and its distance."""
    rotation = np.diag([1.0, -1.0, -1.0])
    o = np.radians(40.0)
    aside = np.array([[np.cos(o), 0, np.sin(o)], [0, 1, 0], [-np.sin(o), 0, np.cos(o)]])
    above, beside = np.array([*CENTRE, 1050.0]), np.array([CENTRE[0] + 1000.0 * np.tan(o), CENTRE[1], 1050.0])
    looks = [
        FrameModel(tuple(centre), tuple(map(tuple, axes)), 2000.0, (100.0, 100.0))
        for axes, centre in ((rotation, above), (rotation @ aside.T, beside))
    ]
    views, _ = tile([sensor(), sensor(gsd=1.0), *looks])
    size = pixels_per_cell(views)
    for found, expected in zip(size, (1.0, 0.25, 1.0, np.cos(o) ** 3), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.05, atol=0)


@pytest.mark.parametrize(("across", "behind"), [(30.0, np.s_[16:24, 37:48]), (-30.0, np.s_[16:24, 12:23])])
def test_cells_that_a_tower_occludes_are_shown_by_another_view(across, behind):
    """12 m high, seen 30 degrees from one side: 7 m, or 13 cells, of the ground behind it."""
    slanted, opposite = sensor(across=across), sensor(across=-across)
    views, visible = tile([slanted, opposite])
    best = best_view(views, visible, tower())
    hidden = best == 1
    assert hidden[behind].all()
    assert not hidden[16:24, 60 - behind[1].stop : 60 - behind[1].start].any()
    far = np.ones(SHAPE, bool)
    far[TOWER[0].start - 2 : TOWER[0].stop + 2, :] = False
    assert (best[far] == 0).all()
    inner = np.s_[TOWER[0].start + RIM : TOWER[0].stop - RIM, TOWER[1].start + RIM : TOWER[1].stop - RIM]
    assert (best[inner] == 0).all()


WIDE, FIRST, HALO = (40, 120), 60, 4
# 12 m high, west of the tile, with its shadow in it: 13 cells at 30 degrees.
BESIDE = np.s_[14:26, 44:56]


def beside_the_tile(across):
    """Views of a wide grid and of a tile in it, and a surface with a tower beside the tile."""
    sensors = [sensor(across=across), sensor(across=-across)]
    surface = np.full(WIDE, LOW, np.float32)
    surface[BESIDE] = HIGH
    views, visible = tile(sensors, shape=WIDE, col=-40)
    part, of_part = tile(sensors, col=FIRST - 40)
    return surface, best_view(views, visible, surface), part, of_part


@pytest.mark.parametrize("across", [30.0, -30.0])
def test_a_tower_beside_a_tile_occludes_its_cells(across):
    surface, whole, views, visible = beside_the_tile(across)
    mine = surface[:, FIRST : FIRST + SHAPE[1]]
    shows_its_shadow = (whole[:, FIRST : FIRST + SHAPE[1]] == 1).any()
    assert shows_its_shadow == (across > 0)
    found = best_view(views, visible, mine, Surroundings(surface, 0, FIRST))
    np.testing.assert_array_equal(found, whole[:, FIRST : FIRST + SHAPE[1]])
    assert (best_view(views, visible, mine) == 0).all()


def test_coarser_levels_are_used_as_far_as_they_can_occlude():
    """The tower as levels of half and of a quarter of the cells have it, whose halos reach twice and four times as
    far."""
    surface, _, views, _ = beside_the_tile(30.0)
    mine, window = surface[:, FIRST : FIRST + SHAPE[1]], CellWindow(0, FIRST, *SHAPE)
    coarser = [
        CoarserHeights(level, CellWindow(0, 0, WIDE[0] // size, WIDE[1] // size), surface[::size, ::size] / size)
        for level, size in ((1, 2), (2, 4))
    ]
    around = surroundings_of_tile(coarser, views, window, mine, HALO)
    # 13.9 cells from the core's edge, 4 of which are the halo: the first level knows 4 of the others, the second 12.
    assert (around.row, around.col) == (0, 10)
    np.testing.assert_array_equal(around.surface, coarser[1].surface.repeat(4, 0).repeat(4, 1)[:, 50:] * 4)
    # Nothing near is that tall, and a false height of a cell is no tower.
    level = [CoarserHeights(1, coarser[0].window, np.full_like(coarser[0].surface, LOW / 2))]
    level[0].surface[8, 20] = HIGH / 2
    assert surroundings_of_tile(level, views, window, mine, HALO) is None
    assert surroundings_of_tile([], views, window, mine, HALO) is None
    # So tall that the coarsest level must do.
    taller = [
        CoarserHeights(c.level, c.window, np.where(c.surface > LOW / 2**c.level, 3 * c.surface, c.surface))
        for c in coarser
    ]
    assert surroundings_of_tile(taller, views, window, mine, HALO).col > 12


def test_both_sides_are_hidden_from_the_views_that_look_over_the_other():
    views, visible = tile([sensor(across=30.0), sensor(across=-30.0)])
    best = best_view(views, visible, tower())
    views, visible = tile([sensor(across=-30.0), sensor(across=30.0)])
    other = best_view(views, visible, tower())
    # Where the first of the two is hidden, the second is shown, and it is the first elsewhere.
    assert not ((best == 1) & (other == 1)).any()
    assert (best >= 0).all()
    assert (best == 1).sum() > 100 < (other == 1).sum()


def test_cells_that_no_view_sees():
    views, visible = tile([sensor(across=30.0), sensor(across=31.0)])
    # Where a view that was matched counts as seeing it, that is shown all the same.
    assert (best_view(views, visible, tower()) >= 0).all()
    mark_occlusions(visible, views, tower(), np.zeros(SHAPE, np.float32), 1.0)
    best = best_view(views, visible, tower())
    ortho = true_ortho(views, visible, tower())
    assert (best < 0).sum() > 80
    np.testing.assert_array_equal(np.isnan(ortho), best < 0)


def test_the_finer_view_is_shown_where_it_is_clearly_finer():
    flat = np.full(SHAPE, LOW, np.float32)
    for gsds, expected in (((0.5, 0.48), 0), ((0.5, 0.25), 1), ((0.25, 0.5), 0)):
        views, visible = tile([sensor(gsd=gsd) for gsd in gsds])
        assert (best_view(views, visible, flat) == expected).all()


def test_grey_values_are_those_of_the_image():
    """Scaled back from what is matched."""
    views, visible = tile([sensor(), sensor(along=20.0)], greys=(0.25, -3.0), contrast=40.0, mean=500.0)
    flat = np.full(SHAPE, LOW, np.float32)
    np.testing.assert_allclose(true_ortho(views, visible, flat), 510.0, rtol=0, atol=1e-3)
    np.testing.assert_allclose(ortho_image(views, flat, 1), -3.0, rtol=0, atol=1e-6)


def test_only_blocks_that_are_wanted_and_shown_are_resampled():
    views, _ = tile([sensor(), sensor(along=20.0)], greys=(0.25, -3.0))
    where, flat = np.zeros(SHAPE, bool), np.full(SHAPE, LOW, np.float32)
    where[20, 40] = True
    found = ortho_image(views, flat, 1, where)
    in_block = np.zeros(SHAPE, bool)
    in_block[16:32, 32:48] = True
    np.testing.assert_allclose(found[in_block], -3.0, rtol=0, atol=1e-6)
    assert (found[~in_block] == 0).all()
    nowhere = replace(views, is_projected=np.zeros_like(views.is_projected))
    assert (ortho_image(nowhere, flat, 1) == 0).all()


def test_grey_values_are_levelled_to_those_of_one_image():
    """0.25 of 40 above 500 is 0.25 of 8 above 100; a trend is taken off."""
    flat = np.full(SHAPE, LOW, np.float32)
    views, visible = tile([sensor()], greys=(0.25,), contrast=40.0, mean=500.0)

    class Seven:
        def window(self, row, col, rows, cols):
            return np.full((rows, cols), 7.0, np.float32)

    (view,) = views.view_pixels
    fallen = replace(views, view_pixels=(replace(view, scale=replace(view.scale, trend=Seven())),))
    for held, scale, expected in (
        (views, None, 510.0), (fallen, None, 517.0),
        (views, GreyScale(100.0, 8.0), 102.0), (fallen, GreyScale(100.0, 8.0), 102.0),
    ):  # fmt: skip
        np.testing.assert_allclose(true_ortho(held, visible, flat, scale=scale), expected, rtol=0, atol=1e-3)
    red, green, blue = (np.full((201, 201), v, np.float32) for v in (517.0, 497.0, 547.0))

    class Coloured:
        def colours(self, row, col, rows, cols):
            return np.stack([red, green, blue])[:, row : row + rows, col : col + cols]

    found = true_ortho(fallen, visible, flat, [Coloured()], scale=GreyScale(100.0, 8.0))
    np.testing.assert_allclose(found[5, 5], [102.0, 98.0, 108.0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(true_ortho(fallen, visible, flat, [Coloured()])[5, 5], [517, 497, 547], atol=1e-3)


@pytest.fixture(scope="module", params=["uint8", "uint16"])
def coloured(tmp_path_factory, request) -> tuple[Path, ...]:
    return rendered_in_colours(tmp_path_factory.mktemp("coloured"), request.param)


@pytest.mark.parametrize("selection", ["default", "guided"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_an_ortho_image_has_the_colours_of_the_images(coloured, tmp_path, selection):
    assert open_image(coloured[0]).has_colours
    out = run(coloured, tmp_path / "out", SMALL_TILES, bounds=PART, heights=HEIGHTS, selection=selection).out
    with rasterio.open(out / "ortho.tif") as source:
        bands, valid, meanings = source.read().astype(float), source.dataset_mask() > 0, source.colorinterp
        assert source.descriptions == ("red", "green", "blue")
    assert meanings == (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    with rasterio.open(out / "dsm.tif") as source:
        np.testing.assert_array_equal(valid, np.isfinite(source.read(1)))
    red, green, blue = (band[valid] for band in bands)
    np.testing.assert_allclose(green, red / 2, rtol=0, atol=GREY)
    np.testing.assert_allclose(blue, 255 - red, rtol=0, atol=GREY)
    assert red.std() > 5


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_heights_of_image_space_have_a_grey_ortho_image(tmp_path):
    """Of colour images too; also where tiles lie beyond what the images show."""
    images, (west, south, east, north) = rendered_in_colours(tmp_path, "uint8"), PART
    bounds = (west - 80.0, south, east, north)
    out = run(images, tmp_path / "out", SMALL_TILES, bounds=bounds, heights=HEIGHTS, method="gc3-sgm", workers=2).out
    with rasterio.open(out / "ortho.tif") as file:
        assert file.count == 1
        assert 0.1 < (file.read_masks(1) > 0).mean() < 0.9


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_grey_where_not_all_images_have_colours(coloured, images, tmp_path):
    out = run((*coloured[:2], images("plane").paths["aft"]), tmp_path / "out", SMALL_TILES, bounds=PART).out
    with rasterio.open(out / "ortho.tif") as source:
        assert source.count == 1


def test_few_cells_of_a_town_show_the_roof_that_occludes_them(shared_data, tmp_path):
    scene = shared_data / "rendered-city"
    # All four look aside: from the side of a house the street behind it is hidden.
    images = tuple(scene / f"img_{view}.tif" for view in ("f1", "b1", "f2", "b2"))
    request = DsmRequest(images, tmp_path, resolution=0.5, bounds=PART_OF_TOWN, products=(), report=False)
    run_dsm(request, RunConfig(products=ProductOptions(ortho_levels="own")), SilentProgress())
    found = double_mapped(tmp_path, scene / "truth_dsm.tif", scene / "truth_class.tif", open_scene(images))
    assert found["ground"][0] <= MOST_HIDDEN
    assert found["building"][0] <= MOST_HIDDEN
