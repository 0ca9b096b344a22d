"""Projection of a block of ground cells, tabulated: exact models are never evaluated per cell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from affine import Affine
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import FloatArray, SensorModel

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


BoolArray = NDArray[np.bool_]
# Heights at which it is looked whether an image shows a block; there and between them, whether its table is exact.
SAMPLES = 33
CORNERS = tuple((slice(i, n), slice(j, m)) for i, n in ((0, -1), (1, None)) for j, m in ((0, -1), (1, None)))
# Coefficients this small (share of the tolerance) are dropped: over a short part of the heights they would be large
# numbers that cancel.
NEGLIGIBLE = 0.02


@dataclass(frozen=True)
class Shown:
    """Where an image shows blocks, (b, d, s) at s heights. near : blocks that may be in the image and whose corners the
    sensor maps; around : these, and as many at the heights before and after, between which a block leaves the image;
    missed : blocks that may be in it though a corner is not mapped."""

    near: BoolArray
    around: BoolArray
    missed: BoolArray


def shown_table(
    sensor: SensorModel,
    transform: Affine,
    shape: tuple[int, int],
    block: int,
    z_range: tuple[float, float],
    tolerance_px: float,
    window: tuple[int, int, int, int],
    degree: int,
    may_bend: bool,
    most_lost: float,
) -> ProjectionTable:
    """Tabulate `sensor` over a grid of cells, each block over the heights at which `window` shows it.

    See `projection_table`. Heights at which a block is too bent are left out, and with them those beyond. may_bend :
    whether that may be; most_lost : share of what the window shows (blocks by heights) that may be left out.

    Raises
    ------
    GeometryError
        Where more is left out.
    """
    rows = block * np.arange(-(-shape[0] // block) + 1, dtype=np.float64)
    cols = block * np.arange(-(-shape[1] // block) + 1, dtype=np.float64)
    z_mid, z_half = (z_range[0] + z_range[1]) / 2, max((z_range[1] - z_range[0]) / 2, 0.5)
    t = np.linspace(-1.0, 1.0, SAMPLES)
    shown = shown_at(_at_heights(sensor, transform, rows, cols, z_mid + z_half * t), window)
    first, last = corner_runs(shown)
    ends = np.stack([t[first], t[last]], axis=-1)
    nodes = fitted(sensor, transform, rows, cols, ends, (z_mid, z_half), degree, NEGLIGIBLE * tolerance_px)
    fine = np.linspace(-1.0, 1.0, 2 * SAMPLES - 1)
    middle = np.mean([nodes[corner] for corner in CORNERS], axis=0)
    exact = _at_heights(sensor, transform, rows[:-1] + block / 2, cols[:-1] + block / 2, z_mid + z_half * fine)
    gaps = np.linalg.norm(middle @ np.vander(fine, degree + 1, increasing=True).T - exact, axis=2)
    begins, stops = (2 * f([k[corner] for corner in CORNERS], axis=0) for f, k in ((np.max, first), (np.min, last)))
    at = np.arange(len(fine))
    holds = between(shown.around) & (at >= begins[..., None]) & (at <= stops[..., None]) & (gaps <= tolerance_px)
    low, high = longest_run(holds)
    some = holds.any(axis=-1)
    kept = some[..., None] & (at >= low[..., None]) & (at <= high[..., None])
    bent = shown.near & ~kept[..., ::2]
    if (bent.any() and not may_bend) or (shown.missed | bent).sum() > most_lost * (shown.near | shown.missed).sum():
        raise projection_error(block, float(np.nanmax(gaps[..., ::2][shown.near], initial=0.0)), tolerance_px, z_range)
    # What reaches the ends of the heights goes on beyond them.
    low_t, high_t = np.where(low == 0, -np.inf, fine[low]), np.where(high == at[-1], np.inf, fine[high])
    limits = np.stack([np.where(some, low_t, np.inf), np.where(some, high_t, -np.inf)], axis=-1)
    lost = np.asarray((shown.missed | bent).any(axis=-1))
    return ProjectionTable(nodes, z_mid, z_half, some, lost, limits)


def _at_heights(
    sensor: SensorModel, transform: Affine, rows: FloatArray, cols: FloatArray, heights: FloatArray
) -> FloatArray:
    """Image positions (b, d, 2, s) px of cells at heights (s,) m."""
    return np.stack([project_cells(sensor, transform, rows, cols, float(z)) for z in heights], axis=-1)


def shown_at(positions: FloatArray, window: tuple[int, int, int, int]) -> Shown:
    """Where a window shows the blocks between corners at positions (b + 1, d + 1, 2, s) px, NaN where unknown: by the
    box around the corners that are known."""
    row, col, n_rows, n_cols = window
    known = np.asarray(np.isfinite(positions).all(axis=2))
    here = known[:, :, None]
    least = np.min([np.where(here, positions, np.inf)[corner] for corner in CORNERS], axis=0)
    most = np.max([np.where(here, positions, -np.inf)[corner] for corner in CORNERS], axis=0)
    first, last = np.array([col, row])[:, None], np.array([col + n_cols - 1, row + n_rows - 1])[:, None]
    meets = ((most >= first) & (least <= last)).all(axis=2)
    whole = np.logical_and.reduce([known[corner] for corner in CORNERS])
    near = meets & whole
    around = near.copy()
    around[..., 1:] |= near[..., :-1]
    around[..., :-1] |= near[..., 1:]
    return Shown(near, around & whole, meets & ~whole)


def between(flags: BoolArray) -> BoolArray:
    """Flags (..., s) at heights, and between each two for which both are set: (..., 2 s - 1)."""
    out = np.empty((*flags.shape[:-1], 2 * flags.shape[-1] - 1), bool)
    out[..., ::2], out[..., 1::2] = flags, flags[..., :-1] & flags[..., 1:]
    return out


def corner_runs(shown: Shown) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last of the longest run of heights (b + 1, d + 1) at which a block around each corner is shown; the
    first is the higher one where there is none."""
    n_b, n_d, n = shown.around.shape
    around = np.zeros((n_b + 1, n_d + 1, n), bool)
    for corner in CORNERS:
        around[corner] |= shown.around
    first, last = longest_run(around)
    some = around.any(axis=-1)
    return np.where(some, first, n - 1), np.where(some, last, 0)


