"""Resampling, NCC and the cost volume against their slow twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernel_scene import HIDDEN, even_lattice, kernel_scene, ragged_lattice
from reference import agreement as twin
from reference.projection import along_base, base_relief, bilinear, derivative, position, positions
from reference.semiglobal import dense
from zlocus.matching.kernels.cost_volume import (
    NOTHING,
    WHOLE,
    block_costs,
    block_relief,
    extent_at,
    flat_cells,
    flat_visibility,
    height_ranges,
    hide,
    plane_grid,
    plane_velocity,
    shown_at,
    taking_part,
    tile_costs,
    whole_views,
)
from zlocus.matching.kernels.ncc import (
    SLACK,
    add_closeness,
    add_pairs,
    column_moments,
    column_products,
    row_sums,
    window_moments,
)
from zlocus.matching.kernels.resample import resample_plane

# Bilinear values of images with a spread of 1.4 grey values: positions are float32 within some 60 px of their origin.
GREY = 1e-4
# Float32 sums of 25 products of values near 1.
NCC = 2e-5
# A cost is a whole number; where its plain value is near a half, rounding may fall either way.
COST = 0.51
# px: speeds change by 0.06 px per t within ten cells of the middle of a block of `kernel_scene`, a relief of 1.5 steps
# is 0.09 t; half a thousandth more for the curve.
BENT = 6e-3
HALVES = np.array([1, 2])
# Variance added to windows, weight and reach of grey differences, share of hidden pairs that is excused, weight where
# two views take part.
PLAIN, GREYS = (0.0, 0.0, 1.0, 0.0, 0.0), (0.02, 0.8, 1.5, 0.4, 0.3)


def bases(scene, half, bumps=1.5, seed=0):
    """Base surface with a border, and at the corners of blocks; apart from each other by up to `bumps` steps."""
    rng = np.random.default_rng(seed)
    nodes = rng.normal(0.0, 3.0, scene.nodes.shape[1:3])
    shape = (scene.shape[0] + 2 * half, scene.shape[1] + 2 * half)
    surface = rng.uniform(-bumps, bumps, shape)
    for r in range(shape[0]):
        for c in range(shape[1]):
            b, d = (min(max(k - half, 0) // scene.block, n - 2) for k, n in zip((r, c), nodes.shape, strict=True))
            u, v = (r - half) / scene.block - b, (c - half) / scene.block - d
            k = nodes[b : b + 2, d : d + 2]
            surface[r, c] += (1 - u) * ((1 - v) * k[0, 0] + v * k[0, 1]) + u * ((1 - v) * k[1, 0] + v * k[1, 1])
    return surface.astype(np.float32), nodes


def costs(scene, lattice, seen, halves=HALVES, measure=PLAIN, bumps=0.0):
    return costs_along(*bases(scene, max(halves), bumps), scene, lattice, seen, halves, measure, len(scene.layout))


def costs_along(base, base_nodes, scene, lattice, seen, halves, measure, few):
    volume = np.zeros(lattice.size, np.uint8)
    tile_costs(
        scene.pixels, scene.layout, scene.nodes, scene.heights, base, base_nodes, lattice.ranges, lattice.address,
        halves, seen, scene.block, with_few(measure, few), volume,
    )  # fmt: skip
    return volume


def with_few(measure, few):
    """As kernels take it: the fifth is the most views of a block that takes all windows."""
    return np.array([*measure[:4], few, *measure[4:]], np.float32)


def twin_costs(scene, lattice, seen, halves=HALVES, measure=PLAIN, bumps=0.0):
    """(r, c, h), infinite where a cell does not search."""
    first, count = lattice.cell_ranges()
    base, base_nodes = bases(scene, max(halves), bumps)
    out = np.full((*scene.shape, int((first + count).max())), np.inf)
    for b, d, rows, cols in scene.blocks():
        nodes, corners = scene.nodes[:, b : b + 2, d : d + 2], base_nodes[b : b + 2, d : d + 2]
        relief = base_relief(base, corners, rows, cols, scene.block, max(halves))
        for k in range(lattice.first[b, d], lattice.first[b, d] + lattice.count[b, d]):
            out[rows, cols, k] = twin.cell_costs(
                scene.images, nodes, scene.heights, k, scene.block, halves, seen[:, :, rows, cols], measure, relief
            )
    return np.where(np.isfinite(out), np.clip(out, 0, 255), np.inf)


def partly_seen(scene, seed=1):
    """Random heights covered and hidden, some cells covered by no view at all."""
    rng = np.random.default_rng(seed)
    seen = scene.all_seen()
    seen[0] = rng.integers(0, 14, seen[0].shape)
    seen[1] = seen[0] + rng.integers(2, 40, seen[1].shape)
    nothing = rng.random(seen[0].shape) < 0.3
    seen[0][nothing], seen[1][nothing] = HIDDEN, -1
    seen[2] = rng.integers(0, 20, seen[2].shape)
    return seen


def resampled(scene, view, b, d, t, relief, half, run=100):
    nodes, cells = scene.nodes[:, b : b + 2, d : d + 2], flat_cells(relief.shape)
    grid, velocity = np.empty(8), np.empty(2, np.float32)
    plane_grid(nodes, view, t, scene.block, half, grid)
    plane_velocity(nodes, view, t, scene.heights[1], velocity)
    out, index, fraction = np.empty(relief.size, np.float32), np.empty(run, np.uint32), np.empty((2, run), np.float32)
    resample_plane(
        scene.pixels, scene.layout[view], grid, cells, relief.ravel(), velocity, index, fraction,
        np.empty((2, run), np.complex64), out,
    )  # fmt: skip
    return out.reshape(relief.shape)


@pytest.mark.parametrize("bumps", [0.0, 1.5])
@pytest.mark.parametrize("half", [0, 2])
@pytest.mark.parametrize("t", [-1.0, 0.37, 1.4])
def test_resampled_planes(half, t, bumps):
    """Also of cells that project outside the image: they get its border."""
    scene = kernel_scene()
    rng = np.random.default_rng(8)
    for view in range(scene.n_views):
        for b, d, rows, cols in scene.blocks():
            cells = (rows.stop - rows.start, cols.stop - cols.start)
            relief = rng.uniform(-bumps, bumps, (cells[0] + 2 * half, cells[1] + 2 * half)).astype(np.float32)
            node = scene.nodes[view, b : b + 2, d : d + 2]
            xy = along_base(node, t, relief, scene.heights[1], cells, scene.block, half)
            found = resampled(scene, view, b, d, t, relief, half)
            np.testing.assert_allclose(found, bilinear(scene.images[view], xy), rtol=0, atol=GREY)


@pytest.mark.parametrize("t", [-1.0, 0.37, 1.4])
def test_relief_moves_cells_to_their_own_heights(t):
    """An image of columns, then one of rows: what is resampled there is the position itself."""
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
    scene, velocity, h = kernel_scene(), np.empty(2, np.float32), 1e-5
    for view in range(scene.n_views):
        node, middle = scene.nodes[view, 1:3, 2:4], scene.block / 2
        plane_velocity(scene.nodes[:, 1:3, 2:4], view, 0.4, scene.heights[1], velocity)
        ends = [position(node, np.float64(0.4 + s * h), middle, middle, scene.block) for s in (-1, 1)]
        by_index = (ends[1] - ends[0]) / (2 * h) * scene.heights[1]
        np.testing.assert_allclose(velocity, by_index, rtol=1e-5)
        exact = position(derivative(node), np.float64(0.4), middle, middle, scene.block)
        np.testing.assert_allclose(velocity, exact * scene.heights[1], rtol=1e-6)


@pytest.mark.parametrize("half", [0, 3])
def test_relief_of_a_block(half):
    scene = kernel_scene()
    base, nodes = bases(scene, half, seed=4)
    for b, d, rows, cols in scene.blocks():
        corners = nodes[b : b + 2, d : d + 2]
        part = base[rows.start : rows.stop + 2 * half, cols.start : cols.stop + 2 * half]
        found = np.empty(part.shape, np.float32)
        block_relief(part, corners, scene.block, half, found)
        expected = base_relief(base, corners, rows, cols, scene.block, half)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_grid_of_a_block_is_its_projection():
    scene, half = kernel_scene(), 3
    grid = np.empty(8)
    plane_grid(scene.nodes[:, 1:3, 2:4], 1, 0.4, scene.block, half, grid)
    for r, c in ((0, 0), (0, 20), (21, 0), (17, 9)):
        xy = grid[:2] + c * grid[2:4] + r * grid[4:6] + r * c * grid[6:]
        exact = position(scene.nodes[1, 1:3, 2:4], np.float64(0.4), r - half, c - half, scene.block)
        np.testing.assert_allclose(xy, exact, rtol=0, atol=1e-9)


def on_flat_layout(planes):
    """(i, r, c) planes as (i, p), with SLACK after each."""
    flat = planes.reshape(len(planes), -1)
    return np.pad(flat, ((0, 0), (0, SLACK))).astype(np.float32)


@pytest.mark.parametrize("windows", [[1], [2], [3], [4], [5], [1, 2], [2, 5], [1, 2, 3]])
def test_box_sums(windows):
    """Sums down the columns of a window go on from those of the one before it."""
    rng = np.random.default_rng(sum(windows))
    rows, cols, half = 11, 14, windows[-1]
    width = cols + 2 * half
    planes = rng.normal(size=(2, rows + 2 * half, width)).astype(np.float32)
    flat, n = on_flat_layout(planes), rows * width
    down = np.empty((3, flat.shape[1]), np.float32)
    out, done = np.empty(flat.shape[1], np.float32), 0
    for window in windows:
        column_moments(flat[0], half, done, window, width, n + SLACK, down[0], down[1])
        column_products(flat, np.uint64(0), np.uint64(1), half, done, window, width, n + SLACK, down[2])
        trim = half - window
        a, b = planes[:, trim : rows + half + window, trim : cols + half + window].astype(float)
        for sums, expected in zip(down, (a, a * a, a * b), strict=True):
            row_sums(sums[trim:], window, n, out)
            found = out[:n].reshape(rows, width)[:, :cols]
            np.testing.assert_allclose(found, twin.windows(expected, window).sum(axis=-1), rtol=0, atol=NCC * 10)
        done = window


def flat_ncc(planes, half, floor=0.0):
    """Sum of NCC over all pairs, by the kernels. planes : (i, r, c) with borders."""
    n_views, tall, width = planes.shape
    rows, cols, windows = tall - 2 * half, width - 2 * half, np.array([half])
    n, flat = rows * width, on_flat_layout(planes)
    mean, scale = np.zeros((2, n_views, 1, flat.shape[1]), np.float32)
    work, out = np.empty((4, flat.shape[1]), np.float32), np.zeros(flat.shape[1], np.float32)
    for i in range(n_views):
        window_moments(flat[i], windows, width, n, np.float32(floor), work, mean[i], scale[i])
    add_pairs(flat, windows, mean, scale, width, n, work, out[None, None])
    return out[:n].reshape(rows, width)[:, :cols]


@pytest.mark.parametrize("floor", [0.0, 0.3])
@pytest.mark.parametrize(("n_views", "half"), [(2, 2), (5, 2), (2, 1), (3, 1), (4, 1), (5, 1), (8, 1), (4, 3)])
def test_pairs_against_plain_ncc(n_views, half, floor):
    """Also of couples of views, which windows of 3 x 3 are compared by."""
    planes = np.random.default_rng(3).normal(size=(n_views, 11 + 2 * half, 14 + 2 * half)).astype(np.float32)
    everyone = np.ones((n_views, 11, 14), bool)
    expected = twin.mean_ncc(planes, (everyone, everyone), half, floor) * n_views * (n_views - 1) / 2
    np.testing.assert_allclose(flat_ncc(planes, half, floor), expected, rtol=0, atol=NCC * n_views**2)


@pytest.mark.parametrize("n_views", [2, 5])
def test_closeness_of_greys(n_views):
    """Over pairs of views that both show the cell; beyond the reach, views are equally strange."""
    rng = np.random.default_rng(n_views)
    reach, weight, shape = 0.7, 1.3, (n_views, 11, 14)
    greys = rng.normal(0.0, 0.6, shape)
    visible = rng.random(shape) < 0.7
    flat, out = (greys * weight / reach).reshape(n_views, -1).astype(np.float32), np.zeros(11 * 14, np.float32)
    for i in range(n_views):
        scale = np.ones((2, out.size), np.float32)
        hide(visible[i].ravel().astype(np.float32), out.size, scale, flat[i], np.float32(1e6 * (i + 1)))
        np.testing.assert_array_equal(scale, [visible[i].ravel()] * 2)
    add_closeness(flat, np.float32(weight), out.size, out)
    expected = twin.mean_closeness(greys, (visible, np.ones_like(visible)), reach) * n_views * (n_views - 1) / 2
    np.testing.assert_allclose(out.reshape(shape[1:]), weight * expected, rtol=0, atol=NCC * n_views**2)
    apart = np.abs(greys[0] - greys[1])
    assert (apart > reach).any()
    assert (apart < reach).any()


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(0.2, 30.0), st.floats(-5.0, 5.0))
def test_gain_and_offset_of_an_image_do_not_matter(seed, gain, offset):
    planes = np.random.default_rng(seed).normal(size=(3, 12, 15)).astype(np.float32)
    changed = planes.copy()
    changed[1] = planes[1] * np.float32(gain) + np.float32(offset * gain)
    np.testing.assert_allclose(flat_ncc(changed, 2), flat_ncc(planes, 2), rtol=0, atol=1e-3)


@pytest.mark.parametrize("half", [1, 2, 4])
def test_an_even_window_agrees_with_nothing(half):
    """Saturated roofs, water and unmarked nodata, whatever their distance from the grey value at the plane's corner."""
    rng = np.random.default_rng(half)
    for _ in range(40):
        planes = rng.normal(size=(2, 14, 17)).astype(np.float32)
        planes[:, 3:, 4:] = rng.uniform(-5.0, 5.0, 2).astype(np.float32)[:, None, None]
        found = flat_ncc(planes, half)
        assert (found[3:, 4:] == 0).all()
        assert np.abs(found).max() <= 1.0 + 1e-3


