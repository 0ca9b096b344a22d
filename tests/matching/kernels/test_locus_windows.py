"""Windows along vertical lines against their slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import kernel_scene
from reference import windows as twin
from reference.agreement import ncc
from zlocus.matching.kernels.locus_windows import line_windows, normalise, sample_window
from zlocus.matching.kernels.shared_records import AxisGrid, BlockGrid, PixelVelocity, ViewImage

# Values of windows of norm 1: bilinear weights are float32, relief moves by a float32 speed.
VALUE = 2e-5
NCC = 1e-4
HALF, K = 2, 25
FIRST, N_HEIGHTS = 4.0, 9


def cells_of(scene):
    """Some cells of every block, its corners among them."""
    found = []
    for _, _, rows, cols in scene.blocks():
        found += [(r, c) for r in {rows.start, rows.start + 3, rows.stop - 1} for c in {cols.start, cols.stop - 1}]
    return np.array(sorted(found), np.int64)


def windows_of(scene, view, cells, first=FIRST, relief=None, blocked=None):
    """(n, h, k), as the kernel gives them."""
    first = np.broadcast_to(np.asarray(first, float), len(cells)).copy()
    relief = np.zeros((len(cells), K), np.float32) if relief is None else relief
    blocked = np.zeros(len(scene.pixels), bool) if blocked is None else blocked
    out = np.full((len(cells), N_HEIGHTS, K), 7.0, np.float32)
    line_windows(scene.arrays, blocked, view, cells, first, HALF, relief, out)
    return out


def twin_windows(scene, view, cells, first=FIRST, relief=None, blocked=None):
    image, block = scene.images[view], scene.block
    first = np.broadcast_to(np.asarray(first, float), len(cells))
    relief = np.zeros((len(cells), K)) if relief is None else relief
    out = np.empty((len(cells), N_HEIGHTS, K))
    offset, rows, cols = scene.layout[view]
    mask = np.zeros(image.shape, bool) if blocked is None else blocked[offset : offset + rows * cols].reshape(rows, -1)
    for n, (r, c) in enumerate(cells):
        b, d = r // block, c // block
        node, bend = scene.of_one_block(view, b, d)
        for k in range(N_HEIGHTS):
            t = scene.heights[0] + (first[n] + k) * scene.heights[1]
            at = (r - b * block, c - d * block)
            out[n, k] = twin.line_window(image, mask, node, t, at, block, HALF, relief[n], scene.heights[1], bend)
    return out


@pytest.fixture(scope="module")
def scene():
    """Every view loses some cells on its left."""
    made = kernel_scene()
    made.nodes[..., 0, 0] -= 10.0
    return made


@pytest.fixture(scope="module")
def cells(scene):
    return cells_of(scene)


def test_windows_of_bent_blocks_are_those_of_the_twin():
    made = kernel_scene(is_bent=True)
    cells = cells_of(made)
    for view in range(made.n_views):
        found, plain = windows_of(made, view, cells), twin_windows(made, view, cells)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(plain))
        np.testing.assert_allclose(found, plain, rtol=0, atol=VALUE)


@pytest.mark.parametrize("view", [0, 1, 2])
def test_windows_are_those_of_the_twin(scene, cells, view):
    found, plain = windows_of(scene, view, cells), twin_windows(scene, view, cells)
    assert 0 < np.isnan(plain[..., 0]).sum() < plain[..., 0].size, "some leave the image"
    np.testing.assert_allclose(found, plain, rtol=0, atol=VALUE)


def test_the_product_of_two_views_is_their_correlation(scene, cells):
    """Against the plain NCC of values at the twin's positions."""
    product = np.einsum("nhk,nhk->nh", windows_of(scene, 0, cells), windows_of(scene, 2, cells))
    n_compared = 0
    for n, (r, c) in enumerate(cells):
        b, d = r // scene.block, c // scene.block
        at = (r - b * scene.block, c - d * scene.block)
        for k in np.flatnonzero(~np.isnan(product[n])):
            t = scene.heights[0] + (FIRST + k) * scene.heights[1]
            values = []
            for view in (0, 2):
                node = scene.nodes[view, b : b + 2, d : d + 2]
                xy = twin.window_places(node, t, at, scene.block, HALF, np.zeros(K), scene.heights[1])
                values.append(twin.values_at(scene.images[view], xy))
            assert product[n, k] == pytest.approx(float(ncc(*values)), abs=NCC)
            n_compared += 1
    assert n_compared > 200
    assert np.nanmax(np.abs(product)) <= 1 + NCC
    own = windows_of(scene, 1, cells)
    norm = (own**2).sum(axis=2)
    np.testing.assert_allclose(norm[~np.isnan(norm)], 1.0, rtol=0, atol=NCC)


