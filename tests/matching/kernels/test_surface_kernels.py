"""Visibility, reach, smoothing, profiles along a surface and the ortho-image against their slow twins."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, spline_filter

from kernel_scene import HIDDEN, even_lattice, kernel_scene
from reference import agreement, surfaces
from reference.projection import bilinear, cubic, positions
from zlocus.matching.kernels.cost_volume import flat_cells, plane_grid
from zlocus.matching.kernels.coverage import block_reach, surely_covered, tile_reach
from zlocus.matching.kernels.occlusion import count_seeing, finest_view, hide_below, lowest_visible
from zlocus.matching.kernels.resample import RUN
from zlocus.matching.kernels.smooth import add_tap, slopes, smaller_slope, smooth_surface
from zlocus.matching.kernels.subpixel import CUBIC, LINEAR, block_profile, resample_surface, tile_ortho, tile_profile

# Float32 images with a spread of 1.4 grey values.
GREY = 1e-4
# Three grids stand for the cubic in height.
NCC = 1e-3
STEPS = 1e-4


def rough_surface(shape, seed=0, high=25.0):
    rng = np.random.default_rng(seed)
    return (rng.integers(0, 2, shape) * high * rng.random(shape)).astype(np.float32)


def visible_from(surface, by_col, by_row):
    out = np.empty(surface.shape, np.float32)
    lowest_visible(surface, by_col, by_row, out)
    return out


@pytest.mark.parametrize("direction", [(0.5, 0.0), (-0.5, 0.0), (0.0, 2.0), (0.0, -0.25), (1.0, 1.0), (-1.0, 1.0)])
def test_lowest_visible_along_rows_columns_and_diagonals(direction):
    surface = rough_surface((37, 53))
    expected = surfaces.marched(surface.astype(float), *direction)
    found = visible_from(surface, *direction)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("direction", [(0.5, 0.2), (-0.3, 1.0), (0.7, -0.69), (-1.5, -0.1)])
def test_lowest_visible_in_any_direction(direction):
    """A hill 60 high. Between two rays their bounds are interpolated again at every cell: tops lose a little."""
    row, col = np.indices((57, 73))
    hill = (60 * np.exp(-((row - 28) ** 2 + (col - 36) ** 2) / 100)).astype(np.float32)
    found, expected = visible_from(hill, *direction), surfaces.marched(hill.astype(float), *direction)
    hidden = expected > hill
    assert hidden.sum() > 50
    assert np.abs(found - expected)[hidden].max() < 3.5


def test_a_nadir_view_sees_everything():
    assert (visible_from(rough_surface((9, 12)), 0.0, 0.0) == np.float32(-1e30)).all()


def test_a_tower_hides_what_its_shadow_covers():
    """20 high, view gains 2 per cell: hidden behind it 18, 16, ... down to 0 after ten cells."""
    surface = np.zeros((5, 30), np.float32)
    surface[:, 20] = 20.0
    found = visible_from(surface, 0.5, 0.0)[2]
    np.testing.assert_allclose(found[10:20], np.arange(0.0, 20.0, 2.0))
    assert (found[:9] < 0).all()


def any_seen(n_views, shape, seed=0):
    """(3, i, r, c), ranges of height indices that meet, touch or miss a surface of heights 0 to 9; some cover none."""
    rng = np.random.default_rng(seed)
    seen = rng.integers(0, 10, (3, n_views, *shape)).astype(np.int32)
    seen[1] += seen[0] - 2
    seen[0][seen[1] < seen[0]] = HIDDEN
    return seen, np.round(rng.uniform(0, 9, shape) * 2).astype(np.float32) / 2


def test_views_that_see_a_surface():
    seen, surface = any_seen(3, (11, 14))
    found = np.full(surface.shape, -7, np.int32)
    count_seeing(seen, surface, found)
    for at in np.ndindex(surface.shape):
        low, high, visible = seen[:, :, *at]
        assert found[at] == sum(max(a, v) <= surface[at] <= b for a, b, v in zip(low, high, visible, strict=True))
    assert set(found.ravel().tolist()) == {0, 1, 2, 3}


def test_the_finest_view_of_those_that_see_a_cell():
    """Blocks of 4 cells; of equal sizes the first; a cell that has a view already keeps it."""
    (seen, surface), block = any_seen(4, (11, 14)), 4
    size = np.random.default_rng(1).integers(0, 4, (4, 3, 4)).astype(float)
    size[0, 0, 0] = np.nan
    found = np.full(surface.shape, -1, np.int32)
    found[5, :] = 9
    finest_view(size, seen, surface, block, found)
    for r, c in np.ndindex(surface.shape):
        low, high, visible = seen[:, :, r, c]
        sees = (np.maximum(low, visible) <= surface[r, c]) & (surface[r, c] <= high)
        of_view = np.where(sees, np.nan_to_num(size[:, r // block, c // block]), 0)
        assert found[r, c] == (9 if r == 5 else of_view.argmax() if of_view.max() > 0 else -1)
    assert {-1, 0, 1, 2, 3} <= set(found.ravel().tolist())


def test_height_indices_from_which_nothing_hides_a_cell():
    """Of a part of the tile, which begins at row 2 and column 3 of a wider surface; other cells stay."""
    rng, least = np.random.default_rng(0), np.float32(-(2**29))
    lowest, base = rng.uniform(-9, 9, (12, 15)).astype(np.float32), rng.uniform(-3, 3, (8, 10)).astype(np.float32)
    lowest[4, 5] = -1e30
    out = np.full(base.shape, 77, np.int32)
    hide_below(lowest, np.array([2, 3]), base, np.float32(1.5), least, np.array([[1, 6], [2, 10]]), out)
    expected = np.full(base.shape, 77)
    expected[1:6, 2:10] = np.floor(np.maximum(lowest[3:8, 5:13] - base[1:6, 2:10] - 1.5, least))
    np.testing.assert_array_equal(out, expected)
    assert out[2, 2] == -(2**29)


def test_rows_and_columns_of_a_block():
    rows, cols = np.indices((3, 5))
    np.testing.assert_array_equal(flat_cells((3, 5)), [rows.ravel(), cols.ravel()])


EVERYWHERE = np.array([-(2**29), 2**29])


def reached(scene, lattice, blocked=None, relief=None, limits=None):
    every = EVERYWHERE[:, None, None, None] + np.zeros((scene.n_views, *lattice.ranges.shape[1:]), np.int64)
    limits = every if limits is None else limits
    relief = np.zeros(scene.shape, np.float32) if relief is None else relief
    blocked = np.zeros(len(scene.pixels), bool) if blocked is None else blocked
    has = np.array([blocked[o : o + r * c].any() for o, r, c in scene.layout])
    seen = np.empty((2, scene.n_views, *scene.shape), np.int32)
    tile_reach(
        blocked, has, scene.layout, scene.nodes, scene.heights, lattice.ranges, limits, scene.block, 3.0, relief,
        seen[0], seen[1],
    )  # fmt: skip
    return seen


@pytest.mark.parametrize(("n_views", "shape", "block"), [(3, (37, 70), 16), (2, (45, 90), 32), (2, (5, 7), 8)])
@pytest.mark.parametrize("with_holes", [False, True])
def test_reach(n_views, shape, block, with_holes):
    scene, lattice = kernel_scene(n_views, shape, block), even_lattice(32, shape, block, first=3)
    blocked = np.zeros(len(scene.pixels), bool)
    if with_holes:
        for offset, rows, cols in scene.layout[:2]:
            blocked[offset : offset + rows * cols].reshape(rows, cols)[20:26, 15:33] = True
    seen = reached(scene, lattice, blocked)
    ends = 0
    for b, d, rows, cols in scene.blocks():
        for i in range(n_views):
            node, cells = scene.nodes[i, b : b + 2, d : d + 2], (rows.stop - rows.start, cols.stop - cols.start)
            good = np.stack([covers(scene, i, node, cells, k, blocked) for k in range(3, 35)], axis=-1)
            for r, c in np.ndindex(cells):
                run = surfaces.longest_run(good[r, c])
                expected = (HIDDEN, -1) if run is None else (run[0] + 3, run[1] + 3)
                assert tuple(seen[:, i, rows.start + r, cols.start + c]) == expected
                ends += run is not None and run != (0, 31)
    assert ends > 0 or shape == (5, 7)


def test_reach_whatever_index_heights_start_at():
    """Heights below the base surface have negative indices: the same heights, numbered from 20 lower."""
    scene = kernel_scene()
    blocked = np.zeros(len(scene.pixels), bool)
    blocked[: 61 * 97].reshape(61, 97)[15:40, 30:60] = True
    plain = reached(scene, even_lattice(32, first=3), blocked)
    moved = replace(scene, heights=scene.heights + np.array([20 * scene.heights[1], 0.0]))
    lower = reached(moved, even_lattice(32, first=-17), blocked)
    never = plain[0] == HIDDEN
    assert 0 < never.sum() < never.size / 2
    np.testing.assert_array_equal(lower[0] == HIDDEN, never)
    np.testing.assert_array_equal(lower[:, ~never], plain[:, ~never] - 20)
    assert (lower[0] > lower[1])[never].all()


def test_reach_ends_where_tables_do():
    """Runs are looked for between the limits of each block and view, and nowhere where the lower one is above."""
    scene, lattice = kernel_scene(), even_lattice(32, first=3)
    limits = np.random.default_rng(2).integers(0, 40, (2, scene.n_views, *lattice.ranges.shape[1:]))
    seen, empty = reached(scene, lattice, limits=limits), 0
    for number, (b, d, rows, cols) in enumerate(scene.blocks()):
        for i in range(scene.n_views):
            low, high = limits[:, i, *np.unravel_index(number, limits.shape[2:])]
            node, cells = scene.nodes[i, b : b + 2, d : d + 2], (rows.stop - rows.start, cols.stop - cols.start)
            inside = [covers(scene, i, node, cells, k, np.zeros(len(scene.pixels), bool)) for k in range(3, 35)]
            good = np.stack([at & (low <= k <= high) for k, at in zip(range(3, 35), inside, strict=True)], axis=-1)
            for r, c in np.ndindex(cells):
                run = surfaces.longest_run(good[r, c])
                expected = (HIDDEN, -1) if run is None else (run[0] + 3, run[1] + 3)
                assert tuple(seen[:, i, rows.start + r, cols.start + c]) == expected
                empty += low > high
    assert empty > 0


def test_ends_of_reach_follow_the_relief():
    """A run that ends at the image's border ends by as much lower as the surface stands higher there; one that ends
    with the block's heights stays."""
    scene, lattice = kernel_scene(), even_lattice(32, first=3)
    relief = np.random.default_rng(3).uniform(-6.0, 6.0, scene.shape).astype(np.float32)
    plain, moved = reached(scene, lattice), reached(scene, lattice, relief=relief)
    never, from_below, from_above = plain[0] > plain[1], plain[0] > 3, plain[1] < 34
    for some in (from_below & ~never, from_above & ~never, ~from_below & ~from_above):
        assert some.any()
    low = np.where(from_below & ~never, np.ceil(plain[0] - relief), plain[0])
    high = np.where(from_above & ~never, np.floor(plain[1] - relief), plain[1])
    np.testing.assert_array_equal(moved, [low, high])


