"""Match curves: how distinct the peak of a correlation is along the heights of a cell, and the label that gives.

A label says how good a search image is at a point (Ji et al. 2014, table 1): 1 where it is enough alone, 0 where it
helps, -1 where it misleads. The same labels tell when enough images have been averaged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.options import SelectionOptions

FloatArray = NDArray[np.float64]
GOOD, FAIR, POOR = 1, 0, -1
# Distances are multiples of a step, which rounding must not put just short of the limit.
ROUNDING_PX = 1e-9


@dataclass(frozen=True)
class CurvePeaks:
    """The highest and the second peak of match curves.

    peak : (n,) int64, sample of the largest correlation, the first of equals (0 where no sample is valid); rho1 : (n,)
    float64, its correlation, NaN where no sample is valid; rho2 : (n,) float64, the largest other local maximum, NaN
    where there is none; ratio : (n,) float64, |rho1 / rho2|, infinite without a rival; is_open : (n,) bool, whether
    the curve may rise beyond what was seen of it: the peak has no valid sample on one side, or too few samples are
    valid.
    """

    peak: NDArray[np.int64]
    rho1: FloatArray
    rho2: FloatArray
    ratio: FloatArray
    is_open: NDArray[np.bool_]


def curve_peaks(
    curves: NDArray[np.floating], step_px: NDArray[np.floating] | float, options: SelectionOptions
) -> CurvePeaks:
    """Peaks of match curves over a fixed range of heights.

    curves : (n, h) float, correlation, NaN where the cell is not seen; step_px : (n,) or one number, equivalent
    disparity of one step of height. A rival is a strict local maximum, both of whose neighbours are seen, at least
    `rival_px` from the peak; so the ends of the range and of what is seen are none.
    Source: Ji et al. 2014, section 2.2, note to table 1. The paper does not say what is a local maximum, nor how far
    from the peak: our reading.
    """
    n, n_heights = curves.shape
    seen = ~np.isnan(curves)
    filled = np.where(seen, curves, -np.inf).astype(np.float64)
    peak = filled.argmax(axis=1)
    rho1 = np.take_along_axis(filled, peak[:, None], axis=1)[:, 0]
    steps_away = np.abs(np.arange(n_heights) - peak[:, None])
    is_far = steps_away * np.broadcast_to(step_px, n)[:, None] >= options.rival_px - ROUNDING_PX
    rho2 = np.where(is_far & strict_maxima(curves), filled, -np.inf).max(axis=1)
    between = np.pad(seen, ((0, 0), (1, 1)))
    has_both_sides = np.take_along_axis(between[:, :-2] & between[:, 2:], peak[:, None], axis=1)[:, 0]
    rho1, rho2 = (np.where(np.isinf(rho), np.nan, rho) for rho in (rho1, rho2))
    return CurvePeaks(
        peak=peak,
        rho1=rho1,
        rho2=rho2,
        ratio=peak_ratio(rho1, rho2, options),
        is_open=~has_both_sides | (seen.mean(axis=1) < options.least_seen),
    )


def strict_maxima(curves: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Samples above both neighbours, (n, h) bool; never the ends, nor a sample beside one that is NaN."""
    maxima = np.zeros(curves.shape, bool)
    inner = curves[:, 1:-1]
    maxima[:, 1:-1] = (inner > curves[:, :-2]) & (inner > curves[:, 2:])
    return maxima


def peak_ratio(rho1: FloatArray, rho2: FloatArray, options: SelectionOptions) -> FloatArray:
    """|rho1 / rho2|, (n,); infinite where rho2 is NaN (no rival) or 0, and as an option where it is negative.

    Source: Ji et al. 2014, table 3 (its second point has a negative rho2, and the absolute value of the ratio).
    """
    is_alone = np.isnan(rho2) | (rho2 == 0)
    if options.negative_rival == "infinite":
        is_alone |= rho2 < 0
    return np.where(is_alone, np.inf, np.abs(rho1 / np.where(is_alone, 1.0, rho2)))


def quality_labels(
    rho1: FloatArray, ratio: FloatArray, is_open: NDArray[np.bool_], options: SelectionOptions
) -> NDArray[np.int8]:
    """Label 1 (good), 0 (fair) or -1 (poor) of match curves, (n,) int8.

    rho1, ratio : (n,) float64; is_open : (n,) bool, such a curve is fair at best. A curve without any valid sample
    (rho1 is NaN) is poor: an image that does not see a point is no help there.
    Source: Ji et al. 2014, table 1, all comparisons strict; values that the table leaves out take the lower label.
    """
    is_good = (
        ((rho1 > options.rho1_high) & (ratio > options.ratio_high))
        | ((rho1 > options.rho1_middle) & (ratio > options.ratio_middle))
        | ((rho1 > options.rho1_low) & (ratio > options.ratio_low))
    )
    is_fair = is_good | (rho1 > options.rho1_low) | ((rho1 > options.rho1_fair) & (ratio > options.ratio_fair))
    return np.where(is_good & ~is_open, GOOD, np.where(is_fair, FAIR, POOR)).astype(np.int8)


def curve_labels(
    curves: NDArray[np.floating], step_px: NDArray[np.floating] | float, options: SelectionOptions
) -> NDArray[np.int8]:
    """Labels of match curves, (n,) int8; arguments as of `curve_peaks`."""
    peaks = curve_peaks(curves, step_px, options)
    return quality_labels(peaks.rho1, peaks.ratio, peaks.is_open, options)
