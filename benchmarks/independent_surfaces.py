"""Comparison of two surfaces of the same ground, without truth, from dsm.tif and sigma.tif of two results.

Two surfaces of different images have different errors, so a cell in which they disagree is wrong in at least one of
them. Where both are wrong in the same way, the comparison cannot see it. Their cameras are oriented separately and may
be shifted as a whole, so each comparison is made twice: of the surfaces as they are, and after the best shift in x, y
and height is removed.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workplace import CannotRun
from zlocus.evaluation.heights import HeightRaster, read_heights

# Horizontal shifts that are tried first, in cells east and north; then the step is halved down to the last.
FIRST_SHIFTS, LAST_STEP = np.arange(-24.0, 25.0, 4.0), 0.05
# Cells that take part in the search of the shift, and the share of them that both surfaces must have at a shift.
SEARCHED_CELLS, LEAST_COMMON = 40_000, 0.3
FALSE_SIGMAS = 3.0
NMAD_FACTOR = 1.4826

Sampler = Callable[[HeightRaster, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Surfaces:
    """Two surfaces on the same grid, one moved against the other.

    z, sigma : (2, r, c) m, NaN where there is none. sigma may be NaN where z is not.
    """

    z: np.ndarray
    sigma: np.ndarray

    @property
    def difference(self) -> np.ndarray:
        """Second less first height, (r, c) m."""
        return self.z[1] - self.z[0]


@dataclass(frozen=True)
class Disagreement:
    """How far two surfaces differ, over the cells (n) in which both have a height.

    in_both : share of the cells in which either has a height. median_m, nmad_m : of the differences. beyond : shares of
    the cells that differ by more than a limit (m). false : share that differs by more than `FALSE_SIGMAS` standard
    deviations and by more than the limit `false_m`. without_sigma : share without a standard deviation; such cells are
    in `false` where they exceed the limit `false_m`.
    """

    n: int
    in_both: float
    median_m: float
    nmad_m: float
    beyond: dict[float, float]
    false: float
    without_sigma: float


@dataclass(frozen=True)
class Comparison:
    """Disagreement of two surfaces as they are, and after the shift (m, of the second against the first) is removed."""

    absolute: Disagreement
    aligned: Disagreement
    east_m: float
    north_m: float
    up_m: float


def compare_surfaces(
    first: Path, second: Path, false_m: float = 3.0, limits_m: tuple[float, ...] = (1.0, 3.0)
) -> Comparison:
    """Compare two folders written by `zlocus dsm` on the same grid.

    false_m : a cell counts as false only where the surfaces differ by more than this; limits_m : of the other shares.

    Raises
    ------
    CannotRun
        The grids differ, or the surfaces share too few cells.
    """
    one, other = (read_heights(folder / "dsm.tif") for folder in (first, second))
    if one.z.shape != other.z.shape or not one.transform.almost_equals(other.transform):
        raise CannotRun(f"{first} and {second} have different grids. Make the second with `--like {first}/dsm.tif`.")
    sigmas = [read_heights(folder / "sigma.tif") for folder in (first, second)]
    plain = Surfaces(np.array([one.z, other.z]), np.array([each.z for each in sigmas]))
    absolute = disagreement(plain, false_m, limits_m)
    east, north = best_shift(one, other)
    moved = Surfaces(
        np.array([one.z, at_shift(other, (east, north), HeightRaster.between_cells)]),
        np.array([sigmas[0].z, at_shift(sigmas[1], (east, north), HeightRaster.nearest)]),
    )
    up = float(np.nanmedian(moved.difference))
    aligned = Surfaces(moved.z - np.array([0.0, up])[:, None, None], moved.sigma)
    return Comparison(absolute, disagreement(aligned, false_m, limits_m), east, north, up)


def disagreement(surfaces: Surfaces, false_m: float, limits_m: tuple[float, ...]) -> Disagreement:
    """How far two surfaces on the same cells differ."""
    has_height = np.isfinite(surfaces.z)
    both = has_height.all(axis=0)
    if not both.any():
        raise CannotRun("The two surfaces have no cell in common. Check that their images show the same ground.")
    difference = surfaces.difference[both]
    sigma = np.sqrt((surfaces.sigma**2).sum(axis=0))[both]
    away, median = np.abs(difference), float(np.median(difference))
    return Disagreement(
        n=len(difference),
        in_both=len(difference) / int(has_height.any(axis=0).sum()),
        median_m=median,
        nmad_m=NMAD_FACTOR * float(np.median(np.abs(difference - median))),
        beyond={limit: float((away > limit).mean()) for limit in limits_m},
        false=float(((away > false_m) & ~(away <= FALSE_SIGMAS * sigma)).mean()),
        without_sigma=float(np.isnan(sigma).mean()),
    )


def at_shift(raster: HeightRaster, shift_m: tuple[float, float], sample: Sampler) -> np.ndarray:
    """Values (r, c) of a raster at the centres of its own cells moved by `shift_m` to the east and to the north."""
    rows, cols = raster.z.shape
    col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    x, y = raster.transform * (col.ravel(), row.ravel())
    return sample(raster, np.column_stack([x, y]) + np.array(shift_m)).reshape(rows, cols)


def best_shift(one: HeightRaster, other: HeightRaster) -> tuple[float, float]:
    """Shift (east, north) m of the second surface against the first, at which their differences spread least.

    The spread is the median absolute deviation. Shifts of up to 24 cells are tried in steps of 4, then a pattern search
    halves the step. Shifts with fewer common cells than `LEAST_COMMON` of the most are passed over.
    """
    row, col = np.nonzero(np.isfinite(one.z))
    if not len(row):
        raise CannotRun(f"{one.path} has no height, so there is nothing to align. Look at its report.")
    chosen = np.random.default_rng(0).permutation(len(row))[:SEARCHED_CELLS]
    row, col = row[chosen], col[chosen]
    xy = np.column_stack(one.transform * (col + 0.5, row + 0.5))
    z, cell = one.z[row, col], abs(one.transform.a)

    @functools.cache
    def differences(shift: tuple[float, float]) -> np.ndarray:
        difference = other.between_cells(xy + np.array(shift) * cell) - z
        return difference[np.isfinite(difference)]

    tried = list(itertools.product(FIRST_SHIFTS, repeat=2))
    least = max(LEAST_COMMON * max(len(differences(shift)) for shift in tried), 1)

    def spread(shift: tuple[float, float]) -> float:
        difference = differences(shift)
        if len(difference) < least:
            return np.inf
        return float(np.median(np.abs(difference - np.median(difference))))

    best, step = min(tried, key=spread), FIRST_SHIFTS[1] - FIRST_SHIFTS[0]
    while step > LAST_STEP:
        nearby = [(best[0] + u * step, best[1] + v * step) for u, v in itertools.product((-1, 0, 1), repeat=2)]
        better = min(nearby, key=spread)
        if spread(better) >= spread(best):
            step /= 2
        else:
            best = better
    return float(best[0] * cell), float(best[1] * cell)
