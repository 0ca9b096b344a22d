"""Satellite images of level, textured ground, and a surface that has a patch in free air above it."""

from __future__ import annotations

import numpy as np
from affine import Affine
from scipy.ndimage import gaussian_filter, map_coordinates

from rendered_scenes import CENTRE
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.tile_views import TileGrid, tile_views
from zlocus.matching.view_pixels import ViewPixels
from zlocus.synthetic.cameras import SatelliteCamera

CELL_M, STEP_M, BLOCK, SHAPE = 0.5, 0.5, 16, (60, 80)
ORIGIN_M, N_STEPS = 40.0, 64
IMAGE = (221, 221)
# Height indices of level ground, and of a patch in free air above it.
GROUND, AIR = 12.0, 44.0
PATCH = np.s_[27:33, 37:43]
ANGLES_DEG = (-20.0, 2.0, 20.0)


def level_ground(angles=ANGLES_DEG):
    """Satellite images of level, textured ground on a grid: their views, and the height lattice."""
    texture = gaussian_filter(np.random.default_rng(1).normal(size=(400, 400)), 1.5)
    texture /= texture.std()
    rows, cols = np.indices(IMAGE)
    pixels = []
    for angle in angles:
        sensor = SatelliteCamera((*CENTRE, 50.0), (110.0, 110.0), 0.5, 0.0, angle)
        xy = np.column_stack([cols.ravel(), rows.ravel()]).astype(float)
        xyz = sensor.ground_from_image(xy, np.full(len(xy), ORIGIN_M + GROUND * STEP_M))
        at = np.stack([200 - (xyz[:, 1] - CENTRE[1]) / CELL_M, 200 + (xyz[:, 0] - CENTRE[0]) / CELL_M])
        image = map_coordinates(texture, at, order=1).reshape(IMAGE).astype(np.float32)
        pixels.append(ViewPixels(sensor, (0, 0), image, np.ones(IMAGE, bool)))
    transform = Affine(CELL_M, 0, CENTRE[0] - 20.0, 0, -CELL_M, CENTRE[1] + 15.0)
    blocks = (-(-SHAPE[0] // BLOCK), -(-SHAPE[1] // BLOCK))
    lattice = HeightLattice(
        ORIGIN_M, STEP_M, SHAPE, BLOCK, np.zeros(blocks, np.int64), np.full(blocks, N_STEPS, np.int64)
    )
    z = (ORIGIN_M, ORIGIN_M + N_STEPS * STEP_M)
    return tile_views(pixels, TileGrid(0, transform, SHAPE, BLOCK, ORIGIN_M, STEP_M), z, 2), lattice


def with_patch():
    surface = np.full(SHAPE, GROUND, np.float32)
    surface[PATCH] = AIR
    return surface
