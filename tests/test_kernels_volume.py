"""Resampling, NCC and the cost volume against their slow twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernel_scene import HIDDEN, even_lattice, kernel_scene, ragged_lattice
from reference import agreement as twin
from reference.projection import bilinear, position, positions
from reference.semiglobal import dense
from zlocus.kernels.agreement import column_sums, pair_sum, product_rows, row_sums, window_moments
from zlocus.kernels.resample import resample_plane
from zlocus.kernels.volume import block_costs, flat_visibility, plane_grid, taking_part, tile_costs

# Bilinear values of images with a spread of 1.4 grey values: positions are float32 within some 60 px of their origin.
GREY = 1e-4
# Float32 sums of 25 products of values near 1.
NCC = 2e-5
# A cost is a whole number; where its plain value is near a half, rounding may fall either way.
COST = 0.51
HALVES = np.array([1, 2])


def costs(scene, lattice, seen, halves=HALVES, floor=0.0):
    volume = np.zeros(lattice.size, np.uint8)
    tile_costs(
        scene.pixels, scene.layout, scene.nodes, scene.heights, lattice.ranges, lattice.address, halves, seen,
        scene.block, np.float32(floor), volume,
    )  # fmt: skip
    return volume


def twin_costs(scene, lattice, seen, halves=HALVES, floor=0.0):
    """(r, c, h), infinite where a cell does not search."""
    first, count = lattice.cell_ranges()
    out = np.full((*scene.shape, int((first + count).max())), np.inf)
    for b, d, rows, cols in scene.blocks():
        nodes = scene.nodes[:, b : b + 2, d : d + 2]
        for k in range(lattice.first[b, d], lattice.first[b, d] + lattice.count[b, d]):
            out[rows, cols, k] = twin.cell_costs(
                scene.images, nodes, scene.heights, k, scene.block, halves, seen[:, :, rows, cols], floor
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


def resampled(scene, view, b, d, t, half, cells):
    grid = np.empty(8)
    plane_grid(scene.nodes[:, b : b + 2, d : d + 2], view, t, scene.block, half, grid)
    out = np.empty((cells[0] + 2 * half, cells[1] + 2 * half), np.float32)
    width = out.shape[1]
    resample_plane(
        scene.pixels, scene.layout[view], grid, np.empty(width, np.uint32), np.empty((2, width), np.float32), out
    )
    return out


@pytest.mark.parametrize("half", [0, 2])
@pytest.mark.parametrize("t", [-1.0, 0.37, 1.4])
def test_resampled_planes(half, t):
    """Also of cells that project outside the image: they get its border."""
    scene = kernel_scene()
    for view in range(scene.n_views):
        for b, d, rows, cols in scene.blocks():
            cells = (rows.stop - rows.start, cols.stop - cols.start)
            xy = positions(scene.nodes[view, b : b + 2, d : d + 2], t, cells, scene.block, half)
            found = resampled(scene, view, b, d, t, half, cells)
            np.testing.assert_allclose(found, bilinear(scene.images[view], xy), rtol=0, atol=GREY)


def test_grid_of_a_block_is_its_projection():
    scene, half = kernel_scene(), 3
    grid = np.empty(8)
    plane_grid(scene.nodes[:, 1:3, 2:4], 1, 0.4, scene.block, half, grid)
    for r, c in ((0, 0), (0, 20), (21, 0), (17, 9)):
        xy = grid[:2] + c * grid[2:4] + r * grid[4:6] + r * c * grid[6:]
        exact = position(scene.nodes[1, 1:3, 2:4], np.float64(0.4), r - half, c - half, scene.block)
        np.testing.assert_allclose(xy, exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("half", [1, 2, 3, 4])
def test_box_sums(half):
    rng = np.random.default_rng(half)
    rows, cols = 11, 14
    width = cols + 2 * half
    a, b = rng.normal(size=(2, rows + 2 * half, width)).astype(np.float32)
    n = rows * width - 2 * half
    across, out, full = np.empty(a.size, np.float32), np.empty(a.size, np.float32), n + 2 * half * width
    product_rows(a.ravel(), b.ravel(), half, full, across)
    column_sums(across, half, width, n, out)
    found = np.append(out[:n], np.zeros(2 * half)).reshape(rows, width)[:, :cols]
    np.testing.assert_allclose(found, twin.windows(a.astype(float) * b, half).sum(axis=-1), rtol=0, atol=NCC * 10)
    row_sums(a.ravel(), half, full, across)
    column_sums(across, half, width, n, out)
    found = np.append(out[:n], np.zeros(2 * half)).reshape(rows, width)[:, :cols]
    np.testing.assert_allclose(found, twin.windows(a, half).sum(axis=-1), rtol=0, atol=NCC * 10)


def flat_ncc(planes, half, floor=0.0):
    """Sum of NCC over all ordered pairs, by the kernels. planes : (i, r, c) with borders."""
    n_views, tall, width = planes.shape
    rows, cols = tall - 2 * half, width - 2 * half
    n = rows * width - 2 * half
    flat = np.ascontiguousarray(planes.reshape(n_views, -1), np.float32)
    mean, scale, work = np.zeros_like(flat), np.zeros_like(flat), np.empty((2, flat.shape[1]), np.float32)
    out = np.empty(flat.shape[1], np.float32)
    for i in range(n_views):
        window_moments(flat[i], 0, half, width, n, np.float32(floor), work[0], mean[i], scale[i])
    pair_sum(flat, 0, mean, scale, half, width, n, work, out)
    return np.append(out[:n], np.zeros(2 * half)).reshape(rows, width)[:, :cols]


@pytest.mark.parametrize("floor", [0.0, 0.3])
@pytest.mark.parametrize("n_views", [2, 5])
def test_pairs_against_plain_ncc(n_views, floor):
    planes = np.random.default_rng(3).normal(size=(n_views, 15, 18)).astype(np.float32)
    everyone = np.ones((n_views, 11, 14), bool)
    expected = twin.mean_ncc(planes, (everyone, everyone), 2, floor) * n_views * (n_views - 1)
    np.testing.assert_allclose(flat_ncc(planes, 2, floor), expected, rtol=0, atol=NCC * n_views**2)


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
        assert np.abs(found).max() <= 2.0 + 1e-3


@pytest.mark.parametrize(
    ("n_views", "shape", "block"), [(2, (37, 70), 32), (3, (37, 70), 16), (5, (9, 11), 32), (3, (33, 17), 16)]
)
def test_costs_of_a_tile(n_views, shape, block):
    scene, lattice = kernel_scene(n_views, shape, block), ragged_lattice(shape, block)
    found = dense(costs(scene, lattice, scene.all_seen()), lattice, np.inf)
    expected = twin_costs(scene, lattice, scene.all_seen())
    searched = np.isfinite(expected)
    assert (np.isfinite(found) == searched).all()
    assert np.abs(found[searched] - expected[searched]).max() < COST


@pytest.mark.parametrize(("halves", "floor"), [([1, 2], 0.0), ([3], 0.05), ([2, 4], 0.0)])
def test_costs_with_hidden_views(halves, floor):
    scene, lattice = kernel_scene(4, (20, 26), 16), ragged_lattice((20, 26), 16, seed=3)
    seen, halves = partly_seen(scene), np.array(halves)
    found = dense(costs(scene, lattice, seen, halves, floor), lattice, np.inf)
    expected = twin_costs(scene, lattice, seen, halves, floor)
    searched = np.isfinite(expected)
    assert np.abs(found[searched] - expected[searched]).max() < COST
    alone = ((seen[0] <= seen[1]).sum(axis=0) < 2)[..., None] & searched
    assert alone.any()
    assert (found[alone] == twin.UNSEEN_COST).all()


def test_costs_of_one_block():
    scene, half = kernel_scene(3, (10, 12), 16), 2
    seen, count = partly_seen(scene), 16
    out = np.zeros((10, 12 * count), np.uint8)
    block_costs(
        scene.pixels, scene.layout, scene.nodes, scene.heights, np.array([5, count]), HALVES, seen, scene.block,
        np.float32(0.0), out,
    )  # fmt: skip
    flat = np.empty((3, 3, (10 + 2 * half) * (12 + 2 * half)), np.int32)
    pairs = np.empty(flat.shape[2], np.float32)
    assert flat_visibility(seen, half, flat, pairs) == 10 * 16 - 4
    for k in range(count):
        expected = twin.cell_costs(scene.images, scene.nodes, scene.heights, 5 + k, 16, HALVES, seen, 0.0)
        assert np.abs(out[:, k::count] - expected).max() < COST


def test_gain_offset_and_order_of_images_do_not_matter():
    scene, lattice = kernel_scene(3, (20, 26), 16), even_lattice(16, (20, 26), 16)
    plain = costs(scene, lattice, scene.all_seen())
    order = [2, 0, 1]
    images = [scene.images[i] * np.float32(1.7 + i) + np.float32(0.5 - i) for i in order]
    sizes = np.array([image.size for image in images])
    layout = np.column_stack([np.cumsum(sizes) - sizes, scene.layout[order, 1:]])
    other = replace(
        scene, images=images, pixels=np.concatenate([i.ravel() for i in images]), layout=layout,
        nodes=scene.nodes[order].copy(),
    )  # fmt: skip
    changed = costs(other, lattice, other.all_seen())
    assert np.abs(changed.astype(int) - plain).max() <= 1
    assert (changed != plain).mean() < 0.01
    assert plain.min() < 40


def test_views_that_take_part():
    """Of heights 5 to 20: covering up to 4, from 21 on, all, one, and none at all."""
    flat = np.zeros((3, 5, 6), np.int32)
    flat[0], flat[1] = HIDDEN, -1
    for i, (low, high) in enumerate(((0, 4), (21, 30), (0, 30), (20, 20))):
        flat[0, i, 3], flat[1, i, 3] = low, high
    np.testing.assert_array_equal(taking_part(flat, np.array([5, 16])), [False, False, True, True, False])
    assert not taking_part(flat, np.array([-40, 16])).any()
    np.testing.assert_array_equal(taking_part(flat, np.array([-15, 16])), [True, False, True, False, False])


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
