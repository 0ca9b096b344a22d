"""Height ranges that views cover, against the slow twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kernel_scene import even_lattice, kernel_scene
from reference import surfaces
from reference.projection import positions
from zlocus.matching.kernels.coverage import (
    BlockLimits,
    ViewMasks,
    block_coverage,
    mask_of,
    surely_covered,
    tile_coverage,
)
from zlocus.matching.kernels.shared_records import NEVER_COVERED, HeightSpan

EVERYWHERE = np.array([-(2**29), 2**29])


def covered(scene, lattice, blocked=None, relief=None, limits=None):
    """Lowest and highest height index at which each view covers each cell, (2, i, r, c)."""
    every = EVERYWHERE[:, None, None, None] + np.zeros((scene.n_views, *lattice.count.shape), np.int64)
    limits = every if limits is None else limits
    relief = np.zeros(scene.shape, np.float32) if relief is None else relief
    blocked = np.zeros(len(scene.pixels), bool) if blocked is None else blocked
    has = np.array([blocked[o : o + r * c].any() for o, r, c in scene.layout])
    out = np.empty((2, scene.n_views, *scene.shape), np.int32)
    masks = ViewMasks(blocked, has)
    tile_coverage(scene.arrays, masks, lattice.layout, BlockLimits(*limits), 3.0, relief, out[0], out[1])
    return out


@pytest.mark.parametrize(("n_views", "shape", "block"), [(3, (37, 70), 16), (2, (45, 90), 32), (2, (5, 7), 8)])
@pytest.mark.parametrize("with_holes", [False, True])
@pytest.mark.parametrize("is_bent", [False, True])
def test_covered_heights(n_views, shape, block, with_holes, is_bent):
    scene, lattice = kernel_scene(n_views, shape, block, is_bent=is_bent), even_lattice(32, shape, block, first=3)
    blocked = np.zeros(len(scene.pixels), bool)
    if with_holes:
        for offset, rows, cols in scene.layout[:2]:
            blocked[offset : offset + rows * cols].reshape(rows, cols)[20:26, 15:33] = True
    found = covered(scene, lattice, blocked)
    ends = 0
    for b, d, rows, cols in scene.blocks():
        for i in range(n_views):
            place, cells = (i, b, d), (rows.stop - rows.start, cols.stop - cols.start)
            good = np.stack([covers(scene, place, cells, k, blocked) for k in range(3, 35)], axis=-1)
            for r, c in np.ndindex(cells):
                run = surfaces.longest_run(good[r, c])
                expected = (NEVER_COVERED, -1) if run is None else (run[0] + 3, run[1] + 3)
                assert tuple(found[:, i, rows.start + r, cols.start + c]) == expected
                ends += run is not None and run != (0, 31)
    assert ends > 0 or shape == (5, 7)


def test_covered_heights_whatever_index_heights_start_at():
    """Heights below the support surface have negative indices: the same heights, numbered from 20 lower."""
    scene = kernel_scene()
    blocked = np.zeros(len(scene.pixels), bool)
    blocked[: 61 * 97].reshape(61, 97)[15:40, 30:60] = True
    plain = covered(scene, even_lattice(32, first=3), blocked)
    moved = replace(scene, heights=scene.heights + np.array([20 * scene.heights[1], 0.0]))
    lower = covered(moved, even_lattice(32, first=-17), blocked)
    never = plain[0] == NEVER_COVERED
    assert 0 < never.sum() < never.size / 2
    np.testing.assert_array_equal(lower[0] == NEVER_COVERED, never)
    np.testing.assert_array_equal(lower[:, ~never], plain[:, ~never] - 20)
    assert (lower[0] > lower[1])[never].all()


def test_covered_heights_end_where_tables_do():
    """Runs are looked for between the limits of each block and view, and nowhere where the lower one is above."""
    scene, lattice = kernel_scene(), even_lattice(32, first=3)
    limits = np.random.default_rng(2).integers(0, 40, (2, scene.n_views, *lattice.count.shape))
    found, empty = covered(scene, lattice, limits=limits), 0
    for number, (b, d, rows, cols) in enumerate(scene.blocks()):
        for i in range(scene.n_views):
            low, high = limits[:, i, *np.unravel_index(number, limits.shape[2:])]
            place, cells = (i, b, d), (rows.stop - rows.start, cols.stop - cols.start)
            inside = [covers(scene, place, cells, k, np.zeros(len(scene.pixels), bool)) for k in range(3, 35)]
            good = np.stack([at & (low <= k <= high) for k, at in zip(range(3, 35), inside, strict=True)], axis=-1)
            for r, c in np.ndindex(cells):
                run = surfaces.longest_run(good[r, c])
                expected = (NEVER_COVERED, -1) if run is None else (run[0] + 3, run[1] + 3)
                assert tuple(found[:, i, rows.start + r, cols.start + c]) == expected
                empty += low > high
    assert empty > 0


def test_ends_of_covered_heights_follow_the_relief():
    """A run that ends at the image's border ends by as much lower as the surface stands higher there; one that ends
    with the block's heights stays."""
    scene, lattice = kernel_scene(), even_lattice(32, first=3)
    relief = np.random.default_rng(3).uniform(-6.0, 6.0, scene.shape).astype(np.float32)
    plain, moved = covered(scene, lattice), covered(scene, lattice, relief=relief)
    never, from_below, from_above = plain[0] > plain[1], plain[0] > 3, plain[1] < 34
    for some in (from_below & ~never, from_above & ~never, ~from_below & ~from_above):
        assert some.any()
    low = np.where(from_below & ~never, np.ceil(plain[0] - relief), plain[0])
    high = np.where(from_above & ~never, np.floor(plain[1] - relief), plain[1])
    np.testing.assert_array_equal(moved, [low, high])