@pytest.mark.parametrize("measure", [PLAIN, GREYS], ids=["plain", "greys"])
@pytest.mark.parametrize(
    ("n_views", "shape", "block"), [(2, (37, 70), 32), (3, (37, 70), 16), (5, (9, 11), 32), (3, (33, 17), 16)]
)
def test_costs_of_a_tile(n_views, shape, block, measure):
    scene, lattice = kernel_scene(n_views, shape, block), ragged_lattice(shape, block)
    found = dense(costs(scene, lattice, scene.all_seen(), measure=measure, bumps=1.5), lattice, np.inf)
    expected = twin_costs(scene, lattice, scene.all_seen(), measure=measure, bumps=1.5)
    searched = np.isfinite(expected)
    assert (np.isfinite(found) == searched).all()
    assert np.abs(found[searched] - expected[searched]).max() < COST


@pytest.mark.parametrize(
    ("halves", "measure"),
    [([1, 2], PLAIN), ([3], (0.05, 0.0, 1.0, 1.0, 0.0)), ([2, 4], PLAIN), ([1, 2], GREYS), ([1], GREYS)],
)
def test_costs_with_hidden_views(halves, measure):
    scene, lattice = kernel_scene(4, (20, 26), 16), ragged_lattice((20, 26), 16, seed=3)
    seen, halves = partly_seen(scene), np.array(halves)
    found = dense(costs(scene, lattice, seen, halves, measure, 1.5), lattice, np.inf)
    expected = twin_costs(scene, lattice, seen, halves, measure, 1.5)
    searched = np.isfinite(expected)
    assert np.abs(found[searched] - expected[searched]).max() < COST
    alone = ((seen[0] <= seen[1]).sum(axis=0) < 2)[..., None] & searched
    assert alone.any()
    assert (found[alone] == round(twin.UNSEEN_COST * (1.0 + measure[1]))).all()


