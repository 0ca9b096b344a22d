"""The base surface: as steep as the ground, blind to buildings, and what projects along it."""

from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import kernel_scene
from zlocus.kernels.volume import plane_grid
from zlocus.matching.base import ANCHOR, BaseSurface, bilinear, block_medians, block_slopes, integrated
from zlocus.matching.views import TileViews

BLOCK = 16
SHAPE = (75, 104)
# Least squares with a weak pull towards the blocks' heights; rounding of float32 heights.
STEPS, FLOAT32_STEPS = 1e-6, 1e-3
# Positions of nodes, px, whose cubics are shifted in float64.
POSITION_PX = 1e-9


def plane(by_row, by_col, shape=SHAPE):
    row, col = np.indices(shape)
    return (by_row * row + by_col * col + 40.0).astype(np.float32)


def views_of(scene):
    none = np.zeros(len(scene.pixels), bool)
    return TileViews(scene.pixels, none, np.zeros(scene.n_views, bool), scene.layout, scene.nodes, scene.heights)


def test_sheared_views_project_where_the_base_lies():
    """Index k of the base, at a node that lies `up` steps above the lattice's origin, is k + up of the lattice."""
    scene = kernel_scene()
    up = np.random.default_rng(4).uniform(-30, 30, scene.nodes.shape[1:3])
    base = BaseSurface(up, bilinear(up, scene.shape, scene.block))
    sheared = base.shear(views_of(scene))
    assert sheared.nodes.shape == scene.nodes.shape
    start, step = scene.heights
    grid, plain = np.empty(8), np.empty(8)
    for view in range(scene.n_views):
        for b, d in np.ndindex(scene.nodes.shape[1] - 1, scene.nodes.shape[2] - 1):
            for k in (-7, 0, 19.25):
                corner = sheared.nodes[:, b : b + 2, d : d + 2]
                plane_grid(corner, view, start + k * step, scene.block, 0, grid)
                for i, j in np.ndindex(2, 2):
                    t = start + (k + up[b + i, d + j]) * step
                    alone = np.broadcast_to(scene.nodes[view, b + i, d + j], (1, 2, 2, 2, 4))
                    plane_grid(np.ascontiguousarray(alone), 0, t, scene.block, 0, plain)
                    r, c = i * scene.block, j * scene.block
                    found = grid[:2] + c * grid[2:4] + r * grid[4:6] + r * c * grid[6:8]
                    np.testing.assert_allclose(found, plain[:2], rtol=0, atol=POSITION_PX)


def test_a_level_base_changes_nothing():
    scene = kernel_scene()
    views, base = views_of(scene), BaseSurface.level(scene.shape, scene.block)
    assert base.nodes.shape == scene.nodes.shape[1:3]
    np.testing.assert_array_equal(base.shear(views).nodes, views.nodes)
    assert (base.cells == 0).all()
    assert base.cells.shape == scene.shape
    assert not base.is_steep


def test_the_slopes_of_a_plane_come_back():
    by_row, by_col = np.full((4, 6), 0.7), np.full((4, 6), -1.3)
    middle = BLOCK * (np.indices((4, 6)) + 0.5)
    nodes = integrated(by_row, by_col, BLOCK, 0.7 * middle[0] - 1.3 * middle[1] + 5)
    np.testing.assert_allclose(np.diff(nodes, axis=0), BLOCK * 0.7, rtol=0, atol=STEPS)
    np.testing.assert_allclose(np.diff(nodes, axis=1), BLOCK * -1.3, rtol=0, atol=STEPS)
    assert nodes[0, 0] == pytest.approx(5.0, abs=STEPS)


