"""NCC and the cost volume against their slow twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernel_scene import even_lattice, kernel_scene, ragged_lattice
from reference import agreement as twin
from reference.projection import slope_relief
from reference.semiglobal import dense
from zlocus.matching.evidence import NO_EVIDENCE
from zlocus.matching.kernels.cost_volume import (
    NOTHING,
    WHOLE,
    BlockVisibility,
    CostParameters,
    FlatVisibility,
    SlopeArrays,
    block_costs,
    block_relief,
    block_visibility,
    count_whole_views,
    covering_views,
    empty_visibility,
    exclude_unseen,
    extent_at,
    flat_visibility,
    mark_seen_cells,
    tile_costs,
)
from zlocus.matching.kernels.ncc import (
    SLACK,
    ColumnSums,
    ViewPair,
    WindowMoments,
    add_closeness,
    add_pairs,
    column_moments,
    column_products,
    row_sums,
    window_moments,
)
from zlocus.matching.kernels.shared_records import NEVER_COVERED, HeightSpan, VisibleHeights

# Float32 sums of 25 products of values near 1.
NCC = 2e-5
# A cost is a whole number; where its plain value is near a half, rounding may fall either way.
COST = 0.51
# The limit between the best pairs and the others is found to 0.02 of the sum of the scores over the windows.
BEST_COST = COST + 64 * 0.02
HALVES = np.array([1, 2])


def parameters(variance, grey_weight, two_images, max_grey_difference, excluded, best_share=0.0):
    """Parameters of the cost; the large window is used however many views cover a block."""
    values = [np.float32(v) for v in (variance, grey_weight, two_images, max_grey_difference, excluded)]
    return CostParameters(*values, max_images_for_large_window=255, best_share_of_reference=np.float32(best_share))


PLAIN, GREYS = parameters(0.0, 0.0, 0.0, 1.0, 0.0), parameters(0.02, 0.8, 0.3, 1.5, 0.4)
BEST_PLAIN, BEST_GREYS = (
    values._replace(best_share_of_reference=np.float32(share)) for values, share in ((PLAIN, 0.5), (GREYS, 0.6))
)


def bases(scene, half, bumps=1.5, seed=0):
    """Support surface with `half` cells around it, and at the corners of blocks; they differ by up to `bumps` steps."""
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


def costs(scene, lattice, visible, halves=HALVES, options=PLAIN, bumps=0.0):
    return costs_along(SlopeArrays(*bases(scene, max(halves), bumps)), scene, lattice, visible, halves, options)


def costs_along(slope, scene, lattice, visible, halves, options):
    volume = np.zeros(lattice.size, np.uint8)
    tile_costs(scene.arrays, slope, lattice.layout, halves, visible, options, NO_EVIDENCE, volume)
    return volume


def twin_costs(scene, lattice, visible, halves=HALVES, options=PLAIN, bumps=0.0):
    """(r, c, h), infinite where a cell does not search."""
    first, count = lattice.cell_ranges()
    base, base_nodes = bases(scene, max(halves), bumps)
    out = np.full((*scene.shape, int((first + count).max())), np.inf)
    for b, d, rows, cols in scene.blocks():
        nodes, corners = scene.nodes[:, b : b + 2, d : d + 2], base_nodes[b : b + 2, d : d + 2]
        relief = slope_relief(base, corners, rows, cols, scene.block, max(halves))
        for k in range(lattice.first[b, d], lattice.first[b, d] + lattice.count[b, d]):
            out[rows, cols, k] = twin.cell_costs(
                scene.images,
                nodes,
                scene.heights,
                k,
                scene.block,
                halves,
                visible.at(np.s_[:, rows, cols]),
                options,
                relief,
            )
    return np.where(np.isfinite(out), np.clip(out, 0, 255), np.inf)


def partly_visible(scene, seed=1):
    """Random heights covered and occluded, some cells covered by no view at all."""
    rng = np.random.default_rng(seed)
    visible = scene.all_visible()
    shape = visible.lowest_covered.shape
    visible.lowest_covered[:] = rng.integers(0, 14, shape)
    visible.highest_covered[:] = visible.lowest_covered + rng.integers(2, 40, shape)
    nothing = rng.random(shape) < 0.3
    visible.lowest_covered[nothing], visible.highest_covered[nothing] = NEVER_COVERED, -1
    visible.lowest_unoccluded[:] = rng.integers(0, 20, shape)
    return visible


@pytest.mark.parametrize("half", [0, 3])
def test_relief_of_a_block(half):
    scene = kernel_scene()
    base, nodes = bases(scene, half, seed=4)
    for b, d, rows, cols in scene.blocks():
        corners = nodes[b : b + 2, d : d + 2]
        part = base[rows.start : rows.stop + 2 * half, cols.start : cols.stop + 2 * half]
        found = np.empty(part.shape, np.float32)
        block_relief(part, corners, scene.block, half, found)
        expected = slope_relief(base, corners, rows, cols, scene.block, half)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


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
        span = ColumnSums(half, done, window, width, n + SLACK)
        column_moments(flat[0], span, down[0], down[1])
        column_products(flat, ViewPair(np.uint64(0), np.uint64(1)), span, down[2])
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
    add_pairs(flat, windows, WindowMoments(mean, scale), width, n, work, out[None, None])
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
        exclude_unseen(visible[i].ravel().astype(np.float32), out.size, scale, flat[i], np.float32(1e6 * (i + 1)))
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
def test_a_window_without_texture_agrees_with_nothing(half):
    """Saturated roofs, water and unmarked nodata, whatever their distance from the grey value at the plane's corner."""
    rng = np.random.default_rng(half)
    for _ in range(40):
        planes = rng.normal(size=(2, 14, 17)).astype(np.float32)
        planes[:, 3:, 4:] = rng.uniform(-5.0, 5.0, 2).astype(np.float32)[:, None, None]
        found = flat_ncc(planes, half)
        assert (found[3:, 4:] == 0).all()
        assert np.abs(found).max() <= 1.0 + 1e-3


