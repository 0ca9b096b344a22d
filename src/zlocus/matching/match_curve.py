"""Match curves: the correlation of a cell along its heights, the distinctness of its peak, and the label of the curve.

A label is the value of a search image at a point (Ji et al. 2014, table 1): 1 where the image is sufficient alone, 0
where it helps, -1 where it misleads. The same labels say when enough images have been averaged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import SelectionOptions
from zlocus.core.sensor_model import FloatArray

GOOD, FAIR, POOR = 1, 0, -1
# Distances are multiples of a step; rounding must not put one just below the limit.
ROUNDING_PX = 1e-9


@dataclass(frozen=True)
class CurvePeaks:
    """The highest and the second peak of match curves.

    peak : (n,) int64, sample of the highest correlation, the first of equal ones (0 where no sample is valid); rho1 :
    (n,) float64, its correlation, NaN where no sample is valid; rho2 : (n,) float64, the highest other local maximum,
    NaN where there is none; ratio : (n,) float64, |rho1 / rho2|, infinite without a second peak; is_open : (n,) bool,
    whether the curve may be higher outside its visible part: the peak has no valid sample on one side, or too few
    samples are valid.
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

    curves : (n, h) float, correlation, NaN where the cell is not visible; step_px : (n,) or one number, equivalent
    disparity of one height step. The second peak is a strict local maximum whose two neighbours are visible, at least
    `second_peak_distance_px` from the highest one; the ends of the range and of its visible part are none.
    Source: Ji et al. 2014, section 2.2, note to table 1. The paper defines neither a local maximum nor a distance from
    the peak; both are our reading.
    """
    n, n_heights = curves.shape
    is_valid = ~np.isnan(curves)
    filled = np.where(is_valid, curves, -np.inf).astype(np.float64)
    peak = filled.argmax(axis=1)
    rho1 = np.take_along_axis(filled, peak[:, None], axis=1)[:, 0]
    steps_away = np.abs(np.arange(n_heights) - peak[:, None])
    is_far = steps_away * np.broadcast_to(step_px, n)[:, None] >= options.second_peak_distance_px - ROUNDING_PX
    rho2 = np.where(is_far & strict_maxima(curves), filled, -np.inf).max(axis=1)
    between = np.pad(is_valid, ((0, 0), (1, 1)))
    has_both_sides = np.take_along_axis(between[:, :-2] & between[:, 2:], peak[:, None], axis=1)[:, 0]
    rho1, rho2 = (np.where(np.isinf(rho), np.nan, rho) for rho in (rho1, rho2))
    return CurvePeaks(
        peak=peak,
        rho1=rho1,
        rho2=rho2,
        ratio=peak_ratio(rho1, rho2, options),
        is_open=~has_both_sides | (is_valid.mean(axis=1) < options.min_visible_share),
    )


def strict_maxima(curves: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Samples that are higher than both neighbours, (n, h) bool; never the ends, nor a sample beside a NaN."""
    maxima = np.zeros(curves.shape, bool)
    inner = curves[:, 1:-1]
    maxima[:, 1:-1] = (inner > curves[:, :-2]) & (inner > curves[:, 2:])
    return maxima


def peak_ratio(rho1: FloatArray, rho2: FloatArray, options: SelectionOptions) -> FloatArray:
    """|rho1 / rho2|, (n,); infinite where rho2 is NaN (no second peak) or 0, and as an option where it is negative.

    Source: Ji et al. 2014, table 3 (its second point has a negative rho2, and the absolute value of the ratio).
    """
    has_no_second = np.isnan(rho2) | (rho2 == 0)
    if options.negative_second_peak == "infinite":
        has_no_second |= rho2 < 0
    return np.where(has_no_second, np.inf, np.abs(rho1 / np.where(has_no_second, 1.0, rho2)))


