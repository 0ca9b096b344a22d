"""Join the heights of several runs cell by cell, without a step where one of them begins or ends.

Where runs agree, their mean is taken, weighted by their precision and by the distance from the end of each (feathering,
also around holes). Where they differ by more than their standard deviations explain, one is chosen: a mean would be a
height that no run has found. The choice follows the weights in a neighbourhood, so that one run is taken for a whole
roof and its edges stay sharp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter

from zlocus.io.surface_cells import SurfaceCells
from zlocus.io.surface_inputs import QUALITY
from zlocus.matching.quality import Quality

# Runs agree up to the first number of standard deviations of their difference, and contradict each other from the
# second on; between them the weight of the one that is not chosen falls to 0, so that no step appears.
AGREE, CONTRADICT = 2.0, 3.0
# Half the side of the neighbourhood over which precision and support are averaged, cells.
NEIGHBOURS = 8
# A cell whose standard deviation is this many times that of its neighbourhood counts by its own.
MAX_ABOVE_NEIGHBOURS = 2.0
# Weight of an interpolated height beside a measured one.
FILLED_WEIGHT = 1e-6
# Of runs with equal support the one that was named first is chosen: the last one's support counts so much less.
ORDER_DISCOUNT = 0.05
# Where all agree, the run with the largest weight of its own is chosen: by this power of it beside the support.
OWN_POWER = 0.05
# Smaller weights count as none.
TINY = 1e-30
# A weight below this share adds nothing to the standard deviation that would have to be known.
SMALL_WEIGHT = 0.01


class SeamKind(IntEnum):
    """Values of `seams.tif`."""

    EMPTY = 0  # no run has a height
    ONE = 1  # one run has a height
    BLENDED = 2  # runs agree, and their heights are averaged
    CHOSEN = 3  # runs contradict each other, and one is chosen


@dataclass(frozen=True)
class RunRelations:
    """What is known of n runs beside their cells.

    scale : (n, n) differences are this many times as large as the standard deviations of both say, 1 or more; shared :
    (n, n) bool, runs that share images, whose errors are taken as the same.
    """

    scale: NDArray[np.float64]
    shared: NDArray[np.bool_]

    def of(self, numbers: Sequence[int]) -> RunRelations:
        """The relations of some of the runs."""
        part = np.ix_(numbers, numbers)
        return RunRelations(self.scale[part], self.shared[part])


@dataclass(frozen=True)
class BlendedCells:
    """Cells of several runs joined.

    height, sigma : (r, c) float32 m, NaN where no run has a height (where it is not known); chosen : (r, c) int64,
    place in the list of the run that is chosen, -1 where none has a height; kind : (r, c) uint8, see `SeamKind`.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    chosen: NDArray[np.int64]
    kind: NDArray[np.uint8]


def halo_cells(feather_cells: int) -> int:
    """Cells beyond a block on which its result depends."""
    return feather_cells + 2 * NEIGHBOURS + 1


def blended(surface_cells: Sequence[SurfaceCells], relations: RunRelations, feather_cells: int) -> BlendedCells:
    """Join runs on one block. Cells closer to the border of the block than `halo_cells` are right only if the block
    ends there.

    surface_cells : of the runs, in the order in which they were named; feather_cells : distance from its end at which
    a run has its full weight.
    """
    z = np.stack([cells.height for cells in surface_cells]).astype(np.float64)
    is_there = np.isfinite(z)
    sigma = np.stack([cells.sigma for cells in surface_cells]).astype(np.float64)
    own_sigma = _known_sigma(sigma, is_there)
    is_measured = np.stack([_is_measured(cells) for cells in surface_cells])
    weight = _weights(own_sigma, is_there, is_measured, feather_cells)
    chosen = _chosen(z, own_sigma, weight, is_measured, relations)
    any_there = is_there.any(axis=0)
    first, of_first = np.take_along_axis(z, chosen[None], 0), np.take_along_axis(own_sigma, chosen[None], 0)
    apart = np.abs(z - first) / (relations.scale[chosen].transpose(2, 0, 1) * np.hypot(own_sigma, of_first))
    weight = np.where(is_there, weight * _agreement(np.where(is_there, apart, 0.0)), 0.0)
    with np.errstate(invalid="ignore"):
        share = weight / weight.sum(axis=0)
    height = np.where(any_there, np.where(is_there, share * np.where(is_there, z, 0.0), 0.0).sum(axis=0), np.nan)
    contradicted = (is_measured & (np.where(is_there, apart, 0.0) >= CONTRADICT)).any(axis=0)
    n_there = is_there.sum(axis=0)
    kind = np.select(
        [n_there == 0, n_there == 1, contradicted], [SeamKind.EMPTY, SeamKind.ONE, SeamKind.CHOSEN], SeamKind.BLENDED
    )
    return BlendedCells(
        height.astype(np.float32), _sigma_of(share, sigma, is_there, relations.shared).astype(np.float32),
        np.where(any_there, chosen, -1), kind.astype(np.uint8),
    )  # fmt: skip


