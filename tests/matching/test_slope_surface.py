"""Slanted support surface: as steep as the ground, without buildings, and projections along it."""

from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import at_all_heights, kernel_scene
from reference.projection import position
from zlocus.matching.kernels.cost_volume import views_of_block
from zlocus.matching.kernels.resample import block_grid, coordinate
from zlocus.matching.slope_surface import DAMPING, PATCH, ROUNDS, CoarserSlope, SlopeSurface, patch_medians, relaxed
from zlocus.matching.tile_views import TileViews

BLOCK = 16
ALL = (slice(0, 1000), slice(0, 1000))
SHAPE = (75, 104)
# Steps of height: rounding of float64 and of float32 heights.
STEPS, FLOAT32_STEPS = 1e-9, 1e-3
# Positions of nodes, px, whose cubics are shifted in float64.
POSITION_PX = 1e-9
# In the middle of a block the product of the twists of the slope and of the projection remains.
SLOPED_MIDDLE_PX = 1e-3
# By how much corners that lie whole steps high may miss the rise of a plane over a patch.
WHOLE_STEPS = 1.0
# Share of the rise of a plane over a block that float32 slopes and their medians cost.
LOST = 2e-3


def plane(by_row, by_col, shape=SHAPE):
    row, col = np.indices(shape)
    return (by_row * row + by_col * col + 40.0).astype(np.float32)


def views_of(scene):
    none = np.zeros(len(scene.pixels), bool)
    holds = np.ones((scene.n_views, *np.subtract(scene.nodes.shape[1:3], 1)), bool)
    return TileViews(scene.pixels, none, np.zeros(scene.n_views, bool), scene.layout, scene.nodes, scene.bends,
                      holds, ~holds, scene.heights, at_all_heights(holds), scene.block)  # fmt: skip


def test_bent_blocks_stay_bent_along_the_slope():
    """In the middle of a block that rises evenly, slope index k is level index k + the mean of its corners."""
    scene = kernel_scene(is_bent=True)
    up = np.random.default_rng(4).uniform(-3, 3, scene.nodes.shape[1:3])
    views = views_of(scene)
    slope_views = SlopeSurface(up, scene.block, scene.shape, scene.block).along(views)
    start, step = scene.heights
    for view in range(scene.n_views):
        for b, d in np.ndindex(scene.nodes.shape[1] - 1, scene.nodes.shape[2] - 1):
            t = start + (7 + up[b : b + 2, d : d + 2].mean()) * step
            node, bend = scene.of_one_block(view, b, d)
            expected = position(node, np.float64(t), scene.block / 2, scene.block / 2, scene.block, bend)
            grid = block_grid(views_of_block(slope_views.arrays, b, d), view, start + 7 * step, 0)
            found = [coordinate(axis, scene.block / 2, scene.block / 2) for axis in grid]
            np.testing.assert_allclose(found, expected, rtol=0, atol=SLOPED_MIDDLE_PX)


def test_views_along_the_slope_take_slope_indices():
    """At a node where the surface has level index `up`, slope index k is level index k + up."""
    scene = kernel_scene()
    up = np.random.default_rng(4).uniform(-30, 30, scene.nodes.shape[1:3])
    slope_surface = SlopeSurface(up, scene.block, scene.shape, scene.block)
    slope_views = slope_surface.along(views_of(scene))
    assert slope_views.nodes.shape == scene.nodes.shape
    start, step = scene.heights
    for view in range(scene.n_views):
        for b, d in np.ndindex(scene.nodes.shape[1] - 1, scene.nodes.shape[2] - 1):
            for k in (-7, 0, 19.25):
                grid = block_grid(views_of_block(slope_views.arrays, b, d), view, start + k * step, 0)
                for i, j in np.ndindex(2, 2):
                    t = start + (k + up[b + i, d + j]) * step
                    r, c = i * scene.block, j * scene.block
                    found = coordinate(grid.x, r, c), coordinate(grid.y, r, c)
                    expected = scene.nodes[view, b + i, d + j] @ t ** np.arange(4)
                    np.testing.assert_allclose(found, expected, rtol=0, atol=POSITION_PX)