def quality_labels(
    rho1: FloatArray, ratio: FloatArray, is_open: NDArray[np.bool_], options: SelectionOptions
) -> NDArray[np.int8]:
    """Label 1 (good), 0 (fair) or -1 (poor) of match curves, (n,) int8.

    rho1, ratio : (n,) float64; is_open : (n,) bool, see `CurvePeaks`: such a curve is fair at best. A curve without any
    valid sample (rho1 is NaN) is poor.
    Source: Ji et al. 2014, table 1, with strict comparisons; values that the table does not cover take the lower label.
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
# (n,) cells and (n,) images, one for each cell -> (n, h) correlation, NaN where a height is not visible in the image.
Correlate = Callable[[IntArray, IntArray], NDArray[np.floating]]


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
        """Add one image to some cells, in place. cells : (m,), each once; ncc : (m, h), NaN where not visible.

        SNCC_m = ((m - 1) SNCC_{m-1} + NCC_m) / m, where m counts the images valid at that cell and height.
        Source: Ji et al. 2014, equation (3); the paper takes every image as valid everywhere.
        """
        valid = ~np.isnan(ncc)
        m = self.count[cells] + valid
        before = self.mean[cells]
        self.mean[cells] = np.where(valid, ((m - 1) * before + ncc) / np.maximum(m, 1), before)
        self.count[cells] = m

    def of(self, cells: IntArray) -> FloatArray:
        """Mean match curves of some cells, (m, h) float64, NaN where no image was valid."""
        return np.where(self.count[cells] > 0, self.mean[cells], np.nan)


@dataclass(frozen=True)
class ProgressiveMatch:
    """Mean match curves of the images that were needed.

    mean_ncc : (n, h) float64, NaN where no image was valid; n_images : (n,) int64, images that were used; label : (n,)
    int8, of the final curve; is_stopped : (n,) bool, whether the curve was good enough after some image (False for
    cells outside the sample, which are not judged); n_added : (b,) int64, images that each block added; evaluations :
    cells x heights x images that were evaluated; evaluations_all : the same of all images.
    """

    mean_ncc: FloatArray
    n_images: IntArray
    label: NDArray[np.int8]
    is_stopped: NDArray[np.bool_]
    n_added: IntArray
    evaluations: int
    evaluations_all: int

    @property
    def saved(self) -> float:
        """Share of the evaluations that was not needed; 0 where there was nothing to evaluate."""
        return 1.0 - self.evaluations / self.evaluations_all if self.evaluations_all else 0.0


@dataclass(frozen=True)
class SearchPlan:
    """Which images are added to which cells, in which order.

    order : (b, j) int64, search images of each block, best first, each once; block : (n,) int64, the block of each
    cell; covered : (n, i) bool, whether an image covers a cell (heights at which it is occluded are NaN in the
    correlation); step_px : (i,) or (b, i) float64, equivalent disparity of one height step in each image; sample : (n,)
    bool, the cells that decide when a block stops; window_cells : cells of the correlation window, 0 where only the
    label decides.
    """

    order: IntArray
    block: IntArray
    covered: NDArray[np.bool_]
    step_px: FloatArray
    sample: NDArray[np.bool_]
    window_cells: int = 0

    @classmethod
    def by_cell(cls, order: IntArray, covered: NDArray[np.bool_], step_px: FloatArray) -> SearchPlan:
        """A plan in which every cell is a block of its own, as in the paper. order : (n, j)."""
        n = len(order)
        return cls(order, np.arange(n), covered, step_px, np.ones(n, bool))


def match_progressively(
    correlate: Correlate, n_heights: int, search_plan: SearchPlan, options: SelectionOptions
) -> ProgressiveMatch:
    """Add images in order until the mean match curves are good enough.

    A block adds images until `stopped_share` of its sampled cells has stopped. A cell stops when its curve is good
    after one of the images and its peak precise enough (`max_sigma_steps`, see `predicted_sigma`), or when no image is
    left that covers it. A cell that has stopped still takes part while its block adds images. A block without a sampled
    cell adds all images. The distance of a second peak is measured in the most sensitive image of the mean. Source: Ji
    et al. 2014, section 3.3, step 3; blocks and precision are ours.
    """
    n_cells, n_ranks = len(search_plan.block), search_plan.order.shape[1]
    everyone = np.arange(n_cells)
    enters = np.take_along_axis(search_plan.covered, search_plan.order[search_plan.block], axis=1)
    images_left = enters.sum(axis=1)
    mean, widest_px = ProgressiveMean.empty(n_cells, n_heights), np.zeros(n_cells)
    n_images, n_added = np.zeros(n_cells, np.int64), np.zeros(len(search_plan.order), np.int64)
    is_stopped = np.zeros(n_cells, bool)
    n_evaluated = 0
    step_px = np.broadcast_to(search_plan.step_px, (len(search_plan.order), search_plan.covered.shape[1]))
    is_active = _active_blocks(images_left == 0, search_plan, options)
    for rank in range(n_ranks):
        n_added += is_active
        cells = np.flatnonzero(is_active[search_plan.block] & enters[:, rank])
        images = search_plan.order[search_plan.block[cells], rank]
        ncc = correlate(cells, images)
        mean.add(cells, ncc)
        n_evaluated += len(cells)
        n_images[cells] += ~np.isnan(ncc).all(axis=1)
        images_left[cells] -= 1
        widest_px[cells] = np.maximum(widest_px[cells], step_px[search_plan.block[cells], images])
        judged = cells[search_plan.sample[cells] & ~is_stopped[cells]]
        is_stopped[judged] = _is_enough(mean, judged, widest_px[judged], search_plan, options)
        is_active &= _active_blocks(is_stopped | (images_left == 0), search_plan, options)
        if not is_active.any():
            break
    curves = mean.of(everyone)
    return ProgressiveMatch(
        mean_ncc=curves,
        n_images=n_images,
        label=curve_labels(curves, widest_px, options),
        is_stopped=is_stopped,
        n_added=n_added,
        evaluations=n_evaluated * n_heights,
        evaluations_all=int(enters.sum()) * n_heights,
    )


def _is_enough(
    mean: ProgressiveMean, cells: IntArray, step_px: FloatArray, search_plan: SearchPlan, options: SelectionOptions
) -> NDArray[np.bool_]:
    """Whether the curves of some cells are good and precise enough, (m,) bool."""
    curves = mean.of(cells)
    enough = curve_labels(curves, step_px, options) == GOOD
    if search_plan.window_cells:
        enough &= predicted_sigma(curves, mean.count[cells], search_plan.window_cells) <= options.max_sigma_steps
    return np.asarray(enough)


def predicted_sigma(curves: FloatArray, count: IntArray, window_cells: int) -> FloatArray:
    """Standard deviation of the peak of mean correlations, (n,) in height steps; infinite where the peak has no
    neighbour on one side.

    curves : (n, h) float64, NaN where not visible; count : (n, h) images in each mean; window_cells : N, of the window.
    With rho at the peak, the curvature c = -d2 rho / dk2 there and m images: sqrt(2 (1 - rho) / (c N m)). It follows
    from 1 - rho = noise over signal of N pixels, which moves the vertex of a parabola of curvature c. A large
    base-to-height ratio increases the curvature, and so does texture.
    """
    highest = np.where(np.isnan(curves), -np.inf, curves).argmax(axis=1)
    peak, rows = np.clip(highest, 1, curves.shape[1] - 2), np.arange(len(curves))
    left, rho, right = (curves[rows, peak + d] for d in (-1, 0, 1))
    bend = 2 * rho - left - right
    images = np.maximum(count[rows, peak], 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt(2 * np.maximum(1 - rho, 0) / (bend * window_cells * images))
    return np.where((bend > 0) & (peak == highest), sigma, np.inf)


def _active_blocks(is_done: NDArray[np.bool_], search_plan: SearchPlan, options: SelectionOptions) -> NDArray[np.bool_]:
    """Blocks that add another image, (b,) bool: too few of their sampled cells are done, or they have none."""
    n_blocks = len(search_plan.order)
    sampled = np.bincount(search_plan.block[search_plan.sample], minlength=n_blocks)
    done = np.bincount(search_plan.block[search_plan.sample & is_done], minlength=n_blocks)
    return np.asarray((sampled == 0) | (done < options.stopped_share * sampled), bool)