def covers(scene, i, node, cells, k, blocked):
    """Whether the cells of a block fall on a usable pixel at height index k, three from the border."""
    x, y = np.moveaxis(positions(node, scene.heights[0] + k * scene.heights[1], cells, scene.block), -1, 0)
    offset, rows, cols = scene.layout[i]
    inside = (x >= 3) & (x <= cols - 4) & (y >= 3) & (y <= rows - 4)
    hole = blocked[offset : offset + rows * cols].reshape(rows, cols)
    at = (np.clip((y + 0.5).astype(int), 0, rows - 1), np.clip((x + 0.5).astype(int), 0, cols - 1))
    return inside & ~hole[at]


def test_reach_of_one_block_and_its_shortcut():
    scene = kernel_scene(2, (8, 8), 8)
    blocked = np.zeros(len(scene.pixels), bool)
    assert surely_covered(scene.nodes, 0, -0.5, 0.5, 8, 3.0, scene.layout[0], blocked, False)
    assert surely_covered(scene.nodes, 0, -0.5, 0.5, 8, 3.0, scene.layout[0], blocked, True)
    assert not surely_covered(scene.nodes, 0, -9.0, 0.5, 8, 3.0, scene.layout[0], blocked, False)
    for t in (-0.5, 0.0, 0.5):
        at = positions(scene.nodes[0, :2, :2], t, (8, 8), 8)[4, 4].astype(int)
        blocked[:] = False
        blocked[at[1] * scene.layout[0, 2] + at[0]] = True
        assert not surely_covered(scene.nodes, 0, -0.5, 0.5, 8, 3.0, scene.layout[0], blocked, True)
    lowest, highest = np.empty((2, 2, 8, 8), np.int32)
    block_reach(
        np.zeros(len(scene.pixels), bool), np.zeros(2, bool), scene.layout, scene.nodes, scene.heights,
        np.array([0, 16]), EVERYWHERE[:, None].repeat(2, axis=1), 8, 3.0, lowest, highest,
    )  # fmt: skip
    assert (lowest == 0).all()
    assert (highest == 15).all()


