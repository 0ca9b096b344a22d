"""Flooding of a band between images, so that they meet where they differ least."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# Cells that are not decided yet.
OPEN = -1
N_LEVELS = 256


class FloodQueue(NamedTuple):
    """Cells that wait, in a list for each level."""

    first: np.ndarray  # (l) i8: number of the first entry of each level, -1 without any
    last: np.ndarray  # (l) i8: number of the last entry of each level
    cells: np.ndarray  # (q) i8: cell of each entry, row by row
    images: np.ndarray  # (q) i4: image of each entry
    following: np.ndarray  # (q) i8: number of the following entry of the same level, -1 without any


# (r,c) u1, (k,r,c) b1, (r,c) i4 -> None
@kernel
def flood(difference, may_show, labels):
    """Give every open cell the number of an image that reaches it over the largest differences.

    difference : (r, c) uint8, between the images that may meet there; may_show : (k, r, c) bool, where an image has a
    value; labels : (r, c) int32, numbers of images, `OPEN` where the cell is to be decided and lower where it is not
    to be touched; changed. Cells that no image reaches stay open.

    Images grow from the cells that they have, first over cells of large differences (Meyer 1994, *Topographic distance
    and watershed lines*, on the reversed differences), so that they meet along cells of small ones.
    """
    n_rows, n_cols = labels.shape
    n_most = 4 * n_rows * n_cols  # every cell is queued once by each of its neighbours at most
    queue = FloodQueue(
        np.full(N_LEVELS, -1, np.int64), np.full(N_LEVELS, -1, np.int64), np.empty(n_most, np.int64),
        np.empty(n_most, np.int32), np.empty(n_most, np.int64),
    )  # fmt: skip
    n_queued = 0
    for row in range(n_rows):
        for col in range(n_cols):
            if labels[row, col] >= 0:
                n_queued = queue_neighbours(row, col, 0, difference, labels, queue, n_queued)
    for level in range(N_LEVELS):
        while queue.first[level] >= 0:
            entry = queue.first[level]
            queue.first[level] = queue.following[entry]
            row, col = queue.cells[entry] // n_cols, queue.cells[entry] % n_cols
            image = queue.images[entry]
            if labels[row, col] == OPEN and may_show[image, row, col]:
                labels[row, col] = image
                n_queued = queue_neighbours(row, col, level, difference, labels, queue, n_queued)


# i8, i8, i8, (r,c) u1, (r,c) i4, FloodQueue, i8 -> i8
@kernel
def queue_neighbours(row, col, level, difference, labels, queue, n_queued):
    """Queue the open neighbours of a cell for its image; return how many entries the queue has then.

    level : at which the cell was reached. A neighbour waits at its own level, or at this one if that is higher.
    """
    n_rows, n_cols = labels.shape
    for k in range(4):
        i = row + (1 if k == 0 else -1 if k == 1 else 0)
        j = col + (1 if k == 2 else -1 if k == 3 else 0)
        if i < 0 or j < 0 or i >= n_rows or j >= n_cols or labels[i, j] != OPEN:
            continue
        at = max(level, N_LEVELS - 1 - int(difference[i, j]))
        queue.cells[n_queued], queue.images[n_queued] = i * n_cols + j, labels[row, col]
        queue.following[n_queued] = -1
        if queue.first[at] < 0:
            queue.first[at] = n_queued
        else:
            queue.following[queue.last[at]] = n_queued
        queue.last[at] = n_queued
        n_queued += 1
    return n_queued
