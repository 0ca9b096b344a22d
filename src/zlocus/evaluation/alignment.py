"""Search for the shift between two surfaces: an error common to all cameras, which matching cannot see."""

from __future__ import annotations

import functools
import itertools

import numpy as np

from zlocus.core.errors import InputError
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.truth import TruthBlocks

MAX_SHIFT_M = 4
FIRST_STEP_M = 0.5
LAST_STEP_M = 0.02


def best_shift(surface: HeightRaster, truth: TruthBlocks, points: Points) -> tuple[float, float]:
    """Horizontal shift (east, north), m, at which the height differences spread least.

    The spread is the median absolute deviation over blocks without an edge. Whole metres up to 4 m are tried first,
    then a pattern search halves its step down to about 0.02 m. points : centres of the blocks in the surface's CRS.

    Raises
    ------
    InputError
        The surface has no height to align.
    """
    flat = ~truth.is_edge
    flat_points, height = points.where(flat), truth.mean[flat]

    @functools.cache
    def spread(shift: tuple[float, float]) -> float:
        difference = flat_points.heights(surface.bilinear, shift) - height
        difference = difference[np.isfinite(difference)]
        return float(np.median(np.abs(difference - np.median(difference)))) if difference.size else np.inf

    whole_metres = [float(m) for m in range(-MAX_SHIFT_M, MAX_SHIFT_M + 1)]
    best = min(itertools.product(whole_metres, whole_metres), key=spread)
    if not np.isfinite(spread(best)):
        raise InputError(
            f"{surface.path} has no height where the reference has one: nothing to align. Leave out --align."
        )
    step = FIRST_STEP_M
    while step > LAST_STEP_M:
        candidates = [(best[0] + u * step, best[1] + v * step) for u, v in itertools.product((-1, 0, 1), repeat=2)]
        nearby = min(candidates, key=spread)
        if nearby == best:
            step /= 2
        best = nearby
    return best