def slopes_of(surface, reach=2):
    by_row, by_col = np.empty_like(surface), np.empty_like(surface)
    slopes(surface, reach, by_row, by_col)
    return by_row, by_col


@pytest.mark.parametrize(("spacing", "jump"), [(1, 3.0), (2, 4.0), (8, 50.0)])
def test_smoothing(spacing, jump):
    surface = rough_surface((23, 31), high=6.0) + 100
    by_row, by_col = slopes_of(surface)
    out = np.empty_like(surface)
    smooth_surface(surface, by_row, by_col, spacing, np.float32(jump), out)
    expected = surfaces.smoothed(*(v.astype(float) for v in (surface, by_row, by_col)), spacing, jump)
    np.testing.assert_allclose(out, expected, rtol=0, atol=STEPS)


def test_the_smaller_slope():
    for before, after, expected in (
        (1, 2, 1), (2, 1, 1), (-3, -2, -2), (-2, -3, -2), (1, -1, 0), (-1, 1, 0), (0, 5, 0), (5, 0, 0),
    ):  # fmt: skip
        assert smaller_slope(np.float32(before), np.float32(after)) == expected


def test_one_neighbour_of_a_row():
    """A neighbour two rows down and one column left, 0.3 of the weight; beyond the jump of 4 it counts for nothing."""
    rng = np.random.default_rng(2)
    centre, other, by_row, by_col = rng.normal(0, 2, (4, 40)).astype(np.float32)
    total, weight = np.ones(40, np.float32), np.full(40, 0.5, np.float32)
    add_tap(centre, other, by_row, by_col, np.array([0.3, 2, -1], np.float32), np.float32(0.25), total, weight)
    away = other - centre - 2 * by_row + by_col
    expected = np.where(np.abs(away) < 4, 0.3 * (1 - (away / 4) ** 2) ** 2, 0)
    assert 0 < (expected == 0).sum() < 40
    np.testing.assert_allclose(weight, 0.5 + expected, rtol=0, atol=STEPS)
    np.testing.assert_allclose(total, 1 + expected * away, rtol=0, atol=STEPS)


