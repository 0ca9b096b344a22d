"""Between which heights an image covers a cell: the cell projects inside the image, on usable pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.cost_volume import cells_of_block, views_of_block
from zlocus.matching.kernels.resample import block_grid, coordinate, largest_bend
from zlocus.matching.kernels.shared_records import NEVER_COVERED, HeightSpan

# Positions this close to a bound (px) are judged cell by cell.
ROUNDING_PX = 1e-6
# Between two heights the path of a point in an image bends by less than this; it is less than the margin from the edge
# of the image.
MAX_BEND_PX = 1.0


class ViewMasks(NamedTuple):
    """The pixels of all views that may not be used, in the order of `ViewArrays.pixels`."""

    blocked: np.ndarray  # (p,) b1: pixels that may not be used, already grown by the half width of the window
    has_blocked: np.ndarray  # (i,) b1: whether a view has any


class ViewMask(NamedTuple):
    """The pixels of one view that may not be used, row by row from `offset` on."""

    blocked: np.ndarray  # (p,) b1: pixels of all views that may not be used
    has_blocked: bool  # b1: whether this view has any
    offset: int  # i8: place of the view's first pixel
    n_rows: int  # i8: rows of the image
    n_cols: int  # i8: columns of the image


class PixelBox(NamedTuple):
    """Extent of some positions in an image, px."""

    x_low: float  # f8: smallest column
    x_high: float  # f8: largest column
    y_low: float  # f8: smallest row
    y_high: float  # f8: largest row


class BlockLimits(NamedTuple):
    """Height indices between which the polynomials of each view hold, by blocks; none where low > high."""

    low: np.ndarray  # (i,b,d) i8: lowest height index
    high: np.ndarray  # (i,b,d) i8: highest height index


class HeightRun(NamedTuple):
    """Runs of consecutive height indices at which one view covers the cells of a block."""

    length: np.ndarray  # (r,c) i4: length of the run that ends at the present height
    longest: np.ndarray  # (r,c) i4: length of the longest run so far
    lowest: np.ndarray  # (r,c) i4: lowest height index of the longest run
    highest: np.ndarray  # (r,c) i4: highest height index of the longest run


# ViewArrays, ViewMasks, i8 -> ViewMask
@kernel
def mask_of(views, masks, view):
    """The unusable pixels of one view."""
    offset, n_rows, n_cols = views.layout[view, 0], views.layout[view, 1], views.layout[view, 2]
    return ViewMask(masks.blocked, masks.has_blocked[view], offset, n_rows, n_cols)


# BlockGrid, i8, i8 -> PixelBox
@kernel
def corner_box(grid, n_rows, n_cols):
    """Extent of the positions of a block of cells, or a little more where they are bent.

    Bilinear positions have their extremes at the corners of the block.
    """
    x_low, y_low = np.inf, np.inf
    x_high, y_high = -np.inf, -np.inf
    for corner in range(4):
        r, c = (corner // 2) * (n_rows - 1), (corner % 2) * (n_cols - 1)
        x, y = coordinate(grid.x, r, c), coordinate(grid.y, r, c)
        x_low, x_high = min(x_low, x), max(x_high, x)
        y_low, y_high = min(y_low, y), max(y_high, y)
    x_more, y_more = largest_bend(grid.x, max(n_rows, n_cols)), largest_bend(grid.y, max(n_rows, n_cols))
    return PixelBox(x_low - x_more, x_high + x_more, y_low - y_more, y_high + y_more)


# ViewMask, PixelBox -> i8
@kernel
def count_blocked(mask, box):
    """Number of unusable pixels in the rectangle around some positions inside an image; -1 where all of them are."""
    left, width = int(box.x_low), min(int(box.x_high) + 2, mask.n_cols) - int(box.x_low)
    top, height = int(box.y_low), min(int(box.y_high) + 2, mask.n_rows) - int(box.y_low)
    n_blocked = np.int64(0)
    for row in range(top, top + height):
        start = mask.offset + row * mask.n_cols + left
        in_row = np.uint16(0)
        for is_blocked in mask.blocked[start : start + width]:
            in_row = np.uint16(in_row + np.uint16(is_blocked))
        n_blocked += np.int64(in_row)
    return np.int64(-1) if n_blocked == width * height else n_blocked


# ViewArrays, i8, f8, f8, f8, ViewMask -> b1
@kernel
def surely_covered(views, view, t_low, t_high, margin, mask):
    """Whether a view covers a whole block at all heights between two, as far as the two heights tell.

    views : of the block. It must project inside the image by `margin` px, on usable pixels. The paths of points are
    nearly straight; unusable pixels are looked for `MAX_BEND_PX` around.
    """
    x_low, y_low = np.inf, np.inf
    x_high, y_high = -np.inf, -np.inf
    for end in range(2):
        box = corner_box(block_grid(views, view, t_low if end == 0 else t_high, 0), views.block + 1, views.block + 1)
        x_low, x_high = min(x_low, box.x_low), max(x_high, box.x_high)
        y_low, y_high = min(y_low, box.y_low), max(y_high, box.y_high)
    if not (margin <= x_low and x_high <= mask.n_cols - 1 - margin):
        return False
    if not (margin <= y_low and y_high <= mask.n_rows - 1 - margin):
        return False
    if not mask.has_blocked:
        return True
    around = PixelBox(x_low - MAX_BEND_PX, x_high + MAX_BEND_PX, y_low - MAX_BEND_PX, y_high + MAX_BEND_PX)
    return count_blocked(mask, around) == 0


# BlockGrid, i8, i8, f8, ViewMask -> i8
@kernel
def plane_cover(grid, n_rows, n_cols, margin, mask):
    """How many of a block's cells an image covers at one height: 1 all, -1 none, 0 some or unknown.

    Unusable pixels are looked for in the rectangle around the positions of the cells.
    """
    box = corner_box(grid, n_rows, n_cols)
    x_last, y_last = mask.n_cols - 1 - margin, mask.n_rows - 1 - margin
    if box.x_high < margin - ROUNDING_PX or box.y_high < margin - ROUNDING_PX:
        return -1
    if box.x_low > x_last + ROUNDING_PX or box.y_low > y_last + ROUNDING_PX:
        return -1
    low = margin + ROUNDING_PX
    is_inside = box.x_low >= low and box.y_low >= low
    if not (is_inside and box.x_high <= x_last - ROUNDING_PX and box.y_high <= y_last - ROUNDING_PX):
        return 0
    if not mask.has_blocked:
        return 1
    n_blocked = count_blocked(mask, box)
    return 1 if n_blocked == 0 else (-1 if n_blocked < 0 else 0)


# HeightRun, i8, i8 -> None
@kernel
def extend_runs(run, steps, last):
    """Extend the run of every cell by `steps` heights up to index `last`, and keep the longest run."""
    step, end = np.int32(steps), np.int32(last)
    for r in range(run.length.shape[0]):
        now, most, low, high = run.length[r], run.longest[r], run.lowest[r], run.highest[r]
        for c in range(now.shape[0]):
            length = np.int32(now[c] + step)
            is_longer = length > most[c]
            now[c] = length
            most[c] = length if is_longer else most[c]
            high[c] = end if is_longer else high[c]
            low[c] = np.int32(np.int32(end - length) + np.int32(1)) if is_longer else low[c]


# BlockGrid, f8, ViewMask, (r,c) i4 -> None
@kernel
def step_cells(grid, margin, mask, length):
    """Judge one height cell by cell: a run grows where the image covers the cell, and ends where it does not."""
    x_last, y_last = mask.n_cols - 1 - margin, mask.n_rows - 1 - margin
    gx, gy, offset, n_cols, blocked = grid.x, grid.y, mask.offset, mask.n_cols, mask.blocked
    for r in range(length.shape[0]):
        x0, y0 = gx.origin + r * (gx.by_row + r * gx.bend_row), gy.origin + r * (gy.by_row + r * gy.bend_row)
        dx, dy = gx.by_col + r * gx.mixed, gy.by_col + r * gy.mixed
        row = length[r]
        for c in range(row.shape[0]):
            x, y = x0 + c * (dx + c * gx.bend_col), y0 + c * (dy + c * gy.bend_col)
            inside = (margin <= x) & (x <= x_last) & (margin <= y) & (y <= y_last)
            row[c] = np.int32(row[c] + np.int32(1)) if inside else np.int32(0)
        if mask.has_blocked:
            for c in range(row.shape[0]):
                if row[c] > 0:
                    x, y = x0 + c * (dx + c * gx.bend_col), y0 + c * (dy + c * gy.bend_col)
                    p = offset + int(y + 0.5) * n_cols + int(x + 0.5)
                    row[c] = 0 if blocked[p] else row[c]


# ViewArrays, i8, ViewMask, HeightSpan, f8, HeightRun -> None
@kernel
def find_longest_runs(views, view, mask, span, margin, run):
    """Find the longest run of height indices at which one view covers each cell of a block.

    run : lowest and highest are written; NEVER_COVERED and -1 where the view covers the cell at no height.
    """
    heights, (n_rows, n_cols), covered = views.heights, run.length.shape, 0
    run.lowest[:], run.highest[:], run.length[:], run.longest[:] = NEVER_COVERED, -1, 0, 0
    end = span.first + span.n_heights
    for k in range(span.first, end):
        grid = block_grid(views, view, heights[0] + k * heights[1], 0)
        cover = plane_cover(grid, n_rows, n_cols, margin, mask)
        if cover > 0:
            covered += 1
            continue
        if covered:
            extend_runs(run, covered, k - 1)
            covered = 0
        if cover < 0:
            run.length[:] = 0
        else:
            step_cells(grid, margin, mask, run.length)
            extend_runs(run, 0, k)
    if covered:
        extend_runs(run, covered, end - 1)


# ViewArrays, ViewMasks, HeightSpan, (i,) i8, (i,) i8, f8, (i,r,c) i4, (i,r,c) i4 -> None
@kernel
def block_coverage(views, masks, span, limit_low, limit_high, margin, lowest, highest):
    """Write the longest run of height indices at which each view covers each cell of a block.

    views : with the nodes of this block; limit_low, limit_high : (i,) height indices between which the nodes of a view
    hold; margin : px from the edge of the image; lowest, highest : (i, r, c) int32, NEVER_COVERED and -1 where the view
    covers the cell at no height.
    """
    heights, shape = views.heights, lowest.shape[1:]
    length, longest = np.empty(shape, np.int32), np.empty(shape, np.int32)
    for i in range(views.layout.shape[0]):
        first, end = max(span.first, limit_low[i]), min(span.first + span.n_heights, limit_high[i] + 1)
        t_low, t_high = heights[0] + first * heights[1], heights[0] + (end - 1) * heights[1]
        mask = mask_of(views, masks, i)
        if first < end and surely_covered(views, i, t_low, t_high, margin, mask):
            lowest[i] = first
            highest[i] = end - 1
            continue
        run = HeightRun(length, longest, lowest[i], highest[i])
        find_longest_runs(views, i, mask, HeightSpan(first, end - first), margin, run)


# (r,c) f4, HeightSpan, (r,c) i4, (r,c) i4 -> None
@kernel
def move_ends_to_relief(relief, span, lowest, highest):
    """Move by the relief those ends of one view's runs that the edge of the image causes, not the searched heights."""
    first, last = span.first, span.first + span.n_heights - 1
    for r in range(relief.shape[0]):
        for c in range(relief.shape[1]):
            low, high = lowest[r, c], highest[r, c]
            if low > high:
                continue
            if low > first:
                lowest[r, c] = np.int32(np.ceil(np.float32(low) - relief[r, c]))
            if high < last:
                highest[r, c] = np.int32(np.floor(np.float32(high) - relief[r, c]))


