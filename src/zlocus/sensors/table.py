"""Projection of a block of ground cells, tabulated: exact models are never evaluated per cell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.errors import GeometryError
from zlocus.sensors.model import FloatArray, SensorModel

TOLERANCE_PX = 0.01
DEGREE = 3
# For cameras so close that their scale changes a lot from the lowest to the highest ground.
HIGHER_DEGREE, HIGHEST_DEGREE = 7, 11
# For raw lines of an unsteady flight: each height on a slanted ray is another exposure. (Beyond about 35 the
# coefficients lose their digits.)
UNSTEADY_DEGREE = 31
# Where a corner is put that the sensor cannot map: in no image, and finite, as the kernels need it.
NOWHERE_PX = -1e9
CHECKED = (-1.0, -0.7, 0.0, 0.7, 1.0)


@dataclass(frozen=True)
class ProjectionTable:
    """Image positions at the corners of blocks of cells, as polynomials in height.

    nodes : (b + 1, d + 1, 2, n) float64, px: corner row, corner column, (x, y), coefficients of 1, t, t^2, ... with
    t = (z - z_mid) / z_half. The corner (b, d) is the centre of cell (b block, d block); between corners positions are
    bilinear. holds : (b, d) bool, blocks in which that is so; the others are not in the image, or the sensor cannot map
    all of them: they count as not seen. lost : (b, d) bool, those that the image may show, at some of the heights,
    where the table does not hold. ends : (b, d, 2), lowest and highest t over which a block's polynomials hold.
    """

    nodes: FloatArray
    z_mid: float
    z_half: float
    holds: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    ends: FloatArray


def projection_table(
    sensor: SensorModel,
    transform: Affine,
    shape: tuple[int, int],
    block: int,
    z_range: tuple[float, float],
    tolerance_px: float = TOLERANCE_PX,
    window: tuple[int, int, int, int] | None = None,
    degree: int = DEGREE,
    most_lost: float = 0.0,
) -> ProjectionTable:
    """Tabulate `sensor` over a grid of cells between two heights.

    transform : of the grid (cell corners to ground); shape : cells (r, c); block : cells between corners; z_range : m;
    window : the part of the image (row, col, rows, cols) that counts, None is all that the sensor maps;
    degree : of the polynomials; most_lost : share of the blocks in which the table need not hold, shown or not:
    they count as not seen.

    Raises
    ------
    GeometryError
        Where the table is further than `tolerance_px` from the exact model at the centres of more blocks that the
        window shows (then a smaller block or a shorter range is needed).
    """
    rows = block * np.arange(-(-shape[0] // block) + 1, dtype=np.float64)
    cols = block * np.arange(-(-shape[1] // block) + 1, dtype=np.float64)
    z_mid, z_half = (z_range[0] + z_range[1]) / 2, max((z_range[1] - z_range[0]) / 2, 0.5)
    t = np.cos((np.arange(degree + 1) + 0.5) * np.pi / (degree + 1))
    fit = np.linalg.inv(np.vander(t, increasing=True))
    positions = np.stack([project_cells(sensor, transform, rows, cols, z_mid + z_half * v) for v in t], axis=-1)
    shown = np.zeros(positions.shape[:2], bool) if window is None else _shows_any(positions, window)
    known = np.asarray(np.isfinite(positions).all(axis=(2, 3)))
    nodes = positions @ fit.T
    nodes[~known] = NOWHERE_PX * (np.arange(degree + 1) == 0)
    whole = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    shows = shown[:-1, :-1] | shown[1:, :-1] | shown[:-1, 1:] | shown[1:, 1:]
    ends = np.broadcast_to((-np.inf, np.inf), (*whole.shape, 2))
    table = ProjectionTable(nodes, z_mid, z_half, whole, ~whole & shows, ends)
    gaps = table_gaps(table, sensor, transform, block)
    unmapped = (~whole | np.isnan(gaps)) & shows
    bad = table.holds & (gaps > tolerance_px)
    if bad.any() and window is not None:
        bad &= _may_show(table, gaps, window)
    if bad.sum() > most_lost * bad.size:
        raise projection_error(block, float(gaps[bad].max()), tolerance_px, z_range)
    return replace(table, holds=table.holds & (gaps <= tolerance_px), lost=bad | unmapped)


def projection_error(block: int, gap_px: float, tolerance_px: float, z_range: tuple[float, float]) -> GeometryError:
    """What is wrong with a table."""
    return GeometryError(
        f"A projection table of {block} cells is {gap_px:.3g} px from the exact model (allowed {tolerance_px} px) "
        f"between heights {z_range[0]:.0f} and {z_range[1]:.0f} m. Use a smaller block or fewer heights."
    )


def table_gaps(table: ProjectionTable, sensor: SensorModel, transform: Affine, block: int) -> FloatArray:
    """Largest distance (b, d) px of the table from the exact model at block centres, at both ends of the heights and
    between the nodes; NaN where the sensor cannot map a centre."""
    n_b, n_d = table.holds.shape
    rows = block * (np.arange(n_b, dtype=np.float64) + 0.5)
    cols = block * (np.arange(n_d, dtype=np.float64) + 0.5)
    centre = 0.25 * (table.nodes[:-1, :-1] + table.nodes[1:, :-1] + table.nodes[:-1, 1:] + table.nodes[1:, 1:])
    worst = np.zeros((n_b, n_d))
    for t in CHECKED:
        exact = project_cells(sensor, transform, rows, cols, table.z_mid + t * table.z_half)
        worst = np.maximum(worst, np.linalg.norm(centre @ t ** np.arange(centre.shape[-1]) - exact, axis=-1))
    return worst


def _shows_any(positions: FloatArray, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Whether any of the n positions (b, d, 2, n) lies in a window, (b, d)."""
    row, col, n_rows, n_cols = window
    x, y = positions[:, :, 0], positions[:, :, 1]
    inside = (x >= col) & (x <= col + n_cols - 1) & (y >= row) & (y <= row + n_rows - 1)
    return np.asarray(inside.any(axis=-1))


def _may_show(table: ProjectionTable, gaps: FloatArray, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Blocks (b, d) that a window may show: by the boxes around their corners at all heights, widened by the gaps."""
    at = np.stack([table.nodes @ t ** np.arange(table.nodes.shape[-1]) for t in CHECKED])
    low, high = at.min(axis=0), at.max(axis=0)
    corners = [(slice(i, n_i), slice(j, n_j)) for i, n_i in ((0, -1), (1, None)) for j, n_j in ((0, -1), (1, None))]
    low = np.min([low[corner] for corner in corners], axis=0) - gaps[..., None]
    high = np.max([high[corner] for corner in corners], axis=0) + gaps[..., None]
    row, col, n_rows, n_cols = window
    return np.asarray(((high >= (col, row)) & (low <= (col + n_cols - 1, row + n_rows - 1))).all(axis=-1))


def project_cells(sensor: SensorModel, transform: Affine, rows: FloatArray, cols: FloatArray, z: float) -> FloatArray:
    """Image positions of cell centres at one height: (b, d, 2) px."""
    col, row = np.meshgrid(cols + 0.5, rows + 0.5)
    x, y = transform.a * col + transform.b * row + transform.c, transform.d * col + transform.e * row + transform.f
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return sensor.image_from_ground(xyz).reshape(len(rows), len(cols), 2)