def covers(scene, place, cells, k, blocked):
    """Whether the cells of a block fall on a usable pixel at height index k, three from the border.

    place : view, row and column of blocks.
    """
    node, bend = scene.of_one_block(*place)
    t = scene.heights[0] + k * scene.heights[1]
    x, y = np.moveaxis(positions(node, t, cells, scene.block, bend=bend), -1, 0)
    offset, rows, cols = scene.layout[place[0]]
    inside = (x >= 3) & (x <= cols - 4) & (y >= 3) & (y <= rows - 4)
    hole = blocked[offset : offset + rows * cols].reshape(rows, cols)
    at = (np.clip((y + 0.5).astype(int), 0, rows - 1), np.clip((x + 0.5).astype(int), 0, cols - 1))
    return inside & ~hole[at]


def test_covered_heights_of_one_block_and_its_shortcut():
    scene = kernel_scene(2, (8, 8), 8)
    blocked = np.zeros(len(scene.pixels), bool)
    plain, some = (mask_of(scene.arrays, ViewMasks(blocked, np.full(2, has)), 0) for has in (False, True))
    assert surely_covered(scene.arrays, 0, -0.5, 0.5, 3.0, plain)
    assert surely_covered(scene.arrays, 0, -0.5, 0.5, 3.0, some)
    assert not surely_covered(scene.arrays, 0, -9.0, 0.5, 3.0, plain)
    for t in (-0.5, 0.0, 0.5):
        at = positions(scene.nodes[0, :2, :2], t, (8, 8), 8)[4, 4].astype(int)
        blocked[:] = False
        blocked[at[1] * scene.layout[0, 2] + at[0]] = True
        assert not surely_covered(scene.arrays, 0, -0.5, 0.5, 3.0, some)
    lowest, highest = np.empty((2, 2, 8, 8), np.int32)
    masks = ViewMasks(np.zeros(len(scene.pixels), bool), np.zeros(2, bool))
    limits = EVERYWHERE[:, None].repeat(2, axis=1)
    block_coverage(scene.arrays, masks, HeightSpan(0, 16), limits[0], limits[1], 3.0, lowest, highest)
    assert (lowest == 0).all()
    assert (highest == 15).all()