def test_many_views_take_the_smallest_window_alone():
    scene, lattice = kernel_scene(4, (20, 40), 16), ragged_lattice((20, 40), 16)
    seen, (base, base_nodes) = scene.all_seen(), bases(scene, 2)
    seen[:2, 0, :, 16:] = np.array([HIDDEN, -1])[:, None, None]  # all four views see the first blocks only
    found = costs_along(base, base_nodes, scene, lattice, seen, HALVES, GREYS, 3)
    small = np.ascontiguousarray(base[1:-1, 1:-1])
    alone = costs_along(small, base_nodes, scene, lattice, seen, HALVES[:1], GREYS, 3)
    both = costs_along(base, base_nodes, scene, lattice, seen, HALVES, GREYS, 4)
    found, alone, both = (dense(volume, lattice, np.inf) for volume in (found, alone, both))
    np.testing.assert_array_equal(found[:, :16], alone[:, :16])
    np.testing.assert_array_equal(found[:, 16:], both[:, 16:])
    assert (found[:, :16] != both[:, :16]).any()
    assert (found[:, 16:] != alone[:, 16:]).any()


def test_costs_of_one_block():
    scene, half = kernel_scene(3, (10, 12), 16), 2
    seen, count = partly_seen(scene), 16
    relief = np.random.default_rng(2).uniform(-1.0, 1.0, (10 + 2 * half, 12 + 2 * half)).astype(np.float32)
    out = np.zeros((10, 12 * count), np.uint8)
    block_costs(
        scene.pixels, scene.layout, scene.nodes, scene.heights, relief, np.array([5, count]), HALVES, seen,
        scene.block, with_few(GREYS, 1), out,
    )  # fmt: skip
    for k in range(count):
        expected = twin.cell_costs(scene.images, scene.nodes, scene.heights, 5 + k, 16, HALVES, seen, GREYS, relief)
        assert np.abs(out[:, k::count] - expected).max() < COST


