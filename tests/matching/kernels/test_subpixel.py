"""Grey values and correlation profiles along a surface, and the ortho-image, against their slow twins."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, spline_filter

from kernel_scene import kernel_scene
from reference import agreement
from reference.projection import bilinear, cubic, positions
from zlocus.matching.kernels.resample import RUN, flat_cells, image_of
from zlocus.matching.kernels.shared_records import NEVER_COVERED
from zlocus.matching.kernels.subpixel import (
    CUBIC,
    LINEAR,
    ProfileSampling,
    block_profile,
    level_grids,
    resample_surface,
    tile_ortho,
    tile_profile,
)

# Float32 images with a spread of 1.4 grey values.
GREY = 1e-4
# Three grids stand for the cubic in height.
NCC = 1e-3
STEPS = 1e-4


def coefficients(scene):
    """Cubic B-spline coefficients of all images, one after the other."""
    return np.concatenate([spline_filter(i, 3, output=np.float32, mode="mirror").ravel() for i in scene.images])


@pytest.mark.parametrize("degree", [LINEAR, CUBIC])
def test_values_on_a_surface(degree):
    """Positions quadratic in the level are given by three grids; values are those of the interpolating B-spline, or
    bilinear. More cells than are taken at a time."""
    scene, shape = kernel_scene(2, (30, 31), 32), (30, 31)
    level, node = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32), scene.nodes[1].copy()
    node[..., 3] = 0.0
    grids = level_grids(scene.arrays._replace(nodes=node[None]), 0, 0.0, 0.3, 0)
    out, pixels = np.empty(level.size, np.float32), scene.pixels if degree == LINEAR else coefficients(scene)
    assert level.size > RUN
    image = image_of(scene.arrays._replace(pixels=pixels), 1)
    resample_surface(image, grids, flat_cells(*shape), level.ravel(), degree, out)
    value = bilinear if degree == LINEAR else cubic
    expected = value(scene.images[1], positions(node, 0.3 * level.astype(float), shape, 32))
    np.testing.assert_allclose(out.reshape(shape), expected, rtol=0, atol=GREY)


@pytest.mark.parametrize(("n_views", "half", "is_bent"), [(2, 2, False), (4, 3, False), (3, 2, True)])
def test_profiles(n_views, half, is_bent):
    scene = kernel_scene(n_views, (20, 26), 16, is_bent=is_bent)
    shape = (20 + 2 * half, 26 + 2 * half)
    surface = (15 + 4 * gaussian_filter(np.random.default_rng(1).normal(size=shape), 3)).astype(np.float32)
    offsets = np.array([-1.5, 0.0, 0.7], np.float32)
    visible = scene.all_visible()
    visible.lowest_covered[1, 3:9], visible.highest_covered[0, :, :5] = NEVER_COVERED, 3
    windows = np.array([1, half])
    groups = np.empty((2, 2, 3, *scene.shape), np.float32)
    sampling = ProfileSampling(CUBIC, offsets, windows, np.float32(0.0))
    tile_profile(scene.arrays._replace(pixels=coefficients(scene)), surface, sampling, visible, groups)
    out = groups.sum(axis=1)
    for (b, d, rows, cols), (w, window) in product(scene.blocks(), enumerate(windows)):
        trim = half - window
        around = surface[
            rows.start + trim : rows.stop + half + window, cols.start + trim : cols.stop + half + window
        ].astype(float)
        nodes, bends = scene.nodes[:, b : b + 2, d : d + 2], scene.bends[:, b, d]
        for j, offset in enumerate(offsets):
            expected = agreement.profile(
                scene.images, nodes, scene.heights, around, offset, scene.block, window,
                visible.at(np.s_[:, rows, cols]), bends=bends,
            )  # fmt: skip
            np.testing.assert_allclose(out[w, j, rows, cols], expected, rtol=0, atol=NCC)
            for group in range(2):
                expected = agreement.profile(
                    scene.images, nodes, scene.heights, around, offset, scene.block, window,
                    visible.at(np.s_[:, rows, cols]), group=(group, 2), bends=bends,
                )  # fmt: skip
                np.testing.assert_allclose(groups[w, group, j, rows, cols], expected, rtol=0, atol=NCC)
    if n_views == 2:
        assert (out[:, :, 3:9] == 0).all()


def test_profile_of_one_block():
    scene = kernel_scene(3, (9, 11), 16)
    surface, out = np.full((13, 15), 12, np.float32), np.empty((1, 1, 1, 9, 11), np.float32)
    sampling = ProfileSampling(CUBIC, np.zeros(1, np.float32), np.array([2]), np.float32(0.0))
    block_profile(scene.arrays._replace(pixels=coefficients(scene)), surface, sampling, scene.all_visible(), out)
    expected = agreement.profile(
        scene.images, scene.nodes, scene.heights, surface.astype(float), 0.0, 16, 2, scene.all_visible()
    )
    np.testing.assert_allclose(out[0, 0, 0], expected, rtol=0, atol=1e-3)


def test_ortho_image():
    scene = kernel_scene(3)
    surface = (15 + 6 * gaussian_filter(np.random.default_rng(1).normal(size=scene.shape), 3)).astype(np.float32)
    out = np.empty(scene.shape, np.float32)
    for view in range(3):
        nodes = scene.nodes.copy()
        nodes[..., 3] = 0.0  # three grids stand for a quadratic exactly
        wanted = np.ones(np.subtract(nodes.shape[1:3], 1), np.bool_)
        tile_ortho(scene.arrays._replace(nodes=nodes), surface, view, wanted, out)
        for b, d, rows, cols in scene.blocks():
            t = scene.heights[0] + surface[rows, cols].astype(float) * scene.heights[1]
            xy = positions(nodes[view, b : b + 2, d : d + 2], t, t.shape, scene.block)
            inside = (xy > 0).all(axis=-1) & (xy < np.array(scene.images[view].shape[::-1]) - 1.1).all(axis=-1)
            expected = bilinear(scene.images[view], xy)
            np.testing.assert_allclose(out[rows, cols][inside], expected[inside], rtol=0, atol=GREY)
