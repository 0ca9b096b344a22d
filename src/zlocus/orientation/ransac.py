"""Matches of one pair that agree with the sensor models after one common pointing shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.epipolar import EpipolarOffsets

N_HYPOTHESES = 400
MATCHES_TO_SCORE = 500  # matches that choose between the hypotheses, about: up to twice as many
REFINEMENTS = 10
SEED = 20240229
# Singular values of a shift's design below this share of the largest carry no information about the pointing.
WEAK_DIRECTION = 0.1


@dataclass(frozen=True)
class PairShift:
    """The pointing of image b against image a.

    shift_px : (2,) column and row by which b's points lie off their loci (minimum norm: the part along the loci, which
    cannot be told from a height, is left out); inliers : (n,) bool; by_chance: how many wrong matches are expected
    among them, from how many lie elsewhere.
    """

    shift_px: FloatArray
    inliers: NDArray[np.bool_]
    by_chance: float

    def is_certain(self, min_ties: int) -> bool:
        """Whether enough matches agree, beyond twice what chance alone puts there."""
        return bool(self.inliers.sum() >= min_ties + 2.0 * self.by_chance)


def find_shift(found: EpipolarOffsets, max_px: float, inlier_px: float) -> PairShift:
    """The shift that puts most matches on their loci, by RANSAC (MSAC score), and the matches it puts there.

    Matches were looked for within `max_px` of where the loci were expected. Half of the hypotheses come from one match
    (right where all loci are parallel), half from two (where they are not). Deterministic: fixed seed. Survives 80 % of
    wrong matches: a hypothesis from one match is right one time in five.
    """
    usable = np.flatnonzero(np.isfinite(found.distance_px) & (np.abs(found.distance_px) <= max_px))
    few = usable[:: max(len(usable) // MATCHES_TO_SCORE, 1)]
    inliers = np.zeros(len(found.distance_px), bool)
    if len(usable) < 2:
        return PairShift(np.zeros(2), inliers, 0.0)
    normal, across = found.normal[usable], found.distance_px[usable]
    rng = np.random.default_rng(SEED)
    one = rng.integers(0, len(usable), N_HYPOTHESES // 2)
    two = rng.integers(0, len(usable), (N_HYPOTHESES // 2, 2))
    hypotheses = np.concatenate([normal[one] * across[one, None], minimum_norm_shifts(normal[two], across[two])])
    hypotheses = hypotheses[np.hypot(*hypotheses.T) <= max_px * (1.0 + 1e-9)]
    # plain sums, not a matrix product: for inner dimension 2 the linear algebra library only wakes its threads
    expected = found.normal[few, :1] * hypotheses[:, 0] + found.normal[few, 1:] * hypotheses[:, 1]
    squares = (found.distance_px[few, None] - expected) ** 2
    best = hypotheses[np.argmin(np.minimum(squares, inlier_px**2).sum(axis=0))]
    for _ in range(REFINEMENTS):
        near = np.abs(across - normal @ best) <= inlier_px
        best = minimum_norm_shifts(normal[near][None], across[near][None])[0]
    inliers[usable[np.abs(across - normal @ best) <= inlier_px]] = True
    outside = len(usable) - int(inliers.sum())
    return PairShift(best, inliers, outside * inlier_px / max(max_px - inlier_px, inlier_px))


def minimum_norm_shifts(normal: FloatArray, across: FloatArray) -> FloatArray:
    """Least-squares shifts (h, 2) of h samples of k matches; directions that the loci hardly show stay at zero.

    normal : (h, k, 2); across : (h, k) px.
    """
    return np.asarray(np.einsum("hjk,hk->hj", np.linalg.pinv(normal, rcond=WEAK_DIRECTION), across))
