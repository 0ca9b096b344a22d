"""Memory of one tile after the other: a tile leaves nothing behind."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import psutil
import pytest
from scipy.ndimage import gaussian_filter

from orientation_scenes import image_of
from zlocus.core.grid import CellWindow
from zlocus.core.height_range import HeightRange
from zlocus.core.options import RunConfig
from zlocus.core.scene import Scene, View
from zlocus.matching.match_scene import build_match_scene
from zlocus.matching.tile import match_tile
from zlocus.matching.tile_views import TileViews
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles

# Largest memory after nine tiles, by that after the second.
MAX_GROWTH = 1.1
CELL_M, TILE_CELLS, TILES_PER_SIDE = 0.1, 160, 3
LENS = BrownDistortion(k1=-0.26, k2=0.1)


@pytest.fixture(scope="module")
def match_scene():
    """Three frames of a wide lens 60 m above level ground, whose tables are made for bent blocks."""
    rng = np.random.default_rng(2)
    texture = gaussian_filter(rng.normal(size=(1400, 1400)), 1.2).astype(np.float32) * 100.0
    row, col = np.mgrid[:800.0, :1000.0]
    views = []
    for number, east in enumerate((-12.0, 0.0, 12.0)):
        turn = rotation_from_angles(2.0 * number, -1.0, 3.0 * number)
        sensor = FrameModel((east, 0.0, 60.0), turn, 800.0, (499.5, 399.5), distortion=LENS)
        ground = sensor.ground_from_image(np.column_stack([col.ravel(), row.ravel()]), np.zeros(col.size))
        at = np.nan_to_num(ground[:, :2] / 0.08).round().astype(int) % 1400
        pixels = texture[at[:, 1], at[:, 0]].reshape(row.shape)
        views.append(View(f"v{number}", Path(f"v{number}.tif"), image_of(pixels), sensor))
    ties = np.column_stack([rng.uniform(-20, 20, (80, 2)), np.zeros(80)])
    heights = HeightRange.limited_to((-6.0, 18.0))
    return build_match_scene(Scene(tuple(views), None), CELL_M, (0.0, 0.0), heights, ties, None, RunConfig().pyramid)


def test_nine_tiles_of_frame_cameras_leave_nothing_behind(match_scene):
    """Garbage is collected rarely in a run, so nothing of a tile may be kept by references that form a cycle."""
    process, held = psutil.Process(), []
    first = -TILE_CELLS * TILES_PER_SIDE // 2
    gc.collect()
    gc.disable()
    try:
        for i, j in np.ndindex(TILES_PER_SIDE, TILES_PER_SIDE):
            window = CellWindow(first + i * TILE_CELLS, first + j * TILE_CELLS, TILE_CELLS, TILE_CELLS)
            result = match_tile(match_scene, window, RunConfig())
            assert np.isfinite(result.surface.height).mean() > 0.9
            del result
            assert not [one for one in gc.get_objects() if type(one) is TileViews]
            held.append(process.memory_info().rss)
    finally:
        gc.enable()
    assert max(held[2:]) < MAX_GROWTH * held[1]
