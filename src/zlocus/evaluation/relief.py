"""Relief of a reference: how much its slopes differ, which decides whether a horizontal shift can be found on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.evaluation.truth import TruthBlocks

# Slopes must spread at least this much in every direction. Below, a shift of a metre changes heights by less than a
# centimetre.
MIN_SLOPE_SPREAD = 0.01
# Steeper blocks are walls: their heights say on which side of the wall a block lies, not how far from it.
MAX_SLOPE = np.tan(np.radians(70.0))
MIN_BLOCKS = 100
# Gradients of blocks this far apart use no common height, so that noise of the reference does not count as slope.
INDEPENDENT_BLOCKS_APART = 3


class SlopeSpread(NamedTuple):
    """Standard deviation of slopes in the direction in which they differ least, and the number of pairs behind it."""

    least: float
    n_pairs: int


def has_slope(truth: TruthBlocks) -> NDArray[np.bool_]:
    """Whether the slope of a block is known and not that of a wall, (n,)."""
    rise = truth.gradient
    return np.asarray(np.isfinite(rise).all(axis=1) & (np.hypot(*rise.T) < MAX_SLOPE))


def slope_spread(truth: TruthBlocks) -> SlopeSpread:
    """Spread of the slopes of a reference: 0 on flat ground, on a tilted plane and where they differ one way only."""
    usable = has_slope(truth)
    rise = np.full((*truth.shape, 2), np.nan)
    rise[tuple(truth.cells[usable].T)] = truth.gradient[usable]
    if not usable.any():
        return SlopeSpread(0.0, 0)
    rise -= np.nanmean(rise, axis=(0, 1))
    apart = INDEPENDENT_BLOCKS_APART
    pairs = [(rise[:-apart], rise[apart:]), (rise[:, :-apart], rise[:, apart:])]
    one, other = (np.concatenate([pair[side].reshape(-1, 2) for pair in pairs]) for side in (0, 1))
    both = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    n = int(np.count_nonzero(both))
    if not n:
        return SlopeSpread(0.0, 0)
    common = one[both].T @ other[both] / n
    least = float(np.linalg.eigvalsh((common + common.T) / 2)[0])
    return SlopeSpread(float(np.sqrt(max(least, 0.0))), n)