@pytest.mark.parametrize(
    "options", [PLAIN, GREYS, BEST_PLAIN, BEST_GREYS], ids=["plain", "greys", "best", "best-greys"]
)
@pytest.mark.parametrize(
    ("n_views", "shape", "block"), [(2, (37, 70), 32), (3, (37, 70), 16), (5, (9, 11), 32), (3, (33, 17), 16)]
)
def test_costs_of_a_tile(n_views, shape, block, options):
    scene, lattice = kernel_scene(n_views, shape, block), ragged_lattice(shape, block)
    found = dense(costs(scene, lattice, scene.all_visible(), options=options, bumps=1.5), lattice, np.inf)
    expected = twin_costs(scene, lattice, scene.all_visible(), options=options, bumps=1.5)
    searched = np.isfinite(expected)
    assert (np.isfinite(found) == searched).all()
    apart = np.abs(found[searched] - expected[searched])
    assert apart.max() < (BEST_COST if options.best_share_of_reference > 0 else COST)
    assert (apart < COST).mean() > 0.99


@pytest.mark.parametrize(
    ("halves", "options"),
    [
        ([1, 2], PLAIN),
        ([3], parameters(0.05, 0.0, 0.0, 1.0, 1.0)),
        ([2, 4], PLAIN),
        ([1, 2], GREYS),
        ([1], GREYS),
        ([1], BEST_PLAIN),
        ([1, 2], BEST_GREYS),
    ],
)
def test_costs_with_occluded_views(halves, options):
    scene, lattice = kernel_scene(4, (20, 26), 16), ragged_lattice((20, 26), 16, seed=3)
    visible, halves = partly_visible(scene), np.array(halves)
    found = dense(costs(scene, lattice, visible, halves, options, 1.5), lattice, np.inf)
    expected = twin_costs(scene, lattice, visible, halves, options, 1.5)
    searched = np.isfinite(expected)
    apart = np.abs(found[searched] - expected[searched])
    assert apart.max() < (BEST_COST if options.best_share_of_reference > 0 else COST)
    assert (apart < COST).mean() > 0.99
    alone = ((visible.lowest_covered <= visible.highest_covered).sum(axis=0) < 2)[..., None] & searched
    assert alone.any()
    assert (found[alone] == round(twin.UNCOVERED_COST * (1.0 + options.grey_weight))).all()