def in_other_order(scene, order, gain=0.0, offset=0.0):
    """The same views in another order, each grey value changed by a gain and offset of its view's own."""
    images = [scene.images[i] * np.float32(1.0 + gain * (i + 1)) + np.float32(offset * (i - 1)) for i in order]
    sizes = np.array([image.size for image in images])
    layout = np.column_stack([np.cumsum(sizes) - sizes, scene.layout[order, 1:]])
    pixels = np.concatenate([image.ravel() for image in images])
    return replace(scene, images=images, pixels=pixels, layout=layout, nodes=scene.nodes[order].copy())


def test_gain_and_offset_of_images_do_not_matter_to_correlation():
    """They do to grey differences, which therefore compare images of one scale: see `grey_scales`."""
    scene, lattice = kernel_scene(3, (20, 26), 16), even_lattice(16, (20, 26), 16)
    other = in_other_order(scene, [2, 0, 1], gain=0.8, offset=0.7)
    plain, changed = (costs(s, lattice, s.all_seen()).astype(int) for s in (scene, other))
    assert np.abs(changed - plain).max() <= 1
    assert (changed != plain).mean() < 0.01
    assert plain.min() < 40
    plain, changed = (costs(s, lattice, s.all_seen(), measure=GREYS).astype(int) for s in (scene, other))
    assert np.abs(changed - plain).max() > 10


