"""The lines of the four sweeps of more-global aggregation: their order, segments and penalties. See `mgm.py`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.sgm import FAR

# Heights come in whole vectors of 16.
LANE_BITS = 4
LANES = 1 << LANE_BITS
N_NEIGHBOURS = 4
W, N, NW, NE = 0, 1, 2, 3


class SweepDirection(NamedTuple):
    """The order of one of the four sweeps."""

    is_by_column: bool  # b1: whether its lines are columns
    line_sign: int  # i8: -1 where the last row (or column) comes first
    cell_sign: int  # i8: -1 where the last cell of a line comes first
    n_lines: int  # i8
    n_cells: int  # i8: cells of a line
    row_offsets: np.ndarray  # (k,) i8: rows from a cell to its neighbours W, N, NW, NE
    col_offsets: np.ndarray  # (k,) i8: columns from a cell to these neighbours


class LineSegment(NamedTuple):
    """One block of a line. Records are kept in the rows of an array, see `line_segment_at`."""

    first: int  # i8: first height index
    n_heights: int  # i8: number of heights
    width: int  # i8: number of heights with those that fill the last vector
    position: int  # i8: position of its first cell in the line
    end: int  # i8: position after its last cell
    place: int  # i8: place of its room before the first cell, among the offers of a line
    sheet_place: int  # i8: place of its first cell in a line of the sheet


# i8, i8, i8 -> i8
@kernel
def in_order(at, n, sign):
    """Place in one order of what has the place `at` of n in the other; sign < 0 reverses the order."""
    return at if sign > 0 else n - 1 - at


# (e,n) i8, i8 -> LineSegment
@kernel
def line_segment_at(segments, e):
    """The record in row e of an array of segments."""
    return LineSegment(
        segments[e, 0], segments[e, 1], segments[e, 2], segments[e, 3], segments[e, 4], segments[e, 5], segments[e, 6]
    )


# (e,n) i8, i8, LineSegment -> None
@kernel
def put_line_segment(segments, e, segment):
    """Write a record to row e of an array of segments."""
    segments[e, 0], segments[e, 1], segments[e, 2] = segment.first, segment.n_heights, segment.width
    segments[e, 3], segments[e, 4] = segment.position, segment.end
    segments[e, 5], segments[e, 6] = segment.place, segment.sheet_place


# VolumeLayout, i8, SweepDirection, (e,n) i8, (t,v) u2 -> None
@kernel
def put_line_segments(layout, b, direction, segments, pads):
    """Write the segments of the lines of block row (or column) b, and what is added to the costs of each.

    pads : 0 for its heights, FAR for those that fill the last vector. After the segments stands a record whose places
    are the lengths of a line.
    """
    n, block = segments.shape[0] - 1, layout.block
    position, place, sheet_place = 0, 0, 0
    for e in range(n):
        d = in_order(e, n, direction.cell_sign)
        br, bc = (d, b) if direction.is_by_column else (b, d)
        count, n_cells = layout.n_heights[br, bc], min(block, direction.n_cells - d * block)
        wide = -(-count // LANES) * LANES
        put_line_segment(
            segments, e,
            LineSegment(layout.first[br, bc], count, wide, position, position + n_cells, place, sheet_place),
        )  # fmt: skip
        position, place, sheet_place = position + n_cells, place + (n_cells + 2) * wide, sheet_place + n_cells * wide
        for k in range(pads.shape[1]):
            pads[e, k] = 0 if k < count else FAR
    put_line_segment(segments, n, LineSegment(0, 0, 0, 0, 0, place, sheet_place))


# (4,r,c) u2, i8, SweepDirection, b1, (k,c) u2 -> None
@kernel
def penalties_of_line(p2, line, direction, is_first, out):
    """Write the P2 of the steps from the neighbours into each cell of a line, in the order of the sweep.

    `p2` has the steps from W, NW, N and NE; those from the other side are stored at the cell that they come from. A
    neighbour that is missing has the P2 of its partner; where both are missing P2 is 0, and nothing is added to the
    costs.
    """
    n, flat, sign = out.shape[1], p2.ravel(), direction.cell_sign
    for path in range(N_NEIGHBOURS):
        dr, dc = direction.row_offsets[path], direction.col_offsets[path]
        is_stored_here = dr < 0 or (dr == 0 and dc < 0)
        plane = 0 if dr == 0 else 2 + (dc if is_stored_here else -dc)
        from_r, from_c = (0, 0) if is_stored_here else (dr, dc)
        low, high = 1 if path in (W, NW) else 0, n - 1 if path == NE else n
        if is_first and path != W:
            low, high = 0, 0
        at = in_order(0, n, sign)
        r, c = (at, line) if direction.is_by_column else (line, at)
        start = (plane * p2.shape[1] + r + from_r) * p2.shape[2] + c + from_c
        step = sign * (p2.shape[2] if direction.is_by_column else 1)
        for i in range(n):
            out[path, i] = 0
        for i in range(low, high):
            out[path, i] = flat[np.uint64(start + i * step)]
    out[W, 0], out[NW, 0], out[NE, n - 1] = out[N, 0], out[NE, 0], out[NW, n - 1]
    if is_first:
        for i in range(n):
            out[N, i] = out[W, i]


# i8, i8, i8 -> SweepDirection
@kernel
def turned(turn, n_rows, n_cols):
    """The order of the sweep after some quarter turns clockwise. The first one goes down, its lines to the right."""
    rows, cols = np.array([0, -1, -1, -1]), np.array([-1, 0, -1, 1])
    is_by_column = turn % 2 == 1
    for _ in range(turn):
        for path in range(N_NEIGHBOURS):
            rows[path], cols[path] = cols[path], -rows[path]
    line_sign = -cols[N] if is_by_column else -rows[N]
    cell_sign = -rows[W] if is_by_column else -cols[W]
    n_lines, n_cells = (n_cols, n_rows) if is_by_column else (n_rows, n_cols)
    return SweepDirection(is_by_column, line_sign, cell_sign, n_lines, n_cells, rows, cols)
