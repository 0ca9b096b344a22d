"""Semi-global aggregation of a cost volume in which every block of cells has its own search range.

Source: Hirschmueller (2008), eq. 13, along 8 paths. Neighbouring cells are compared at equal heights, so a neighbour
with another search range is shifted by a whole number of heights.

There are two sweeps: down (paths that come from W, NW, N, NE), then up (from E, SE, S, SW). Within a sweep everything
is counted in the order of the sweep: `position` is the place of a cell in its row, the segments of a row are its
blocks, and W, NW, N, NE are the neighbours that the sweep has passed. Only the path costs of the previous row are kept.

Why it is fast: every sum and minimum is cast back to uint16, because Numba widens integers to 64 bits, which would
lose vector lanes. In `run_cells` all addresses grow evenly and upwards from cell to cell, so the compiler checks once a
run, not in every cell, that what is read does not overlap what is written. This is why rows are copied in reverse for
the sweep upwards, and why a neighbour with another range is copied to the heights of the cell. The path from W cannot
begin a cell before the previous cell is stored, and with few heights this wait is longer than the work. Therefore the
paths from W of several rows are computed side by side, ahead of the other three paths.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

# Places kept free between the path costs of neighbouring cells.
PAD = 2
# Path cost of a height that is not searched: only a jump (P2) leads from there.
FAR = np.uint16(16000)
NW, N, NE, PATHS_FROM_ABOVE = 0, 1, 2, 3
# Number of rows whose paths from W are computed side by side. Their path costs stand in two planes, which cells read
# and write in turns; a third plane holds copies of a previous cell with another range.
ROWS_SIDE_BY_SIDE, COPY_PLANE = 4, 2
# Number of heights of the segments that stand for the outside of the volume.
OUTSIDE = -1


class SweptVolume(NamedTuple):
    """Costs and sums of path costs, cell after cell in the order of the sweep."""

    cost: np.ndarray  # (v,) u1: matching costs
    sums: np.ndarray  # (v,) u2: sums of path costs, written


class RowSegment(NamedTuple):
    """One block of a row, in the order of the sweep. Records are kept in the rows of an array, see `segment_at`."""

    first: int  # i8: first height index
    n_heights: int  # i8: number of heights, OUTSIDE where there is no segment
    position: int  # i8: position of its first cell in the row
    end: int  # i8: position after its last cell
    place: int  # i8: place of its first cell among the path costs of the row
    reversed_place: int  # i8: place of its first cell in a reversed row


class PathStore(NamedTuple):
    """What the sweep knows of a row and of the previous row; even rows stand at 0 and odd rows at 1."""

    segments: np.ndarray  # (k,e,n) i8: records `RowSegment`; segment e at e + 1, the first and the last are outside
    costs: np.ndarray  # (l,) u2: path costs from NW, N and NE of both rows, and of neighbours that were copied
    min_costs: np.ndarray  # (k,p,c) u2: their minima over the heights, of the cell at c - 1
    width: int  # i8: number of path costs of a row and path
    longest: int  # i8: number of path costs of a copied neighbour


class CellRun(NamedTuple):
    """Neighbouring cells of one row that have one range, and whose neighbours above have it too.

    read_... and write_... : places of the path costs of the first cell's neighbours and of its own.
    """

    start: int  # i8: place of the first cell in the volume
    n_heights: int  # i8
    n_cells: int  # i8
    position: int  # i8: position of the first cell in its row
    read_nw: int  # i8
    read_n: int  # i8
    read_ne: int  # i8
    write_nw: int  # i8
    write_n: int  # i8
    write_ne: int  # i8


class WestRun(NamedTuple):
    """Neighbouring cells of one range, at the same positions in several rows."""

    start: int  # i8: place of the first cell of the first row in the volume
    row_step: int  # i8: distance to the next row in the volume
    n_heights: int  # i8
    n_cells: int  # i8
    n_rows: int  # i8
    position: int  # i8: position of the first cell in its row
    read: int  # i8: plane of path costs that the first cell reads
    write: int  # i8: plane that it writes; from then on cells read and write the planes 0 and 1 in turns


# u2, u2, u2, u2, u2, u2, u2 -> u2
@kernel
def path_cost(same, down, up, p1, jump, least, cost):
    """L(p, k) = C + min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1, min L(q) + P2) - min L(q)."""
    best = min(same, np.uint16(min(down, up) + p1))
    return np.uint16(np.uint16(min(best, jump) - least) + cost)


# SweptVolume, WestRun, (3,r,l) u2, (r,) u2, (r,4,c) u2, u2 -> None
@kernel
def run_west(volume, run, paths, min_costs, p2, p1):
    """Write the path costs from W of neighbouring cells, in several rows at once, to `volume.sums`.

    paths : (3, r, l), see `WestRun`; min_costs : (r,), minimum path cost of the previous cell of each row, changed;
    p2 : (r, 4, c), penalty of a jump into each cell.

    Rows are the inner axis of `paths`: the compiler compares what all rows read with what all of them write.
    """
    cost, sums = volume.cost, volume.sums
    n, n_rows, step, one = np.uint64(run.n_heights), np.uint64(run.n_rows), np.uint64(run.row_step), np.uint64(1)
    pad = np.uint64(PAD)
    behind, ahead = np.uint64(run.read), np.uint64(run.write)
    for cell in range(np.uint64(run.n_cells)):
        s0, i = np.uint64(run.start) + cell * n, np.uint64(run.position) + cell
        for row in range(n_rows):
            s, low = s0 + row * step, np.uint16(65535)
            before = min_costs[row]
            jump = np.uint16(before + p2[row, 0, i])
            for k in range(n):
                down, up = paths[behind, row, pad + k - one], paths[behind, row, pad + k + one]
                here = path_cost(paths[behind, row, pad + k], down, up, p1, jump, before, np.uint16(cost[s + k]))
                paths[ahead, row, pad + k] = here
                sums[s + k] = here
                low = min(low, here)
            min_costs[row] = low
        behind, ahead = ahead, one - ahead


# SweptVolume, CellRun, (l,) u2, (p,c) u2, (p,c) u2, (4,c) u2, u2 -> None
@kernel
def run_cells(volume, run, paths, above, here, p2, p1):
    """Add the path costs from NW, N and NE of neighbouring cells to `volume.sums`.

    paths : costs of the `PathStore`, changed; above, here : minima of the path costs of the previous row and of this
    one, the latter changed; p2 : (4, c), penalty of a jump into each cell.
    """
    cost, sums = volume.cost, volume.sums
    n, one, two = np.uint64(run.n_heights), np.uint64(1), np.uint64(2)
    wide = n + np.uint64(PAD)
    nw_read, n_read, ne_read = np.uint64(run.read_nw), np.uint64(run.read_n), np.uint64(run.read_ne)
    nw_write, n_write, ne_write = np.uint64(run.write_nw), np.uint64(run.write_n), np.uint64(run.write_ne)
    for cell in range(np.uint64(run.n_cells)):
        i, away, s = np.uint64(run.position) + cell, cell * wide, np.uint64(run.start) + cell * n
        r1, r2, r3 = nw_read + away, n_read + away, ne_read + away
        a1, a2, a3 = nw_write + away, n_write + away, ne_write + away
        l1, l2, l3 = above[NW, i], above[N, i + one], above[NE, i + two]
        j1, j2, j3 = np.uint16(l1 + p2[1, i]), np.uint16(l2 + p2[2, i]), np.uint16(l3 + p2[3, i])
        m1 = m2 = m3 = np.uint16(65535)
        for k in range(n):
            c = np.uint16(cost[s + k])
            v1 = path_cost(paths[r1 + k], paths[r1 + k - one], paths[r1 + k + one], p1, j1, l1, c)
            v2 = path_cost(paths[r2 + k], paths[r2 + k - one], paths[r2 + k + one], p1, j2, l2, c)
            v3 = path_cost(paths[r3 + k], paths[r3 + k - one], paths[r3 + k + one], p1, j3, l3, c)
            paths[a1 + k] = v1
            paths[a2 + k] = v2
            paths[a3 + k] = v3
            m1, m2, m3 = min(m1, v1), min(m2, v2), min(m3, v3)
            sums[s + k] = np.uint16(np.uint16(sums[s + k] + v1) + np.uint16(v2 + v3))
        here[NW, i + one], here[N, i + one], here[NE, i + one] = m1, m2, m3


# (l,) u2, i8, i8, (l,) u2, i8 -> None
@kernel
def copy_shifted(source, n_source, shift, target, count):
    """Copy the path costs of a neighbour to the heights of this cell and one more at both ends; both begin at PAD.

    shift : first height index of this cell minus that of the neighbour. Heights that the neighbour did not search are
    FAR. n_source < 0 : there is no neighbour, and zeros are written (L = C).
    """
    nothing = FAR if n_source >= 0 else np.uint16(0)
    for k in range(PAD - 1, PAD + count + 1):
        target[k] = nothing
    low, high = max(-1, -shift), min(count + 1, n_source - shift)
    if low < high:
        a, b = source[PAD + shift + low : PAD + shift + high], target[PAD + low : PAD + high]
        for k in range(a.shape[0]):
            b[k] = a[k]


# (e,n) i8, i8 -> RowSegment
@kernel
def segment_at(segments, e):
    """The record in row e of an array of segments."""
    return RowSegment(
        segments[e, 0], segments[e, 1], segments[e, 2], segments[e, 3], segments[e, 4], segments[e, 5]
    )  # fmt: skip


# (e,n) i8, i8, RowSegment -> None
@kernel
def put_segment(segments, e, segment):
    """Write a record to row e of an array of segments."""
    segments[e, 0], segments[e, 1], segments[e, 2] = segment.first, segment.n_heights, segment.position
    segments[e, 3], segments[e, 4], segments[e, 5] = segment.end, segment.place, segment.reversed_place


# VolumeLayout, i8, i8, i8, (e,n) i8 -> i8
@kernel
def put_row_segments(layout, block_row, n_cols, sign, segments):
    """Write the segments of the rows of a block row; returns the number of costs of a row.

    sign : -1 where the sweep runs from the last column to the first.
    """
    n_d, block = layout.n_heights.shape[1], layout.block
    position, place, reversed_place = 0, PAD, 0
    put_segment(segments, 0, RowSegment(OUTSIDE, OUTSIDE, OUTSIDE, 0, OUTSIDE, OUTSIDE))
    for e in range(n_d):
        d = e if sign > 0 else n_d - 1 - e
        first, count = layout.first[block_row, d], layout.n_heights[block_row, d]
        n_cells = min(block, n_cols - d * block)
        put_segment(segments, e + 1, RowSegment(first, count, position, position + n_cells, place, reversed_place))
        position += n_cells
        place += n_cells * (count + PAD)
        reversed_place += n_cells * count
    put_segment(segments, n_d + 1, RowSegment(OUTSIDE, OUTSIDE, position, OUTSIDE, OUTSIDE, OUTSIDE))
    return reversed_place


# (4,r,c) u2, i8, i8, (4,c) u2 -> None
@kernel
def penalties_of_row(p2, row, sign, out):
    """Write the P2 of the steps into each cell of a row, by position; the sweep upwards takes steps the other way."""
    rows, cols = p2.shape[1], p2.shape[2]
    if sign > 0:
        # Plain loops: Numba takes five seconds to compile the shape check of an array assigned to a slice.
        for path in range(4):
            for c in range(cols):
                out[path, c] = p2[path, row, c]
        return
    below = min(row + 1, rows - 1)
    for i in range(cols):
        c = cols - 1 - i
        out[0, i] = p2[0, row, min(c + 1, cols - 1)]
        out[1, i] = p2[1, below, min(c + 1, cols - 1)]
        out[2, i] = p2[2, below, c]
        out[3, i] = p2[3, below, max(c - 1, 0)]


# RowSegment, RowSegment -> b1
@kernel
def have_same_range(a, b):
    """Whether two segments search the same heights."""
    return a.n_heights == b.n_heights and a.first == b.first


# SweptVolume, (e,) i8, i8, (e,n) i8, (3,r,l) u2, i8, (r,4,c) u2, u2 -> None
@kernel
def sweep_west(volume, starts, row_step, segments, paths, n_rows, p2, p1):
    """Write the path costs from W of all cells of several rows, which have the same segments, to `volume.sums`.

    starts : places of the segments of the first row in the volume; row_step : distance to the next row; segments :
    records `RowSegment`; paths : (3, r, l), path costs of the last two cells of each row, and copies.
    """
    turn = 0
    min_costs = np.zeros(n_rows, np.uint16)
    for e in range(1, starts.shape[0] - 1):
        segment, previous = segment_at(segments, e), segment_at(segments, e - 1)
        count, n_cells = segment.n_heights, segment.end - segment.position
        read = turn
        if not have_same_range(segment, previous):
            read, shift = COPY_PLANE, segment.first - previous.first
            for row in range(n_rows):
                copy_shifted(paths[turn, row], previous.n_heights, shift, paths[COPY_PLANE, row], count)
                paths[0, row, PAD + count] = paths[1, row, PAD + count] = FAR
        run = WestRun(starts[e], row_step, count, n_cells, n_rows, segment.position, read, 1 - turn)
        run_west(volume, run, paths, min_costs, p2, p1)
        turn = (turn + n_cells) % 2


# (l,) u2, RowSegment, RowSegment, i8, i8, i8 -> i8
@kernel
def neighbour_above(costs, segment, above, column, row_start, copied):
    """Place of the path costs of a neighbour of a cell in the previous row.

    costs : of the `PathStore`; segment, above : of the cell and of its neighbour; column : position of the neighbour;
    row_start : place of the previous row's costs. A neighbour with another range is copied to the place `copied`, by
    the heights of the cell.
    """
    place = row_start + above.place + (column - above.position) * (above.n_heights + PAD)
    if have_same_range(segment, above):
        return place
    copy_shifted(
        costs[place - PAD :], above.n_heights, segment.first - above.first, costs[copied - PAD :], segment.n_heights
    )
    return copied


# SweptVolume, i8, PathStore, i8, i8, (4,c) u2, u2 -> None
@kernel
def sweep_segment(volume, start, store, parity, e, p2, p1):
    """Add the path costs from NW, N and NE of all cells of a segment, whose first cell is at `start` of the volume.

    Cells at its ends and below another range are computed one by one, the others in one run.
    """
    costs, width, longest = store.costs, store.width, store.longest
    above, here = store.min_costs[1 - parity], store.min_costs[parity]
    segment, others = segment_at(store.segments[parity], e), store.segments[1 - parity]
    before, same, after = segment_at(others, e - 1), segment_at(others, e), segment_at(others, e + 1)
    left, right, count = segment.position, segment.end, segment.n_heights
    first_write, first_read = parity * PATHS_FROM_ABOVE * width, (1 - parity) * PATHS_FROM_ABOVE * width
    copied = 2 * PATHS_FROM_ABOVE * width + PAD
    run, end = left, right
    if not have_same_range(segment, same):
        run = right
    elif not have_same_range(segment, before):
        run = left + 1
    if not have_same_range(segment, after):
        end = right - 1
    i = left
    while i < right:
        n_cells = end - i if run <= i < end else 1
        nw, ne = before if i == left else same, after if i + 1 == right else same
        write = first_write + segment.place + (i - left) * (count + PAD)
        cells = CellRun(
            start + (i - left) * count, count, n_cells, i,
            neighbour_above(costs, segment, nw, i - 1, first_read, copied),
            neighbour_above(costs, segment, same, i, first_read + width, copied + longest),
            neighbour_above(costs, segment, ne, i + 1, first_read + 2 * width, copied + 2 * longest),
            write, write + width, write + 2 * width,
        )  # fmt: skip
        run_cells(volume, cells, costs, above, here, p2, p1)
        i += n_cells


# (v,) u1, i8, i8, i8, (s,) u1 -> None
@kernel
def reverse_cells(source, start, count, n_cells, target):
    """Copy cells of a volume in reverse order; the heights of each cell keep their order."""
    for cell in range(n_cells):
        at = start + (n_cells - 1 - cell) * count
        a, b = source[at : at + count], target[cell * count : (cell + 1) * count]
        for k in range(count):
            b[k] = a[k]


# (s,) u2, i8, i8, i8, (v,) u2 -> None
@kernel
def add_reversed(source, start, count, n_cells, total):
    """Add cells that stand in reverse order to a volume."""
    for cell in range(n_cells):
        at = start + (n_cells - 1 - cell) * count
        a, b = source[cell * count : (cell + 1) * count], total[at : at + count]
        for k in range(count):
            b[k] = np.uint16(b[k] + a[k])


# (v,) u1, (e,) i8, i8, (e,n) i8, i8, (s,) u1 -> None
@kernel
def reverse_row(cost, starts, shift, segments, place, out):
    """Copy the costs of a row, whose segments start `shift` after `starts`, to `out` from `place` on, its cells in
    reverse order."""
    for e in range(1, starts.shape[0] - 1):
        segment = segment_at(segments, e)
        n_cells, at = segment.end - segment.position, place + segment.reversed_place
        reverse_cells(cost, starts[e] + shift, segment.n_heights, n_cells, out[at : at + n_cells * segment.n_heights])


# (s,) u2, (e,) i8, i8, (e,n) i8, i8, (v,) u2 -> None
@kernel
def add_reversed_row(sums, starts, shift, segments, place, total):
    """Add the sums of a row that `reverse_row` put in reverse order to those of the volume."""
    for e in range(1, starts.shape[0] - 1):
        segment = segment_at(segments, e)
        n_cells, at = segment.end - segment.position, place + segment.reversed_place
        add_reversed(sums[at : at + n_cells * segment.n_heights], starts[e] + shift, segment.n_heights, n_cells, total)


# VolumeLayout, i8 -> PathStore
@kernel
def new_path_store(layout, n_cols):
    """Room for two rows of n_cols cells; all path costs are FAR, all segments are outside."""
    width, longest = layout.row_length.max() + PAD * (n_cols + 2), layout.n_heights.max() + 2 * PAD
    segments = np.full((2, layout.n_heights.shape[1] + 2, 6), OUTSIDE, np.int64)
    costs = np.full(2 * PATHS_FROM_ABOVE * width + PATHS_FROM_ABOVE * longest, FAR, np.uint16)
    return PathStore(segments, costs, np.zeros((2, PATHS_FROM_ABOVE, n_cols + 2), np.uint16), width, longest)


# SweptVolume, (e,) i8, i8, PathStore, i8, b1, (4,c) u2, u2 -> None
@kernel
def sweep_row(volume, starts, shift, store, parity, has_new_segments, p2, p1):
    """Add the path costs from NW, N and NE of a row, whose segments start `shift` after `starts` in the volume.

    has_new_segments : whether its segments differ from those of the row before the last, whose room it takes.
    """
    if has_new_segments:
        n = PATHS_FROM_ABOVE * store.width
        store.costs[parity * n : (parity + 1) * n] = FAR
    for e in range(1, starts.shape[0] - 1):
        sweep_segment(volume, starts[e] + shift, store, parity, e, p2, p1)


# VolumeLayout, i8, i8, (e,) i8 -> None
@kernel
def find_starts(layout, row, sign, starts):
    """Write where the blocks of a row start in the volume, in the order of the sweep; block e stands at e + 1."""
    n_d, b = layout.n_heights.shape[1], row // layout.block
    first = layout.block_row_start[b, 0] + (row - b * layout.block) * layout.row_length[b, 0]
    for e in range(1, n_d + 1):
        starts[e] = first + layout.block_start[b, e - 1 if sign > 0 else n_d - e]


# (v,) u1, VolumeLayout, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep(cost, layout, p2, p1, sign, total):
    """Sums of four paths: sign = 1 sweeps down and writes `total`, -1 sweeps up and adds to it.

    cost : (v,) uint8; p2 : (4, r, c) uint16, penalty of the jump into a cell from W, NW, N, NE; total : (v,) uint16.
    """
    n_rows, n_cols, n_d, block = p2.shape[1], p2.shape[2], layout.n_heights.shape[1], layout.block
    store, starts = new_path_store(layout, n_cols), np.empty(n_d + 2, np.int64)
    west_paths = np.full((3, ROWS_SIDE_BY_SIDE, store.longest), FAR, np.uint16)
    row_p2 = np.empty((ROWS_SIDE_BY_SIDE, 4, n_cols), np.uint16)
    n_reversed = 0 if sign > 0 else ROWS_SIDE_BY_SIDE * layout.row_length.max()
    reversed_rows = SweptVolume(np.empty(n_reversed, np.uint8), np.empty(n_reversed, np.uint16))
    done = 0
    while done < n_rows:
        r = done if sign > 0 else n_rows - 1 - done
        br = r // block
        n_beside = min(ROWS_SIDE_BY_SIDE, min((br + 1) * block, n_rows) - r if sign > 0 else r - br * block + 1)
        here = store.segments[done % 2]
        length = put_row_segments(layout, br, n_cols, sign, here)
        for row in range(n_beside):
            penalties_of_row(p2, r + sign * row, sign, row_p2[row])
        find_starts(layout, r, sign, starts)
        step, swept, volume_starts = layout.row_length[br, 0], SweptVolume(cost, total), starts
        if sign < 0:
            for row in range(n_beside):
                reverse_row(cost, starts, -row * step, here, row * length, reversed_rows.cost)
            swept, volume_starts = reversed_rows, starts.copy()
            for e in range(1, n_d + 1):
                starts[e] = segment_at(here, e).reversed_place
        sweep_west(swept, starts, step, here, west_paths, n_beside, row_p2, p1)
        for row in range(n_beside):
            parity = (done + row) % 2
            if row == 1:
                # From here on the previous row has the same segments.
                put_row_segments(layout, br, n_cols, sign, store.segments[parity])
            has_new_segments = done + row < 2 or br != (r - sign * (2 - row)) // block
            sweep_row(swept, starts, row * step, store, parity, has_new_segments, row_p2[row], p1)
        if sign < 0:
            for row in range(n_beside):
                add_reversed_row(reversed_rows.sums, volume_starts, -row * step, here, row * length, total)
        done += n_beside