def test_order_of_images_does_not_matter():
    scene, lattice = kernel_scene(3, (20, 26), 16), even_lattice(16, (20, 26), 16)
    other = in_other_order(scene, [2, 0, 1])
    plain, changed = (costs(s, lattice, s.all_seen(), measure=GREYS).astype(int) for s in (scene, other))
    assert np.abs(changed - plain).max() <= 1
    assert (changed != plain).mean() < 0.01


def test_views_shown_at_a_height():
    """Shown from where nothing hides it, within what the image covers; covered whether hidden or not."""
    bounds = np.array([[[0, 5, 6, HIDDEN, 0], [9, 5, 9, -1, 4], [0, 5, 0, 0, 0]]], np.int32)
    shown, counts = np.full(5, 7.0, np.float32), np.stack([np.arange(5), np.arange(10, 15)]).astype(np.float32)
    shown_at(bounds, 0, np.int32(5), 5, shown, counts)
    np.testing.assert_array_equal(shown, [1, 1, 0, 0, 0])
    np.testing.assert_array_equal(counts, [[1, 2, 2, 3, 4], [11, 12, 12, 13, 14]])
    bounds = np.array([np.zeros((3, 2)), [[0, 0], [9, 9], [5, 6]]], np.int32)
    shown_at(bounds, 1, np.int32(5), 2, shown, counts)
    np.testing.assert_array_equal(shown[:2], [1, 0])
    np.testing.assert_array_equal(counts[:, :2], [[2, 3], [12, 12]])


