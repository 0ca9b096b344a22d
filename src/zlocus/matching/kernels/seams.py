"""Flooding of a band between images, so that they meet where they differ least."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel

# Cells that are not decided yet.
OPEN = -1
N_LEVELS = 256


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
    first, last = np.full(N_LEVELS, -1, np.int64), np.full(N_LEVELS, -1, np.int64)
    n_most = 4 * n_rows * n_cols
    cells, images, following = np.empty(n_most, np.int64), np.empty(n_most, np.int32), np.empty(n_most, np.int64)
    n_queued = 0
    for start in range(n_rows * n_cols):
        image = labels[start // n_cols, start % n_cols]
        if image >= 0:
            n_queued = queue_neighbours(start, image, 0, difference, labels, (first, last, cells, images, following),
                                        n_queued)  # fmt: skip
    for level in range(N_LEVELS):
        while first[level] >= 0:
            entry = first[level]
            first[level] = following[entry]
            cell, image = cells[entry], images[entry]
            row, col = cell // n_cols, cell % n_cols
            if labels[row, col] != OPEN or not may_show[image, row, col]:
                continue
            labels[row, col] = image
            n_queued = queue_neighbours(cell, image, level, difference, labels,
                                        (first, last, cells, images, following), n_queued)  # fmt: skip


# i8, i4, i8, (r,c) u1, (r,c) i4, tuple, i8 -> i8
@kernel
def queue_neighbours(cell, image, level, difference, labels, queue, n_queued):
    """Queue the open neighbours of a cell for an image, and return how many entries the queue has then.

    level : of the cell; queue : first and last entry of each level, and of each entry its cell, image and following
    entry.
    """
    first, last, cells, images, following = queue
    n_rows, n_cols = labels.shape
    row, col = cell // n_cols, cell % n_cols
    for k in range(4):
        i, j = row + (k == 0) - (k == 1), col + (k == 2) - (k == 3)
        if not (0 <= i < n_rows and 0 <= j < n_cols) or labels[i, j] != OPEN or n_queued == len(cells):
            continue
        at = max(level, N_LEVELS - 1 - difference[i, j])
        cells[n_queued], images[n_queued], following[n_queued] = i * n_cols + j, image, -1
        if first[at] < 0:
            first[at] = n_queued
        else:
            following[last[at]] = n_queued
        last[at] = n_queued
        n_queued += 1
    return n_queued
