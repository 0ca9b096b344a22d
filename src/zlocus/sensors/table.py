"""Projection of a block of ground cells, tabulated: exact models are never evaluated per cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine

from zlocus.errors import GeometryError
from zlocus.sensors.model import FloatArray, SensorModel

TOLERANCE_PX = 0.01
DEGREE = 3


@dataclass(frozen=True)
class ProjectionTable:
    """Image positions at the corners of blocks of cells, as cubics in height.

    nodes : (b + 1, d + 1, 2, 4) float64, px: corner row, corner column, (x, y), coefficients of 1, t, t^2, t^3 with
    t = (z - z_mid) / z_half. The corner (b, d) is the centre of cell (b block, d block); between corners positions are
    bilinear.
    """

    nodes: FloatArray
    z_mid: float
    z_half: float


def projection_table(
    sensor: SensorModel,
    transform: Affine,
    shape: tuple[int, int],
    block: int,
    z_range: tuple[float, float],
    tolerance_px: float = TOLERANCE_PX,
) -> ProjectionTable:
    """Tabulate `sensor` over a grid of cells between two heights.

    transform : of the grid (cell corners to ground); shape : cells (r, c); block : cells between corners; z_range : m.

    Raises
    ------
    GeometryError
        Where the sensor cannot map a corner, or the table is further than `tolerance_px` from the exact model at the
        centres of the blocks (then a smaller block is needed).
    """
    rows = block * np.arange(-(-shape[0] // block) + 1, dtype=np.float64)
    cols = block * np.arange(-(-shape[1] // block) + 1, dtype=np.float64)
    z_mid, z_half = (z_range[0] + z_range[1]) / 2, max((z_range[1] - z_range[0]) / 2, 0.5)
    t = np.cos((np.arange(DEGREE + 1) + 0.5) * np.pi / (DEGREE + 1))
    fit = np.linalg.inv(np.vander(t, increasing=True))
    positions = np.stack([_project(sensor, transform, rows, cols, z_mid + z_half * v) for v in t], axis=-1)
    table = ProjectionTable(positions @ fit.T, z_mid, z_half)
    error = table_error(table, sensor, transform, block)
    if not error <= tolerance_px:
        raise GeometryError(
            f"A projection table of {block} cells is {error:.3g} px from the exact model (allowed {tolerance_px} px) "
            f"between heights {z_range[0]:.0f} and {z_range[1]:.0f} m. Use a smaller block or fewer heights."
        )
    return table


def table_error(table: ProjectionTable, sensor: SensorModel, transform: Affine, block: int) -> float:
    """Largest distance (px) of the table from the exact model at block centres, at both ends and between the nodes."""
    n_b, n_d = table.nodes.shape[0] - 1, table.nodes.shape[1] - 1
    rows = block * (np.arange(n_b, dtype=np.float64) + 0.5)
    cols = block * (np.arange(n_d, dtype=np.float64) + 0.5)
    centre = 0.25 * (table.nodes[:-1, :-1] + table.nodes[1:, :-1] + table.nodes[:-1, 1:] + table.nodes[1:, 1:])
    worst = 0.0
    for t in (-1.0, -0.7, 0.0, 0.7, 1.0):
        exact = _project(sensor, transform, rows, cols, table.z_mid + t * table.z_half)
        gap = np.linalg.norm(centre @ t ** np.arange(DEGREE + 1) - exact, axis=-1)
        worst = max(worst, float(gap.max()) if np.isfinite(gap).all() else np.inf)
    return worst


def _project(sensor: SensorModel, transform: Affine, rows: FloatArray, cols: FloatArray, z: float) -> FloatArray:
    """Image positions of cell centres at one height: (b, d, 2) px."""
    col, row = np.meshgrid(cols + 0.5, rows + 0.5)
    x, y = transform.a * col + transform.b * row + transform.c, transform.d * col + transform.e * row + transform.f
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return sensor.image_from_ground(xyz).reshape(len(rows), len(cols), 2)
