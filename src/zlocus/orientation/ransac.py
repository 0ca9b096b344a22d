"""RANSAC: the matches of a pair that agree with the sensor models after one common shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.epipolar import EpipolarOffsets

N_HYPOTHESES = 400
# About so many matches (up to twice as many) score the hypotheses.
MATCHES_TO_SCORE = 500
REFINEMENTS = 10
SEED = 20240229
# Singular values of a shift's design matrix below this share of the largest carry no information about the pointing.
WEAK_DIRECTION = 0.1


@dataclass(frozen=True)
class PairShift:
    """Shift of image b against image a.

    shift_px : (2,) column and row by which b's points lie off their epipolar curves. It is the shift of minimum norm:
    its part along the curves cannot be told from a height and is zero. inliers : (n,) bool, matches that agree;
    by_chance : number of wrong matches expected among them, from the number of matches elsewhere.
    """

    shift_px: FloatArray
    inliers: NDArray[np.bool_]
    by_chance: float

    def is_certain(self, min_ties: int) -> bool:
        """Whether at least `min_ties` more matches agree than twice the number expected by chance."""
        return bool(self.inliers.sum() >= min_ties + 2.0 * self.by_chance)


def find_shift(offsets: EpipolarOffsets, max_px: float, inlier_px: float) -> PairShift:
    """The shift that puts most matches on their epipolar curves, by RANSAC (MSAC score), and these matches.

    offsets : of all matches, which were searched within `max_px` of the expected curves; inlier_px : largest distance
    of an inlier. Half of the hypotheses come from one match (correct where all curves are parallel), half from two
    (where they are not). The seed is fixed, so that the result is the same every time. Up to 80 % of the matches may be
    wrong: a hypothesis from one match is then correct one time in five.
    """
    usable = np.flatnonzero(np.isfinite(offsets.distance_px) & (np.abs(offsets.distance_px) <= max_px))
    few = usable[:: max(len(usable) // MATCHES_TO_SCORE, 1)]
    inliers = np.zeros(len(offsets.distance_px), bool)
    if len(usable) < 2:
        return PairShift(np.zeros(2), inliers, 0.0)
    normal, distance = offsets.normal[usable], offsets.distance_px[usable]
    rng = np.random.default_rng(SEED)
    one = rng.integers(0, len(usable), N_HYPOTHESES // 2)
    two = rng.integers(0, len(usable), (N_HYPOTHESES // 2, 2))
    hypotheses = np.concatenate([normal[one] * distance[one, None], minimum_norm_shifts(normal[two], distance[two])])
    hypotheses = hypotheses[np.hypot(*hypotheses.T) <= max_px * (1.0 + 1e-9)]
    # plain sums, not a matrix product: for inner dimension 2 the linear algebra library only wakes its threads
    expected = offsets.normal[few, :1] * hypotheses[:, 0] + offsets.normal[few, 1:] * hypotheses[:, 1]
    squares = (offsets.distance_px[few, None] - expected) ** 2
    best = hypotheses[np.argmin(np.minimum(squares, inlier_px**2).sum(axis=0))]
    for _ in range(REFINEMENTS):
        near = np.abs(distance - normal @ best) <= inlier_px
        best = minimum_norm_shifts(normal[near][None], distance[near][None])[0]
    inliers[usable[np.abs(distance - normal @ best) <= inlier_px]] = True
    outside = len(usable) - int(inliers.sum())
    return PairShift(best, inliers, outside * inlier_px / max(max_px - inlier_px, inlier_px))


def minimum_norm_shifts(normal: FloatArray, distance: FloatArray) -> FloatArray:
    """Least-squares shifts (h, 2) px of h samples of k matches; directions that the curves hardly show stay at zero.

    normal : (h, k, 2); distance : (h, k) px.
    """
    return np.asarray(np.einsum("hjk,hk->hj", np.linalg.pinv(normal, rcond=WEAK_DIRECTION), distance))