def longest_run(flags: BoolArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last index (...) of the longest run of set flags (..., s); zeros where there is none."""
    run = np.zeros(flags.shape[:-1], np.int64)
    most, last = run.copy(), run.copy()
    for k in range(flags.shape[-1]):
        run = np.where(flags[..., k], run + 1, 0)
        longer = run > most
        most, last = np.where(longer, run, most), np.where(longer, k, last)
    return np.maximum(last - most + 1, 0), last


def fitted(
    sensor: SensorModel,
    transform: Affine,
    rows: FloatArray,
    cols: FloatArray,
    ends: FloatArray,
    heights: tuple[float, float],
    degree: int,
    negligible_px: float,
) -> FloatArray:
    """Polynomials in t (b + 1, d + 1, 2, n) px through Chebyshev nodes between the ends of each corner, (b + 1, d + 1,
    2); NOWHERE_PX where it has none. heights : z_mid and z_half."""
    nodes = np.zeros((len(rows), len(cols), 2, degree + 1))
    nodes[..., 0] = NOWHERE_PX
    at = ends[..., 0] <= ends[..., 1]
    low, high = ends[at].T
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-3)
    s = np.cos((np.arange(degree + 1) + 0.5) * np.pi / (degree + 1))
    b, d = np.nonzero(at)
    col, row = cols[d] + 0.5, rows[b] + 0.5
    x, y = transform.a * col + transform.b * row + transform.c, transform.d * col + transform.e * row + transform.f
    z = heights[0] + heights[1] * (middle[:, None] + half[:, None] * s)
    xyz = np.column_stack([np.repeat(x, len(s)), np.repeat(y, len(s)), z.ravel()])
    values = sensor.image_from_ground(xyz).reshape(-1, len(s), 2)
    waves = np.linalg.solve(chebyshev.chebvander(s, degree), values)
    tail = np.cumsum(np.abs(waves)[:, ::-1], axis=1)[:, ::-1].max(axis=2)
    waves[tail < negligible_px] = 0.0
    powers = np.array([np.pad(chebyshev.cheb2poly(row), (0, degree - k)) for k, row in enumerate(_units(degree))])
    local = np.einsum("cnx,np->cxp", waves, powers)
    nodes[at] = shifted(local, middle, half)
    nodes[at] = np.where(np.isfinite(nodes[at]).all(axis=(1, 2), keepdims=True), nodes[at], NOWHERE_PX)
    return nodes


def _units(degree: int) -> list[FloatArray]:
    """Coefficients of each Chebyshev polynomial up to a degree, (k + 1,) each."""
    return [np.eye(k + 1)[k] for k in range(degree + 1)]


def shifted(local: FloatArray, middle: FloatArray, half: FloatArray) -> FloatArray:
    """Polynomials (c, 2, n) in (t - middle) / half as polynomials in t, by Horner's scheme. middle, half : (c,)."""
    out = np.zeros_like(local)
    a, b = (1.0 / half)[:, None, None], (-middle / half)[:, None, None]
    for k in range(local.shape[-1] - 1, -1, -1):
        raised = b * out
        raised[..., 1:] += a * out[..., :-1]
        out = raised
        out[..., 0] += local[..., k]
    return out
