"""Between which heights an image covers a cell: inside its borders and without nodata."""

from __future__ import annotations

import numpy as np

from zlocus.kernels._jit import kernel
from zlocus.kernels.volume import HIDDEN, plane_grid


# (i,2,2,2,4) f8, i8, f8, f8, i8, f8, (3,) i8 -> b1
@kernel
def surely_inside(nodes, view, t_low, t_high, block, margin, layout):
    """Whether a block projects inside an image by `margin` px at both ends of its heights (loci are near straight)."""
    grid = np.empty(8)
    for end in range(2):
        plane_grid(nodes, view, t_low if end == 0 else t_high, block, 0, grid)
        for corner in range(4):
            r, c = (corner // 2) * block, (corner % 2) * block
            x = grid[0] + r * grid[4] + c * (grid[2] + r * grid[6])
            y = grid[1] + r * grid[5] + c * (grid[3] + r * grid[7])
            if not (margin <= x <= layout[2] - 1 - margin and margin <= y <= layout[1] - 1 - margin):
                return False
    return True


# (p,) b1, (i,) b1, (i,3) i8, (i,2,2,2,4) f8, (2,) f8, (2,) i8, i8, f8, (i,r,c) i4, (i,r,c) i4 -> None
@kernel
def block_reach(blocked, has_blocked, layout, nodes, heights, span, block, margin, lowest, highest):
    """Longest run of height indices at which each view covers each cell of a block.

    blocked : (p,) bool, pixels that may not be used (already grown by the window); has_blocked : (i,) whether a view
    has any; margin : px from the image's border; lowest, highest : (i, r, c) int32, written; HIDDEN, -1 where there is
    no such height.
    """
    grid = np.empty(8)
    first, count = span[0], span[1]
    rows, cols = lowest.shape[1], lowest.shape[2]
    t_low, t_high = heights[0] + first * heights[1], heights[0] + (first + count - 1) * heights[1]
    for i in range(layout.shape[0]):
        if not has_blocked[i] and surely_inside(nodes, i, t_low, t_high, block, margin, layout[i]):
            lowest[i] = first
            highest[i] = first + count - 1
            continue
        lowest[i] = HIDDEN
        highest[i] = -1
        run = np.zeros((rows, cols), np.int32)
        longest = np.zeros((rows, cols), np.int32)
        base, n_rows, n_cols = layout[i, 0], layout[i, 1], layout[i, 2]
        for k in range(first, first + count):
            plane_grid(nodes, i, heights[0] + k * heights[1], block, 0, grid)
            for r in range(rows):
                for c in range(cols):
                    x = grid[0] + r * grid[4] + c * (grid[2] + r * grid[6])
                    y = grid[1] + r * grid[5] + c * (grid[3] + r * grid[7])
                    inside = margin <= x <= n_cols - 1 - margin and margin <= y <= n_rows - 1 - margin
                    if inside and blocked[base + int(y + 0.5) * n_cols + int(x + 0.5)]:
                        inside = False
                    run[r, c] = run[r, c] + 1 if inside else 0
                    if run[r, c] > longest[r, c]:
                        longest[r, c] = run[r, c]
                        highest[i, r, c] = k
                        lowest[i, r, c] = k - run[r, c] + 1


# as block_reach, over every block of a tile; ranges : (2,b,d) i8
@kernel
def tile_reach(blocked, has_blocked, layout, nodes, heights, ranges, block, margin, lowest, highest):
    """`block_reach` of every block of a tile."""
    n_rows, n_cols = lowest.shape[1], lowest.shape[2]
    span = np.empty(2, np.int64)
    for br in range(ranges.shape[1]):
        r0, r1 = br * block, min((br + 1) * block, n_rows)
        for bc in range(ranges.shape[2]):
            c0, c1 = bc * block, min((bc + 1) * block, n_cols)
            span[0], span[1] = ranges[0, br, bc], ranges[1, br, bc]
            block_reach(
                blocked, has_blocked, layout, nodes[:, br : br + 2, bc : bc + 2], heights, span, block, margin,
                lowest[:, r0:r1, c0:c1], highest[:, r0:r1, c0:c1],
            )  # fmt: skip
