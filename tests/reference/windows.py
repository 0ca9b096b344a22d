"""Twins of `normalise` and `line_windows`: windows of one view around a cell at one height."""

from __future__ import annotations

import numpy as np

from reference.projection import derivative, position


def normalised(window):
    """Less its mean, of norm 1; all zero where it is even."""
    apart = np.asarray(window, float) - np.mean(window)
    norm = np.sqrt((apart**2).sum())
    return apart / norm if norm > 1e-4 else np.zeros_like(apart)


def window_places(node, t, cell, block, half, relief, per_index, bend=None):
    """(k, 2) px of a window's cells, row by row, each `relief` (k,) steps above its middle.

    node : (2, 2, 2, 4), corners of the cell's block; cell : row and column in the block; a step moves a cell as it does
    the middle of the block.
    """
    row, col = (v.ravel() + start for v, start in zip(np.indices((2 * half + 1,) * 2) - half, cell, strict=True))
    speed = position(derivative(node), np.float64(t), block / 2, block / 2, block) * per_index
    return position(node, np.full(row.shape, t), row, col, block, bend) + np.asarray(relief, float)[:, None] * speed


def line_window(image, blocked, node, t, cell, block, half, relief, per_index, bend=None):
    """(k,) normalised values of a window; NaN where it leaves the image, or its middle is on a blocked pixel."""
    xy = window_places(node, t, cell, block, half, relief, per_index, bend)
    last = np.array([image.shape[1] - 1, image.shape[0] - 1])
    if (xy < 0).any() or (xy >= last).any():
        return np.full(len(xy), np.nan)
    col, row = np.floor(xy[len(xy) // 2] + 0.5).astype(int)
    if blocked[row, col]:
        return np.full(len(xy), np.nan)
    return normalised(values_at(image, xy))


def values_at(image, xy):
    """Bilinear values of an image at positions (k, 2) inside it."""
    out = []
    for x, y in xy:
        left, top = int(x), int(y)
        fx, fy = x - left, y - top
        (a, b), (c, d) = np.asarray(image[top : top + 2, left : left + 2], float)
        out.append((1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d))
    return np.array(out)
