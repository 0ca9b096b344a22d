"""A location grid, point by point: from the image to the ground at a height, and back.

The nodes of each height are interpolated by a uniform cubic B-spline, and those of neighbouring heights by a polynomial
of up to the third degree. In plain NumPy each point would gather 128 coefficients for every step of the way back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

MAX_HEIGHTS = 4
MAX_ITERATIONS = 30
# Largest Newton step, as a share of the grid.
MAX_STEP = 0.5


class GridNumbers(NamedTuple):
    """A location grid as its kernels take it. Places in the image are counted in nodes, from the first one."""

    coefficients: np.ndarray  # (h,r,c,2) f8: of the splines of x and y, one more at each border than there are nodes
    heights: np.ndarray  # (h) f8: increasing, m
    guess: np.ndarray  # (2,4) f8: column and row are nearly these times x, y, z and 1
    margin: np.ndarray  # (2) f8: columns and rows that the grid is extended at each border
    z_margin: np.ndarray  # (2) f8: m that it is extended below and above
    tolerance: np.ndarray  # (2) f8: a last step to column and row


class GroundPosition(NamedTuple):
    """A ground position, and its derivatives by the column and the row."""

    x: float  # f8: m
    y: float  # f8: m
    x_by_column: float  # f8: m per node
    y_by_column: float  # f8: m per node
    x_by_row: float  # f8: m per node
    y_by_row: float  # f8: m per node


# (h) f8, f8, (w) f8 -> i8
@kernel
def write_height_weights(heights, z, weights):
    """Write the weights of the heights around z in a polynomial through them; returns the number of the first one."""
    n = weights.shape[0]
    first = min(max(np.searchsorted(heights, z) - n // 2, 0), heights.shape[0] - n)
    for k in range(n):
        weight = 1.0
        for other in range(n):
            if other != k:
                at = heights[first + other]
                weight *= (z - at) / (heights[first + k] - at)
        weights[k] = weight
    return first


# f8, (2,4) f8 -> None
@kernel
def write_spline_weights(t, weights):
    """Write the four weights of a uniform cubic B-spline at a part t of a cell, and their derivatives."""
    s = 1.0 - t
    weights[0, 0], weights[0, 3] = s * s * s / 6.0, t * t * t / 6.0
    weights[0, 1] = ((3.0 * t - 6.0) * t * t + 4.0) / 6.0
    weights[0, 2] = ((3.0 * s - 6.0) * s * s + 4.0) / 6.0
    weights[1, 0], weights[1, 3] = -s * s / 2.0, t * t / 2.0
    weights[1, 1] = (3.0 * t - 4.0) * t / 2.0
    weights[1, 2] = (4.0 - 3.0 * s) * s / 2.0


# (h,r,c,2) f8, (w) f8, i8, (2,2,4) f8, f8, f8 -> GroundPosition
@kernel
def position(coefficients, height_weights, first, work, column, row):
    """Ground position of a place in the image, whose heights are weighted from number `first` on.

    Outside of the nodes the position goes on as at their border, linearly. work : scratch.
    """
    last_column, last_row = coefficients.shape[2] - 3, coefficients.shape[1] - 3
    inside_column, inside_row = min(max(column, 0.0), float(last_column)), min(max(row, 0.0), float(last_row))
    j, i = min(int(inside_column), last_column - 1), min(int(inside_row), last_row - 1)
    write_spline_weights(inside_column - j, work[0])
    write_spline_weights(inside_row - i, work[1])
    x, y, x_by_column, y_by_column, x_by_row, y_by_row = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(height_weights.shape[0]):
        for a in range(4):
            along_x, along_y, slope_x, slope_y = 0.0, 0.0, 0.0, 0.0
            for b in range(4):
                node_x, node_y = coefficients[first + k, i + a, j + b, 0], coefficients[first + k, i + a, j + b, 1]
                along_x += work[0, 0, b] * node_x
                along_y += work[0, 0, b] * node_y
                slope_x += work[0, 1, b] * node_x
                slope_y += work[0, 1, b] * node_y
            weight, slope = height_weights[k] * work[1, 0, a], height_weights[k] * work[1, 1, a]
            x += weight * along_x
            y += weight * along_y
            x_by_column += weight * slope_x
            y_by_column += weight * slope_y
            x_by_row += slope * along_x
            y_by_row += slope * along_y
    over_column, over_row = column - inside_column, row - inside_row
    x += over_column * x_by_column + over_row * x_by_row
    y += over_column * y_by_column + over_row * y_by_row
    return GroundPosition(x, y, x_by_column, y_by_column, x_by_row, y_by_row)


# GridNumbers, f8 -> b1
@kernel
def holds_height(numbers, z):
    """Whether a height lies in the extended grid; not where it is NaN."""
    heights, z_margin = numbers.heights, numbers.z_margin
    return z >= heights[0] - z_margin[0] and z <= heights[heights.shape[0] - 1] + z_margin[1]


# GridNumbers, f8, f8 -> b1
@kernel
def holds_place(numbers, column, row):
    """Whether a place in the image lies in the extended grid; not where it is NaN."""
    last_column, last_row = numbers.coefficients.shape[2] - 3, numbers.coefficients.shape[1] - 3
    column_margin, row_margin = numbers.margin[0], numbers.margin[1]
    is_across = column >= -column_margin and column <= last_column + column_margin
    return is_across and row >= -row_margin and row <= last_row + row_margin


# GridNumbers, (n,2) f8, (n) f8, (n,2) f8 -> None
@kernel
def ground_positions(numbers, places, z, out):
    """Write the ground positions x, y (n, 2) of places in the image at heights; NaN outside of the extended grid."""
    height_weights, work = np.empty(min(numbers.heights.shape[0], MAX_HEIGHTS)), np.empty((2, 2, 4))
    for n in range(out.shape[0]):
        out[n] = np.nan
        column, row = places[n, 0], places[n, 1]
        if holds_height(numbers, z[n]) and holds_place(numbers, column, row):
            first = write_height_weights(numbers.heights, z[n], height_weights)
            here = position(numbers.coefficients, height_weights, first, work, column, row)
            out[n, 0], out[n, 1] = here.x, here.y


# GridNumbers, (n,3) f8, (n,2) f8 -> None
@kernel
def image_places(numbers, xyz, out):
    """Write the places in the image (n, 2) that see ground points; NaN outside of the extended grid, and where Newton's
    method does not converge."""
    height_weights, work = np.empty(min(numbers.heights.shape[0], MAX_HEIGHTS)), np.empty((2, 2, 4))
    most_columns = MAX_STEP * (numbers.coefficients.shape[2] - 3)
    most_rows = MAX_STEP * (numbers.coefficients.shape[1] - 3)
    guess, tolerance = numbers.guess, numbers.tolerance
    for n in range(out.shape[0]):
        out[n] = np.nan
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        if not (holds_height(numbers, z) and np.isfinite(x) and np.isfinite(y)):
            continue
        first = write_height_weights(numbers.heights, z, height_weights)
        column = guess[0, 0] * x + guess[0, 1] * y + guess[0, 2] * z + guess[0, 3]
        row = guess[1, 0] * x + guess[1, 1] * y + guess[1, 2] * z + guess[1, 3]
        for _ in range(MAX_ITERATIONS):
            here = position(numbers.coefficients, height_weights, first, work, column, row)
            to_x, to_y = x - here.x, y - here.y
            determinant = here.x_by_column * here.y_by_row - here.y_by_column * here.x_by_row
            by_column = (to_x * here.y_by_row - to_y * here.x_by_row) / determinant
            by_row = (here.x_by_column * to_y - here.y_by_column * to_x) / determinant
            if not (np.isfinite(by_column) and np.isfinite(by_row)):
                break
            column += min(max(by_column, -most_columns), most_columns)
            row += min(max(by_row, -most_rows), most_rows)
            if abs(by_column) < tolerance[0] and abs(by_row) < tolerance[1]:
                if holds_place(numbers, column, row):
                    out[n, 0], out[n, 1] = column, row
                break
