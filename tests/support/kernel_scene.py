"""A tile of smooth images and made-up projections, as the kernels take them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import views_of_block
from zlocus.matching.kernels.shared_records import ViewArrays, VisibleHeights

IMAGE_SHAPE = (61, 97)


@dataclass(frozen=True)
class KernelScene:
    """images : one (r, c) float32 each; nodes : (i, b + 1, d + 1, 2, 4); bends : (i, b, d, 2, 2, 4), or n = 0; the
    others as in `TileViews`."""

    images: list[np.ndarray]
    pixels: np.ndarray
    layout: np.ndarray
    nodes: np.ndarray
    bends: np.ndarray
    heights: np.ndarray
    shape: tuple[int, int]
    block: int

    @property
    def n_views(self):
        return len(self.images)

    @property
    def arrays(self):
        """The record that kernels take."""
        return ViewArrays(self.pixels, self.layout, self.nodes, self.bends, self.heights, self.block)

    def of_block(self, b, d):
        """The record that kernels take of one block."""
        return views_of_block(self.arrays, b, d)

    def of_one_block(self, view, b, d):
        """Corners (2, 2, 2, 4) and bends (2, 2, n) of one view."""
        return self.nodes[view, b : b + 2, d : d + 2], self.bends[view, b, d]

    def blocks(self):
        """Block row and column, and the rows and columns of its cells."""
        for b in range(self.nodes.shape[1] - 1):
            for d in range(self.nodes.shape[2] - 1):
                r0, c0 = b * self.block, d * self.block
                rows = slice(r0, min(r0 + self.block, self.shape[0]))
                yield b, d, rows, slice(c0, min(c0 + self.block, self.shape[1]))

    def all_visible(self):
        """Every view covers and sees every height."""
        shape = (self.n_views, *self.shape)
        return VisibleHeights(np.zeros(shape, np.int32), np.full(shape, 1000, np.int32), np.zeros(shape, np.int32))


def kernel_scene(n_views=3, shape=(37, 70), block=16, seed=0, is_bent=False):
    """Views turned, scaled and curved a little; image sizes differ; some cells near the edges project outside.

    is_bent : rows and columns of the blocks bend by up to a pixel, a little more or less with the height.
    """
    rng = np.random.default_rng(seed)
    corners = (-(-shape[0] // block) + 1, -(-shape[1] // block) + 1)
    row, col = np.meshgrid(np.arange(corners[0]) * block, np.arange(corners[1]) * block, indexing="ij")
    images, nodes, layout, offset = [], [], [], 0
    for i in range(n_views):
        rows, cols = IMAGE_SHAPE[0] - 3 * i, IMAGE_SHAPE[1] + i
        images.append(gaussian_filter(rng.normal(size=(rows, cols)), 1.0).astype(np.float32) * 5 + 4)
        layout.append((offset, rows, cols))
        offset += rows * cols
        turn, size = 0.06 * (i - 1), 1.05 + 0.05 * i
        node = np.zeros((*corners, 2, 4))
        node[..., 0, 0] = 9 + size * (col * np.cos(turn) - row * np.sin(turn)) + 2e-4 * col * row
        node[..., 1, 0] = 8 + size * (row * np.cos(turn) + col * np.sin(turn)) - 3e-4 * col * row
        node[..., 0, 1], node[..., 1, 1] = 4.0 * i + 0.004 * row, 2.0 - 3.0 * i + 0.006 * col
        node[..., 0, 2], node[..., 1, 2], node[..., 0, 3] = 0.05, 0.03 * i, 0.02
        nodes.append(node)
    pixels = np.concatenate([image.ravel() for image in images])
    heights = np.array([-0.9, 0.06])
    bends = np.zeros((n_views, corners[0] - 1, corners[1] - 1, 2, 2, 4 if is_bent else 0))
    if is_bent:
        bends[..., :2] = rng.uniform(-1.0, 1.0, (*bends.shape[:-1], 2)) * (4.0 / block**2, 0.4 / block**2)
    return KernelScene(images, pixels, np.array(layout, np.int64), np.stack(nodes), bends, heights, shape, block)


def ragged_lattice(shape=(37, 70), block=16, seed=0, counts=(16, 32)):
    """Every block with a range of its own."""
    rng = np.random.default_rng(seed)
    blocks = (-(-shape[0] // block), -(-shape[1] // block))
    first = rng.integers(0, 12, blocks).astype(np.int64)
    return HeightLattice(0.0, 1.0, shape, block, first, rng.choice(counts, blocks).astype(np.int64))


def even_lattice(count=16, shape=(37, 70), block=16, first=0):
    """Every block with the same range."""
    blocks = (-(-shape[0] // block), -(-shape[1] // block))
    return HeightLattice(0.0, 1.0, shape, block, np.full(blocks, first), np.full(blocks, count))


def at_all_heights(holds):
    """`TileViews.index_range` of blocks (i, b, d) that hold at every height."""
    return np.broadcast_to((-np.inf, np.inf), (*holds.shape, 2))


def rough_surface(shape, seed=0, high=25.0):
    """(r, c) float32: half of the cells at 0, the others anywhere up to `high`."""
    rng = np.random.default_rng(seed)
    return (rng.integers(0, 2, shape) * high * rng.random(shape)).astype(np.float32)


def random_cost(lattice, seed=0, high=129):
    """(v,) uint8 costs of a lattice, below `high`."""
    return np.random.default_rng(seed).integers(0, high, lattice.size).astype(np.uint8)


def random_p2(shape, seed=0):
    """(4, r, c) uint16 penalties of jumps from the west, north-west, north and north-east."""
    return np.random.default_rng(seed).integers(60, 241, (4, *shape)).astype(np.uint16)
