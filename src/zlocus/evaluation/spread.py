"""Spread of the height differences between a surface and its reference, as a function of the surface's shift."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.truth import TruthBlocks

# (east, north), m, of the frame.
HorizontalShift = tuple[float, float]
# Sizes of the random samples of blocks that are looked at before all blocks are. A sample that is not this much smaller
# than the whole saves nothing.
SAMPLE_BLOCKS = (8_192, 65_536, 524_288)
MIN_SAMPLING_RATIO = 4
SAMPLING_SEED = 0
# Probability that a lower bound from a sample exceeds the spread of all blocks. A search needs some 200 bounds.
BOUND_FAILURE_PROBABILITY = 1e-9


@dataclass(frozen=True)
class HeightDifferences:
    """Blocks of a reference without an edge, with which a shifted surface is compared.

    points : centres of the n blocks in the surface's CRS. heights : (n,) float64, m, of the reference.
    """

    surface: HeightRaster
    points: Points
    heights: FloatArray

    @classmethod
    def of(cls, surface: HeightRaster, truth: TruthBlocks, points: Points) -> HeightDifferences:
        """The blocks of a reference that hold no edge. points : centres of all its blocks."""
        flat = ~truth.is_edge
        return cls(surface, points.where(flat), truth.mean[flat])

    def at(self, shift: HorizontalShift) -> FloatArray:
        """Surface less reference (n,) m in the k <= n blocks where both have a height, the shift removed."""
        difference = self.points.heights(self.surface, HeightRaster.bilinear, shift) - self.heights
        return difference[np.isfinite(difference)]

    def spread(self, shift: HorizontalShift) -> float:
        """Median absolute deviation of the differences from their median, m; infinite where there is none."""
        return median_deviation(self.at(shift))

    def sample(self, n: int) -> HeightDifferences:
        """Randomly chosen blocks, n of them or all; the same blocks every time."""
        if n >= len(self.heights):
            return self
        chosen = np.zeros(len(self.heights), bool)
        chosen[np.random.default_rng(SAMPLING_SEED).choice(len(chosen), n, replace=False, shuffle=False)] = True
        return HeightDifferences(self.surface, self.points.where(chosen), self.heights[chosen])


class LeastSpread:
    """Finds the shift with the least spread among candidates, with few passes over all blocks.

    The result is that of computing every spread from all blocks. A candidate is dismissed as soon as a lower bound of
    its spread, from a sample of the blocks, exceeds the spread of another candidate.
    """

    def __init__(self, differences: HeightDifferences) -> None:
        self.differences = differences
        self._bounds: dict[HorizontalShift, float] = {}
        # Number of samples that have been used for the bound; one more where the bound is the spread itself.
        self._depth: dict[HorizontalShift, int] = {}

    @cached_property
    def samples(self) -> tuple[HeightDifferences, ...]:
        """Samples of rising size, each much smaller than the whole."""
        largest = len(self.differences.heights) / MIN_SAMPLING_RATIO
        return tuple(self.differences.sample(n) for n in SAMPLE_BLOCKS if n <= largest)

    @property
    def n_complete(self) -> int:
        """Number of shifts whose spread was computed from all blocks."""
        return sum(depth > len(self.samples) for depth in self._depth.values())

    def spread(self, shift: HorizontalShift) -> float:
        """Spread of all blocks, m."""
        while not self._is_complete(shift):
            self._depth[shift] = max(self._depth.get(shift, 0), len(self.samples))
            self._refine(shift)
        return self._bounds[shift]

    def least(self, candidates: Iterable[HorizontalShift]) -> HorizontalShift:
        """The candidate with the least spread; the first one of several that are equal."""
        candidates = list(candidates)
        while True:
            bound = min(self._bounds.get(shift, 0.0) for shift in candidates)
            lowest = [shift for shift in candidates if self._bounds.get(shift, 0.0) <= bound]
            unsure = [shift for shift in lowest if not self._is_complete(shift)]
            if not unsure:
                return lowest[0]
            for shift in unsure:
                self._refine(shift)

    def _is_complete(self, shift: HorizontalShift) -> bool:
        return self._depth.get(shift, 0) > len(self.samples)

    def _refine(self, shift: HorizontalShift) -> None:
        """Compute the bound of a shift from the next larger sample, or its spread from all blocks after the largest."""
        depth = self._depth.get(shift, 0)
        if depth < len(self.samples):
            bound = spread_bound(self.samples[depth].at(shift))
            self._bounds[shift] = max(bound, self._bounds.get(shift, 0.0))
        else:
            self._bounds[shift] = self.differences.spread(shift)
        self._depth[shift] = depth + 1


def median_deviation(differences: FloatArray) -> float:
    """Median absolute deviation (n,) from the median; infinite for none."""
    if not differences.size:
        return math.inf
    return float(np.median(np.abs(differences - np.median(differences))))


def spread_bound(sample: FloatArray) -> float:
    """A lower bound of the median absolute deviation of a population, from a random sample of it (n,).

    By the inequality of Dvoretzky, Kiefer and Wolfowitz with Massart's constant (1990, Annals of Probability 18), the
    shares below any value differ between sample and population by at most e = sqrt(ln(2 / p) / 2n), but for a
    probability p. So the population's median lies between the (0.5 - e) and (0.5 + e) quantiles of the sample, and at
    least 0.5 - 2e of the sample lie within the deviation of it. 0 where the sample is too small to say anything.
    """
    if not sample.size:
        return 0.0
    e = math.sqrt(math.log(2 / BOUND_FAILURE_PROBABILITY) / (2 * sample.size))
    if e >= 0.25:
        return 0.0
    low, middle, high = np.quantile(sample, (0.5 - e, 0.5, 0.5 + e))
    around_middle = np.quantile(np.abs(sample - middle), 0.5 - 2 * e, method="lower")
    return max(0.0, float(around_middle - max(high - middle, middle - low)))
