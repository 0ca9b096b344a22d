"""Search for the shift between two surfaces: an error common to all cameras, which matching cannot see."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.relief import MIN_BLOCKS, MIN_SLOPE_SPREAD, slope_spread
from zlocus.evaluation.spread import SAMPLE_BLOCKS, HeightDifferences, HorizontalShift, LeastSpread
from zlocus.evaluation.truth import TruthBlocks

MAX_SHIFT_M = 4
# The smaller steps lead at most this far, east and north. Shifts of up to 6 m are found so.
SEARCHED_M = 2 * MAX_SHIFT_M
FIRST_STEP_M = 0.5
LAST_STEP_M = 0.02
# A shift is determined where moving the surface on by 4 m raises the spread by at least this share in every direction.
# On flat ground under noise of both surfaces it rises by up to 2 % (25 000 blocks and more), on hills several times.
MIN_SPREAD_RISE = 0.05


def best_shift(surface: HeightRaster, truth: TruthBlocks, points: Points) -> HorizontalShift:
    """Horizontal shift (east, north), m, at which the height differences spread least.

    The spread is the median absolute deviation over blocks without an edge. Whole metres up to 4 m are tried first,
    then a pattern search halves its step down to about 0.02 m, and ends `SEARCHED_M` away. points : centres of the
    blocks in the surface's CRS.

    Raises
    ------
    InputError
        No block without an edge has a height in the surface.
    """
    differences = HeightDifferences.of(surface, truth, points)
    shift = _best_shift(differences)
    if not len(differences.at(shift)):
        raise InputError(
            f"{surface.path} has no height at a block without an edge of the reference, so there is no shift to find. "
            "Compare surfaces of the same ground."
        )
    return shift


def why_too_flat(truth: TruthBlocks) -> str | None:
    """Why no horizontal shift can be found on the ground of a reference, as a clause; None where one can be sought."""
    relief = slope_spread(truth)
    # Too few blocks with neighbours say nothing about the ground.
    if relief.n_pairs < MIN_BLOCKS or relief.least >= MIN_SLOPE_SPREAD:
        return None
    return f"in one direction slopes differ by {100 * relief.least:.1f} %, and {100 * MIN_SLOPE_SPREAD:g} % is needed"


def determined_shift(surface: HeightRaster, truth: TruthBlocks, points: Points) -> HorizontalShift | str:
    """The horizontal shift of `best_shift`; or why it is not determined, as a clause."""
    reason = why_too_flat(truth)
    if reason is not None:
        return reason
    differences = HeightDifferences.of(surface, truth, points)
    too_few = f"fewer than {MIN_BLOCKS} blocks without an edge have a height in both"
    if np.count_nonzero(differences.points.reaching(surface, math.hypot(SEARCHED_M, SEARCHED_M))) < MIN_BLOCKS:
        return too_few
    shift = _best_shift(differences)
    if len(differences.at(shift)) < MIN_BLOCKS:
        return too_few
    if max(map(abs, shift)) >= SEARCHED_M:
        return f"the differences spread less and less up to {SEARCHED_M} m, as far as is searched"
    sample = differences.sample(SAMPLE_BLOCKS[1])
    least_around = min(sample.spread(moved) for moved in _around(shift, surface, points))
    if least_around <= (1 + MIN_SPREAD_RISE) * sample.spread(shift):
        return f"{MAX_SHIFT_M} m more in some direction raise the spread by less than {100 * MIN_SPREAD_RISE:g} %"
    return shift


def _best_shift(differences: HeightDifferences) -> HorizontalShift:
    """The shift of `best_shift`; any one where the surface has no height to align."""
    spreads = LeastSpread(differences)
    whole_metres = [float(m) for m in range(-MAX_SHIFT_M, MAX_SHIFT_M + 1)]
    best = spreads.least(itertools.product(whole_metres, whole_metres))
    if spreads.spread(best) in (0.0, math.inf):
        # Nothing fits better. On level ground many shifts fit as well, and the search would follow them.
        return best
    step = FIRST_STEP_M
    while step > LAST_STEP_M:
        around = ((best[0] + u * step, best[1] + v * step) for u, v in itertools.product((-1, 0, 1), repeat=2))
        nearby = spreads.least(shift for shift in around if max(map(abs, shift)) <= SEARCHED_M)
        if nearby == best:
            step /= 2
        best = nearby
    return best


def _around(shift: HorizontalShift, surface: HeightRaster, points: Points) -> Iterator[HorizontalShift]:
    """Shifts in eight directions from one, about `MAX_SHIFT_M` away and by whole cells of the surface.

    Between the centres of cells, interpolation averages their noise. After whole cells it does so as much as before.
    """
    cells = _cells_m(surface, points)
    lengths = np.hypot(*cells)
    per_side = np.maximum(1, np.round(MAX_SHIFT_M / lengths))
    for u, v in itertools.product((-1, 0, 1), repeat=2):
        if (u, v) != (0, 0):
            east, north = cells @ (per_side * (u, v))
            yield shift[0] + float(east), shift[1] + float(north)


def _cells_m(surface: HeightRaster, points: Points) -> FloatArray:
    """Steps (2, 2) of a cell of the surface along its columns ([:, 0]) and rows ([:, 1]), m east and north."""
    t = surface.transform
    cells = np.array([[t.a, t.b], [t.d, t.e]])
    return cells if points.per_metre is None else np.linalg.solve(np.nanmean(points.per_metre, axis=0), cells)
