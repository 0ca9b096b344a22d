"""A surface as a mesh: every cell is a patch, patches that belong together share their corners, and where heights jump
a vertical wall stands on the line between two cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

# Corners that differ by less are one, m.
SAME_M = 1e-3
# Corners of a cell in the order of its outline, seen from above: row and column beyond the first corner.
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))


@dataclass(frozen=True)
class CellPatches:
    """The patches of the cells of a tile.

    rows, cols : (k,) of the cells with a height; z : (k, 4) m, heights of their corners, in the order of `CORNERS`:
    counter-clockwise from above.
    """

    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    z: FloatArray

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def outlines(self) -> FloatArray:
        """Outlines (k, 4, 3): column and row of cell corners, and height, m."""
        at = np.array(CORNERS)
        cols, rows = self.cols[:, None] + at[:, 1], self.rows[:, None] + at[:, 0]
        return np.stack([cols, rows, self.z], axis=-1).astype(float)


@dataclass(frozen=True)
class Walls:
    """Vertical walls between cells, counter-clockwise as they are seen from outside.

    outlines : (k, 4, 3) column and row of cell corners, and height, m: lower left, lower right, upper right and upper
    left; outwards : (k, 2) columns and rows, from the higher cell to the lower one.
    """

    outlines: FloatArray
    outwards: FloatArray

    def __len__(self) -> int:
        return len(self.outlines)


def surface_mesh(z: NDArray[np.floating], jump_m: float) -> tuple[CellPatches, Walls]:
    """Patches and walls of a tile.

    z : (r + 2, c + 2) m, heights of the cells of the tile and of one cell around it, NaN where there is none; jump_m :
    heights of neighbours that differ by more do not belong together. Walls on the right and lower border belong to the
    tile, those on the left and upper border to its neighbours. Rows and columns are counted from the tile's first cell.
    """
    corner = _corner_heights(np.asarray(z, float), jump_m)
    inner = z[1:-1, 1:-1]
    rows, cols = np.nonzero(np.isfinite(inner))
    # Which cell around a corner this cell is: the first corner of a cell has it at its lower right.
    of_cell = ((0, 0, 2), (1, 0, 1), (1, 1, 0), (0, 1, 3))
    heights = np.stack([corner[which, rows + i, cols + j] for i, j, which in of_cell], axis=-1)
    return CellPatches(rows, cols, heights), _walls(corner)


def _corner_heights(z: FloatArray, jump_m: float) -> FloatArray:
    """Heights (4, r + 1, c + 1) m of the corners of cells, for each of the four cells around: upper left, upper right,
    lower right, lower left. A corner has the mean height of the cells around it that belong together."""
    around = np.stack([z[:-1, :-1], z[:-1, 1:], z[1:, 1:], z[1:, :-1]])
    with np.errstate(invalid="ignore"):
        linked = np.abs(around - np.roll(around, -1, axis=0)) <= jump_m  # to the next one of the ring
    heights = np.full(around.shape, np.nan)
    known = np.isfinite(around)
    values = np.where(known, around, 0.0)
    for k in range(4):
        ahead, two_ahead, three_ahead = linked[k], linked[(k + 1) % 4], linked[(k + 2) % 4]
        behind = linked[(k + 3) % 4]
        joined = np.stack([
            known[k],
            ahead | (behind & three_ahead & two_ahead),
            (ahead & two_ahead) | (behind & three_ahead),
            behind | (ahead & two_ahead & three_ahead),
        ])  # fmt: skip
        total = sum(joined[n] * values[(k + n) % 4] for n in range(4))
        count = joined.sum(axis=0)
        heights[k] = np.where(known[k], total / np.maximum(count, 1), np.nan)
    return heights


def _walls(corner: FloatArray) -> Walls:
    """The walls on the lines between cells that have different heights at an end of the line."""
    n_rows, n_cols = corner.shape[1] - 1, corner.shape[2] - 1
    outlines, outwards = [], []
    # Lines down the columns, between a cell and its right neighbour; then lines along the rows, below a cell.
    for is_down in (True, False):
        if is_down:
            row, col = (a.ravel() for a in np.mgrid[0:n_rows, 1 : n_cols + 1])
            first, second = (row, col), (row + 1, col)
            here = np.stack([corner[3][first], corner[0][second]])
            other = np.stack([corner[2][first], corner[1][second]])
            towards = np.array([1.0, 0.0])
        else:
            row, col = (a.ravel() for a in np.mgrid[1 : n_rows + 1, 0:n_cols])
            first, second = (row, col), (row, col + 1)
            here = np.stack([corner[1][first], corner[0][second]])
            other = np.stack([corner[2][first], corner[3][second]])
            towards = np.array([0.0, 1.0])
        difference = here - other
        stands = np.isfinite(difference).all(axis=0) & (np.abs(difference) > SAME_M).any(axis=0)
        is_higher = difference.mean(axis=0) > 0
        # Seen from outside the line runs from left to right; rows grow downwards on the map.
        forwards = is_higher == (not is_down)
        for keep, higher in ((stands & is_higher, True), (stands & ~is_higher, False)):
            a, b = (np.stack([n[keep] for n in end], axis=-1)[:, ::-1] for end in (first, second))
            top, bottom = (here, other) if higher else (other, here)
            top, bottom = top[:, keep], bottom[:, keep]
            if not forwards[keep].all():
                a, b, top, bottom = b, a, top[::-1], bottom[::-1]
            outline = np.stack([
                np.column_stack([a, bottom[0]]), np.column_stack([b, bottom[1]]),
                np.column_stack([b, top[1]]), np.column_stack([a, top[0]]),
            ], axis=1)  # fmt: skip
            outlines.append(outline)
            outwards.append(np.broadcast_to(towards if higher else -towards, (len(outline), 2)))
    return Walls(np.concatenate(outlines).astype(float), np.concatenate(outwards))
