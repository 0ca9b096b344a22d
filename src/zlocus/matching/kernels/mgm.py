"""More-global aggregation: every path cost depends on two neighbours, one along its direction and one across it.

Source: Facciolo, de Franchis, Meinhardt (2015), "MGM: a significantly more global matching for stereovision", the
recursion with two predecessors, in eight directions. Penalties, ranges and sums are those of `sgm.py`. Differences from
the paper: the mean of the two arrivals is rounded down, because path costs are uint16; and a cell that has only one of
the two neighbours takes the arrival from that one.

There are four sweeps; each is the first one turned by a quarter. The lines of a sweep are rows or columns. A cell has
four neighbours: the previous one on its line (W) and three on the previous line (N, NW, NE). W and N give one path cost
("along"), NW and NE give another ("across"). Everything is counted in the order of the sweep: `position` is the place
of a cell in its line, and the segments of a line are its blocks.

Why it is fast: what a neighbour offers is computed once, as soon as its own path costs are known,

    offer(q, k) = min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1) - min L(q),

and each cell that depends on it needs only min(offer, P2). The offers of a line stand cell after cell. Each segment has
room for one more cell at both ends, for its neighbours in other segments by its own heights, so that all cells of a
segment are treated alike. The heights are padded to whole vectors (their costs are FAR), so that no loop has a
remainder. Costs are copied to a sheet in the order of the sweep, and sums replace them there. So addresses grow evenly
and upwards from cell to cell, and the compiler checks once a segment that what is read does not overlap what is
written; and the sheet of the columns of a block reads the volume row by row, not a few bytes here and there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.mgm_lines import (
    LANE_BITS,
    LANES,
    N_NEIGHBOURS,
    NE,
    NW,
    N,
    W,
    in_order,
    line_segment_at,
    penalties_of_line,
    put_line_segments,
    turned,
)
from zlocus.matching.kernels.sgm import FAR

ALONG, ACROSS, N_KINDS = 0, 1, 2
ZERO, ONE = np.uint16(0), np.uint16(1)


class SheetPatch(NamedTuple):
    """Cells of one block in the volume and on a sheet. Records are kept in the rows of an array, see `patch_at`."""

    source: int  # i8: place of the first cell in the volume
    source_row: int  # i8: distance from row to row in the volume
    target: int  # i8: place of the first cell on the sheet
    target_row: int  # i8: distance from row to row on the sheet
    target_cell: int  # i8: distance from cell to cell of a row on the sheet
    n_rows: int  # i8
    n_cells: int  # i8: cells of a row


class LineOffers(NamedTuple):
    """The segments of a line, and where its offers start."""

    segments: np.ndarray  # (e,n) i8: records `LineSegment`; the last one has only the length of a line in its places
    along: int  # i8: place of the offers of path costs from W and N
    across: int  # i8: place of the offers of path costs from NW and NE


class LineBuffers(NamedTuple):
    """Arrays of one line. The path costs along stand in the first half of `paths`, those across in the second."""

    paths: np.ndarray  # (l,) u2: path costs of a segment, cell after cell
    min_costs: np.ndarray  # (k,n) u2: their minima over the heights, by kind and cell
    ends: np.ndarray  # (k,e,c) u2: what each cell offers one height below its first and one above its last, by kind
    p2: np.ndarray  # (k,c) u2: penalty of a jump into each cell, by neighbour


class SegmentRun(NamedTuple):
    """All cells of a segment; places of the offers of the first cell's neighbours."""

    sheet_place: int  # i8: place of the first cell on the sheet
    n_vectors: int  # i8: vectors of heights
    n_cells: int  # i8
    position: int  # i8: position of the first cell in its line
    w: int  # i8
    n: int  # i8
    nw: int  # i8
    ne: int  # i8


# u2, u2, u2, u2, u2 -> u2
@kernel
def joined(offer, other, jump, other_jump, cost):
    """L(p, k) = C + (arrival + arrival) / 2, where arrival = min(offer, P2)."""
    return np.uint16(np.uint16(np.uint16(min(offer, jump) + min(other, other_jump)) >> ONE) + cost)


