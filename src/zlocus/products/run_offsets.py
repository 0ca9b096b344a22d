"""Vertical offsets between runs that overlap, and how much their differences exceed their standard deviations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.io.surface_cells import SurfaceCells
from zlocus.io.surface_inputs import QUALITY
from zlocus.matching.quality import Quality

# Side of the blocks over which differences are reduced to a median, cells, and the cells that such a block needs.
BLOCK_CELLS, MIN_BLOCK_CELLS = 32, 64
# Single differences kept of each block, to tell their spread.
KEPT_PER_BLOCK = 64
# The uncertainty of a median is estimated from groups of blocks, of which there are at least so many.
MIN_GROUPS = 8
NMAD, MEDIAN_EFFICIENCY = 1.4826, 1.2533
# An offset is removed where it is this many times its standard deviation, and not less than a millimetre.
SIGNIFICANT, SMALLEST_M = 3.0, 1e-3
# Doubtful cells, which say little about the offset of a whole run.
LEFT_OUT = Quality.FILLED | Quality.JUMP | Quality.AMBIGUOUS | Quality.DISPUTED


@dataclass(frozen=True)
class PairSample:
    """Differences of two runs in blocks of cells, the second less the first.

    median : (m,) m; place : (m, 2) row and column of each block, in blocks; difference : (k,) m, single differences;
    sigmas : (k, 2) m, standard deviations of both heights, NaN where a run states none.
    """

    median: NDArray[np.float64]
    place: NDArray[np.int64]
    difference: NDArray[np.float64]
    sigmas: NDArray[np.float64]


@dataclass(frozen=True)
class PairOffset:
    """The offset of one run from another.

    first, second : numbers of the runs; offset_m : median of second less first; sigma_m : its standard deviation, with
    the correlation of neighbouring cells; scale : the spread of the differences about the offset, in units of what the
    standard deviations say, NaN where these are not known; spread_m : that spread; usual_sigmas_m : median of the
    standard deviations of each of both, NaN where it states none; n_blocks : blocks of cells that were looked at.
    """

    first: int
    second: int
    offset_m: float
    sigma_m: float
    scale: float
    spread_m: float
    usual_sigmas_m: tuple[float, float]
    n_blocks: int


@dataclass(frozen=True)
class RunOffsets:
    """Offsets of all runs from the first of those they are connected with by overlaps.

    offset_m, sigma_m : (n,) m; group : (n,) int, number of the first run of each one's group; pairs : see `PairOffset`;
    largest_misclosure_m : by which an offset of a pair differs from those of its runs.
    """

    offset_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    group: NDArray[np.int64]
    pairs: tuple[PairOffset, ...]
    largest_misclosure_m: float

    @property
    def is_significant(self) -> bool:
        """Whether an offset is more than its uncertainty explains."""
        size = np.abs(self.offset_m)
        return bool(((size > SIGNIFICANT * self.sigma_m) & (size > SMALLEST_M)).any())


def sampled_pairs(
    surface_cells: Mapping[int, SurfaceCells], row: int, col: int, seed: int = 0
) -> dict[tuple[int, int], PairSample]:
    """Differences of all pairs of runs in one window of the grid, by their numbers.

    row, col : place of the window's first cell in the grid, a multiple of `BLOCK_CELLS`.
    """
    good = {number: _good_heights(run) for number, run in surface_cells.items()}
    found = {}
    rng = np.random.default_rng([seed, row, col])
    numbers = sorted(surface_cells)
    for place, first in enumerate(numbers):
        for second in numbers[place + 1 :]:
            difference = good[second] - good[first]
            if np.isfinite(difference).any():
                sigmas = np.stack([surface_cells[first].sigma, surface_cells[second].sigma], axis=-1)
                sample = _sample(difference, sigmas, (row // BLOCK_CELLS, col // BLOCK_CELLS), rng)
                if len(sample.median):
                    found[first, second] = sample
    return found


def joined_samples(samples: Sequence[PairSample]) -> PairSample:
    """The samples of several windows as one."""
    return PairSample(
        *(
            np.concatenate([getattr(one, name) for one in samples])
            for name in ("median", "place", "difference", "sigmas")
        )
    )


def pair_offset(first: int, second: int, sample: PairSample) -> PairOffset:
    """Offset of a pair of runs, from the differences of all windows."""
    offset = float(np.median(sample.median))
    apart = sample.difference - offset
    with np.errstate(invalid="ignore"):
        relative = np.abs(apart) / np.hypot(*sample.sigmas.T)
    relative = relative[np.isfinite(relative)]
    scale = float(NMAD * np.median(relative)) if relative.size else math.nan
    spread_m = float(NMAD * np.median(np.abs(apart)))
    sigma_m = offset_sigma(sample.median, sample.place)
    usual = [float(np.median(of_run[np.isfinite(of_run)])) if np.isfinite(of_run).any() else math.nan
             for of_run in sample.sigmas.T]  # fmt: skip
    return PairOffset(first, second, offset, sigma_m, scale, spread_m, (usual[0], usual[1]), len(sample.median))


def estimated_sigmas(n_runs: int, pairs: Sequence[PairOffset]) -> NDArray[np.float64]:
    """Standard deviations (n,) m of runs that state none, from the spread of their differences from others.

    What the standard deviation of the other explains is taken off; two runs without one share the spread equally. NaN
    for a run that overlaps no other.
    """
    found: list[list[float]] = [[] for _ in range(n_runs)]
    for pair in pairs:
        for run, of_other in ((pair.first, pair.usual_sigmas_m[1]), (pair.second, pair.usual_sigmas_m[0])):
            half = pair.spread_m / math.sqrt(2.0)
            left = pair.spread_m**2 - of_other**2
            found[run].append(max(math.sqrt(left) if left > 0 else half, SMALLEST_M))
    return np.array([float(np.median(each)) if each else math.nan for each in found])


def offset_sigma(median: NDArray[np.float64], place: NDArray[np.int64]) -> float:
    """Standard deviation of the median of block medians (m,), m, whose errors may be correlated over many blocks.

    Blocks are joined to ever larger groups. While groups are smaller than the correlation reaches, the spread of their
    means divided by the root of their number is too small; so the largest of these estimates counts.
    """
    best, side = 0.0, 1
    while True:
        _, group = np.unique(place // side, axis=0, return_inverse=True)
        group = group.ravel()
        n = int(group.max()) + 1 if len(group) else 0
        if n < MIN_GROUPS and side > 1:
            return best
        means = np.bincount(group, median) / np.bincount(group)
        spread = NMAD * float(np.median(np.abs(means - np.median(means))))
        if n < MIN_GROUPS:
            # Too few to tell: as if all errors were the same.
            return max(spread, float(np.ptp(means)) / 2.0)
        best = max(best, MEDIAN_EFFICIENCY * spread / math.sqrt(n))
        side *= 2


def run_offsets(n_runs: int, pairs: Sequence[PairOffset]) -> RunOffsets:
    """Adjust the offsets of all pairs: least squares, weighted by their uncertainty. The first run of a group has 0."""
    group = _groups(n_runs, pairs)
    offset, sigma = np.zeros(n_runs), np.zeros(n_runs)
    misclosure = 0.0
    for first in np.unique(group):
        members = np.flatnonzero(group == first)
        if len(members) == 1:
            continue
        inside = [pair for pair in pairs if group[pair.first] == first]
        place = {int(number): i for i, number in enumerate(members)}
        design = np.zeros((len(inside), len(members)))
        for i, pair in enumerate(inside):
            design[i, place[pair.second]], design[i, place[pair.first]] = 1.0, -1.0
        root = 1.0 / np.maximum([pair.sigma_m for pair in inside], SMALLEST_M / 10)
        found = np.array([pair.offset_m for pair in inside])
        weighted = design[:, 1:] * root[:, None]  # the first member is fixed
        covariance = np.linalg.inv(weighted.T @ weighted)
        solved = covariance @ weighted.T @ (found * root)
        left = found - design[:, 1:] @ solved
        n_spare = len(inside) - (len(members) - 1)
        inflation = max(1.0, math.sqrt(float(((left * root) ** 2).sum()) / n_spare)) if n_spare else 1.0
        offset[members[1:]], sigma[members[1:]] = solved, inflation * np.sqrt(np.diag(covariance))
        misclosure = max(misclosure, float(np.abs(left).max()))
    return RunOffsets(offset, sigma, group, tuple(pairs), misclosure)


def as_record(offsets: RunOffsets, names: Sequence[str], is_removed: bool) -> dict[str, Any]:
    """The entry of run.json. names : of the runs."""
    return {
        "removed": is_removed,
        "runs": [
            {
                "run": name, "offset_m": round(float(offset), 4), "sigma_m": round(float(sigma), 4),
                "relative_to": names[int(first)],
            }
            for name, offset, sigma, first in zip(names, offsets.offset_m, offsets.sigma_m, offsets.group, strict=True)
        ],
        "pairs": [
            {
                "first": names[pair.first], "second": names[pair.second], "median_m": round(pair.offset_m, 4),
                "sigma_m": round(pair.sigma_m, 4), "spread_m": round(pair.spread_m, 4),
                "spread_by_sigma": round(pair.scale, 4), "blocks": pair.n_blocks,
            }
            for pair in offsets.pairs
        ],
        "largest_misclosure_m": round(offsets.largest_misclosure_m, 4),
    }  # fmt: skip


def _good_heights(surface_cells: SurfaceCells) -> NDArray[np.float64]:
    """Heights (r, c), NaN where they are doubtful."""
    z = surface_cells.height.astype(np.float64)
    if QUALITY in surface_cells.flags:
        z[(surface_cells.flags[QUALITY].astype(np.uint16) & np.uint16(LEFT_OUT)) != 0] = np.nan
    return z


def _sample(
    difference: NDArray[np.float64], sigmas: NDArray[np.float32], first: tuple[int, int], rng: np.random.Generator
) -> PairSample:
    medians, places, kept, of_kept = [], [], [], []
    for r in range(0, difference.shape[0], BLOCK_CELLS):
        for c in range(0, difference.shape[1], BLOCK_CELLS):
            block = difference[r : r + BLOCK_CELLS, c : c + BLOCK_CELLS].ravel()
            known = np.flatnonzero(np.isfinite(block))
            if len(known) < MIN_BLOCK_CELLS:
                continue
            medians.append(float(np.median(block[known])))
            places.append((first[0] + r // BLOCK_CELLS, first[1] + c // BLOCK_CELLS))
            some = rng.choice(known, min(KEPT_PER_BLOCK, len(known)), replace=False)
            kept.append(block[some])
            of_kept.append(sigmas[r : r + BLOCK_CELLS, c : c + BLOCK_CELLS].reshape(-1, 2)[some].astype(np.float64))
    return PairSample(
        np.array(medians), np.array(places, np.int64).reshape(-1, 2), np.concatenate(kept or [np.empty(0)]),
        np.concatenate(of_kept or [np.empty((0, 2))]),
    )  # fmt: skip


def _groups(n_runs: int, pairs: Sequence[PairOffset]) -> NDArray[np.int64]:
    """The lowest number of the runs with which each run is connected by overlaps."""
    group = np.arange(n_runs)
    for _ in range(n_runs):
        before = group.copy()
        for pair in pairs:
            group[pair.first] = group[pair.second] = min(group[pair.first], group[pair.second])
        if (group == before).all():
            break
    return group