@pytest.mark.parametrize("shape", [SHAPE, (64, 72), (5, 9)])
def test_small_blocks_have_the_slope_of_whole_patches(shape):
    """Medians over a few cells would follow noise."""
    surface = plane(0.7, -0.4, shape) + np.random.default_rng(2).normal(size=shape).astype(np.float32)
    small, whole = SlopeSurface.from_surface(surface, PATCH // 2), SlopeSurface.from_surface(surface, PATCH)
    assert small.nodes.shape == tuple(-(-n // (PATCH // 2)) + 1 for n in shape)
    np.testing.assert_allclose(small.cells, whole.cells, rtol=0, atol=FLOAT32_STEPS)


def test_a_flat_surface_changes_nothing():
    scene = kernel_scene()
    views, slope_surface = views_of(scene), SlopeSurface.flat(scene.shape, scene.block)
    assert slope_surface.nodes.shape == scene.nodes.shape[1:3]
    np.testing.assert_array_equal(slope_surface.along(views).nodes, views.nodes)
    assert slope_surface.cells.shape == slope_surface.relief.shape == scene.shape
    assert slope_surface.padded(5).shape == (scene.shape[0] + 10, scene.shape[1] + 10)
    assert (slope_surface.padded(5) == 0).all()
    assert (slope_surface.relief == 0).all()
    assert not slope_surface.is_steep(ALL)


def corners_of(by_row, by_col, shape, patch=PATCH):
    """Heights of the corners of patches of a plane."""
    return patch * (by_row * np.arange(shape[0] + 1)[:, None] + by_col * np.arange(shape[1] + 1)) + 5.0


def test_a_plane_that_has_its_slopes_stays():
    corners = corners_of(0.7, -1.3, (4, 6))
    found = relaxed(corners, np.full((4, 6), 0.7), np.full((4, 6), -1.3), PATCH)
    np.testing.assert_allclose(found, corners, rtol=0, atol=STEPS)


def relaxed_slowly(corners, by_row, by_col, patch):
    """Slow twin of `relaxed`: a corner moves most of the way to the mean of what its neighbours' slopes predict."""
    rows, cols = by_row.shape

    def around(values, patches):
        return np.mean([values[b, d] for b, d in patches if 0 <= b < rows and 0 <= d < cols])

    for _ in range(ROUNDS):
        before = corners.copy()
        for b, d in np.ndindex(corners.shape):
            asked = []
            for up in (-1, 1):
                if 0 <= b + up <= rows:
                    beside = [(min(b, b + up), d - 1), (min(b, b + up), d)]
                    asked.append(before[b + up, d] - up * patch * around(by_row, beside))
                if 0 <= d + up <= cols:
                    beside = [(b - 1, min(d, d + up)), (b, min(d, d + up))]
                    asked.append(before[b, d + up] - up * patch * around(by_col, beside))
            corners[b, d] = before[b, d] + DAMPING * (np.mean(asked) - before[b, d])
    return corners


@pytest.mark.parametrize("shape", [(3, 4), (5, 2), (1, 7), (1, 1)])
def test_slopes_that_no_surface_has_are_shared_out(shape):
    rng = np.random.default_rng(0)
    by_row, by_col = rng.normal(size=shape), rng.normal(size=shape)
    corners = 50 * rng.normal(size=np.add(shape, 1))
    found = relaxed(corners.copy(), by_row, by_col, PATCH)
    np.testing.assert_allclose(found, relaxed_slowly(corners.copy(), by_row, by_col, PATCH), rtol=0, atol=STEPS)


def test_a_corner_depends_on_patches_nearby_only():
    """So that heights do not depend on where a tile ends."""
    rng = np.random.default_rng(3)
    corners, slopes = rng.normal(size=(20, 25)), rng.normal(size=(2, 19, 24))
    other = slopes.copy()
    other[:, 9, 12] += 7.0
    found, moved = (relaxed(corners, *both, PATCH) for both in (slopes, other))
    changed = np.argwhere(found != moved)
    assert changed.min(axis=0).tolist() == [10 - ROUNDS, 13 - ROUNDS]
    assert changed.max(axis=0).tolist() == [9 + ROUNDS, 12 + ROUNDS]


@pytest.mark.parametrize(("row", "col"), [(0.0, 0.0), (-16.0, -4.5)])
def test_the_coarser_slope_on_finer_cells(row, col):
    """A plane of the coarser level, continued: in cells half as large, and steps half as high."""
    coarse = SlopeSurface(corners_of(0.6, -0.2, (6, 7)), PATCH, (48, 56), PATCH)
    found = CoarserSlope(coarse, row, col).corners((9, 11), PATCH)
    down, across = ((np.arange(n + 1) * PATCH + 0.5) / 2 - 0.5 - first for n, first in ((9, row), (11, col)))
    np.testing.assert_allclose(found, 2 * (0.6 * down[:, None] - 0.2 * across + 5.0), rtol=0, atol=STEPS)


def test_long_slopes_are_those_of_the_coarser_level():
    """Where the surface is level, as far as its patches tell, the slope that the coarser level found stays."""
    coarse = SlopeSurface(corners_of(0.0, 0.5, (10, 10)), PATCH, (80, 80), PATCH)
    slope_surface = SlopeSurface.from_surface(
        np.full((64, 96), 40.0, np.float32), BLOCK, CoarserSlope(coarse, 0.0, 0.0)
    )
    middle = np.diff(slope_surface.patch_corners, axis=1)[2:-2, 5:-5]
    assert (slope_surface.patch_corners == np.rint(slope_surface.patch_corners)).all()
    np.testing.assert_allclose(middle, PATCH * 0.5, rtol=0, atol=WHOLE_STEPS)


@pytest.mark.parametrize("block", [16, 32, 12])
@pytest.mark.parametrize(("by_row", "by_col"), [(1.5, 0.0), (-0.4, 2.0)])
def test_the_surface_follows_a_slope_everywhere(by_row, by_col, block):
    """Also where the border cuts the last blocks, and where no slope is known."""
    surface = plane(by_row, by_col)
    slope_surface = SlopeSurface.from_surface(surface, block)
    rise = block * max(abs(by_row), abs(by_col))
    assert slope_surface.is_steep(ALL) == (rise > 8)
    for axis, slope in enumerate((by_row, by_col)):
        np.testing.assert_allclose(
            np.diff(slope_surface.cells, axis=axis), slope, rtol=0, atol=WHOLE_STEPS / slope_surface.patch
        )
    # Whole steps are all that it misses the plane by, from one end to the other.
    n_patches = np.subtract(slope_surface.patch_corners.shape, 1)
    away = slope_surface.patch_corners - corners_of(by_row, by_col, n_patches, slope_surface.patch)
    assert np.ptp(away) <= WHOLE_STEPS + LOST * rise
    assert slope_surface.cells.shape == SHAPE
    assert slope_surface.cells.dtype == np.float32


def hillside(wavelength=64.0, height=8.0):
    """A slope with folds that are too short for blocks of 32 cells, not for patches."""
    row, col = np.indices((160, 192))
    folds = height * np.sin(2 * np.pi * (col + 0.5 * row) / wavelength)
    return (0.8 * row - 0.5 * col + folds).astype(np.float32)


def test_patches_follow_a_rough_hillside():
    """The slope that remains above the surface is at most two fifths of what whole blocks would leave."""
    surface = hillside()
    slope_surface = SlopeSurface.from_surface(surface, 32)

    def left_over(cells):
        by_row, by_col = np.gradient((cells - surface)[16:-16, 16:-16])
        return np.hypot(by_row, by_col).mean()

    by_patches, by_blocks = left_over(slope_surface.cells), left_over(slope_surface.cells - slope_surface.relief)
    assert by_blocks > 0.3
    assert by_patches < 0.4 * by_blocks


def test_relief_is_what_lies_above_the_corners_of_blocks():
    slope_surface = SlopeSurface.from_surface(hillside()[:150, :187], 32)
    relief = slope_surface.relief
    assert slope_surface.nodes.shape == (6, 7)
    assert slope_surface.patch_corners.shape == (21, 25)
    assert (relief[::32, ::32] == 0).all()
    assert np.abs(relief).max() > 3
    for r, c in ((5, 9), (33, 64), (31, 100), (149, 186)):
        b, d, p, q = r // 32, c // 32, r % 32 / 32, c % 32 / 32
        top = (1 - q) * slope_surface.nodes[b, d] + q * slope_surface.nodes[b, d + 1]
        low = (1 - q) * slope_surface.nodes[b + 1, d] + q * slope_surface.nodes[b + 1, d + 1]
        blocks = (1 - p) * top + p * low
        assert relief[r, c] == pytest.approx(slope_surface.cells[r, c] - blocks, abs=FLOAT32_STEPS)


def test_a_block_that_patches_do_not_divide_is_one_patch():
    slope_surface = SlopeSurface.from_surface(hillside(), 12)
    assert slope_surface.patch == slope_surface.block == 12
    np.testing.assert_array_equal(slope_surface.nodes, slope_surface.patch_corners)
    assert (slope_surface.relief == 0).all()
    assert np.ptp(slope_surface.cells) > 50


def test_a_tile_too_small_to_know_slopes_is_level():
    surface = np.random.default_rng(1).normal(0, 30, (8, 5)).astype(np.float32)
    slope_surface = SlopeSurface.from_surface(surface, BLOCK)
    assert slope_surface.cells.shape == (8, 5)
    assert np.ptp(slope_surface.cells) < FLOAT32_STEPS


def level_above(by_col=0.0):
    """The slanted support surface of the coarser level on half as many cells as `SHAPE`."""
    shape = (SHAPE[0] // 2 + 1, SHAPE[1] // 2)
    n_patches = [-(-n // PATCH) for n in shape]
    return CoarserSlope(SlopeSurface(corners_of(0.0, by_col, n_patches), PATCH, shape, PATCH), 0.0, 0.0)


@pytest.mark.parametrize("above", ["level", None])
def test_a_building_on_level_ground_leaves_the_surface_nearly_level(above):
    surface = np.full(SHAPE, 40.0, np.float32)
    surface[20:43, 30:61] = 130.0
    surface[50:53, 5:100] = 70.0
    slope_surface = SlopeSurface.from_surface(surface, BLOCK, level_above() if above else None)
    assert max(np.abs(np.diff(slope_surface.nodes, axis=axis)).max() for axis in (0, 1)) < 0.5
    assert np.abs(slope_surface.relief).max() < 0.5
    assert not slope_surface.is_steep(ALL)


def test_a_jump_in_a_slope_adds_nothing_to_it():
    """A terrace wall across a hill: the surface rises by the slope, not by the wall."""
    surface = plane(0.0, 1.0)
    surface[:, 52:] += 60.0
    nodes = SlopeSurface.from_surface(surface, BLOCK, level_above(by_col=1.0)).nodes
    np.testing.assert_allclose(np.diff(nodes[1:4], axis=1)[:, 1:5], BLOCK, rtol=0, atol=0.1 * BLOCK)


@pytest.mark.parametrize("half", [0, 1, 5])
@pytest.mark.parametrize(("shape", "patch"), [((37, 70), 16), ((16, 32), 16), ((5, 3), 8), ((1, 9), 4)])
def test_values_of_cells_and_of_their_border(shape, patch, half):
    """Bilinear between the corners of patches, and on from the outermost ones."""
    n_b, n_d = (-(-n // patch) for n in shape)
    corners = np.random.default_rng(2).normal(0, 50, (n_b + 1, n_d + 1))
    slope_surface = SlopeSurface(corners, patch, shape, patch)
    found = slope_surface.padded(half)
    assert found.dtype == np.float32
    assert found.shape == (shape[0] + 2 * half, shape[1] + 2 * half)
    np.testing.assert_array_equal(found[half : half + shape[0], half : half + shape[1]], slope_surface.cells)
    for r, c in np.ndindex(found.shape):
        row, col = r - half, c - half
        b, d = min(max(row // patch, 0), n_b - 1), min(max(col // patch, 0), n_d - 1)
        p, q = row / patch - b, col / patch - d
        top = (1 - q) * corners[b, d] + q * corners[b, d + 1]
        low = (1 - q) * corners[b + 1, d] + q * corners[b + 1, d + 1]
        assert found[r, c] == pytest.approx((1 - p) * top + p * low, abs=FLOAT32_STEPS)


def test_medians_of_patches():
    """Patches that the border cuts have the median of their remaining cells."""
    values = np.random.default_rng(3).normal(size=(37, 21)).astype(np.float32)
    found = patch_medians(values, PATCH)
    assert found.shape == (5, 3)
    for b, d in np.ndindex(5, 3):
        part = values[b * PATCH : (b + 1) * PATCH, d * PATCH : (d + 1) * PATCH]
        assert found[b, d] == pytest.approx(np.median(part), abs=1e-6)