def test_an_image_that_does_not_show_what_the_reference_does_is_not_counted():
    """One of two further images is replaced by noise: the other alone gives the cost, whichever it is."""
    scene, lattice = kernel_scene(3, (20, 26), 16), even_lattice(16, (20, 26), 16)
    pair = kernel_scene(3, (20, 26), 16)
    visible = pair.all_visible()
    visible.lowest_covered[2], visible.highest_covered[2] = NEVER_COVERED, -1
    rng, (start, rows, cols) = np.random.default_rng(6), (int(v) for v in scene.layout[2])
    scene.pixels[start : start + rows * cols] = rng.normal(size=rows * cols).astype(np.float32)
    alone = costs(pair, lattice, visible, options=GREYS._replace(grey_weight_of_one_pair=GREYS.grey_weight))
    best, mean = (
        costs(scene, lattice, scene.all_visible(), options=GREYS._replace(best_share_of_reference=np.float32(share)))
        for share in (0.5, 0.0)
    )
    least_alone, least_best, least_mean = (
        dense(volume, lattice, np.inf).min(axis=-1).mean() for volume in (alone, best, mean)
    )
    assert least_best <= least_alone + 1.0
    assert least_mean > least_alone + 10.0


def test_many_views_take_the_smallest_window_alone():
    scene, lattice = kernel_scene(4, (20, 40), 16), ragged_lattice((20, 40), 16)
    visible, slope = scene.all_visible(), SlopeArrays(*bases(scene, 2))
    visible.lowest_covered[0, :, 16:], visible.highest_covered[0, :, 16:] = NEVER_COVERED, -1  # three views there
    few, many = (GREYS._replace(max_images_for_large_window=n) for n in (3, 4))
    found = costs_along(slope, scene, lattice, visible, HALVES, few)
    small = slope._replace(cells=np.ascontiguousarray(slope.cells[1:-1, 1:-1]))
    alone = costs_along(small, scene, lattice, visible, HALVES[:1], few)
    both = costs_along(slope, scene, lattice, visible, HALVES, many)
    found, alone, both = (dense(volume, lattice, np.inf) for volume in (found, alone, both))
    np.testing.assert_array_equal(found[:, :16], alone[:, :16])
    np.testing.assert_array_equal(found[:, 16:], both[:, 16:])
    assert (found[:, :16] != both[:, :16]).any()
    assert (found[:, 16:] != alone[:, 16:]).any()


def test_costs_of_one_block():
    scene, half = kernel_scene(3, (10, 12), 16), 2
    visible, count = partly_visible(scene), 16
    relief = np.random.default_rng(2).uniform(-1.0, 1.0, (10 + 2 * half, 12 + 2 * half)).astype(np.float32)
    out = np.zeros((10, 12 * count), np.uint8)
    block_costs(scene.arrays, relief, HeightSpan(5, count), HALVES, visible, GREYS, NO_EVIDENCE, out)
    for k in range(count):
        expected = twin.cell_costs(scene.images, scene.nodes, scene.heights, 5 + k, 16, HALVES, visible, GREYS, relief)
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
    plain, changed = (costs(s, lattice, s.all_visible()).astype(int) for s in (scene, other))
    assert np.abs(changed - plain).max() <= 1
    assert (changed != plain).mean() < 0.01
    assert plain.min() < 40
    plain, changed = (costs(s, lattice, s.all_visible(), options=GREYS).astype(int) for s in (scene, other))
    assert np.abs(changed - plain).max() > 10


def test_order_of_images_does_not_matter():
    scene, lattice = kernel_scene(3, (20, 26), 16), even_lattice(16, (20, 26), 16)
    other = in_other_order(scene, [2, 0, 1])
    plain, changed = (costs(s, lattice, s.all_visible(), options=GREYS).astype(int) for s in (scene, other))
    assert np.abs(changed - plain).max() <= 1
    assert (changed != plain).mean() < 0.01


def test_views_shown_at_a_height():
    """Seen from where nothing occludes it, within what the image covers; covered whether occluded or not."""
    flat = FlatVisibility(*np.array([[[0, 5, 6, NEVER_COVERED, 0]], [[9, 5, 9, -1, 4]], [[0, 5, 0, 0, 0]]], np.int32))
    shown, counts = np.full(5, 7.0, np.float32), np.stack([np.arange(5), np.arange(10, 15)]).astype(np.float32)
    mark_seen_cells(flat, 0, np.int32(5), 5, shown, counts)
    np.testing.assert_array_equal(shown, [1, 1, 0, 0, 0])
    np.testing.assert_array_equal(counts, [[1, 2, 2, 3, 4], [11, 12, 12, 13, 14]])
    flat = FlatVisibility(*np.array([[[0, 0], [0, 0]], [[0, 0], [9, 9]], [[0, 0], [5, 6]]], np.int32))
    mark_seen_cells(flat, 1, np.int32(5), 2, shown, counts)
    np.testing.assert_array_equal(shown[:2], [1, 0])
    np.testing.assert_array_equal(counts[:, :2], [[2, 3], [12, 12]])