@pytest.mark.parametrize("reach", [1, 2])
def test_slopes(reach):
    surface = rough_surface((17, 22), high=6.0)
    for axis, found in enumerate(slopes_of(surface, reach)):
        np.testing.assert_allclose(found, surfaces.slope(surface.astype(float), reach, axis), rtol=0, atol=STEPS)


def test_smoothing_keeps_planes_and_jumps():
    row, col = np.indices((20, 30))
    surface = (0.2 * row + 0.1 * col + 10.0 * (col >= 15)).astype(np.float32)
    out = np.empty_like(surface)
    smooth_surface(surface, *slopes_of(surface, 1), 1, np.float32(3.0), out)
    np.testing.assert_allclose(out[3:-3, 3:12], surface[3:-3, 3:12], rtol=0, atol=STEPS)
    assert np.abs(out - surface)[3:-3, 3:-3].max() < 0.5


def coefficients(scene):
    """Cubic B-spline coefficients of all images, one after the other."""
    return np.concatenate([spline_filter(i, 3, output=np.float32, mode="mirror").ravel() for i in scene.images])


@pytest.mark.parametrize("degree", [LINEAR, CUBIC])
def test_values_on_a_surface(degree):
    """Positions quadratic in the level are given by three grids; values are those of the interpolating B-spline, or
    bilinear. More cells than are taken at a time."""
    scene, shape = kernel_scene(2, (30, 31), 32), (30, 31)
    grids, level = np.empty((3, 8)), np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    node = scene.nodes[1].copy()
    node[..., 3] = 0.0
    for m in range(3):
        plane_grid(node[None], 0, 0.3 * (m - 1), 32, 0, grids[m])
    out, pixels = np.empty(level.size, np.float32), scene.pixels if degree == LINEAR else coefficients(scene)
    assert level.size > RUN
    resample_surface(pixels, scene.layout[1], grids, flat_cells(shape), level.ravel(), degree, out)
    value = bilinear if degree == LINEAR else cubic
    expected = value(scene.images[1], positions(node, 0.3 * level.astype(float), shape, 32))
    np.testing.assert_allclose(out.reshape(shape), expected, rtol=0, atol=GREY)