# ViewArrays, ViewMasks, VolumeLayout, BlockLimits, f8, (r,c) f4, (i,r,c) i4, (i,r,c) i4 -> None
@kernel
def tile_coverage(views, masks, layout, limits, margin, relief, lowest, highest):
    """Write `block_coverage` of every block of a tile, whose heights are counted from a surface with `relief`.

    relief : (r, c) float32, steps by which that surface lies above the one that the nodes follow within each block.
    """
    n_rows, n_cols = lowest.shape[1], lowest.shape[2]
    for br in range(layout.n_heights.shape[0]):
        for bc in range(layout.n_heights.shape[1]):
            box = cells_of_block(br, bc, views.block, n_rows, n_cols)
            r0, r1, c0, c1 = box.first_row, box.end_row, box.first_col, box.end_col
            span, of_block = HeightSpan(layout.first[br, bc], layout.n_heights[br, bc]), views_of_block(views, br, bc)
            block_coverage(
                of_block, masks, span, limits.low[:, br, bc], limits.high[:, br, bc], margin,
                lowest[:, r0:r1, c0:c1], highest[:, r0:r1, c0:c1],
            )  # fmt: skip
            for i in range(views.layout.shape[0]):
                move_ends_to_relief(relief[r0:r1, c0:c1], span, lowest[i, r0:r1, c0:c1], highest[i, r0:r1, c0:c1])
