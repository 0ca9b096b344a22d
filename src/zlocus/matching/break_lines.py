"""Break lines that an operator gives: where the surface may jump, and where its height is known.

A line without heights says that heights may jump across it: at every level the semi-global constraint costs nothing
between two cells on both sides of it. A line with heights says what the surface is along it: a cell on it has no other
height, and its neighbours pay for a jump as everywhere, so that the surface comes up to the line and creases there.
"""

from __future__ import annotations

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.break_lines import BreakLines
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.level_records import PyramidLevel
from zlocus.matching.slope_surface import SlopeSurface

# Steps (row, column) by which the paths of `jump_penalties` come into a cell: from W, NW, N and NE.
STEPS = ((0, -1), (-1, -1), (-1, 0), (-1, 1))
# Rows and columns, from the cell in which a piece of a line begins, of the cells into which a step may cross the piece.
NEARBY = tuple((row, col) for row in range(-2, 4) for col in range(-2, 4))
# Pieces of a line are at most as long, cells.
PIECE_CELLS = 1.0
# The cost of every height that a cell on a line does not have.
OTHER_HEIGHT = np.uint8(255)


def steps_across(break_lines: BreakLines, level: PyramidLevel) -> NDArray[np.bool_]:
    """Which steps between the centres of neighbouring cells cross or touch a line, (4, r, c) bool, see `STEPS`."""
    rows, cols = level.shape
    across = np.zeros((len(STEPS), rows, cols), np.bool_)
    inverse = ~level.transform
    first, last = (_in_cells(inverse, break_lines.jumps[:, end]) for end in (0, 1))
    near = (np.minimum(first, last) < (cols + 1, rows + 1)) & (np.maximum(first, last) > -1)
    first, last = first[near.all(axis=1)], last[near.all(axis=1)]
    for start, end in zip(first, last, strict=True):
        n = max(int(np.ceil(np.abs(end - start).max() / PIECE_CELLS)), 1)
        nodes = start + np.linspace(0.0, 1.0, n + 1)[:, None] * (end - start)
        is_near = ((nodes[:-1] > -2) & (nodes[:-1] < (cols + 1, rows + 1))).all(axis=1)
        _mark(nodes[:-1][is_near], nodes[1:][is_near], across)
    return across


def _mark(begin: NDArray[np.float64], end: NDArray[np.float64], across: NDArray[np.bool_]) -> None:
    """Mark the steps that cross pieces of a line, (n, 2) column and row; the centres of cells are whole numbers."""
    corner = np.floor(np.minimum(begin, end)).astype(int)
    rows, cols = across.shape[1:]
    for down, right in NEARBY:
        row, col = corner[:, 1] + down, corner[:, 0] + right
        cell = np.column_stack([col, row]).astype(float)
        is_inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        for k, (from_row, from_col) in enumerate(STEPS):
            crosses = is_inside & _meet(begin, end, cell + np.array([from_col, from_row]), cell)
            across[k, row[crosses], col[crosses]] = True


def _meet(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether the segments a to b and c to d, all (n, 2), share a point; segments on one line do not count."""

    def side(p: NDArray[np.float64], q: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0]))

    of_c, of_d, of_a, of_b = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
    is_on_line = (of_c == 0) & (of_d == 0)
    return np.asarray((of_c * of_d <= 0) & (of_a * of_b <= 0) & ~is_on_line)


def _in_cells(inverse: Affine, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 2) m as column and row, where whole numbers are the centres of cells. inverse : from the ground."""
    a, b, c, d, e, f = inverse[:6]
    x, y = xy.T
    return np.column_stack([a * x + b * y + c, d * x + e * y + f]) - 0.5


def held_heights(points: NDArray[np.float64], inverse: Affine, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Mean height of the points in each cell, (r, c) m; NaN in cells without one.

    points : (k, 3) m; inverse : affine transform from the ground to columns and rows.
    """
    place = np.floor(_in_cells(inverse, points[:, :2]) + 0.5).astype(int)
    is_inside = ((place >= 0) & (place < (shape[1], shape[0]))).all(axis=1)
    cols, rows = place[is_inside].T
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, (rows, cols), points[is_inside, 2])
    np.add.at(count, (rows, cols), 1.0)
    return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def constrain(
    break_lines: BreakLines | None,
    level: PyramidLevel,
    lattice: HeightLattice,
    slope_surface: SlopeSurface,
    cost: NDArray[np.uint8],
    penalties: NDArray[np.uint16],
) -> NDArray[np.uint16]:
    """Penalties (4, r, c) without those of jumps across lines; changes `cost`, (v,), of cells on lines with heights.

    lattice : of slope indices, see `HeightLattice.layout` for the costs.
    """
    if break_lines is None:
        return penalties
    if len(break_lines.held):
        heights = held_heights(break_lines.held, ~level.transform, level.shape)
        level_index = (heights - level.height_origin) / level.height_step
        _hold(cost, lattice, level_index - slope_surface.cells)
    if not len(break_lines.jumps):
        return penalties
    return np.where(steps_across(break_lines, level), np.uint16(0), penalties)


def _hold(cost: NDArray[np.uint8], lattice: HeightLattice, slope_index: NDArray[np.float64]) -> None:
    """Let cells have one height, where the block searches it. slope_index : (r, c), NaN where they may have any."""
    for r, c in np.argwhere(np.isfinite(slope_index)).tolist():
        b, d = r // lattice.block, c // lattice.block
        row_start, row_length, block_start = (int(part[b, d]) for part in lattice.address)
        n = int(lattice.count[b, d])
        start = row_start + (r - b * lattice.block) * row_length + block_start + (c - d * lattice.block) * n
        step = round(float(slope_index[r, c])) - int(lattice.first[b, d])
        if 0 <= step < n:
            cost[start : start + n] = OTHER_HEIGHT
            cost[start + step] = 0
