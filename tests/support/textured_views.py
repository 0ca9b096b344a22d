"""Views of one texture on a plane, as tests of labels and of the choice of images need them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from kernel_scene import at_all_heights
from zlocus.core.grid import CellWindow
from zlocus.core.options import SelectionOptions
from zlocus.matching.tile_views import TileViews

# Match curves over so few steps that the images of `textured` contain them.
SHORT = SelectionOptions(reach_steps=16, feature_cells=8)
SHAPE, BLOCK, SIDE, BORDER_PX = (40, 48), 16, 7, 20
# Pixels along columns that a cell moves per step: the first view looks straight down.
SPEEDS = (0.0, 0.5, -0.5, 0.7)
LEVEL_STEPS, STEEP, STEPS_PER_CELL = 30.0, (0.0, 0.9), 1.0


def textured(slope=(0.0, 0.0), spoiled=(), noise=0.0, speeds=SPEEDS):
    """Views of one texture on a plane, LEVEL_STEPS up in the middle; slope : steps a cell down and across.

    Those that are `spoiled` show another texture.
    """
    rng = np.random.default_rng(7)
    shape = (SHAPE[0] + 2 * BORDER_PX, SHAPE[1] + 2 * BORDER_PX)
    per_step = 0.02
    corners = (-(-SHAPE[0] // BLOCK) + 1, -(-SHAPE[1] // BLOCK) + 1)
    row, col = np.meshgrid(np.arange(corners[0]) * BLOCK, np.arange(corners[1]) * BLOCK, indexing="ij")
    y, x = np.indices(shape) - float(BORDER_PX)
    same = gaussian_filter(rng.normal(size=(300, 300)), 1.2) * 10
    images, nodes, layout = [], [], []
    for i, speed in enumerate(speeds):
        # A pixel sees the cell whose column, moved by the height there, is its own: x = c + speed height(r, c).
        at_zero = height_at(slope, y, 0.0) - LEVEL_STEPS
        across = (x - speed * at_zero) / (1 + speed * slope[1])
        other = gaussian_filter(rng.normal(size=(300, 300)), 1.2) * 10
        image = map_coordinates(other if i in spoiled else same, [y + 120, across + 120], order=3)
        images.append((image + noise * rng.normal(size=shape)).astype(np.float32))
        layout.append((i * shape[0] * shape[1], *shape))
        node = np.zeros((*corners, 2, 4))
        node[..., 0, 0], node[..., 0, 1] = col + BORDER_PX, speed / per_step
        node[..., 1, 0] = row + BORDER_PX
        nodes.append(node)
    pixels = np.concatenate([image.ravel() for image in images])
    heights = np.array([-LEVEL_STEPS * per_step, per_step])
    holds = np.ones((len(images), corners[0] - 1, corners[1] - 1), bool)
    return TileViews(
        pixels, np.zeros(len(pixels), bool), np.zeros(len(images), bool), np.array(layout, np.int64), np.stack(nodes),
        np.empty((*holds.shape, 2, 2, 0)), holds, ~holds, heights, at_all_heights(holds), BLOCK,
    )  # fmt: skip


def height_at(slope, row, col):
    """Steps of the plane."""
    return LEVEL_STEPS + slope[0] * (row - SHAPE[0] / 2) + slope[1] * (col - SHAPE[1] / 2)


def ties(n=60, slope=(0.0, 0.0), seed=1):
    """xy (n, 2) columns and rows, height indices (n,)."""
    xy = np.random.default_rng(seed).uniform((8.0, 8.0), (SHAPE[1] - 8.0, SHAPE[0] - 8.0), (n, 2))
    cell = np.floor(xy)
    return xy, height_at(slope, cell[:, 1], cell[:, 0])


WINDOW = CellWindow(0, 0, *SHAPE)