def test_visibility_of_a_block_on_the_flat_layout():
    scene, half = kernel_scene(4, (10, 12), 16), 2
    visible = partly_visible(scene)
    flat, pairs = empty_visibility(4, 14 * 16 + SLACK), np.empty(14 * 16 + SLACK, np.float32)
    flat_visibility(visible, half, flat, pairs)
    for found, bound in zip(flat, visible, strict=True):
        np.testing.assert_array_equal(found[:, : 10 * 16].reshape(4, 10, 16)[..., :12], bound)
    assert (flat.lowest_covered[:, : 10 * 16].reshape(4, 10, 16)[..., 12:] == NEVER_COVERED).all()
    assert (flat.lowest_covered[:, 160:] == NEVER_COVERED).all()
    assert (flat.highest_covered[:, 160:] == -1).all()
    n = (visible.lowest_covered <= visible.highest_covered).sum(axis=0)
    expected = np.where(n > 1, 2.0 / np.maximum(n * (n - 1), 1), 0.0)
    np.testing.assert_allclose(pairs[:160].reshape(10, 16)[:, :12], expected, rtol=1e-6)
    assert (pairs[160:] == 0).all()


def test_heights_of_a_block_that_a_view_covers_and_sees():
    visible = partly_visible(kernel_scene(3, (10, 12), 16))
    visible.lowest_covered[0], visible.highest_covered[0], visible.lowest_unoccluded[0] = 3, 30, 7
    visible.lowest_covered[0, 4, 5], visible.highest_covered[0, 9, 11], visible.lowest_unoccluded[0, 0, 0] = 8, 25, 9
    block = block_visibility(visible)
    assert [bound[0] for bound in block] == [3, 30, 9, 25, 7]
    low, high, free_from = (bound.reshape(3, -1) for bound in visible)
    np.testing.assert_array_equal(block.lowest_covering_any, low.min(axis=1))
    np.testing.assert_array_equal(block.highest_covering_any, high.max(axis=1))
    np.testing.assert_array_equal(block.lowest_seeing_all, np.maximum(low, free_from).max(axis=1))
    np.testing.assert_array_equal(block.highest_covering_all, high.min(axis=1))
    np.testing.assert_array_equal(block.lowest_seeing_any, np.maximum(low, free_from).min(axis=1))
    heights = np.arange(-2, 60)
    shown = (np.maximum(low, free_from)[..., None] <= heights) & (heights <= high[..., None])
    found = np.array([[extent_at(block, view, np.int32(h)) for h in heights] for view in range(3)])
    np.testing.assert_array_equal(found == WHOLE, shown.all(axis=1))
    assert not shown.any(axis=1)[found == NOTHING].any()
    assert (found == NOTHING).any()
    takes = np.array([0, 2])
    counts = [count_whole_views(block, takes, np.int32(h)) for h in heights]
    assert counts == list(shown[takes].all(axis=1).sum(axis=0))


def test_views_that_cover_a_block_at_searched_heights():
    """Of heights 5 to 20: covering up to 4, from 21 on, all, one, and none at all."""
    low, high = np.array([(0, 4), (21, 30), (0, 30), (20, 20), (NEVER_COVERED, -1)], np.int32).T.copy()
    block = BlockVisibility(low, high, low, high, low)
    np.testing.assert_array_equal(covering_views(block, HeightSpan(5, 16)), [2, 3])
    assert not covering_views(block, HeightSpan(-40, 16)).size
    np.testing.assert_array_equal(covering_views(block, HeightSpan(-15, 16)), [0, 2])


def test_costs_whatever_index_heights_start_at():
    """Heights below the support surface have negative indices: the same heights, numbered from 20 lower."""
    scene, lattice = kernel_scene(), ragged_lattice()
    visible = partly_visible(scene)
    expected = costs(scene, lattice, visible)
    moved = replace(scene, heights=scene.heights + np.array([20 * scene.heights[1], 0.0]))
    covered = visible.lowest_covered < NEVER_COVERED
    lower = VisibleHeights(*(np.where(covered, bound - 20, bound).astype(np.int32) for bound in visible))
    found = costs(moved, replace(lattice, first=lattice.first - 20), lower)
    # The table's t of a height is rounded differently.
    assert np.abs(found.astype(int) - expected).max() <= 1
    assert (found != expected).mean() < 1e-3