def test_slopes_that_no_surface_has_are_shared_out():
    """A block with a slope of its own among level ones: the sum of squares is least, so moving any node raises it."""
    rng = np.random.default_rng(0)
    by_row, by_col, heights = rng.normal(size=(3, 4)), rng.normal(size=(3, 4)), rng.normal(size=(3, 4))

    def misfit(nodes):
        rows, cols = np.diff(nodes, axis=0), np.diff(nodes, axis=1)
        total = sum(((rows[:, k : k + 4] - BLOCK * by_row) ** 2).sum() for k in (0, 1))
        total += sum(((cols[k : k + 3] - BLOCK * by_col) ** 2).sum() for k in (0, 1))
        middle = (nodes[:-1, :-1] + nodes[:-1, 1:] + nodes[1:, :-1] + nodes[1:, 1:]) / 4
        return total + ANCHOR * ((middle - heights) ** 2).sum()

    nodes = integrated(by_row, by_col, BLOCK, heights)
    least = misfit(nodes)
    for at in np.ndindex(nodes.shape):
        for by in (-0.01, 0.01):
            moved = nodes.copy()
            moved[at] += by
            assert misfit(moved) > least


@pytest.mark.parametrize(("by_row", "by_col"), [(1.5, 0.0), (-0.4, 2.0)])
def test_along_a_slope(by_row, by_col):
    """Also where the last blocks are cut off by the tile's border, and at the border, where slopes are unknown."""
    surface = plane(by_row, by_col)
    base = BaseSurface.along(surface, BLOCK)
    rise = BLOCK * max(abs(by_row), abs(by_col))
    assert base.is_steep == (rise > 8)
    away = base.cells - surface
    assert np.ptp(away[BLOCK : 4 * BLOCK, BLOCK : 6 * BLOCK]) < 0.02 * rise
    assert base.cells.dtype == np.float32


def test_a_building_on_level_ground_leaves_the_base_nearly_level():
    surface = np.full(SHAPE, 40.0, np.float32)
    surface[20:43, 30:61] = 130.0
    surface[50:53, 5:100] = 70.0
    base = BaseSurface.along(surface, BLOCK)
    assert max(np.abs(np.diff(base.nodes, axis=axis)).max() for axis in (0, 1)) < 0.5
    assert not base.is_steep


def test_a_jump_in_a_slope_adds_nothing_to_it():
    """A terrace wall across a hill: the base rises by the slope, not by the wall."""
    surface = plane(0.0, 1.0)
    surface[:, 52:] += 60.0
    nodes = BaseSurface.along(surface, BLOCK).nodes
    np.testing.assert_allclose(np.diff(nodes[1:4], axis=1)[:, 1:5], BLOCK, rtol=0, atol=0.1 * BLOCK)


@pytest.mark.parametrize(("shape", "block"), [((37, 70), 16), ((16, 32), 16), ((5, 3), 8), ((1, 9), 4)])
def test_bilinear_values(shape, block):
    nodes = np.random.default_rng(2).normal(0, 50, (-(-shape[0] // block) + 1, -(-shape[1] // block) + 1))
    found = bilinear(nodes, shape, block)
    assert found.dtype == np.float32
    for r, c in np.ndindex(shape):
        b, d, p, q = r // block, c // block, r % block / block, c % block / block
        top = (1 - q) * nodes[b, d] + q * nodes[b, d + 1]
        low = (1 - q) * nodes[b + 1, d] + q * nodes[b + 1, d + 1]
        assert found[r, c] == pytest.approx((1 - p) * top + p * low, abs=FLOAT32_STEPS)


def test_medians_of_blocks():
    """Of the cells there are, in blocks that the border cuts."""
    values = np.random.default_rng(3).normal(size=(37, 21)).astype(np.float32)
    found = block_medians(values, BLOCK)
    assert found.shape == (3, 2)
    for b, d in np.ndindex(3, 2):
        part = values[b * BLOCK : (b + 1) * BLOCK, d * BLOCK : (d + 1) * BLOCK]
        assert found[b, d] == pytest.approx(np.median(part), abs=STEPS)


def test_slopes_of_blocks():
    by_row, by_col = block_slopes(plane(0.25, -0.75), BLOCK)
    assert by_row.shape == by_col.shape == (5, 7)
    np.testing.assert_allclose(by_row[1:-1], 0.25, rtol=0, atol=FLOAT32_STEPS)
    np.testing.assert_allclose(by_col[:, 1:-1], -0.75, rtol=0, atol=FLOAT32_STEPS)