def test_visibility_of_a_block_on_the_flat_layout():
    scene, half = kernel_scene(4, (10, 12), 16), 2
    seen = partly_seen(scene)
    flat, pairs = np.empty((4, 3, 14 * 16 + SLACK), np.int32), np.empty(14 * 16 + SLACK, np.float32)
    flat_visibility(seen, half, flat, pairs)
    rows = flat[:, :, : 10 * 16].reshape(4, 3, 10, 16)
    np.testing.assert_array_equal(rows[..., :12], seen.transpose(1, 0, 2, 3))
    assert (rows[:, 0, :, 12:] == HIDDEN).all()
    assert (flat[:, 0, 160:] == HIDDEN).all()
    assert (flat[:, 1, 160:] == -1).all()
    n = (seen[0] <= seen[1]).sum(axis=0)
    expected = np.where(n > 1, 2.0 / np.maximum(n * (n - 1), 1), 0.0)
    np.testing.assert_allclose(pairs[:160].reshape(10, 16)[:, :12], expected, rtol=1e-6)
    assert (pairs[160:] == 0).all()


def test_heights_of_a_block_that_a_view_covers_and_shows():
    seen = partly_seen(kernel_scene(3, (10, 12), 16))
    seen[:, 0] = np.array([3, 30, 7])[:, None, None]
    seen[0, 0, 4, 5], seen[1, 0, 9, 11], seen[2, 0, 0, 0] = 8, 25, 9
    ranges = height_ranges(seen)
    np.testing.assert_array_equal(ranges[0], [3, 30, 9, 25, 7])
    low, high, visible = seen.reshape(3, 3, -1)
    np.testing.assert_array_equal(ranges[:, 0], low.min(axis=1))
    np.testing.assert_array_equal(ranges[:, 1], high.max(axis=1))
    np.testing.assert_array_equal(ranges[:, 2], np.maximum(low, visible).max(axis=1))
    np.testing.assert_array_equal(ranges[:, 3], high.min(axis=1))
    np.testing.assert_array_equal(ranges[:, 4], np.maximum(low, visible).min(axis=1))
    heights = np.arange(-2, 60)
    shown = (np.maximum(low, visible)[..., None] <= heights) & (heights <= high[..., None])
    found = np.array([[extent_at(ranges, view, np.int32(h)) for h in heights] for view in range(3)])
    np.testing.assert_array_equal(found == WHOLE, shown.all(axis=1))
    assert not shown.any(axis=1)[found == NOTHING].any()
    assert (found == NOTHING).any()
    takes = np.array([0, 2])
    assert [whole_views(ranges, takes, np.int32(h)) for h in heights] == list(shown[takes].all(axis=1).sum(axis=0))


def test_views_that_take_part():
    """Of heights 5 to 20: covering up to 4, from 21 on, all, one, and none at all."""
    ranges = np.zeros((5, 5), np.int32)
    ranges[:, :2] = [(0, 4), (21, 30), (0, 30), (20, 20), (HIDDEN, -1)]
    np.testing.assert_array_equal(taking_part(ranges, np.array([5, 16])), [2, 3])
    assert not taking_part(ranges, np.array([-40, 16])).size
    np.testing.assert_array_equal(taking_part(ranges, np.array([-15, 16])), [0, 2])


def test_costs_whatever_index_heights_start_at():
    """Heights below the base surface have negative indices: the same heights, numbered from 20 lower."""
    scene, lattice = kernel_scene(), ragged_lattice()
    seen = partly_seen(scene)
    expected = costs(scene, lattice, seen)
    moved = replace(scene, heights=scene.heights + np.array([20 * scene.heights[1], 0.0]))
    covered = seen[0] < HIDDEN
    lower = np.where(covered, seen - 20, seen).astype(np.int32)
    found = costs(moved, replace(lattice, first=lattice.first - 20), lower)
    # The table's t of a height is rounded differently.
    assert np.abs(found.astype(int) - expected).max() <= 1
    assert (found != expected).mean() < 1e-3


def test_rows_and_columns_of_a_block():
    rows, cols = np.indices((3, 5))
    np.testing.assert_array_equal(flat_cells((3, 5)), [rows.ravel(), cols.ravel()])
