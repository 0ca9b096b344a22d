"""Errors of the difference of two surfaces, from ground that has not changed: offset, size, and correlation in space.

The standard deviations that both surfaces state are a beginning. How large the differences of unchanged ground really
are, and how far their errors reach, is seen in the differences themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import norm

from zlocus.core.sensor_model import FloatArray

NMAD = 1.4826
# Shares of unchanged cells at which the size of differences is compared with that of normal errors. Where it is not
# known which ground has changed, only the smaller differences tell.
SHARES = (0.5, 0.6827, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
SHARES_OF_UNKNOWN = (0.5, 0.6827, 0.8, 0.9, 0.95)
# Above this share, differences of ground that may have changed are looked at on the side (raised or lowered) that has
# fewer large ones, because change is mostly of one kind; and they count as errors up to this many times those of normal
# errors, because it may be of both kinds.
SURE_SHARE, MAX_TAIL = 0.8, 1.5
# Larger differences, in units of the robust spread, are mismatches: they say nothing of the spread or of correlation.
MAX_SPREADS = 5.0
# Ranges of spherical models whose sum is fitted to the correlation, from this many cells on, each so many times the
# one before.
FIRST_RANGE_CELLS, RANGE_FACTOR = 1.5, 1.5
# Distances of pairs of cells are counted in classes, each so many times the one before.
LAG_FACTOR = 1.25
# Side of the blocks whose means tell the correlation over distances larger than a window, and most blocks compared.
MEAN_CELLS, MAX_MEANS = 32, 1500
# Random pairs of cells over which a mean correlation is taken.
N_PAIRS = 400_000
SEED = 0


@dataclass(frozen=True)
class StableWindow:
    """Differences in a window of the grid. row, col : of its first cell; difference : (r, c) m, NaN where a height is
    missing or the ground may have changed; sigma : (r, c) m, of the difference as both surfaces state it; slope : (r,
    c, 2) rise of the first surface by a metre to the east and to the north."""

    row: int
    col: int
    difference: FloatArray
    sigma: FloatArray
    slope: FloatArray


@dataclass(frozen=True)
class Correlation:
    """Correlation of errors over a distance: a sum of spherical models and a part that no two cells share.

    shares : (m,) of the variance; ranges_m : (m,) distance from which each model is 0.
    """

    shares: FloatArray
    ranges_m: FloatArray

    def at(self, distance_m: FloatArray) -> FloatArray:
        """Correlation, of the shape of the distances; 1 at distance 0."""
        out = np.zeros(np.shape(distance_m))
        for share, range_m in zip(self.shares, self.ranges_m, strict=True):
            u = np.minimum(distance_m / range_m, 1.0)
            out += share * (1.0 - 1.5 * u + 0.5 * u**3)
        return np.where(distance_m == 0, 1.0, out)

    @property
    def area_m2(self) -> float:
        """Area over which errors count as one: the integral of the correlation over the plane."""
        return float((self.shares * math.pi * self.ranges_m**2 / 5.0).sum())

    def as_dict(self) -> dict[str, Any]:
        """The entry of change.json."""
        kept = self.shares > 1e-4
        return {
            "spherical_models": [
                {"share": round(float(share), 4), "range_m": round(float(range_m), 3)}
                for share, range_m in zip(self.shares[kept], self.ranges_m[kept], strict=True)
            ],
            "uncorrelated_share": round(float(1.0 - self.shares.sum()), 4),
        }


@dataclass(frozen=True)
class ChangeNoise:
    """Errors of the differences of two surfaces.

    offset_m : median difference of unchanged ground; offset_sigma_m : its standard deviation; scale : unchanged
    differences are this many times as large as their stated standard deviations; correlation : of the errors;
    quantiles, normal : (q,) sizes of differences in stated standard deviations, and the sizes of normal errors of the
    same share; places : (n, 2) row and column of cells of unchanged ground; sigma_m : root mean square of its stated
    standard deviations; mean_correlation : of two random cells of it; n_cells : number; spread_m : robust spread of its
    differences; shift_m : by which the second surface seems to lie to the east and to the north of the first;
    is_shift_clear : whether its removal would make the differences clearly smaller; mismatch_m2 : variance of the sum
    of gross errors over an area, m2 for each cell of it, 0 where unchanged ground is not known.
    """

    offset_m: float
    offset_sigma_m: float
    scale: float
    correlation: Correlation
    quantiles: FloatArray
    normal: FloatArray
    places: NDArray[np.int64]
    sigma_m: float
    mean_correlation: float
    n_cells: int
    spread_m: float
    shift_m: tuple[float, float]
    is_shift_clear: bool
    mismatch_m2: float = 0.0

    def significance(self, difference: FloatArray, sigma: FloatArray, is_removed: bool = True) -> FloatArray:
        """Change in standard deviations of a normal error that is as rare on unchanged ground, with its sign.

        difference : m; sigma : m, as both surfaces state it; is_removed : whether the offset was removed.
        """
        offset = self.offset_m if is_removed else 0.0
        beside = self.offset_sigma_m if is_removed else math.hypot(self.offset_m, self.offset_sigma_m)
        size = (difference - offset) / np.hypot(sigma, beside / self.scale)
        last = self.normal[-1] / self.quantiles[-1]
        known = np.interp(np.abs(size), np.append(0.0, self.quantiles), np.append(0.0, self.normal))
        return np.asarray(np.copysign(np.where(np.abs(size) > self.quantiles[-1], np.abs(size) * last, known), size))

    def sigma(self, sigma: FloatArray, is_removed: bool = True) -> FloatArray:
        """Standard deviation of differences, m, by those that both surfaces state, with the part of the offset."""
        return np.hypot(self.scale * sigma, self.offset_sigma_m if is_removed else abs(self.offset_m))

    @cached_property
    def random_places(self) -> NDArray[np.int64]:
        """Some cells (n, 2) of unchanged ground, in random order."""
        rng = np.random.default_rng(SEED)
        return self.places[rng.integers(0, len(self.places), min(N_PAIRS, 4 * len(self.places)))]

    def as_dict(self) -> dict[str, Any]:
        """The entry of change.json."""
        return {
            "offset_m": round(self.offset_m, 5), "offset_sigma_m": round(self.offset_sigma_m, 5),
            "spread_m": round(self.spread_m, 5), "scale_of_sigmas": round(self.scale, 4), "cells": self.n_cells,
            "correlation": self.correlation.as_dict(),
            "mismatch_m2_per_cell": round(self.mismatch_m2, 5),
            "horizontal_shift_m": {"east": round(self.shift_m[0], 4), "north": round(self.shift_m[1], 4)},
        }  # fmt: skip


def change_noise(windows: Sequence[StableWindow], cell_m: float, is_known: bool) -> ChangeNoise:
    """Errors of differences from windows of ground that has not changed, or for the most part not.

    windows : at least one, with differences; is_known : whether unchanged ground is known, so that large differences
    are errors too.
    """
    d = np.concatenate([window.difference.ravel() for window in windows])
    sigma = np.concatenate([window.sigma.ravel() for window in windows])
    known = np.isfinite(d)
    places = np.concatenate([_places(window) for window in windows])[known]
    d, sigma = d[known], sigma[known]
    offset = float(np.median(d))
    size = np.abs(d - offset) / sigma
    spread = NMAD * float(np.median(size))
    shares = np.array(SHARES if is_known else SHARES_OF_UNKNOWN)
    normal = norm.ppf((1.0 + shares) / 2.0)
    if spread > 0:
        usual = size < MAX_SPREADS * spread
        scale = float(np.sqrt(np.mean(size[usual] ** 2))) if is_known else spread
        quantiles = np.quantile(size, shares)
        if not is_known:
            sides = [np.quantile(size[side], shares) for side in (d >= offset, d <= offset)]
            sure = shares <= SURE_SHARE
            most = MAX_TAIL * float((quantiles[sure] / normal[sure]).max()) * normal
            quantiles = np.where(sure, quantiles, np.minimum(np.minimum(*sides), most))
        quantiles = _rising(quantiles)
    else:
        # Most heights are the same in both, which says nothing of the others.
        scale, quantiles = 1.0, normal
    correlation = fitted_correlation(windows, offset, spread, cell_m)
    rng = np.random.default_rng(SEED)
    first, second = (places[rng.integers(0, len(places), N_PAIRS)] for _ in range(2))
    mean_correlation = float(correlation.at(cell_m * np.hypot(*(first - second).T.astype(float))).mean())
    sigma_m = float(np.sqrt(np.mean(sigma**2)))
    shift, is_clear = _shift(windows, offset, cell_m)
    return ChangeNoise(
        offset, scale * sigma_m * math.sqrt(mean_correlation), scale, correlation, quantiles, normal, places, sigma_m,
        mean_correlation, len(d), NMAD * float(np.median(np.abs(d - offset))), shift, is_clear,
        _mismatch_variance(windows, offset, spread) if is_known else 0.0,
    )  # fmt: skip


def _mismatch_variance(windows: Sequence[StableWindow], offset: float, spread: float) -> float:
    """Variance of the sum of gross errors, m2 for each cell: from their sums over blocks, which hold whole patches."""
    total, n_cells = 0.0, 0
    for window in windows:
        residual = window.difference - offset
        with np.errstate(invalid="ignore"):
            is_gross = np.abs(residual) >= MAX_SPREADS * spread * window.sigma
        gross, known = np.where(is_gross, residual, 0.0), np.isfinite(residual)
        for r in range(0, gross.shape[0], MEAN_CELLS):
            for c in range(0, gross.shape[1], MEAN_CELLS):
                total += float(gross[r : r + MEAN_CELLS, c : c + MEAN_CELLS].sum()) ** 2
                n_cells += int(known[r : r + MEAN_CELLS, c : c + MEAN_CELLS].sum())
    return total / max(n_cells, 1)


def _rising(quantiles: FloatArray) -> FloatArray:
    """Quantiles that rise everywhere, as interpolation needs."""
    return np.maximum.accumulate(quantiles + 1e-9 * quantiles.max() * np.arange(1, len(quantiles) + 1))


def _places(window: StableWindow) -> NDArray[np.int64]:
    row, col = np.indices(window.difference.shape)
    return np.column_stack([row.ravel() + window.row, col.ravel() + window.col])


def fitted_correlation(windows: Sequence[StableWindow], offset: float, spread: float, cell_m: float) -> Correlation:
    """Correlation of the errors: spherical models of many ranges, whose shares are fitted and not negative.

    spread : of the differences, in stated standard deviations.
    """
    limit = MAX_SPREADS * max(spread, 1e-12)
    residuals = [(window.difference - offset) / window.sigma for window in windows]
    residuals = [np.where(np.abs(each) < limit, each, np.nan) for each in residuals]
    variance = float(np.nanmean(np.concatenate([each.ravel() for each in residuals]) ** 2))
    if not variance > 0:
        return Correlation(np.zeros(1), np.array([cell_m]))
    lag, value, weight = _within_windows(residuals)
    far = _between_windows(windows, residuals, max(each.shape[0] for each in residuals) / 2)
    lag, value, weight = (np.concatenate(pair) for pair in zip((lag, value, weight), far, strict=True))
    ranges = [FIRST_RANGE_CELLS]
    while ranges[-1] < lag.max():
        ranges.append(ranges[-1] * RANGE_FACTOR)
    models = np.column_stack([Correlation(np.ones(1), np.array([r])).at(lag) for r in ranges])
    shares, _ = nnls(models * weight[:, None], value / variance * weight)
    total = shares.sum()
    return Correlation(shares / max(total, 1.0), np.array(ranges) * cell_m)


def _within_windows(residuals: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean distance in cells, mean product, and weight of pairs of cells of the same window, by class of distance."""
    total: dict[int, NDArray[np.float64]] = {}
    for residual in residuals:
        rows, cols = residual.shape
        known = np.isfinite(residual)
        shape = (2 * rows, 2 * cols)
        value, mask = (np.fft.rfft2(each, shape) for each in (np.where(known, residual, 0.0), known.astype(float)))
        product, n = (np.fft.irfft2(each * each.conj(), shape) for each in (value, mask))
        down, across = (np.minimum(np.arange(2 * k), 2 * k - np.arange(2 * k)) for k in (rows, cols))
        distance = np.hypot(down[:, None], across[None]).astype(float)
        near = (distance > 0) & (distance <= max(rows, cols) / 2) & (n > 0.5)
        kind = np.rint(np.log(distance[near]) / math.log(LAG_FACTOR)).astype(int)
        for number in np.unique(kind):
            here = kind == number
            sums = np.array([(distance[near] * n[near])[here].sum(), product[near][here].sum(), n[near][here].sum()])
            total[int(number)] = total.get(int(number), np.zeros(3)) + sums
    if not total:
        return np.empty(0), np.empty(0), np.empty(0)
    table = np.array([total[number] for number in sorted(total)])
    return table[:, 0] / table[:, 2], table[:, 1] / table[:, 2], np.ones(len(table))


