"""Match curves: how distinct the peak of a correlation is along the heights of a cell, and the label that gives.

A label says how good a search image is at a point (Ji et al. 2014, table 1): 1 where it is enough alone, 0 where it
helps, -1 where it misleads. The same labels tell when enough images have been averaged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SelectionOptions
from zlocus.core.sensor_model import FloatArray

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


IntArray = NDArray[np.int64]
# (n,) cells and (n,) images, one each -> (n, h) correlation, NaN where the image does not see that height.
Measure = Callable[[IntArray, IntArray], NDArray[np.floating]]


@dataclass(frozen=True)
class ProgressiveMean:
    """Mean correlation over the images added so far.

    mean : (n, h) float64, 0 where no image was valid; count : (n, h) int64, images valid at each height.
    """

    mean: FloatArray
    count: IntArray

    @classmethod
    def empty(cls, n_cells: int, n_heights: int) -> ProgressiveMean:
        """Before the first image."""
        return cls(np.zeros((n_cells, n_heights)), np.zeros((n_cells, n_heights), np.int64))

    def add(self, cells: IntArray, ncc: NDArray[np.floating]) -> None:
        """Add one image to some cells, in place. cells : (m,), each once; ncc : (m, h), NaN where not valid.

        SNCC_m = ((m - 1) SNCC_{m-1} + NCC_m) / m, where m counts the images valid at that cell and height.
        Source: Ji et al. 2014, equation (3); the paper takes every image as valid everywhere.
        """
        valid = ~np.isnan(ncc)
        m = self.count[cells] + valid
        before = self.mean[cells]
        self.mean[cells] = np.where(valid, ((m - 1) * before + ncc) / np.maximum(m, 1), before)
        self.count[cells] = m

    def sncc(self, cells: IntArray) -> FloatArray:
        """(m, h) float64, the match curves of some cells, NaN where no image was valid."""
        return np.where(self.count[cells] > 0, self.mean[cells], np.nan)


@dataclass(frozen=True)
class ProgressiveMatch:
    """Match curves of the images that were needed.

    sncc : (n, h) float64, NaN where no image was valid; n_images : (n,) int64, images that were used; label : (n,)
    int8, of the final curve; is_stopped : (n,) bool, whether the curve was good after some image (cells outside the
    sample are not judged: False); n_added : (b,) int64, images that each block went through; evaluations : cell x
    height x image that were evaluated; evaluations_all : those of all images.
    """

    sncc: FloatArray
    n_images: IntArray
    label: NDArray[np.int8]
    is_stopped: NDArray[np.bool_]
    n_added: IntArray
    evaluations: int
    evaluations_all: int

    @property
    def saved(self) -> float:
        """Share of the evaluations of all images that was not needed; 0 where there was nothing to evaluate."""
        return 1.0 - self.evaluations / self.evaluations_all if self.evaluations_all else 0.0


@dataclass(frozen=True)
class SearchPlan:
    """What may be matched with what, in which order.

    order : (b, j) int64, search images of each block, best first, each once; block : (n,) int64, the block of each
    cell; seen : (n, i) bool, whether the image enters the cell (over its whole range; heights hidden in it are NaN in
    the measure); step_px : (i,) or (b, i) float64, equivalent disparity of one step of height in each image; sample :
    (n,) bool, the cells that decide when a block stops; window_cells : cells that a correlation rests on, 0 where a
    stop asks for the label alone.
    """

    order: IntArray
    block: IntArray
    seen: NDArray[np.bool_]
    step_px: FloatArray
    sample: NDArray[np.bool_]
    window_cells: int = 0

    @classmethod
    def by_cell(cls, order: IntArray, seen: NDArray[np.bool_], step_px: FloatArray) -> SearchPlan:
        """Every cell is a block of its own: the rule of the paper. order : (n, j)."""
        n = len(order)
        return cls(order, np.arange(n), seen, step_px, np.ones(n, bool))


def match_progressively(
    measure: Measure, n_heights: int, plan: SearchPlan, options: SelectionOptions
) -> ProgressiveMatch:
    """Add images in order until the match curves are good.

    A block adds images until `stopped_share` of its sampled cells has stopped: their curve was good after one of the
    images, and its peak precise enough (`sigma_steps`, see `predicted_sigma`), or no image is left that sees them. A
    cell that has stopped takes part as long as its block goes on. A block without a sampled cell adds all images.
    Rivals of a mean count by the equivalent disparity of the most sensitive image in it.
    Source: Ji et al. 2014, section 3.3, step 3; blocks and precision are ours.
    """
    n_cells, n_ranks = len(plan.block), plan.order.shape[1]
    everyone = np.arange(n_cells)
    enters = np.take_along_axis(plan.seen, plan.order[plan.block], axis=1)
    images_left = enters.sum(axis=1)
    mean, widest_px = ProgressiveMean.empty(n_cells, n_heights), np.zeros(n_cells)
    n_images, n_added = np.zeros(n_cells, np.int64), np.zeros(len(plan.order), np.int64)
    is_stopped = np.zeros(n_cells, bool)
    n_evaluated = 0
    step_px = np.broadcast_to(plan.step_px, (len(plan.order), plan.seen.shape[1]))
    goes_on = _goes_on(images_left == 0, plan, options)
    for rank in range(n_ranks):
        n_added += goes_on
        cells = np.flatnonzero(goes_on[plan.block] & enters[:, rank])
        images = plan.order[plan.block[cells], rank]
        ncc = measure(cells, images)
        mean.add(cells, ncc)
        n_evaluated += len(cells)
        n_images[cells] += ~np.isnan(ncc).all(axis=1)
        images_left[cells] -= 1
        widest_px[cells] = np.maximum(widest_px[cells], step_px[plan.block[cells], images])
        judged = cells[plan.sample[cells] & ~is_stopped[cells]]
        is_stopped[judged] = _is_enough(mean, judged, widest_px[judged], plan, options)
        goes_on &= _goes_on(is_stopped | (images_left == 0), plan, options)
        if not goes_on.any():
            break
    curves = mean.sncc(everyone)
    return ProgressiveMatch(
        sncc=curves,
        n_images=n_images,
        label=curve_labels(curves, widest_px, options),
        is_stopped=is_stopped,
        n_added=n_added,
        evaluations=n_evaluated * n_heights,
        evaluations_all=int(enters.sum()) * n_heights,
    )


def _is_enough(
    mean: ProgressiveMean, cells: IntArray, step_px: FloatArray, plan: SearchPlan, options: SelectionOptions
) -> NDArray[np.bool_]:
    """Whether the curves of some cells are distinct, and precise enough, (m,) bool."""
    curves = mean.sncc(cells)
    enough = curve_labels(curves, step_px, options) == GOOD
    if plan.window_cells:
        enough &= predicted_sigma(curves, mean.count[cells], plan.window_cells) <= options.sigma_steps
    return np.asarray(enough)


def predicted_sigma(curves: FloatArray, count: IntArray, window_cells: int) -> FloatArray:
    """Standard deviation of the peak of mean correlations, (n,) in height steps; infinite where it has no two sides.

    curves : (n, h) float64, NaN where not seen; count : (n, h) images in each mean; window_cells : N, of each window.
    With rho at the peak, c = -d2 rho / dk2 there and m images: sqrt(2 (1 - rho) / (c N m)), from 1 - rho = noise over
    signal of N pixels, which moves the vertex of a parabola of curvature c. A wide base bends the curve more, and so
    does texture.
    """
    highest = np.where(np.isnan(curves), -np.inf, curves).argmax(axis=1)
    peak, rows = np.clip(highest, 1, curves.shape[1] - 2), np.arange(len(curves))
    left, rho, right = (curves[rows, peak + d] for d in (-1, 0, 1))
    bend = 2 * rho - left - right
    images = np.maximum(count[rows, peak], 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt(2 * np.maximum(1 - rho, 0) / (bend * window_cells * images))
    return np.where((bend > 0) & (peak == highest), sigma, np.inf)


def _goes_on(is_done: NDArray[np.bool_], plan: SearchPlan, options: SelectionOptions) -> NDArray[np.bool_]:
    """Blocks with too few sampled cells that are done, or with no sampled cell, (b,) bool."""
    n_blocks = len(plan.order)
    sampled = np.bincount(plan.block[plan.sample], minlength=n_blocks)
    done = np.bincount(plan.block[plan.sample & is_done], minlength=n_blocks)
    return np.asarray((sampled == 0) | (done < options.stopped_share * sampled), bool)