# u2, u2, u2, u2, u2 -> u2
@kernel
def offered(same, down, up, p1, least):
    """min(L(q, k), L(q, k - 1) + P1, L(q, k + 1) + P1) - min L(q)."""
    return np.uint16(min(same, np.uint16(min(down, up) + p1)) - least)


# (s,) u2, (o,) u2, SegmentRun, (l,) u2, (k,n) u2, (k,c) u2, u2 -> None
@kernel
def run_along(sheet, offers, run, paths, min_costs, p2, p1):
    """Compute both path costs of the cells of a segment, and write their offers along to the place of N's offers.

    paths, min_costs, p2 : see `LineBuffers`; the first two are written.
    """
    wide, one = np.uint64(run.n_vectors) << np.uint64(LANE_BITS), np.uint64(1)
    w0, n0, nw0, ne0 = np.uint64(run.w), np.uint64(run.n), np.uint64(run.nw), np.uint64(run.ne)
    s0, to0, half = np.uint64(run.sheet_place), w0 + wide, np.uint64(paths.shape[0] // N_KINDS)
    position = np.uint64(run.position)
    for cell in range(np.uint64(run.n_cells)):
        i = position + cell
        x, y = cell * wide, one + cell * (wide + one)
        s, w, n, nw, ne, to, z = s0 + x, w0 + x, n0 + x, nw0 + x, ne0 + x, to0 + x, half + y
        jump_w, jump_n, jump_nw, jump_ne = p2[W, i], p2[N, i], p2[NW, i], p2[NE, i]
        low = low_across = np.uint16(65535)
        for k in range(wide):
            cost = sheet[s + k]
            here = joined(offers[w + k], offers[n + k], jump_w, jump_n, cost)
            across = joined(offers[nw + k], offers[ne + k], jump_nw, jump_ne, cost)
            paths[y + k] = here
            paths[z + k] = across
            low, low_across = min(low, here), min(low_across, across)
        min_costs[ALONG, cell], min_costs[ACROSS, cell] = low, low_across
        for k in range(wide):
            offers[to + k] = offered(paths[y + k], paths[y + k - one], paths[y + k + one], p1, low)


# (s,) u2, (o,) u2, SegmentRun, i8, (l,) u2, (k,n) u2, u2 -> None
@kernel
def run_across(sheet, offers, run, target, paths, min_costs, p1):
    """Write the offers across of the cells of a segment to `target` of the offers, and both path costs' sums to the
    sheet."""
    wide, one = np.uint64(run.n_vectors) << np.uint64(LANE_BITS), np.uint64(1)
    s0, to0, half = np.uint64(run.sheet_place), np.uint64(target), np.uint64(paths.shape[0] // N_KINDS)
    for cell in range(np.uint64(run.n_cells)):
        x, y = cell * wide, one + cell * (wide + one)
        s, to, z, low = s0 + x, to0 + x, half + y, min_costs[ACROSS, cell]
        for k in range(wide):
            offers[to + k] = offered(paths[z + k], paths[z + k - one], paths[z + k + one], p1, low)
            sheet[s + k] = np.uint16(paths[y + k] + paths[z + k])


# LineSegment, i8, (l,) u2, (k,n) u2, u2, (k,e,c) u2 -> None
@kernel
def keep_ends(segment, stride, paths, min_costs, p1, ends):
    """Write what every stride-th cell of a segment offers one height below its first one and one above its last."""
    for kind in range(N_KINDS):
        for cell in range(0, segment.end - segment.position, stride):
            at = kind * (paths.shape[0] // N_KINDS) + 1 + cell * (segment.width + 1)
            i = segment.position + cell
            ends[kind, 0, i] = np.uint16(np.uint16(paths[at] + p1) - min_costs[kind, cell])
            ends[kind, 1, i] = np.uint16(np.uint16(paths[at + segment.n_heights - 1] + p1) - min_costs[kind, cell])


# (o,) u2, i8, LineSegment, i8, (e,c) u2, i8, LineSegment -> None
@kernel
def copy_offers(offers, source, segment, position, ends, target, other):
    """Copy what a cell offers to another line or segment, by the heights of the segment `other` there.

    segment, position : of the cell; source, target : places of the offers of both lines, of one kind; ends : see
    `LineBuffers`, of that kind. Heights that the cell did not search are FAR: only a jump (P2) leads there. The copy
    goes to the place of that position on a line, which is the room at the end of a segment for cells beyond it.
    """
    shift, wide = other.first - segment.first, other.width
    count, last = segment.n_heights, segment.n_heights - shift
    here = source + segment.place + (1 + position - segment.position) * segment.width + shift
    there = target + other.place + (1 + position - other.position) * wide
    for k in range(wide):
        offers[there + k] = FAR
    for k in range(max(0, -shift), min(wide, count - shift)):
        offers[there + k] = offers[here + k]
    if 0 <= -1 - shift < wide:
        offers[there - 1 - shift] = ends[0, position]
    if 0 <= last < wide:
        offers[there + last] = ends[1, position]


# (e,n) i8, i8 -> SheetPatch
@kernel
def patch_at(patches, e):
    """The record in row e of an array of patches."""
    return SheetPatch(
        patches[e, 0], patches[e, 1], patches[e, 2], patches[e, 3], patches[e, 4], patches[e, 5], patches[e, 6]
    )


# (e,n) i8, i8, SheetPatch -> None
@kernel
def put_patch(patches, e, patch):
    """Write a record to row e of an array of patches."""
    patches[e, 0], patches[e, 1], patches[e, 2], patches[e, 3] = (
        patch.source, patch.source_row, patch.target, patch.target_row
    )  # fmt: skip
    patches[e, 4], patches[e, 5], patches[e, 6] = patch.target_cell, patch.n_rows, patch.n_cells


# VolumeLayout, i8, SweepDirection, (k,) i8, (e,n) i8, (e,n) i8 -> None
@kernel
def put_patches(layout, line, direction, shape, segments, patches):
    """Write a patch for each segment: its cells on a line, or on all lines of its block where the lines are columns.

    shape : rows and columns of the volume.
    """
    n, block = segments.shape[0] - 1, layout.block
    line_length = line_segment_at(segments, n).sheet_place
    for e in range(n):
        segment = line_segment_at(segments, e)
        d, b = in_order(e, n, direction.cell_sign), line // block
        br, bc = (d, b) if direction.is_by_column else (b, d)
        top = br * block if direction.is_by_column else line
        along, across = direction.cell_sign * segment.width, direction.line_sign * line_length
        n_rows = min(block, shape[0] - top) if direction.is_by_column else 1
        n_cells = min(block, shape[1] - bc * block)
        by_row, by_cell = (along, across) if direction.is_by_column else (0, along)
        row_start = layout.block_row_start[br, bc] + (top - br * block) * layout.row_length[br, bc]
        put_patch(
            patches, e,
            SheetPatch(
                row_start + layout.block_start[br, bc], layout.row_length[br, bc],
                segment.sheet_place - min(0, by_row) * (n_rows - 1) - min(0, by_cell) * (n_cells - 1),
                by_row, by_cell, n_rows, n_cells,
            ),
        )  # fmt: skip


# (v,) u1, SheetPatch, i8, (v,) u2, (b,) i8, (s,) u2 -> None
@kernel
def lay_costs(cost, patch, count, pad, steps, sheet):
    """Copy the costs of the cells of a patch to a sheet, with FAR above the last height.

    count : number of heights; pad : see `put_line_segments`; steps : distance from the first cell of a row to each.
    The steps are read from a table: if they were computed, the compiler would not vectorise where they may lead
    downwards.
    """
    wide = np.uint64(pad.shape[0] >> LANE_BITS) << np.uint64(LANE_BITS)
    for row in range(patch.n_rows):
        source = patch.source + row * patch.source_row
        target = patch.target + row * patch.target_row
        for cell in range(patch.n_cells):
            s, to = np.uint64(source + cell * count), np.uint64(target + steps[cell])
            if source + cell * count + pad.shape[0] <= cost.shape[0]:
                for k in range(wide):
                    sheet[to + k] = np.uint16(np.uint16(cost[s + k]) + pad[k])
            else:
                for k in range(wide):
                    sheet[to + k] = np.uint16(cost[s + k]) if k < np.uint64(count) else FAR


# (s,) u2, SheetPatch, i8, (v,) u2, (b,) i8, (v,) u2 -> None
@kernel
def add_sums(sheet, patch, count, pad, steps, total):
    """Add the sums on a sheet, laid out as by `lay_costs`, to those of the volume; the next cell's heights do not
    change."""
    wide = np.uint64(pad.shape[0] >> LANE_BITS) << np.uint64(LANE_BITS)
    for row in range(patch.n_rows):
        source = patch.source + row * patch.source_row
        target = patch.target + row * patch.target_row
        for cell in range(patch.n_cells):
            s, to = np.uint64(source + cell * count), np.uint64(target + steps[cell])
            if source + cell * count + pad.shape[0] <= total.shape[0]:
                for k in range(wide):
                    here = sheet[to + k]
                    total[s + k] = np.uint16(total[s + k] + (here if pad[k] == ZERO else ZERO))
            else:
                for k in range(np.uint64(count)):
                    total[s + k] = np.uint16(total[s + k] + sheet[to + k])


# SheetPatch, (b,) i8 -> None
@kernel
def find_steps(patch, steps):
    """Write the distance on the sheet from the first cell of a row to each."""
    for cell in range(patch.n_cells):
        steps[cell] = cell * patch.target_cell


# (v,) u1, (e,n) i8, (e,n) i8, (t,v) u2, (b,) i8, (s,) u2 -> None
@kernel
def lay_sheet(cost, patches, segments, pads, steps, sheet):
    """Copy the costs of all segments to a sheet. steps : (b,), room for those of a row of a block."""
    for e in range(patches.shape[0] - 1):
        patch, segment = patch_at(patches, e), line_segment_at(segments, e)
        find_steps(patch, steps)
        lay_costs(cost, patch, segment.n_heights, pads[e, : segment.width], steps, sheet)


# (s,) u2, (e,n) i8, (e,n) i8, (t,v) u2, (b,) i8, (v,) u2 -> None
@kernel
def add_sheet(sheet, patches, segments, pads, steps, total):
    """Add the sums of all segments on a sheet to those of the volume."""
    for e in range(patches.shape[0] - 1):
        patch, segment = patch_at(patches, e), line_segment_at(segments, e)
        find_steps(patch, steps)
        add_sums(sheet, patch, segment.n_heights, pads[e, : segment.width], steps, total)


# (o,) u2, LineOffers, LineOffers, (k,e,c) u2, b1 -> None
@kernel
def copy_from_previous_line(offers, previous, line, ends, has_new_segments):
    """Copy what the cells of the previous line offer, by the heights of the segments of this line.

    If this line has other segments all offers are copied, else only those at the ends of the segments. The offers of a
    missing neighbour are those of its partner.
    """
    n = line.segments.shape[0] - 1
    ends_along, ends_across = ends[ALONG], ends[ACROSS]
    for e in range(n):
        other, segment = line_segment_at(previous.segments, e), line_segment_at(line.segments, e)
        if has_new_segments:
            for i in range(other.position, other.end):
                copy_offers(offers, previous.along, other, i, ends_along, line.along, segment)
            for i in range(other.position, other.end):
                copy_offers(offers, previous.across, other, i, ends_across, line.across, segment)
        if e > 0:
            target = line_segment_at(line.segments, e - 1)
            copy_offers(offers, previous.across, other, other.position, ends_across, line.across, target)
        if e < n - 1:
            target = line_segment_at(line.segments, e + 1)
            copy_offers(offers, previous.across, other, other.end - 1, ends_across, line.across, target)
    width = line_segment_at(line.segments, 0).width
    for k in range(width):
        offers[line.along + k] = offers[line.along + width + k]
        offers[line.across + k] = offers[line.across + 2 * width + k]
    width = line_segment_at(line.segments, n - 1).width
    after = line.across + line_segment_at(line.segments, n).place - width
    for k in range(width):
        offers[after + k] = offers[after - 2 * width + k]


# (s,) u2, i8, (o,) u2, LineOffers, b1, b1, LineBuffers, u2 -> None
@kernel
def run_line(sheet, sheet_place, offers, line, is_first, is_last, buffers, p1):
    """Compute path costs and offers of a line, whose costs start at `sheet_place`; sums replace the costs there.

    is_first : whether there is no previous line; is_last : whether the next line may have other segments.
    """
    paths, min_costs, ends, p2 = buffers.paths, buffers.min_costs, buffers.ends, buffers.p2
    half, segments, ends_along = paths.shape[0] // N_KINDS, line.segments, ends[ALONG]
    for e in range(segments.shape[0] - 1):
        segment = line_segment_at(segments, e)
        wide, n_cells = segment.width, segment.end - segment.position
        if e > 0:
            before = line_segment_at(segments, e - 1)
            copy_offers(offers, line.along, before, segment.position - 1, ends_along, line.along, segment)
        for cell in range(n_cells + 1):
            paths[cell * (wide + 1)], paths[half + cell * (wide + 1)] = FAR, FAR
        w, nw = line.along + segment.place, line.across + segment.place
        run = SegmentRun(
            sheet_place + segment.sheet_place, wide >> LANE_BITS, n_cells, segment.position,
            w, w + (0 if is_first else wide), nw, nw + 2 * wide,
        )  # fmt: skip
        run_along(sheet, offers, run, paths, min_costs, p2, p1)
        run_across(sheet, offers, run, nw + wide, paths, min_costs, p1)
        keep_ends(segment, 1 if is_last else max(1, n_cells - 1), paths, min_costs, p1, ends)


# i8, i8, i8 -> LineBuffers
@kernel
def new_buffers(n_cells, block, widest):
    """Arrays of a line of n_cells. widest : heights of a segment, at most."""
    return LineBuffers(
        np.full(N_KINDS * (1 + block * (widest + 1)), FAR, np.uint16), np.zeros((N_KINDS, block), np.uint16),
        np.zeros((N_KINDS, 2, n_cells), np.uint16), np.zeros((N_NEIGHBOURS, n_cells), np.uint16),
    )  # fmt: skip


# (v,) u1, VolumeLayout, (4,r,c) u2, u2, i8, (v,) u2 -> None
@kernel
def sweep_quarter(cost, layout, p2, p1, turn, total):
    """Add the path costs of two directions to `total`. turn : quarter turns clockwise from (W, N) and (NW, NE).

    cost : (v,) uint8; p2 : (4, r, c) uint16, penalty of the jump into a cell from W, NW, N, NE; total : (v,) uint16.
    """
    shape, block = np.array(p2.shape[1:]), layout.block
    direction = turned(turn, shape[0], shape[1])
    n_lines, n_cells = direction.n_lines, direction.n_cells
    n_segments, widest = -(-n_cells // block), -(-layout.n_heights.max() // LANES) * LANES
    length = (n_cells + 2 * n_segments) * widest
    offers, buffers = np.zeros(2 * N_KINDS * length, np.uint16), new_buffers(n_cells, block, widest)
    pads, steps = np.zeros((n_segments, widest), np.uint16), np.empty(block, np.int64)
    segments, patches = np.zeros((2, n_segments + 1, 7), np.int64), np.zeros((n_segments + 1, 7), np.int64)
    sheet = np.empty((block if direction.is_by_column else 1) * n_cells * widest, np.uint16)
    now = place = np.int64(0)
    for i in range(n_lines):
        line, before = in_order(i, n_lines, direction.line_sign), now
        is_new = i == 0 or line // block != (line - direction.line_sign) // block
        is_last = i == n_lines - 1 or line // block != (line + direction.line_sign) // block
        if is_new:
            now = 1 - now
            put_line_segments(layout, line // block, direction, segments[now], pads)
        if is_new or not direction.is_by_column:
            place = np.int64(0)
            put_patches(layout, line, direction, shape, segments[now], patches)
            lay_sheet(cost, patches, segments[now], pads, steps, sheet)
        penalties_of_line(p2, line, direction, i == 0, buffers.p2)
        here = LineOffers(segments[now], 2 * now * length, (2 * now + 1) * length)
        if i > 0:
            previous = LineOffers(segments[before], 2 * before * length, (2 * before + 1) * length)
            copy_from_previous_line(offers, previous, here, buffers.ends, is_new)
        run_line(sheet, place, offers, here, i == 0, is_last, buffers, p1)
        place += line_segment_at(segments[now], n_segments).sheet_place
        if is_last or not direction.is_by_column:
            add_sheet(sheet, patches, segments[now], pads, steps, total)