def _between_windows(
    windows: Sequence[StableWindow], residuals: Sequence[FloatArray], least_cells: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same of pairs of cells farther apart, from the means of blocks."""
    means, places = [], []
    for window, residual in zip(windows, residuals, strict=True):
        for r in range(0, residual.shape[0] - MEAN_CELLS + 1, MEAN_CELLS):
            for c in range(0, residual.shape[1] - MEAN_CELLS + 1, MEAN_CELLS):
                block = residual[r : r + MEAN_CELLS, c : c + MEAN_CELLS]
                known = np.isfinite(block)
                if 2 * known.sum() >= known.size:
                    means.append(float(block[known].mean()))
                    places.append((window.row + r, window.col + c))
    if len(means) < 3:
        return np.empty(0), np.empty(0), np.empty(0)
    rng = np.random.default_rng(SEED)
    chosen = rng.choice(len(means), min(MAX_MEANS, len(means)), replace=False)
    mean, place = np.array(means)[chosen], np.array(places, float)[chosen]
    i, j = np.triu_indices(len(mean), 1)
    distance, product = np.hypot(*(place[i] - place[j]).T), mean[i] * mean[j]
    # Over more than half of the extent few pairs are left, and the removed offset makes them seem opposite.
    far = (distance > least_cells) & (distance <= distance.max() / 2)
    if not far.any():
        return np.empty(0), np.empty(0), np.empty(0)
    kind = np.rint(np.log(distance[far]) / math.log(LAG_FACTOR)).astype(int)
    _, place_of = np.unique(kind, return_inverse=True)
    n = np.bincount(place_of)
    return np.bincount(place_of, distance[far]) / n, np.bincount(place_of, product[far]) / n, np.ones(len(n))


def _shift(windows: Sequence[StableWindow], offset: float, cell_m: float) -> tuple[tuple[float, float], bool]:
    """Horizontal shift, east and north, m, of the second surface, from slopes; and whether it is clear."""
    d = np.concatenate([window.difference.ravel() for window in windows]) - offset
    slope = np.concatenate([window.slope.reshape(-1, 2) for window in windows])
    known = np.isfinite(d) & np.isfinite(slope).all(axis=1) & (np.abs(slope) < 1.0).all(axis=1)
    d, slope = d[known], slope[known]
    if len(d) < 100:
        return (0.0, 0.0), False
    shift = np.zeros(2)
    spread = NMAD * float(np.median(np.abs(d)))
    for _ in range(3):
        left = d + slope @ shift
        inside = np.abs(left - np.median(left)) < 3.0 * max(NMAD * float(np.median(np.abs(left))), 1e-9)
        design = np.column_stack([-slope[inside], np.ones(inside.sum())])
        solved, _, rank, _ = np.linalg.lstsq(design, d[inside], rcond=1e-6)
        if rank < 3:
            return (0.0, 0.0), False
        shift = solved[:2]
    left = d + slope @ shift
    better = NMAD * float(np.median(np.abs(left - np.median(left))))
    is_clear = bool(np.hypot(*shift) > 0.2 * cell_m and better < 0.95 * spread)
    return (float(shift[0]), float(shift[1])), is_clear
