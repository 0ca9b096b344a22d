"""The base surface of a level: heights are searched along it, so that a slope is level to windows and penalties.

Level windows see a slope as a step per cell, and the semi-global constraint makes stairs of it. The base surface takes
the slopes of the coarser level's surface (medians over blocks, which jumps do not touch) and none of its jumps; height
index k then means k steps above the base. It is continuous and bilinear between the corners of blocks, so neighbours
are still compared by height. It follows no building: where slopes are small it is nearly level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.smooth import slopes
from zlocus.matching.views import TileViews

SLOPE_REACH = 4
ANCHOR = 1e-3
STEEP_STEPS = 8.0
BINOMIAL = ((1, 1, 1, 1), (0, 1, 2, 3), (0, 0, 1, 3), (0, 0, 0, 1))


@dataclass(frozen=True)
class BaseSurface:
    """nodes : (b + 1, d + 1) float64, height indices at corners of blocks; cells : (r, c) float32, of every cell."""

    nodes: NDArray[np.float64]
    cells: NDArray[np.float32]

    @classmethod
    def level(cls, shape: tuple[int, int], block: int) -> BaseSurface:
        """No slope anywhere."""
        return cls(np.zeros((-(-shape[0] // block) + 1, -(-shape[1] // block) + 1)), np.zeros(shape, np.float32))

    @classmethod
    def along(cls, surface: NDArray[np.float32], block: int) -> BaseSurface:
        """With the slopes of a smooth surface, (r, c) float32 height indices."""
        nodes = integrated(*block_slopes(surface, block), block, block_heights(surface, block))
        return cls(nodes, bilinear(nodes, surface.shape, block))

    @property
    def is_steep(self) -> bool:
        """Whether it rises anywhere by so much from a block's corner to the next that level windows would suffer."""
        return bool(max(np.abs(np.diff(self.nodes, axis=axis)).max(initial=0.0) for axis in (0, 1)) > STEEP_STEPS)

    def shear(self, views: TileViews) -> TileViews:
        """The views with nodes that project height index k of the base instead of the lattice.

        A cubic in t at a node, taken at t + delta, is another cubic in t: c'_j = sum_i C(i, j) c_i delta^(i - j).
        """
        delta = self.nodes * views.heights[1]
        moved = np.zeros_like(views.nodes)
        for j in range(4):
            for i in range(j, 4):
                moved[..., j] += BINOMIAL[j][i] * views.nodes[..., i] * (delta ** (i - j))[None, :, :, None]
        return replace(views, nodes=moved)


def block_slopes(surface: NDArray[np.float32], block: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Median slope per cell of every block along rows and columns, each (b, d)."""
    by_row, by_col = np.empty_like(surface), np.empty_like(surface)
    slopes(surface, SLOPE_REACH, by_row, by_col)
    return block_medians(by_row, block), block_medians(by_col, block)


def block_heights(surface: NDArray[np.float32], block: int) -> NDArray[np.float64]:
    """Median height of every block, (b, d)."""
    return block_medians(surface, block)


def block_medians(values: NDArray[np.float32], block: int) -> NDArray[np.float64]:
    """Median of every block of (r, c) values; blocks at the border may be smaller."""
    rows, cols = values.shape
    n_b, n_d = -(-rows // block), -(-cols // block)
    whole_b, whole_d = rows // block, cols // block
    out = np.empty((n_b, n_d))
    whole = values[: whole_b * block, : whole_d * block].reshape(whole_b, block, whole_d, block)
    out[:whole_b, :whole_d] = np.median(whole.transpose(0, 2, 1, 3).reshape(whole_b, whole_d, block * block), axis=2)
    for b in range(n_b):
        for d in range(n_d):
            if b >= whole_b or d >= whole_d:
                out[b, d] = np.median(values[b * block : (b + 1) * block, d * block : (d + 1) * block])
    return out


def integrated(
    by_row: NDArray[np.float64], by_col: NDArray[np.float64], block: int, heights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Heights of the corners of blocks whose differences come closest to the slopes of the blocks. (b + 1, d + 1).

    Least squares over both edges of every block and direction; a weak weight on the blocks' heights, which are the
    means of their corners, fixes the rest.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import spsolve

    n_b, n_d = by_row.shape
    number = np.arange((n_b + 1) * (n_d + 1)).reshape(n_b + 1, n_d + 1)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]]
    equations = [
        (corners[2], corners[0], by_row), (corners[3], corners[1], by_row),
        (corners[1], corners[0], by_col), (corners[3], corners[2], by_col),
    ]  # fmt: skip
    rows, cols, values = [], [], []
    right = np.zeros(number.size)
    for plus, minus, slope in equations:
        p, m, rise = plus.ravel(), minus.ravel(), block * slope.ravel()
        rows += [p, m, p, m]
        cols += [p, m, m, p]
        values += [np.ones(p.size), np.ones(p.size), -np.ones(p.size), -np.ones(p.size)]
        np.add.at(right, p, rise)
        np.add.at(right, m, -rise)
    for corner in corners:
        p = corner.ravel()
        np.add.at(right, p, ANCHOR / 4 * heights.ravel())
        for other in corners:
            rows.append(p)
            cols.append(other.ravel())
            values.append(np.full(p.size, ANCHOR / 16))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
    matrix = coo_array(entries, shape=(number.size, number.size)).tocsc()
    return np.asarray(spsolve(matrix, right)).reshape(number.shape)


def bilinear(nodes: NDArray[np.float64], shape: tuple[int, int], block: int) -> NDArray[np.float32]:
    """Values at every cell between corners `block` cells apart, (r, c) float32."""
    r, c = np.arange(shape[0]), np.arange(shape[1])
    b, d, fr, fc = r // block, c // block, (r % block) / block, (c % block) / block
    along = nodes[:, d] * (1 - fc) + nodes[:, d + 1] * fc
    return (along[b] * (1 - fr)[:, None] + along[b + 1] * fr[:, None]).astype(np.float32)
