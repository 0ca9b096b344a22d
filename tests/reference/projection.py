"""Twins of `plane_grid`, `resample_plane`, `resample_surface` and `tile_ortho`: where cells fall, and what is there."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates


def position(node, t, row, col, block):
    """(x, y) px of a cell (row, col) of a block at height t. node : (2, 2, 2, 4) corner row, corner column, axis, cubic.

    Bilinear between the four corners, cubic in height.
    """
    powers = np.array([1.0, t, t**2, t**3])
    a, b = row / block, col / block
    corners = node @ powers
    top = (1 - b) * corners[0, 0] + b * corners[0, 1]
    low = (1 - b) * corners[1, 0] + b * corners[1, 1]
    return (1 - a) * top + a * low


def positions(node, t, shape, block, border=0):
    """(r, c, 2) px of the first `shape` cells of a block and of a border around them. t : height, a number or (r, c)."""
    t = np.broadcast_to(t, (shape[0] + 2 * border, shape[1] + 2 * border))
    out = np.empty((*t.shape, 2))
    for r, c in np.ndindex(t.shape):
        out[r, c] = position(node, t[r, c], r - border, c - border, block)
    return out


def bilinear(image, xy):
    """Values of an image (r, c) at positions (..., 2), clamped to just inside its last pixel."""
    x = np.clip(xy[..., 0], 0, image.shape[1] - 1.01)
    y = np.clip(xy[..., 1], 0, image.shape[0] - 1.01)
    return map_coordinates(image.astype(float), [y, x], order=1)


def cubic(image, xy):
    """Values of the cubic B-spline through an image (r, c) at positions (..., 2), from plain pixels."""
    return map_coordinates(image.astype(float), [xy[..., 1], xy[..., 0]], order=3, mode="mirror")
