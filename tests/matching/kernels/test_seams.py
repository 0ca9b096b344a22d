"""Flooding between images: against a slow twin with a sorted queue, and where images meet."""

from __future__ import annotations

import heapq

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from zlocus.matching.kernels.seams import OPEN, flood


def slow_twin(difference, may_show, labels):
    """The same flood with a queue that is sorted by level, then by the time of entry."""
    labels, queue, time = labels.copy(), [], 0
    rows, cols = labels.shape

    def enter(row, col, level):
        nonlocal time
        for i, j in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            if 0 <= i < rows and 0 <= j < cols and labels[i, j] == OPEN:
                heapq.heappush(queue, (max(level, 255 - int(difference[i, j])), time, i, j, labels[row, col]))
                time += 1

    for row, col in np.ndindex(rows, cols):
        if labels[row, col] >= 0:
            enter(row, col, 0)
    while queue:
        level, _, row, col, image = heapq.heappop(queue)
        if labels[row, col] == OPEN and may_show[image, row, col]:
            labels[row, col] = image
            enter(row, col, level)
    return labels


@given(st.integers(0, 2**16))
def test_slow_twin(seed):
    rng = np.random.default_rng(seed)
    difference = rng.integers(0, 256, (8, 9)).astype(np.uint8)
    labels = rng.choice([OPEN, OPEN, OPEN, OPEN - 1, 0, 1, 2], (8, 9)).astype(np.int32)
    may_show = rng.random((3, 8, 9)) < 0.8
    expected = slow_twin(difference, may_show, labels)
    flood(difference, may_show, labels)
    assert (labels == expected).all()


def test_images_meet_where_they_differ_least():
    difference = np.full((20, 30), 200, np.uint8)
    seam = 13 + np.round(3 * np.sin(np.arange(20) / 4)).astype(int)
    for row, col in enumerate(seam):
        difference[row, col - 1 : col + 2] = 0  # a valley along a bend
    labels = np.full((20, 30), OPEN, np.int32)
    labels[:, 0], labels[:, -1] = 0, 1
    flood(difference, np.ones((2, 20, 30), bool), labels)
    assert (np.abs((labels == 0).sum(axis=1) - seam) <= 1).all()