@pytest.mark.parametrize(("n_views", "half"), [(2, 2), (4, 3)])
def test_profiles(n_views, half):
    scene = kernel_scene(n_views, (20, 26), 16)
    shape = (20 + 2 * half, 26 + 2 * half)
    surface = (15 + 4 * gaussian_filter(np.random.default_rng(1).normal(size=shape), 3)).astype(np.float32)
    offsets = np.array([-1.5, 0.0, 0.7], np.float32)
    seen = scene.all_seen()
    seen[0, 1, 3:9], seen[1, 0, :, :5] = HIDDEN, 3
    windows = np.array([1, half])
    groups = np.empty((2, 2, 3, *scene.shape), np.float32)
    tile_profile(
        coefficients(scene), CUBIC, scene.layout, scene.nodes, scene.heights, surface, offsets, scene.block, windows,
        seen, np.float32(0.0), groups,
    )  # fmt: skip
    out = groups.sum(axis=1)
    for (b, d, rows, cols), (w, window) in product(scene.blocks(), enumerate(windows)):
        trim = half - window
        around = surface[
            rows.start + trim : rows.stop + half + window, cols.start + trim : cols.stop + half + window
        ].astype(float)
        nodes = scene.nodes[:, b : b + 2, d : d + 2]
        for j, offset in enumerate(offsets):
            expected = agreement.profile(
                scene.images, nodes, scene.heights, around, offset, scene.block, window, seen[:, :, rows, cols]
            )
            np.testing.assert_allclose(out[w, j, rows, cols], expected, rtol=0, atol=NCC)
            for group in range(2):
                expected = agreement.profile(
                    scene.images, nodes, scene.heights, around, offset, scene.block, window, seen[:, :, rows, cols],
                    group=(group, 2),
                )  # fmt: skip
                np.testing.assert_allclose(groups[w, group, j, rows, cols], expected, rtol=0, atol=NCC)
    if n_views == 2:
        assert (out[:, :, 3:9] == 0).all()


def test_profile_of_one_block():
    scene = kernel_scene(3, (9, 11), 16)
    surface, out = np.full((13, 15), 12, np.float32), np.empty((1, 1, 1, 9, 11), np.float32)
    block_profile(
        coefficients(scene), CUBIC, scene.layout, scene.nodes, scene.heights, surface, np.zeros(1, np.float32), 16,
        np.array([2]), scene.all_seen(), np.float32(0.0), out,
    )  # fmt: skip
    expected = agreement.profile(
        scene.images, scene.nodes, scene.heights, surface.astype(float), 0.0, 16, 2, scene.all_seen()
    )
    np.testing.assert_allclose(out[0, 0, 0], expected, rtol=0, atol=1e-3)


def test_ortho_image():
    scene = kernel_scene(3)
    surface = (15 + 6 * gaussian_filter(np.random.default_rng(1).normal(size=scene.shape), 3)).astype(np.float32)
    out = np.empty(scene.shape, np.float32)
    for view in range(3):
        nodes = scene.nodes.copy()
        nodes[..., 3] = 0.0  # three grids stand for a quadratic exactly
        tile_ortho(scene.pixels, scene.layout, nodes, scene.heights, surface, view, scene.block, out)
        for b, d, rows, cols in scene.blocks():
            t = scene.heights[0] + surface[rows, cols].astype(float) * scene.heights[1]
            xy = positions(nodes[view, b : b + 2, d : d + 2], t, t.shape, scene.block)
            inside = (xy > 0).all(axis=-1) & (xy < np.array(scene.images[view].shape[::-1]) - 1.1).all(axis=-1)
            expected = bilinear(scene.images[view], xy)
            np.testing.assert_allclose(out[rows, cols][inside], expected[inside], rtol=0, atol=GREY)
