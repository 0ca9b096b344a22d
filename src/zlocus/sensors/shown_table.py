"""Projection tables of cameras close by, each corner over the heights at which the image shows it.

Perspective bends a projection without bound towards the height of the camera, and a lens maps only what is in front of
it. Over all heights of a scene such a table would need any degree, or hold nowhere; over those at which a block is in
the image it is as tame as any.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from zlocus.errors import GeometryError
from zlocus.sensors.model import FloatArray, SensorModel
from zlocus.sensors.table import NOWHERE_PX, ProjectionTable, project_cells, projection_error

BoolArray = NDArray[np.bool_]
# Heights at which it is looked whether an image shows a block, and at which its table is checked.
SAMPLES, CHECKS = 33, 7
# Coefficients this small (share of the tolerance) are dropped: over a short part of the heights they would be large
# numbers that cancel.
NEGLIGIBLE = 0.02


@dataclass(frozen=True)
class Shown:
    """Where an image shows blocks. known : (b + 1, d + 1, s) corners that the sensor maps; near : (b, d, s) blocks that
    may be in the image and whose corners are known; missed : (b, d, s) blocks that are in it though a corner is not
    known; s heights."""

    known: BoolArray
    near: BoolArray
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
    most_lost: float,
) -> ProjectionTable:
    """Tabulate `sensor` over a grid of cells, at each corner over the heights at which `window` shows what is around it.

    See `projection_table`. most_lost : share of what the window shows (blocks by heights) in which the table need not
    hold.

    Raises
    ------
    GeometryError
        Where it does not hold in more.
    """
    rows = block * np.arange(-(-shape[0] // block) + 1, dtype=np.float64)
    cols = block * np.arange(-(-shape[1] // block) + 1, dtype=np.float64)
    z_mid, z_half = (z_range[0] + z_range[1]) / 2, max((z_range[1] - z_range[0]) / 2, 0.5)
    t = np.linspace(-1.0, 1.0, SAMPLES)
    shown = shown_at(np.stack([project_cells(sensor, transform, rows, cols, z_mid + z_half * v) for v in t], -1), window)
    ends = corner_ends(shown, t)
    nodes = fitted(sensor, transform, rows, cols, ends, (z_mid, z_half), degree, NEGLIGIBLE * tolerance_px)
    low = np.max([ends[corner][..., 0] for corner in CORNERS], axis=0)
    high = np.min([ends[corner][..., 1] for corner in CORNERS], axis=0)
    table = ProjectionTable(nodes, z_mid, z_half, low <= high, np.zeros(low.shape, bool), ends)
    gaps = gaps_where_shown(table, sensor, transform, block, np.stack([low, high], -1), window)
    bent = table.holds & (gaps > tolerance_px)
    outside = (t < low[..., None]) | (t > high[..., None]) | bent[..., None]
    lost = shown.missed | (shown.near & outside)
    if lost.sum() > most_lost * (shown.near | shown.missed).sum():
        raise projection_error(block, float(gaps[bent].max(initial=0.0)), tolerance_px, z_range)
    return ProjectionTable(nodes, z_mid, z_half, table.holds & ~bent, np.asarray(lost.any(axis=-1)), ends)


CORNERS = tuple((slice(i, n), slice(j, m)) for i, n in ((0, -1), (1, None)) for j, m in ((0, -1), (1, None)))


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
    return Shown(known, meets & whole, meets & ~whole)


def corner_ends(shown: Shown, t: FloatArray) -> FloatArray:
    """(b + 1, d + 1, 2) lowest and highest t of the longest run of heights at which a block around each corner is shown,
    and the samples before and after it where the corner is known there; inf and -inf where there is none."""
    near = np.zeros(shown.known.shape, bool)
    for corner in CORNERS:
        near[corner] |= shown.near
    near &= shown.known
    first, last = longest_run(near)
    b, d = np.indices(first.shape)
    before, after = np.maximum(first - 1, 0), np.minimum(last + 1, len(t) - 1)
    first = np.where(shown.known[b, d, before], before, first)
    last = np.where(shown.known[b, d, after], after, last)
    # What reaches the ends of the heights goes on beyond them.
    low = np.where(first == 0, -np.inf, t[first])
    high = np.where(last == len(t) - 1, np.inf, t[last])
    some = near.any(axis=-1)
    return np.stack([np.where(some, low, np.inf), np.where(some, high, -np.inf)], axis=-1)


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
    """Polynomials in t (b + 1, d + 1, 2, n) px through Chebyshev nodes between the ends of each corner; NOWHERE_PX where
    a corner has none. heights : z_mid and z_half."""
    nodes = np.zeros((len(rows), len(cols), 2, degree + 1))
    nodes[..., 0] = NOWHERE_PX
    at = ends[..., 0] <= ends[..., 1]
    low, high = np.clip(ends[at][:, 0], -1.0, 1.0), np.clip(ends[at][:, 1], -1.0, 1.0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-3)
    s = np.cos((np.arange(degree + 1) + 0.5) * np.pi / (degree + 1))
    b, d = np.nonzero(at)
    x, y = transform * (cols[d] + 0.5, rows[b] + 0.5)
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


def gaps_where_shown(
    table: ProjectionTable,
    sensor: SensorModel,
    transform: Affine,
    block: int,
    ends: FloatArray,
    window: tuple[int, int, int, int],
) -> FloatArray:
    """Largest distance (b, d) px of the table from the exact model at block centres, over heights between the ends
    (b, d, 2) of each block at which it puts the centre into the window or about it."""
    b, d = np.nonzero(table.holds)
    row, col, n_rows, n_cols = window
    low, high = np.clip(ends[b, d], -1.0, 1.0).T
    x, y = transform * (block * (d + 0.5) + 0.5, block * (b + 0.5) + 0.5)
    corners = np.stack([table.nodes[corner][b, d] for corner in CORNERS])
    powers, worst = np.arange(table.nodes.shape[-1]), np.zeros(len(b))
    for share in np.linspace(0.0, 1.0, CHECKS):
        t = low + share * (high - low)
        at = np.einsum("kcxp,cp->kcx", corners, t[:, None] ** powers)
        exact = sensor.image_from_ground(np.column_stack([x, y, table.z_mid + table.z_half * t]))
        gap = np.linalg.norm(at.mean(axis=0) - exact, axis=1)
        inside = (at.max(axis=0) >= (col, row)) & (at.min(axis=0) <= (col + n_cols - 1, row + n_rows - 1))
        worst = np.where(inside.all(axis=1), np.maximum(worst, np.nan_to_num(gap, nan=np.inf)), worst)
    out = np.zeros(table.holds.shape)
    out[b, d] = worst
    return out