def _is_measured(surface_cells: SurfaceCells) -> NDArray[np.bool_]:
    """Cells (r, c) whose height is not interpolated. The level of water counts as measured."""
    is_there = np.isfinite(surface_cells.height)
    if QUALITY not in surface_cells.flags:
        return is_there
    quality = surface_cells.flags[QUALITY].astype(np.uint16)
    return np.asarray(is_there & ((quality & np.uint16(Quality.WATER)) != np.uint16(Quality.FILLED)))


def _known_sigma(sigma: NDArray[np.float64], is_there: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Standard deviations (n, r, c), the median of the run's where one is not known; of all runs, or 1 m, without."""
    known = is_there & np.isfinite(sigma)
    usual = float(np.median(sigma[known])) if known.any() else 1.0
    out = np.empty_like(sigma)
    for number in range(len(sigma)):
        own = float(np.median(sigma[number][known[number]])) if known[number].any() else usual
        out[number] = np.where(known[number], sigma[number], own)
    return out


def _weights(
    sigma: NDArray[np.float64], is_there: NDArray[np.bool_], is_measured: NDArray[np.bool_], feather_cells: int
) -> NDArray[np.float64]:
    """Weights (n, r, c): precision, averaged over the neighbourhood, times a factor that falls to 0 at the end of a
    run and at its holes."""
    out = np.zeros_like(sigma)
    for number in range(len(sigma)):
        measured = is_measured[number]
        usual = np.exp(_mean_nearby(np.log(sigma[number]), is_there[number]))
        above = np.maximum(sigma[number] / (MAX_ABOVE_NEIGHBOURS * usual), 1.0)
        feather = np.where(measured, _feather(measured, feather_cells), FILLED_WEIGHT)
        out[number] = np.where(is_there[number], feather / (usual * above) ** 2, 0.0)
    return out


def _feather(is_measured: NDArray[np.bool_], feather_cells: int) -> NDArray[np.float64]:
    """Factor (r, c) that rises from almost 0 beside an empty cell to 1 at a distance from it."""
    if is_measured.all():
        return np.ones(is_measured.shape)
    u = np.minimum(distance_transform_edt(is_measured) / feather_cells, 1.0)
    return np.asarray(u * u * (3.0 - 2.0 * u))


def _mean_nearby(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean (r, c) of the known values in the neighbourhood; 0 where there are none."""
    side = 2 * NEIGHBOURS + 1
    total = uniform_filter(np.where(known, values, 0.0), side, mode="constant")
    n = uniform_filter(known.astype(np.float64), side, mode="constant")
    return np.asarray(np.where(n > 0.5 / side**2, total / np.maximum(n, 0.5 / side**2), 0.0))


def _agreement(apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """Factor of a weight by the distance of two heights, in standard deviations of their difference."""
    u = np.clip((apart - AGREE) / (CONTRADICT - AGREE), 0.0, 1.0)
    return np.asarray(1.0 - u * u * (3.0 - 2.0 * u))


def _chosen(
    z: NDArray[np.float64],
    sigma: NDArray[np.float64],
    weight: NDArray[np.float64],
    is_measured: NDArray[np.bool_],
    relations: RunRelations,
) -> NDArray[np.int64]:
    """The run (r, c) around whose height the others count: that with which most of the weight agrees nearby."""
    n = len(z)
    if n == 1:
        return np.zeros(z.shape[1:], np.int64)
    score = np.empty_like(z)
    for number in range(n):
        support = weight[number].copy()
        for other in range(n):
            if other != number:
                apart = np.abs(z[other] - z[number]) / (
                    relations.scale[number, other] * np.hypot(sigma[number], sigma[other])
                )
                support += np.where(np.isfinite(apart), weight[other] * _agreement(np.nan_to_num(apart)), 0.0)
        is_there = np.isfinite(z[number])
        nearby, own = (
            uniform_filter(np.where(is_there, each, 0.0), 2 * NEIGHBOURS + 1, mode="constant")
            for each in (support, weight[number])
        )
        score[number] = np.log(np.maximum(nearby, TINY)) + OWN_POWER * np.log(np.maximum(own, TINY))
        score[number] -= ORDER_DISCOUNT * number / (n - 1)
        score[number][~is_there] = -np.inf
    # An interpolated height never stands for a measured one.
    score[~is_measured & is_measured.any(axis=0)] = -np.inf
    return np.asarray(score.argmax(axis=0))


def _sigma_of(
    share: NDArray[np.float64],
    sigma: NDArray[np.float64],
    is_there: NDArray[np.bool_],
    shared: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Standard deviation (r, c) of the mean; NaN where a height of some weight has none."""
    is_known = np.isfinite(sigma)
    parts = np.where(is_there & is_known, np.nan_to_num(share) * np.where(is_known, sigma, 0.0), 0.0)
    variance = np.zeros(share.shape[1:])
    for number in range(len(share)):
        for other in range(number, len(share)):
            if number == other:
                variance += parts[number] ** 2
            elif shared[number, other]:
                variance += 2.0 * parts[number] * parts[other]
    is_missing = (is_there & ~is_known & (np.nan_to_num(share) > SMALL_WEIGHT)).any(axis=0)
    return np.where(is_there.any(axis=0) & ~is_missing, np.sqrt(variance), np.nan)
