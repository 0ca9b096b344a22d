"""Twins of `block_grid`, `resample_plane`, `resample_surface` and `tile_ortho`: where cells project to, and values."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates


def position(node, t, row, col, block, bend=None):
    """(x, y) px of the cell (row, col) of a block at height t: bilinear between four corners, cubic in height.

    node : (2, 2, 2, 4) corner row, corner column, axis, coefficients. t, row, col : numbers, or arrays of one shape.
    bend : (2, 2, 4) along rows and along columns, axis, coefficients: what is added times r (r - block), c (c - block).
    """
    powers = np.stack([np.ones_like(t), t, t**2, t**3], axis=-1)
    a, b = np.asarray(row / block)[..., None], np.asarray(col / block)[..., None]
    corners = [[powers @ node[i, j].T for j in (0, 1)] for i in (0, 1)]
    top = (1 - b) * corners[0][0] + b * corners[0][1]
    low = (1 - b) * corners[1][0] + b * corners[1][1]
    straight = (1 - a) * top + a * low
    if bend is None or not bend.shape[-1]:
        return straight
    along_rows, along_cols = (powers @ coefficients.T for coefficients in bend)
    return straight + block**2 * (a * (a - 1) * along_rows + b * (b - 1) * along_cols)


def positions(node, t, shape, block, border=0, bend=None):
    """(r, c, 2) px of the first `shape` cells of a block and of `border` cells around them.

    t : height, a number or (r, c).
    """
    row, col = np.indices((shape[0] + 2 * border, shape[1] + 2 * border)) - float(border)
    return position(node, np.broadcast_to(np.asarray(t, float), row.shape), row, col, block, bend)


def derivative(node):
    """Corners (2, 2, 2, 4) whose positions are the px per t of `node`'s."""
    return np.concatenate([node[..., 1:] * [1.0, 2.0, 3.0], np.zeros_like(node[..., :1])], axis=-1)


def along_slope(node, t, relief, per_index, shape, block, border=0, bend=None):
    """(r, c, 2) px of the cells of a block, `relief` steps above t, moving as fast as the block's middle does at t.

    relief : (r + 2 border, c + 2 border) steps; per_index : t per step. `positions` of the cells' own heights, but for
    the change of speed within a block and over the relief.
    """
    speed = position(derivative(node), np.float64(t), block / 2, block / 2, block) * per_index
    return positions(node, t, shape, block, border, bend) + relief[..., None] * speed


def slope_relief(surface, corners, rows, cols, block, border):
    """Support surface less the bilinear surface through a block's four corners.

    surface : of a tile and of `border` cells around it.
    """
    part = surface[rows.start : rows.stop + 2 * border, cols.start : cols.stop + 2 * border]
    a, b = (np.indices(part.shape) - border) / block
    top = (1 - b) * corners[0, 0] + b * corners[0, 1]
    low = (1 - b) * corners[1, 0] + b * corners[1, 1]
    return part - (1 - a) * top - a * low


def bilinear(image, xy):
    """Values of an image (r, c) at positions (..., 2), clamped to just inside its last pixel."""
    x = np.clip(xy[..., 0], 0, image.shape[1] - 1.01)
    y = np.clip(xy[..., 1], 0, image.shape[0] - 1.01)
    return map_coordinates(image.astype(float), [y, x], order=1)


def cubic(image, xy):
    """Values of the cubic B-spline through an image (r, c) at positions (..., 2), clamped to its inner pixels."""
    x = np.clip(xy[..., 0], 1.0, image.shape[1] - 3.01)
    y = np.clip(xy[..., 1], 1.0, image.shape[0] - 3.01)
    return map_coordinates(image.astype(float), [y, x], order=3, mode="mirror")
