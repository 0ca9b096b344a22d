"""Known ground: control points, check points, and the heights of a terrain model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.triangulate import Observations


@dataclass(frozen=True, eq=False)
class GroundControl:
    """Points known on the ground and seen in images.

    names : (n,); xyz : (n, 3) m in the scene's frame; sigma_m : (n, 3), standard deviations, NaN where they are not
    given; is_check : (n,) bool, points that take no part in the adjustment and only show its errors; observations :
    their image points, in the scene's views.
    """

    names: tuple[str, ...]
    xyz: FloatArray
    sigma_m: FloatArray
    is_check: NDArray[np.bool_]
    observations: Observations

    @classmethod
    def none(cls) -> GroundControl:
        """No points."""
        nothing = Observations(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
        return cls((), np.empty((0, 3)), np.empty((0, 3)), np.empty(0, bool), nothing)

    def __len__(self) -> int:
        return len(self.names)

    def only(self, wanted: NDArray[np.bool_]) -> GroundControl:
        """The points where wanted (n,) bool is set, numbered anew."""
        number = np.cumsum(wanted) - 1
        observations = self.observations.kept(wanted[self.observations.point])
        names = tuple(name for name, is_wanted in zip(self.names, wanted, strict=True) if is_wanted)
        renumbered = Observations(observations.view, number[observations.point], observations.xy)
        return GroundControl(names, self.xyz[wanted], self.sigma_m[wanted], self.is_check[wanted], renumbered)


@dataclass(frozen=True, eq=False)
class TerrainHeights:
    """Heights on a north-up grid in the scene's frame.

    z : (r, c) m, NaN where there is none; west, north : coordinates of the first cell's centre, m; cell_m : distance
    from cell to cell.
    """

    z: FloatArray
    west: float
    north: float
    cell_m: float

    def at(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Heights (n,) m at points (n, 2), bilinear, and slopes (n, 2) to the east and north; NaN outside of the
        grid."""
        col, row = (xy[:, 0] - self.west) / self.cell_m, (self.north - xy[:, 1]) / self.cell_m
        with np.errstate(invalid="ignore"):
            inside = (col >= 0) & (row >= 0) & (col < self.z.shape[1] - 1) & (row < self.z.shape[0] - 1)
        col, row = np.where(inside, col, 0.0), np.where(inside, row, 0.0)
        c, r = col.astype(int), row.astype(int)
        right, down = col - c, row - r
        (a, b), (d, e) = (
            (np.where(inside, self.z[r + i, c], np.nan), np.where(inside, self.z[r + i, c + 1], np.nan)) for i in (0, 1)
        )
        z = (a * (1 - right) + b * right) * (1 - down) + (d * (1 - right) + e * right) * down
        east = ((b - a) * (1 - down) + (e - d) * down) / self.cell_m
        north = ((a - d) * (1 - right) + (b - e) * right) / self.cell_m
        return z, np.column_stack([east, north])
