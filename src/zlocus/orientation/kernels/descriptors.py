"""Search for the SIFT feature of nearest descriptor along an epipolar curve, which a straight segment stands for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.jit import kernel
from zlocus.core.sensor_model import FloatArray

# Features are sorted into square cells, of which only those along the segment are searched.
CELL_PX = 64.0
# A point beyond an end of a segment and beside it at the same time is up to sqrt(2) times the search distance away.
CORNER_FACTOR = 1.5
# Features closer than this are one feature with several orientations, and do not compete with each other.
SAME_PLACE_PX = 2.0
# Distance of RootSIFT descriptors of different ground. Random pairs have 0.9 to 1.2.
UNRELATED_DISTANCE = 0.9
# Descriptors are whole numbers, of this length: sums of whole numbers do not depend on their order, so that they are
# added many at a time, in a seventh of the time. No product of two descriptors exceeds a number of 32 bits.
DESCRIPTOR_LENGTH_UNITS = 2**14


class CurveSegments(NamedTuple):
    """Segments in the second image, one for each feature of the first image, and the descriptors of these features."""

    low: FloatArray  # (n,2) f8: end at the lowest height, px; NaN where there is no segment
    high: FloatArray  # (n,2) f8: end at the highest height, px
    descriptors: NDArray[np.int16]  # (n,d) i2: of a length of DESCRIPTOR_LENGTH_UNITS


class SecondFeatures(NamedTuple):
    """Features of the second image."""

    xy: FloatArray  # (k,2) f8: px
    descriptors: NDArray[np.int16]  # (k,d) i2: of a length of DESCRIPTOR_LENGTH_UNITS


class Direction(NamedTuple):
    """Unit vector along a segment, and its length. A segment without length is taken as horizontal."""

    by_x: float  # f8: component along the columns
    by_y: float  # f8: component along the rows
    length: float  # f8: px


# (n,d) i2, u8, (k,d) i2, u8 -> f4
@kernel
def descriptor_distance(in_a, i, in_b, j):
    """Distance of two descriptors, rows i and j, as a share of their length."""
    product, per_square = np.int32(0), np.float32(2.0 / DESCRIPTOR_LENGTH_UNITS**2)
    for k in range(np.uint64(in_a.shape[1])):
        product = np.int32(product + np.int32(np.int32(in_a[i, k]) * np.int32(in_b[j, k])))
    return np.sqrt(max(np.float32(2.0) - per_square * np.float32(product), np.float32(0.0)))


# (k,2) f8, (2) f8, i8, i8, (c) i8, (k) i8 -> None
@kernel
def sort_into_cells(xy, corner, rows, cols, start, order):
    """Sort points (k, 2) into the cells of a grid with its first cell at `corner`, px.

    order : (k,) receives the numbers of the points, cell after cell, row by row; start : (rows * cols + 1,) receives
    the place in `order` at which each cell begins.
    """
    cell = np.empty(len(xy), np.int64)
    start[:] = 0
    for k in range(len(xy)):
        col, row = int((xy[k, 0] - corner[0]) / CELL_PX), int((xy[k, 1] - corner[1]) / CELL_PX)
        cell[k] = row * cols + col
        start[cell[k] + 1] += 1
    for c in range(rows * cols):
        start[c + 1] += start[c]
    filled = start[:-1].copy()
    for k in range(len(xy)):
        order[filled[cell[k]]] = k
        filled[cell[k]] += 1


# (2) f8, (2) f8 -> Direction
@kernel
def direction(low, high):
    """Direction of the segment between two points, px."""
    by_x, by_y = high[0] - low[0], high[1] - low[1]
    length = np.sqrt(by_x * by_x + by_y * by_y)
    return Direction(by_x / length, by_y / length, length) if length > 1e-9 else Direction(1.0, 0.0, length)


# f8, f8, Direction, f8 -> b1
@kernel
def is_near(x, y, along_segment, max_px):
    """Whether a point lies within `max_px` of a segment, both along it beyond its ends and across it.

    x, y : from the first end of the segment; along_segment : of it.
    """
    along = x * along_segment.by_x + y * along_segment.by_y
    across = abs(x * along_segment.by_y - y * along_segment.by_x)
    return across <= max_px and -max_px <= along <= along_segment.length + max_px


# (2) f8, (2) f8, f8, f8 -> (2) f8
@kernel
def span_in_row(low, high, top, max_px):
    """Smallest and largest x, in the row of cells that begins at y = `top`, of points that `is_near` can accept."""
    margin = CORNER_FACTOR * max_px
    x0, x1, by_y = low[0], high[0], high[1] - low[1]
    if abs(by_y) > 1e-9:
        one = min(max((top - margin - low[1]) / by_y, 0.0), 1.0)
        other = min(max((top + CELL_PX + margin - low[1]) / by_y, 0.0), 1.0)
        x0, x1 = low[0] + one * (high[0] - low[0]), low[0] + other * (high[0] - low[0])
    return np.array([min(x0, x1) - margin, max(x0, x1) + margin])


# (k,2) f8, (m) i8, (m) f4, i8, f8 -> b1
@kernel
def is_clear(xy, near, distance, n_near, ratio):
    """Whether the best match is clearly better than the second-best match at another place.

    near, distance : (m,), of which the first `n_near` hold the numbers of the candidates and the distances of their
    descriptors; ratio : the best distance must be below this share of the second best.
    """
    best = np.argmin(distance[:n_near])
    second_best = np.float32(UNRELATED_DISTANCE)
    for k in range(n_near):
        away_x = abs(xy[near[k], 0] - xy[near[best], 0])
        away_y = abs(xy[near[k], 1] - xy[near[best], 1])
        if max(away_x, away_y) > SAME_PLACE_PX:
            second_best = min(second_best, distance[k])
    return distance[best] < ratio * second_best


# CurveSegments, SecondFeatures, f8, f8, (n) i8, (k) i8 -> None
@kernel
def nearest_descriptors(segments, features, max_px, ratio, best_a, best_b):
    """Find for each segment the feature near it with the nearest descriptor, and for each feature the segment.

    max_px : largest distance of a feature from its segment; ratio : see `is_clear`. best_a : (n,) receives the number
    of a feature, -1 where none is near or the best match is not clear; best_b : (k,) receives the number of a segment,
    -1 where none is near.
    """
    low, high, in_a, xy, in_b = segments.low, segments.high, segments.descriptors, features.xy, features.descriptors
    best_a[:] = -1
    best_b[:] = -1
    if not len(xy):
        return
    corner = np.array([xy[:, 0].min(), xy[:, 1].min()])
    cols, rows = int((xy[:, 0].max() - corner[0]) / CELL_PX) + 1, int((xy[:, 1].max() - corner[1]) / CELL_PX) + 1
    start, order = np.empty(rows * cols + 1, np.int64), np.empty(len(xy), np.int64)
    sort_into_cells(xy, corner, rows, cols, start, order)
    closest, sorted_xy = np.full(len(xy), np.inf, np.float32), xy[order]
    near, distance = np.empty(len(xy), np.int64), np.empty(len(xy), np.float32)
    for i in range(len(low)):
        if not (np.isfinite(low[i]).all() and np.isfinite(high[i]).all()):
            continue
        top = min(low[i, 1], high[i, 1]) - CORNER_FACTOR * max_px
        bottom = max(low[i, 1], high[i, 1]) + CORNER_FACTOR * max_px
        first, last = int(np.floor((top - corner[1]) / CELL_PX)), int(np.floor((bottom - corner[1]) / CELL_PX))
        n_near, x, y, along_segment = 0, low[i, 0], low[i, 1], direction(low[i], high[i])
        for row in range(max(first, 0), min(last, rows - 1) + 1):
            left, right = span_in_row(low[i], high[i], corner[1] + row * CELL_PX, max_px)
            c0, c1 = int(np.floor((left - corner[0]) / CELL_PX)), int(np.floor((right - corner[0]) / CELL_PX))
            if c1 < 0 or c0 >= cols:
                continue
            for at in range(start[row * cols + max(c0, 0)], start[row * cols + min(c1, cols - 1) + 1]):
                if not is_near(sorted_xy[at, 0] - x, sorted_xy[at, 1] - y, along_segment, max_px):
                    continue
                j = order[at]
                apart = descriptor_distance(in_a, np.uint64(i), in_b, np.uint64(j))
                near[n_near], distance[n_near] = j, apart
                n_near += 1
                if apart < closest[j]:
                    closest[j], best_b[j] = apart, i
        if n_near and is_clear(xy, near, distance, n_near, ratio):
            best_a[i] = near[np.argmin(distance[:n_near])]
