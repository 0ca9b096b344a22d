"""The shift between two surfaces: a common translation of the ground, which no matcher can see."""

from __future__ import annotations

import functools
import itertools

import numpy as np

from zlocus.core.errors import InputError
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.truth import TruthBlocks

REACH_M = 4
FIRST_STEP_M = 0.5
LAST_STEP_M = 0.02


def best_shift(surface: HeightRaster, truth: TruthBlocks, points: Points) -> tuple[float, float]:
    """The horizontal shift (east, north) in m of the look-up that makes the height differences most alike.

    Every metre within 4 m first, then a pattern search down to steps of about 0.02 m, on the median absolute deviation
    over blocks without an edge. points : centres of the blocks as the surface has them.

    Raises
    ------
    InputError
        The surface has no height to align.
    """
    flat = ~truth.is_edge
    at, height = points.where(flat), truth.mean[flat]

    @functools.cache
    def spread(shift: tuple[float, float]) -> float:
        difference = at.heights(surface.bilinear, shift) - height
        difference = difference[np.isfinite(difference)]
        return float(np.median(np.abs(difference - np.median(difference)))) if difference.size else np.inf

    whole_metres = [float(m) for m in range(-REACH_M, REACH_M + 1)]
    best = min(itertools.product(whole_metres, whole_metres), key=spread)
    if not np.isfinite(spread(best)):
        raise InputError(
            f"{surface.path} has no height where the reference has one: nothing to align. Leave out --align."
        )
    step = FIRST_STEP_M
    while step > LAST_STEP_M:
        around = [(best[0] + u * step, best[1] + v * step) for u, v in itertools.product((-1, 0, 1), repeat=2)]
        nearby = min(around, key=spread)
        if nearby == best:
            step /= 2
        best = nearby
    return best
