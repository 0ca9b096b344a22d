"""Volumes of change inside polygons, with an uncertainty that knows how far errors reach."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.grid import CellWindow
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.change_noise import ChangeNoise, Correlation
from zlocus.io.grid_inputs import cells_inside

# Longest side of the grid on which correlated errors are summed; larger polygons are summed in blocks of cells.
MAX_SIDE = 512
# Rows of a polygon that are read at a time are chosen so that a strip has about this many cells.
STRIP_CELLS = 2_000_000
# Cells whose correlation with unchanged ground is looked at.
N_PLACES = 20_000
# A change is significant where it is larger than this many standard deviations: 5 %, two-sided.
SIGNIFICANT = 1.96
# Blocks this close to each other are summed cell by cell.
NEAR_BLOCKS = 2


class ChangeClass(IntEnum):
    """Values of `class.tif`."""

    UNKNOWN = 0  # a surface has no height
    UNCHANGED = 1  # no significant change
    RAISED = 2
    LOWERED = 3


@dataclass(frozen=True)
class ChangeCells:
    """A window of the results. difference, sigma : (r, c) m, NaN where unknown; kind : (r, c) uint8, `ChangeClass`."""

    difference: FloatArray
    sigma: FloatArray
    kind: NDArray[np.uint8]


@dataclass(frozen=True)
class Volume:
    """Change inside a polygon.

    n_cells, n_known : cells with their centre in the polygon, and those of them that both surfaces know; volume_m3,
    sigma_m3 : net volume of the whole polygon, and its standard deviation, NaN where no cell is known; mean_m : mean
    change; missing_sigma_m3, offset_sigma_m3 : parts of the standard deviation from unknown cells and from the offset;
    mismatch_sigma_m3 : standard deviation of gross errors, if they are as frequent as on unchanged ground, which is not
    in `sigma_m3`: most polygons have none of them, and a few have large ones;
    raised_m2, lowered_m2, raised_m3, lowered_m3 : area and volume of the cells with a significant change; area_m2 : of
    all cells.
    """

    n_cells: int
    n_known: int
    area_m2: float
    volume_m3: float
    sigma_m3: float
    mean_m: float
    missing_sigma_m3: float
    offset_sigma_m3: float
    mismatch_sigma_m3: float
    raised_m2: float
    lowered_m2: float
    raised_m3: float
    lowered_m3: float

    @property
    def known_share(self) -> float:
        """Share of the cells that both surfaces know."""
        return self.n_known / self.n_cells if self.n_cells else 0.0

    @property
    def is_significant(self) -> bool:
        """Whether the volume differs from 0 at the 5 % level, gross errors included."""
        return bool(abs(self.volume_m3) > SIGNIFICANT * math.hypot(self.sigma_m3, self.mismatch_sigma_m3))

    def as_dict(self) -> dict[str, Any]:
        """The values of a row of the table, by their names."""
        return {
            "cells": self.n_cells, "known_cells": self.n_known, "known_share": round(self.known_share, 4),
            "area_m2": round(self.area_m2, 3), "volume_m3": _rounded(self.volume_m3),
            "sigma_m3": _rounded(self.sigma_m3), "low_68_m3": _rounded(self.volume_m3 - self.sigma_m3),
            "high_68_m3": _rounded(self.volume_m3 + self.sigma_m3), "significant": self.is_significant,
            "mean_m": _rounded(self.mean_m, 5), "sigma_of_missing_m3": _rounded(self.missing_sigma_m3),
            "sigma_of_offset_m3": _rounded(self.offset_sigma_m3),
            "sigma_of_mismatches_m3": _rounded(self.mismatch_sigma_m3), "raised_m2": round(self.raised_m2, 3),
            "lowered_m2": round(self.lowered_m2, 3), "raised_m3": _rounded(self.raised_m3),
            "lowered_m3": _rounded(self.lowered_m3),
        }  # fmt: skip


def _rounded(value: float, digits: int = 3) -> float:
    return round(value, digits) if math.isfinite(value) else math.nan


@dataclass
class _Sums:
    """Sums over the cells of a polygon. weights : (r, c) stated errors, m, summed in blocks of `step` cells a side."""

    weights: FloatArray
    step: int
    n_cells: int = 0
    n_known: int = 0
    total: float = 0.0
    squares: float = 0.0
    counts: tuple[int, int] = (0, 0)
    changed: tuple[float, float] = (0.0, 0.0)

    def add(self, inside: NDArray[np.bool_], cells: ChangeCells, row: int) -> None:
        """Add a strip. row : of its first cell in the window of the polygon."""
        known = inside & np.isfinite(cells.difference)
        d = np.where(known, cells.difference, 0.0)
        self.n_cells += int(inside.sum())
        self.n_known += int(known.sum())
        self.total += float(d.sum())
        self.squares += float((d**2).sum())
        kinds = [known & (cells.kind == kind) for kind in (ChangeClass.RAISED, ChangeClass.LOWERED)]
        self.counts = (self.counts[0] + int(kinds[0].sum()), self.counts[1] + int(kinds[1].sum()))
        sums = [float(d[each].sum()) for each in kinds]
        self.changed = (self.changed[0] + sums[0], self.changed[1] + sums[1])
        rows, cols = np.nonzero(known)
        np.add.at(self.weights, ((rows + row) // self.step, cols // self.step), cells.sigma[known])


def volume_of(
    polygon: Any, geobox: GeoBox, read: Callable[[CellWindow], ChangeCells], noise: ChangeNoise, is_removed: bool = True
) -> Volume:
    """Change inside a polygon, in bounded memory.

    polygon : shapely, in the CRS of the grid; read : cells of a window, also beyond the grid, where they are unknown;
    is_removed : whether the offset was removed from the differences.

    Unknown cells count with the mean of the known ones. That mean is taken as uncertain by the spread of the changes
    inside the polygon, the same error for all unknown cells.
    """
    cell_m = abs(float(geobox.transform.a))
    window = _window_of(polygon, geobox)
    step = -(-max(window.rows, window.cols) // MAX_SIDE)
    sums = _Sums(np.zeros((-(-window.rows // step), -(-window.cols // step))), step)
    rows = max(1, STRIP_CELLS // max(window.cols, 1))
    for row in range(0, window.rows, rows):
        part = CellWindow(window.row + row, window.col, min(rows, window.rows - row), window.cols)
        moved = geobox.transform * Affine.translation(part.col, part.row)
        inside = cells_inside(np.array([polygon]), GeoBox((part.rows, part.cols), moved, geobox.crs))
        sums.add(inside, read(part), row)
    return _volume(sums, window, cell_m, noise, is_removed)


def _window_of(polygon: Any, geobox: GeoBox) -> CellWindow:
    west, south, east, north = polygon.bounds
    (c0, r0), (c1, r1) = ~geobox.transform * (west, north), ~geobox.transform * (east, south)
    row, col = math.floor(min(r0, r1)), math.floor(min(c0, c1))
    return CellWindow(row, col, math.ceil(max(r0, r1)) - row, math.ceil(max(c0, c1)) - col)


def _volume(sums: _Sums, window: CellWindow, cell_m: float, noise: ChangeNoise, is_removed: bool) -> Volume:
    cell_m2 = cell_m**2
    area = sums.n_cells * cell_m2
    changed = [cell_m2 * each for each in (*sums.counts, *sums.changed)]
    if not sums.n_known:
        nan = math.nan
        return Volume(sums.n_cells, 0, area, nan, nan, nan, nan, nan, nan, *changed)
    mean = sums.total / sums.n_known
    spread = math.sqrt(max(sums.squares / sums.n_known - mean**2, 0.0))
    own = correlated_variance(sums.weights, noise.correlation, cell_m, sums.step) / sums.n_known**2
    if is_removed:
        usual = float(sums.weights.sum()) / sums.n_known
        shared = _correlation_with_stable(sums, window, cell_m, noise)
        of_offset = noise.offset_sigma_m**2 - 2.0 * usual * noise.scale * noise.sigma_m * shared
        # The errors of a polygon and of the ground around it may be alike, but never cancel completely.
        of_offset = max(of_offset, -0.75 * own)
    else:
        of_offset = noise.offset_m**2
    missing = (sums.n_cells - sums.n_known) * cell_m2 * spread
    variance = area**2 * (own + of_offset) + missing**2
    return Volume(
        sums.n_cells, sums.n_known, area, area * mean, math.sqrt(variance), mean, missing,
        area * (noise.offset_sigma_m if is_removed else abs(noise.offset_m)),
        cell_m2 * math.sqrt(sums.n_cells * noise.mismatch_m2), *changed,
    )  # fmt: skip


def _correlation_with_stable(sums: _Sums, window: CellWindow, cell_m: float, noise: ChangeNoise) -> float:
    """Mean correlation of the errors of a polygon's cells with those of unchanged ground."""
    rng = np.random.default_rng(0)
    weights = sums.weights.ravel() / sums.weights.sum()
    chosen = rng.choice(len(weights), N_PLACES, p=weights)
    places = np.column_stack(np.divmod(chosen, sums.weights.shape[1])).astype(float)
    places = (places + rng.random(places.shape)) * sums.step + (window.row, window.col)
    stable = noise.random_places[rng.integers(0, len(noise.random_places), N_PLACES)]
    return float(noise.correlation.at(cell_m * np.hypot(*(places - stable - 0.5).T)).mean())


