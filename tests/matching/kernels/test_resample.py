"""Image positions of the cells of a block, and the image values there, against their slow twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kernel_scene import kernel_scene
from reference.projection import along_slope, bilinear, derivative, position, positions
from zlocus.matching.kernels.resample import (
    block_grid,
    block_velocity,
    coordinate,
    flat_cells,
    image_of,
    resample_plane,
    resample_scratch,
)

# Bilinear values of images with a spread of 1.4 grey values: positions are float32 within some 60 px of their origin.
GREY = 1e-4
# px: speeds change by 0.06 px per t within ten cells of the middle of a block of `kernel_scene`, a relief of 1.5 steps
# is 0.09 t; half a thousandth more for the curve.
BENT = 6e-3


def resampled(scene, view, b, d, t, relief, half, run=100):
    views, cells = scene.of_block(b, d), flat_cells(*relief.shape)
    grid, velocity = block_grid(views, view, t, half), block_velocity(views, view, t)
    out, scratch = np.empty(relief.size, np.float32), resample_scratch(run)
    resample_plane(image_of(scene.arrays, view), grid, velocity, cells, relief.ravel(), scratch, out)
    return out.reshape(relief.shape)


@pytest.mark.parametrize("bumps", [0.0, 1.5])
@pytest.mark.parametrize("half", [0, 2])
@pytest.mark.parametrize("t", [-1.0, 0.37, 1.4])
@pytest.mark.parametrize("is_bent", [False, True])
def test_resampled_planes(half, t, bumps, is_bent):
    """Also of cells that project outside the image: they get the values of its edge."""
    scene = kernel_scene(is_bent=is_bent)
    rng = np.random.default_rng(8)
    for view in range(scene.n_views):
        for b, d, rows, cols in scene.blocks():
            cells = (rows.stop - rows.start, cols.stop - cols.start)
            relief = rng.uniform(-bumps, bumps, (cells[0] + 2 * half, cells[1] + 2 * half)).astype(np.float32)
            node, bend = scene.of_one_block(view, b, d)
            xy = along_slope(node, t, relief, scene.heights[1], cells, scene.block, half, bend)
            found = resampled(scene, view, b, d, t, relief, half)
            np.testing.assert_allclose(found, bilinear(scene.images[view], xy), rtol=0, atol=GREY)


@pytest.mark.parametrize("t", [-1.0, 0.37, 1.4])
def test_relief_moves_cells_to_their_own_heights(t):
    """An image of columns, then one of rows: the values that are resampled there are the positions themselves."""
    scene, half, shape = kernel_scene(), 2, (200, 230)
    plane = np.indices(shape).astype(np.float32)[::-1]
    relief = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 20)).astype(np.float32)
    for axis in (0, 1):
        image = np.ascontiguousarray(plane[axis])
        layout = np.array([[0, *shape]] * scene.n_views, np.int64)
        inside = replace(scene, pixels=image.ravel(), layout=layout, nodes=scene.nodes + 40 * (np.arange(4) == 0))
        for view in range(scene.n_views):
            own = t + relief * scene.heights[1]
            xy = positions(inside.nodes[view, :2, 1:3], own, (16, 16), scene.block, half)
            found = resampled(inside, view, 0, 1, t, relief, half)
            np.testing.assert_allclose(found, xy[..., axis], rtol=0, atol=BENT)


def test_velocity_is_the_speed_at_the_middle_of_a_block():
    scene, h = kernel_scene(), 1e-5
    for view in range(scene.n_views):
        node, middle = scene.nodes[view, 1:3, 2:4], scene.block / 2
        velocity = block_velocity(scene.of_block(1, 2), view, 0.4)
        ends = [position(node, np.float64(0.4 + s * h), middle, middle, scene.block) for s in (-1, 1)]
        by_index = (ends[1] - ends[0]) / (2 * h) * scene.heights[1]
        np.testing.assert_allclose(velocity, by_index, rtol=1e-5)
        exact = position(derivative(node), np.float64(0.4), middle, middle, scene.block)
        np.testing.assert_allclose(velocity, exact * scene.heights[1], rtol=1e-6)


@pytest.mark.parametrize("is_bent", [False, True])
def test_grid_of_a_block_is_its_projection(is_bent):
    scene, half = kernel_scene(is_bent=is_bent), 3
    grid, (node, bend) = block_grid(scene.of_block(1, 2), 1, 0.4, half), scene.of_one_block(1, 1, 2)
    for r, c in ((0, 0), (0, 20), (21, 0), (17, 9)):
        xy = coordinate(grid.x, r, c), coordinate(grid.y, r, c)
        exact = position(node, np.float64(0.4), r - half, c - half, scene.block, bend)
        np.testing.assert_allclose(xy, exact, rtol=0, atol=1e-9)


def test_rows_and_columns_of_a_block():
    rows, cols = np.indices((3, 5))
    np.testing.assert_array_equal(flat_cells(3, 5), [rows.ravel(), cols.ravel()])
