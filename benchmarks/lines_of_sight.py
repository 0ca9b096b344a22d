"""Occlusions that a surface causes itself, for any sensor model: lines of sight must not meet the surface.

The direction of the line of sight at a cell is found by projecting the cell into the image, and from there back to the
ground at a height a little above the cell. This works for RPCs as for frame cameras and needs no projection centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zlocus.core.jit import kernel
from zlocus.core.sensor_model import SensorModel, Stationed, bare
from zlocus.evaluation.heights import read_heights

# A cell is occluded where the surface rises more than this many cells above its line of sight.
CLEAR_CELLS = 3.0
# Side, in cells, of the squares that a ray may skip at once, and of the squares whose occlusion is decided together.
SQUARE, ALIKE = 16, 2
# The line of sight of a cell passes through the cell and through a point this many cells higher.
RISE_CELLS = 8.0
# Rows that are projected at a time, to limit the memory.
ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class Surface:
    """xyz : (r, c, 3) m, NaN in z where there is no height; cell_m : side of a cell."""

    xyz: np.ndarray
    cell_m: float

    @classmethod
    def read(cls, path: Path) -> Surface:
        """A dsm.tif in the frame of the cameras."""
        raster = read_heights(path)
        rows, cols = raster.z.shape
        col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
        x, y = raster.transform * (col, row)
        return cls(np.dstack([x, y, raster.z]), float(raster.transform.a))

    def moved(self, by_m: float | np.ndarray) -> Surface:
        """The surface with all heights raised by `by_m`, a number or one per cell (r, c)."""
        return Surface(np.dstack([self.xyz[..., :2], self.xyz[..., 2] + by_m]), self.cell_m)

    @property
    def has_height(self) -> np.ndarray:
        """Cells (r, c) that have a height."""
        return np.isfinite(self.xyz[..., 2])


@dataclass(frozen=True)
class Projection:
    """A surface as one sensor sees it.

    xy : (r, c, 2) px, image positions of the cells; sight : (r, c, 2), metres by which the line of sight goes to the
    east and to the north per metre of height. Both are NaN where the cell has no height or does not project.
    """

    xy: np.ndarray
    sight: np.ndarray

    @classmethod
    def of(cls, sensor: SensorModel, surface: Surface) -> Projection:
        """Projection of a surface by a sensor model."""
        xy, sight = (np.empty((*surface.xyz.shape[:2], 2), kind) for kind in (np.float64, np.float32))
        rise_m = RISE_CELLS * surface.cell_m
        for first in range(0, len(surface.xyz), ROWS_AT_ONCE):
            rows = np.s_[first : first + ROWS_AT_ONCE]
            ground = surface.xyz[rows].reshape(-1, 3)
            at = sensor.image_from_ground(ground)
            higher = sensor.ground_from_image(at, ground[:, 2] + rise_m)
            xy[rows] = at.reshape(xy[rows].shape)
            sight[rows] = ((higher - ground)[:, :2] / rise_m).reshape(xy[rows].shape)
        return cls(xy, sight)

    def clear(self, sensor: SensorModel, surface: Surface) -> np.ndarray:
        """Whether the line of sight from each cell to the sensor does not meet the surface, (r, c)."""
        height = (surface.xyz[..., 2] / surface.cell_m).astype(np.float32)
        highest = highest_of(height)
        top = float(highest.max())
        if isinstance(station := bare(sensor), Stationed):
            top = min(top, station.station_height() / surface.cell_m)
        clear = np.empty(height.shape, bool)
        # Rows of the grid go down to the south.
        columns_and_rows = self.sight * np.array([1, -1], np.float32)
        clear_cells(height, highest, columns_and_rows, top, CLEAR_CELLS, clear)
        return clear


def parallax_rate(target: SensorModel, target_xy: np.ndarray, texture: Projection, surface: Surface) -> np.ndarray:
    """Displacement in the target image per metre of height, (r, c, 2) px/m, of what a texture image shows at a cell.

    Where the surface is wrong by dz, the texture image shows the ground that lies dz higher on its own line of sight.
    The target image sees that ground displaced by dz times this rate, along the epipolar line.
    """
    rise_m = RISE_CELLS * surface.cell_m
    rate = np.empty(target_xy.shape, np.float32)
    for first in range(0, len(rate), ROWS_AT_ONCE):
        rows = np.s_[first : first + ROWS_AT_ONCE]
        by = np.dstack([texture.sight[rows], np.ones(texture.sight[rows].shape[:2])]) * rise_m
        higher = target.image_from_ground((surface.xyz[rows] + by).reshape(-1, 3)).reshape(rate[rows].shape)
        rate[rows] = (higher - target_xy[rows]) / rise_m
    return rate


# (r,c) f4, (b,d) f4, (r,c,2) f4, f8, f8, (r,c) b1 -> None
@kernel
def clear_cells(height, highest, sight, top, margin, out):
    """Whether the line of sight from each cell stays above the surface; it is followed cell by cell.

    height : (r, c) float32 in cells, NaN where there is none; highest : (b, d) float32, see `highest_of`; sight :
    (r, c, 2) columns and rows by which the line goes per cell of height, NaN where it is not known: not clear; top :
    height in cells above which nothing occludes; margin : cells by which the surface must stand above the line.
    A square that the line enters above its highest cell is skipped.
    """
    n_rows, n_cols = height.shape
    for r in range(0, n_rows, ALIKE):
        for c in range(0, n_cols, ALIKE):
            clear = False
            for k in range(ALIKE**2):
                row, col = min(r + k // ALIKE, n_rows - 1), min(c + k % ALIKE, n_cols - 1)
                if not np.isnan(height[row, col]):
                    clear = is_clear(height, highest, (row, col), sight[row, col], top, margin)
                    break
            out[r : r + ALIKE, c : c + ALIKE] = clear


# (r,c) f4, (b,d) f4, (2,) i8, (2,) f4, f8, f8 -> b1
@kernel
def is_clear(height, highest, cell, sight, top, margin):
    """Whether the line of sight from one cell stays above the surface. cell : row and column."""
    (r, c), (n_rows, n_cols) = cell, height.shape
    by_col, by_row = np.float64(sight[0]), np.float64(sight[1])
    if np.isnan(by_col) or np.isnan(by_row):
        return False
    z, longer = np.float64(height[r, c]), max(abs(by_col), abs(by_row))
    n_steps = (top - z) * longer
    step = 1.0
    while step <= n_steps:
        ray, at_row, at_col = z + step / longer, r + by_row / longer * step, c + by_col / longer * step
        row, col = int(np.rint(at_row)), int(np.rint(at_col))
        if row < 0 or col < 0 or row >= n_rows or col >= n_cols:
            break
        if highest[row // SQUARE, col // SQUARE] > ray + margin:
            if height[row, col] > ray + margin:
                return False
            step += 1.0
        else:
            out_of_square = min(way_out(at_row, by_row / longer), way_out(at_col, by_col / longer))
            step += max(np.floor(out_of_square), 1.0)
    return True


# f8, f8 -> f8
@kernel
def way_out(at, by):
    """Steps until a position on an axis leaves its square of cells."""
    first = np.rint(at) // SQUARE * SQUARE - 0.5
    if by > 0.0:
        return (first + SQUARE - at) / by
    if by < 0.0:
        return (first - at) / by
    return np.inf


def highest_of(height: np.ndarray) -> np.ndarray:
    """Highest cell of each square. (r, c) -> (b, d) float32, -inf where there is none."""
    rows, cols = (-n % SQUARE for n in height.shape)
    whole = np.pad(np.where(np.isnan(height), -np.inf, height), ((0, rows), (0, cols)), constant_values=-np.inf)
    squares = whole.reshape(whole.shape[0] // SQUARE, SQUARE, whole.shape[1] // SQUARE, SQUARE)
    return squares.max(axis=(1, 3)).astype(np.float32)
