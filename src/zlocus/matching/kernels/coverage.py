"""Between which heights an image covers a cell: inside its borders and without nodata."""

from __future__ import annotations

import numpy as np

from zlocus.core.jit import kernel
from zlocus.matching.kernels.cost_volume import HIDDEN, plane_grid

# Positions this close to a bound (px) are judged cell by cell.
ROUNDING = 1e-6
BENT = 1.0  # px, below the margin from an image's border


# (3,) i8, f8, f8, f8, f8, (p,) b1 -> i8
@kernel
def count_blocked(layout, x_low, x_high, y_low, y_high, blocked):
    """Blocked pixels in the rectangle around positions inside an image, and -1 in place of all of them."""
    left, width = int(x_low), min(int(x_high) + 2, layout[2]) - int(x_low)
    top, height = int(y_low), min(int(y_high) + 2, layout[1]) - int(y_low)
    n_blocked = np.int64(0)
    for row in range(top, top + height):
        start = layout[0] + row * layout[2] + left
        in_row = np.uint16(0)
        for is_blocked in blocked[start : start + width]:
            in_row = np.uint16(in_row + np.uint16(is_blocked))
        n_blocked += np.int64(in_row)
    return np.int64(-1) if n_blocked == width * height else n_blocked


# (i,2,2,2,4) f8, i8, f8, f8, i8, f8, (3,) i8, (p,) b1, b1 -> b1
@kernel
def surely_covered(nodes, view, t_low, t_high, block, margin, layout, blocked, has_blocked):
    """Whether a block projects inside an image by `margin` px, on pixels that are not blocked, at all heights between
    two; loci are near straight, and those pixels are looked for `BENT` px around."""
    grid = np.empty(8)
    x_low, y_low = np.inf, np.inf
    x_high, y_high = -np.inf, -np.inf
    for end in range(2):
        plane_grid(nodes, view, t_low if end == 0 else t_high, block, 0, grid)
        for corner in range(4):
            r, c = (corner // 2) * block, (corner % 2) * block
            x = grid[0] + r * grid[4] + c * (grid[2] + r * grid[6])
            y = grid[1] + r * grid[5] + c * (grid[3] + r * grid[7])
            if not (margin <= x <= layout[2] - 1 - margin and margin <= y <= layout[1] - 1 - margin):
                return False
            x_low, x_high = min(x_low, x), max(x_high, x)
            y_low, y_high = min(y_low, y), max(y_high, y)
    if not has_blocked:
        return True
    return count_blocked(layout, x_low - BENT, x_high + BENT, y_low - BENT, y_high + BENT, blocked) == 0


# (8,) f8, (2,) i8, f8, (3,) i8, (p,) b1, b1 -> i8
@kernel
def plane_cover(grid, shape, margin, layout, blocked, has_blocked):
    """Of a block's cells at one height, an image covers: 1 all, -1 none, 0 some or unknown.

    grid : see `plane_grid`; shape : rows and columns of cells. Positions are bilinear, so their extremes are at the
    corners; blocked pixels are looked for in the rectangle around them.
    """
    x_low, y_low = np.inf, np.inf
    x_high, y_high = -np.inf, -np.inf
    for corner in range(4):
        r, c = (corner // 2) * (shape[0] - 1), (corner % 2) * (shape[1] - 1)
        x = grid[0] + r * grid[4] + c * (grid[2] + r * grid[6])
        y = grid[1] + r * grid[5] + c * (grid[3] + r * grid[7])
        x_low, x_high = min(x_low, x), max(x_high, x)
        y_low, y_high = min(y_low, y), max(y_high, y)
    x_last, y_last = layout[2] - 1 - margin, layout[1] - 1 - margin
    if x_high < margin - ROUNDING or y_high < margin - ROUNDING:
        return -1
    if x_low > x_last + ROUNDING or y_low > y_last + ROUNDING:
        return -1
    low = margin + ROUNDING
    if not (x_low >= low and y_low >= low and x_high <= x_last - ROUNDING and y_high <= y_last - ROUNDING):
        return 0
    if not has_blocked:
        return 1
    n_blocked = count_blocked(layout, x_low, x_high, y_low, y_high, blocked)
    return 1 if n_blocked == 0 else (-1 if n_blocked < 0 else 0)


# (r,c) i4, i8, i8, (r,c) i4, (r,c) i4, (r,c) i4 -> None
@kernel
def lengthen(run, steps, last, longest, lowest, highest):
    """Lengthen the run of every cell by `steps` heights up to index `last`, and keep the longest."""
    step, end = np.int32(steps), np.int32(last)
    for r in range(run.shape[0]):
        now, most, low, high = run[r], longest[r], lowest[r], highest[r]
        for c in range(now.shape[0]):
            length = np.int32(now[c] + step)
            is_longer = length > most[c]
            now[c] = length
            most[c] = length if is_longer else most[c]
            high[c] = end if is_longer else high[c]
            low[c] = np.int32(np.int32(end - length) + np.int32(1)) if is_longer else low[c]


# (8,) f8, f8, (3,) i8, (p,) b1, b1, (r,c) i4 -> None
@kernel
def step_cells(grid, margin, layout, blocked, has_blocked, run):
    """One height, cell by cell: a run grows where the image covers the cell and ends where it does not."""
    base, n_cols = layout[0], layout[2]
    x_last, y_last = layout[2] - 1 - margin, layout[1] - 1 - margin
    for r in range(run.shape[0]):
        x0, y0 = grid[0] + r * grid[4], grid[1] + r * grid[5]
        dx, dy = grid[2] + r * grid[6], grid[3] + r * grid[7]
        row = run[r]
        for c in range(row.shape[0]):
            x, y = x0 + c * dx, y0 + c * dy
            inside = (margin <= x) & (x <= x_last) & (margin <= y) & (y <= y_last)
            row[c] = np.int32(row[c] + np.int32(1)) if inside else np.int32(0)
        if has_blocked:
            for c in range(row.shape[0]):
                if row[c] > 0:
                    p = base + int(y0 + c * dy + 0.5) * n_cols + int(x0 + c * dx + 0.5)
                    row[c] = 0 if blocked[p] else row[c]


# (p,) b1, (i,) b1, (i,3) i8, (i,2,2,2,4) f8, (2,) f8, (2,) i8, (2,i) i8, i8, f8, (i,r,c) i4, (i,r,c) i4 -> None
@kernel
def block_reach(blocked, has_blocked, layout, nodes, heights, span, limits, block, margin, lowest, highest):
    """Longest run of height indices at which each view covers each cell of a block.

    blocked : (p,) bool, pixels that may not be used (already grown by the window); has_blocked : (i,) whether a view
    has any; limits : (2, i) lowest and highest index at which the nodes of a view hold; margin : px from the image's
    border; lowest, highest : (i, r, c) int32, written; HIDDEN, -1 where there is no such height.
    """
    grid = np.empty(8)
    shape = np.array([lowest.shape[1], lowest.shape[2]])
    run = np.empty((shape[0], shape[1]), np.int32)
    longest = np.empty_like(run)
    for i in range(layout.shape[0]):
        first, end = max(span[0], limits[0, i]), min(span[0] + span[1], limits[1, i] + 1)
        t_low, t_high = heights[0] + first * heights[1], heights[0] + (end - 1) * heights[1]
        if first < end and surely_covered(nodes, i, t_low, t_high, block, margin, layout[i], blocked, has_blocked[i]):
            lowest[i] = first
            highest[i] = end - 1
            continue
        lowest[i] = HIDDEN
        highest[i] = -1
        run[:] = 0
        longest[:] = 0
        covered = 0
        for k in range(first, end):
            plane_grid(nodes, i, heights[0] + k * heights[1], block, 0, grid)
            cover = plane_cover(grid, shape, margin, layout[i], blocked, has_blocked[i])
            if cover > 0:
                covered += 1
                continue
            if covered:
                lengthen(run, covered, k - 1, longest, lowest[i], highest[i])
                covered = 0
            if cover < 0:
                run[:] = 0
            else:
                step_cells(grid, margin, layout[i], blocked, has_blocked[i], run)
                lengthen(run, 0, k, longest, lowest[i], highest[i])
        if covered:
            lengthen(run, covered, end - 1, longest, lowest[i], highest[i])


# (r,c) f4, (2,) i8, (r,c) i4, (r,c) i4 -> None
@kernel
def ends_on_relief(relief, span, lowest, highest):
    """Move the ends of one view's runs that lie within a block's heights, where the image ends, by the relief."""
    first, last = span[0], span[0] + span[1] - 1
    for r in range(relief.shape[0]):
        for c in range(relief.shape[1]):
            low, high = lowest[r, c], highest[r, c]
            if low > high:
                continue
            if low > first:
                lowest[r, c] = np.int32(np.ceil(np.float32(low) - relief[r, c]))
            if high < last:
                highest[r, c] = np.int32(np.floor(np.float32(high) - relief[r, c]))


# as block_reach, with (r,c) f4 after its margin, over every block of a tile; ranges : (2,b,d) i8; limits : (2,i,b,d) i8
@kernel
def tile_reach(blocked, has_blocked, layout, nodes, heights, ranges, limits, block, margin, relief, lowest, highest):
    """`block_reach` of every block of a tile, whose heights are counted from a surface with `relief`.

    relief : (r, c) float32, steps by which that surface lies above the one that `nodes` follow within each block.
    """
    n_rows, n_cols = lowest.shape[1], lowest.shape[2]
    span = np.empty(2, np.int64)
    for br in range(ranges.shape[1]):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range(ranges.shape[2]):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            span[0], span[1] = ranges[0, br, bc], ranges[1, br, bc]
            block_reach(
                blocked, has_blocked, layout, nodes[:, br : br + 2, bc : bc + 2], heights, span, limits[:, :, br, bc],
                block, margin, lowest[:, r0:r1, c0:c1], highest[:, r0:r1, c0:c1],
            )  # fmt: skip
            for i in range(layout.shape[0]):
                ends_on_relief(relief[r0:r1, c0:c1], span, lowest[i, r0:r1, c0:c1], highest[i, r0:r1, c0:c1])