def correlated_variance(weights: FloatArray, correlation: Correlation, cell_m: float, step: int = 1) -> float:
    """Variance of the sum of correlated errors.

    weights : (r, c) standard deviations of the errors, m, each the sum over a block of `step` cells a side.
    """
    rows, cols = weights.shape
    shape = (2 * rows, 2 * cols)
    spectrum = np.fft.rfft2(weights, shape)
    products = np.fft.irfft2(spectrum * spectrum.conj(), shape)
    down, across = (np.minimum(np.arange(2 * k), 2 * k - np.arange(2 * k)) for k in (rows, cols))
    rho = correlation.at(cell_m * step * np.hypot(down[:, None], across[None]).astype(float))
    if step > 1:
        near = np.arange(NEAR_BLOCKS + 1)
        means = np.array([[_mean_correlation(correlation, cell_m, step, int(u), int(v)) for v in near] for u in near])
        is_near = (down[:, None] <= NEAR_BLOCKS) & (across[None] <= NEAR_BLOCKS)
        rho = np.where(
            is_near, means[np.minimum(down, NEAR_BLOCKS)[:, None], np.minimum(across, NEAR_BLOCKS)[None]], rho
        )
    return float((products * rho).sum())


def _mean_correlation(correlation: Correlation, cell_m: float, step: int, u: int, v: int) -> float:
    """Mean correlation of the cells of two blocks that lie u and v blocks apart."""
    apart = np.arange(1 - step, step)
    share = (step - np.abs(apart)) / step**2
    distance = cell_m * np.hypot((u * step + apart)[:, None], (v * step + apart)[None])
    return float((share[:, None] * share[None] * correlation.at(distance)).sum())