def test_windows_follow_the_relief(scene, cells):
    relief = np.random.default_rng(2).uniform(-3, 3, (len(cells), K)).astype(np.float32)
    for view in range(scene.n_views):
        found, plain = windows_of(scene, view, cells, relief=relief), twin_windows(scene, view, cells, relief=relief)
        np.testing.assert_allclose(found, plain, rtol=0, atol=VALUE)
    level = windows_of(scene, 2, cells)
    seen = ~np.isnan(found) & ~np.isnan(level)
    assert np.abs(found - level)[seen].max() > 0.1


def test_a_level_relief_is_another_height(scene, cells):
    """Everything two steps up, but for the change of speed over two steps and within a block."""
    up = windows_of(scene, 1, cells, relief=np.full((len(cells), K), 2.0, np.float32))
    higher = windows_of(scene, 1, cells, FIRST + 2)
    seen = ~np.isnan(up) & ~np.isnan(higher)
    assert seen.mean() > 0.5
    assert np.abs(up - higher)[seen].max() < 0.01


def test_the_first_height_may_be_a_fraction(scene, cells):
    first = FIRST + np.random.default_rng(3).uniform(0, 1, len(cells))
    np.testing.assert_allclose(
        windows_of(scene, 2, cells, first), twin_windows(scene, 2, cells, first), rtol=0, atol=VALUE
    )
    whole = windows_of(scene, 2, cells, FIRST + 1)
    np.testing.assert_array_equal(windows_of(scene, 2, cells)[:, 1:], whole[:, :-1])


def test_no_window_outside_the_image(scene):
    """Every height of a cell beside the image is NaN, in all of the window; its neighbours do not matter."""
    cells = np.array([[0, 0], [20, 30]], np.int64)
    far = kernel_scene()
    far.nodes[..., 0, 0] -= 60.0
    found = windows_of(far, 0, cells)
    assert np.isnan(found[0]).all()
    inside = windows_of(scene, 0, cells)
    assert not np.isnan(inside[1]).any()


def test_windows_whose_middle_is_blocked_are_nan(scene, cells):
    blocked = np.zeros(len(scene.pixels), bool)
    offset, rows, cols = scene.layout[1]
    mask = blocked[offset : offset + rows * cols].reshape(rows, cols)
    mask[10:30, 30:60] = True
    found, plain = (of(scene, 1, cells, blocked=blocked) for of in (windows_of, twin_windows))
    free = windows_of(scene, 1, cells)
    assert (np.isnan(found[..., 0]) & ~np.isnan(free[..., 0])).sum() > 20
    np.testing.assert_allclose(found, plain, rtol=0, atol=VALUE)
    np.testing.assert_array_equal(windows_of(scene, 0, cells, blocked=blocked), windows_of(scene, 0, cells))
    relief = np.zeros((len(cells), K), np.float32)
    relief[:, K // 2] = 40.0  # the middle moves, and with it what blocks it
    moved, plain = (of(scene, 1, cells, relief=relief, blocked=blocked) for of in (windows_of, twin_windows))
    np.testing.assert_array_equal(np.isnan(moved), np.isnan(plain))
    assert (np.isnan(moved) != np.isnan(found)).any()


@pytest.mark.parametrize("grey", [0.0, 1e-3, 1000.0, 1234.567, -30000.7])
def test_windows_without_texture_agree_with_none(grey):
    """All zero: their correlation with any window is 0, not NaN."""
    window = np.full(K, grey, np.float32)
    normalise(window)
    np.testing.assert_array_equal(window, 0.0)
    even = kernel_scene()
    even.pixels[:] = grey
    found = windows_of(even, 0, np.array([[20, 30]], np.int64))
    np.testing.assert_array_equal(found, 0.0)


def test_a_window_is_normalised_whatever_its_gain_and_offset():
    rng = np.random.default_rng(5)
    window = rng.normal(size=K).astype(np.float32)
    expected = twin.normalised(window)
    for gain, offset in ((1.0, 0.0), (300.0, 40.0), (0.01, 0.02)):
        found = window * np.float32(gain) + np.float32(offset)
        normalise(found)
        np.testing.assert_allclose(found, expected, rtol=0, atol=VALUE)


def test_a_sample_outside_ends_the_window():
    pixels = np.arange(12 * 9, dtype=np.float32)
    image, velocity = ViewImage(pixels, 9, 12), PixelVelocity(np.float32(0.5), np.float32(0.0))
    grid = BlockGrid(AxisGrid(0.0, 1.0, 0.0, 0.0, 0.0, 0.0), AxisGrid(0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    relief, out = np.zeros(9, np.float32), np.empty(9, np.float32)

    def is_sampled(row, col):
        return sample_window(image, grid, velocity, row, col, 1, relief, out)

    assert is_sampled(4.0, 5.0)
    np.testing.assert_array_equal(out, pixels.reshape(9, 12)[3:6, 4:7].ravel())
    assert is_sampled(1.0, 1.0)
    assert not is_sampled(0.99, 1.0)
    assert is_sampled(6.99, 9.99)
    assert not is_sampled(7.0, 9.0), "no pixel below"
    assert not is_sampled(4.0, 10.0)
    relief[3] = -8.0
    assert not is_sampled(4.0, 4.0)
