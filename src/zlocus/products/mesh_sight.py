"""Whether an image sees a point of a surface, by following the ray to the sensor over the cells of the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray, SensorModel

# Cells from a point on its way to the sensor to the next.
STEP_CELLS = 0.7
# Cells from a patch at which its ray is followed first: nearer cells are noise of the surface.
FIRST_CELLS = 1.2
# Rays are followed over so many cells at most.
MAX_CELLS = 512.0
# Cells by which the surface must stand above a ray to occlude the point.
TOLERANCE_CELLS = 0.5
# A wall is seen from outside where the ray leaves it at this angle's sine or more.
MIN_SINE = 0.1


@dataclass(frozen=True)
class SurfaceWindow:
    """Cells of a surface around a tile.

    z : (r, c) m, NaN where there is none; row, col : of the tile's first cell in it; transform : from column and row of
    the tile's cell corners to the map, north up.
    """

    z: NDArray[np.floating]
    row: int
    col: int
    transform: Affine

    @property
    def cell_m(self) -> float:
        """Side of a cell, m."""
        return float(self.transform.a)

    def ground(self, points: FloatArray) -> FloatArray:
        """Ground points (n, 3) m of points (n, 3): column and row of the tile's cell corners, and height, m."""
        t = self.transform
        return np.column_stack([t.c + t.a * points[:, 0], t.f + t.e * points[:, 1], points[:, 2]])


def is_seen(
    sensor: SensorModel, samples: FloatArray, outwards: FloatArray | None, window: SurfaceWindow
) -> NDArray[np.bool_]:
    """Which faces (k,) bool a sensor sees: at all of their samples nothing of the surface stands before them.

    samples : (k, s, 3) column, row and height (m); outwards : (k, 2) directions out of walls, in columns and rows; None
    for patches.
    """
    if not len(samples):
        return np.zeros(0, bool)
    points = samples.reshape(-1, 3)
    rise = float(np.clip(window.cell_m, 0.2, 20.0))
    xy = sensor.image_from_ground(window.ground(points))
    above = sensor.ground_from_image(xy, points[:, 2] + rise)
    # Columns and rows by which the ray moves for each metre that it rises.
    lean = (above[:, :2] - window.ground(points)[:, :2]) / [window.transform.a, window.transform.e] / rise
    seen = np.asarray(np.isfinite(lean).all(axis=1))
    if outwards is not None:
        out = np.repeat(outwards, samples.shape[1], axis=0)
        length = np.hypot(np.hypot(*lean.T), 1.0 / window.cell_m)
        with np.errstate(invalid="ignore"):
            seen &= (lean * out).sum(axis=1) > MIN_SINE * length
    seen[seen] = ~_occluded(points[seen], lean[seen], 0.0 if outwards is not None else FIRST_CELLS, window)
    return np.asarray(seen.reshape(samples.shape[:2]).all(axis=1))


def _occluded(points: FloatArray, lean: FloatArray, first: float, window: SurfaceWindow) -> NDArray[np.bool_]:
    """Which points (n,) the surface occludes. lean : (n, 2) cells per m; first : cells at which rays are followed
    first."""
    hidden = np.zeros(len(points), bool)
    if not np.isfinite(window.z).any():
        return hidden
    highest, tolerance = float(np.nanmax(window.z)), TOLERANCE_CELLS * window.cell_m
    per_metre = np.maximum(np.hypot(*lean.T), 1e-9)
    direction = lean / per_metre[:, None]
    going = np.arange(len(points))
    distance = first + STEP_CELLS / 2
    while len(going) and distance < MAX_CELLS:
        z = points[going, 2] + distance / per_metre[going]
        below = z < highest
        going, z = going[below], z[below]
        at = points[going, :2] + distance * direction[going]
        col, row = np.floor(at).astype(np.int64).T + np.array([[window.col], [window.row]])
        inside = (row >= 0) & (row < window.z.shape[0]) & (col >= 0) & (col < window.z.shape[1])
        going, z, row, col = going[inside], z[inside], row[inside], col[inside]
        with np.errstate(invalid="ignore"):
            stands = window.z[row, col] > z + tolerance
        hidden[going[stands]] = True
        going = going[~stands]
        distance += STEP_CELLS
    return hidden
