"""Projection tables against the exact models, and where pixels of a pyramid level lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from affine import Affine

from orientation_scenes import image_of
from rendered_scenes import CENTRE, camera
from zlocus.errors import GeometryError
from zlocus.io.scene_file import open_scene
from zlocus.matching.views import ViewPixels, halved, read_pixels, tile_views
from zlocus.scene import View
from zlocus.sensors.table import TOLERANCE_PX, projection_table
from zlocus.synthetic.cameras import LineScanner, SatelliteCamera

HEIGHTS = (20.0, 140.0)
# Rounding of float32 grey values, in contrasts of the image.
FLOAT32_CONTRASTS = 1e-5


def steep():
    return SatelliteCamera((*CENTRE, 50.0), (500.0, 500.0), 0.5, 45.0, -20.0, 30.0, 30_000.0)


def airborne(wobble=0.03):
    """A backward line of an ADS40, 2000 m above ground, far from the nadir."""
    position = (CENTRE[0] - 900.0, CENTRE[1] + 500.0, 2050.0)
    return LineScanner(position, (6000.0, 4000.0), 0.0, -14.0, 0.208, wobble_m=0.5, wobble_deg=wobble)


def grid(cell_m, shape):
    return Affine(cell_m, 0, CENTRE[0] - cell_m * shape[1] / 2, 0, -cell_m, CENTRE[1] + cell_m * shape[0] / 2)


def worst_gap(sensor, table, transform, shape, block, n=4000):
    """Largest distance of the table from the exact model at random cells and heights, px."""
    rng = np.random.default_rng(1)
    row, col = rng.integers(0, shape[0], n), rng.integers(0, shape[1], n)
    t = rng.uniform(-1, 1, n)
    x, y = transform * (col + 0.5, row + 0.5)
    exact = sensor.image_from_ground(np.column_stack([x, y, table.z_mid + t * table.z_half]))
    b, d = row // block, col // block
    u, v = ((col % block) / block)[:, None], ((row % block) / block)[:, None]
    at = [[(table.nodes[b + i, d + j] * (t[:, None] ** np.arange(4))[:, None]).sum(-1) for j in (0, 1)] for i in (0, 1)]
    found = (1 - v) * ((1 - u) * at[0][0] + u * at[0][1]) + v * ((1 - u) * at[1][0] + u * at[1][1])
    return np.linalg.norm(found - exact, axis=1).max()


@pytest.mark.parametrize(
    ("sensor", "cell_m"), [(steep(), 0.5), (airborne(), 0.2), (airborne(), 0.8), (camera("aft"), 2)]
)
def test_steep_and_wide_views(sensor, cell_m):
    shape, block = (150, 203), 32
    transform = grid(cell_m, shape)
    table = projection_table(sensor, transform, shape, block, HEIGHTS)
    assert table.nodes.shape == (6, 8, 2, 4)
    assert worst_gap(sensor, table, transform, shape, block) < TOLERANCE_PX


def test_real_satellite_models(shared_data):
    """RPC of a Pleiades triplet, over its whole relief and more."""
    scene = open_scene(sorted((shared_data / "pleiades_triplet_calanques").glob("img_0*.tif")))
    transform = Affine(0.5, 0, 698_000.0, 0, -0.5, 4_793_000.0)
    for view in scene.views:
        table = projection_table(view.sensor, transform, (700, 700), 32, (50.0, 350.0))
        assert worst_gap(view.sensor, table, transform, (700, 700), 32) < TOLERANCE_PX


def test_blocks_too_large_are_refused():
    """A scanner that shakes within a block."""
    shape = (512, 512)
    with pytest.raises(GeometryError, match=r"of 256 cells is .* Use a smaller block"):
        projection_table(airborne(0.3), grid(0.4, shape), shape, 256, HEIGHTS)
    projection_table(airborne(0.3), grid(0.4, shape), shape, 8, HEIGHTS)


def test_a_sensor_that_maps_nothing_is_refused():
    class Blind:
        def image_from_ground(self, xyz):
            return np.full((len(xyz), 2), np.nan)

    with pytest.raises(GeometryError):
        projection_table(Blind(), grid(0.5, (64, 64)), (64, 64), 32, HEIGHTS)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_pixels_of_a_level(level):
    """A cell at (x, y) px of the image is at (x + 0.5) / 2^level - 0.5 px of the level, less the window's origin."""
    sensor, shape, block = camera("fore"), (40, 50), 16
    transform = grid(0.5 * 2**level, shape)
    origin = (8, 20)
    pixels = tuple(np.zeros((96 // 2**k, 112 // 2**k), np.float32) for k in range(3))
    window = ViewPixels(sensor, origin, 0.0, 1.0, pixels, tuple(np.ones(p.shape, bool) for p in pixels))
    lattice = (30.0, 1.5)
    views = tile_views([window], level, transform, shape, block, lattice, HEIGHTS, 2)
    for row, col, k in ((0, 0, 0), (16, 32, 7), (32, 48, 30)):
        t = views.heights[0] + k * views.heights[1]
        x, y = views.nodes[0, row // block, col // block] @ t ** np.arange(4)
        ground = np.array([[*(transform * (col + 0.5, row + 0.5)), lattice[0] + k * lattice[1]]])
        exact = (sensor.image_from_ground(ground)[0] + 0.5) / 2**level - 0.5 - np.array(origin[::-1]) / 2**level
        np.testing.assert_allclose((x, y), exact, rtol=0, atol=TOLERANCE_PX)


def test_pixels_of_a_window_are_on_the_scale_of_all_views():
    """The view's own zero and one, at every level, wherever the window starts."""
    pixels = 500.0 + 40.0 * np.random.default_rng(0).normal(size=(40, 60))
    view = View("v", Path("v.tif"), image_of(pixels), camera("fore"))
    read = read_pixels(view, (4, 8, 24, 32), 3, 480.0, 25.0)
    assert (read.origin, read.mean, read.contrast) == ((4, 8), 480.0, 25.0)
    plain = (pixels[4:28, 8:40] - 480.0) / 25.0
    for level, found in enumerate(read.pixels):
        side = 2**level
        means = plain.reshape(24 // side, side, 32 // side, side).mean(axis=(1, 3))
        np.testing.assert_allclose(found, means, rtol=0, atol=FLOAT32_CONTRASTS)


def test_halved_pixels_lie_between_four():
    """The mean of a ramp in column and row is the ramp at (2 c + 0.5, 2 r + 0.5); odd last ones are dropped."""
    row, col = np.indices((9, 13)).astype(np.float32)
    coarse, valid = halved(col + 100 * row, np.ones((9, 13), bool))
    r, c = np.indices((4, 6))
    np.testing.assert_array_equal(coarse, (2 * c + 0.5) + 100 * (2 * r + 0.5))
    assert valid.all()


def test_halved_pixels_skip_what_is_not_valid():
    pixels, valid = np.full((4, 6), 3.0, np.float32), np.ones((4, 6), bool)
    pixels[0, 0], valid[0, 0] = 900, False
    valid[0:2, 2:4] = [[False, True], [False, True]]
    coarse, kept = halved(pixels, valid)
    assert coarse[0, 0] == 3.0
    np.testing.assert_array_equal(kept, [[True, False, True], [True, True, True]])
