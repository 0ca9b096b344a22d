"""One cell under the glass: match curve of every search view, their order, and where the mean of the first is enough.

What `zlocus.matching.selection` does for blocks, with all that it passes through kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.cells import CellWindow
from zlocus.matching.curve import CurvePeaks, curve_peaks, quality_labels
from zlocus.matching.order import Evidence, FeaturePoints, NeighbourSearch, image_order
from zlocus.matching.progressive import ProgressiveMean, SearchPlan, match_progressively, predicted_sigma
from zlocus.matching.selection import Ranking, Samples, order_views
from zlocus.matching.views import TileViews
from zlocus.matching.visibility import cells_per_step
from zlocus.options import SelectionOptions

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class PointOrder:
    """The reference of a cell and the other views that show it, best first.

    reference : view; search : (j,) int64 views; accumulated : (j,) int64, their labels summed over the feature points
    around; is_worth : (j,) bool, whether they help; evidence : what the order rests on; features : (f,) int64 feature
    points, the nearest first; xy : (f, 2) float64, where they are, as `Ranking.xy`; distance : (f,) float64 cells;
    labels : (f, j) int8, of the search views there.
    """

    reference: int
    search: IntArray
    accumulated: IntArray
    is_worth: NDArray[np.bool_]
    evidence: Evidence
    features: IntArray
    xy: FloatArray
    distance: FloatArray
    labels: NDArray[np.int8]


@dataclass(frozen=True)
class JudgedCurves:
    """Match curves and what Table 1 says of them. values : (j, h) float64, NaN where not seen; labels : (j,) int8."""

    values: FloatArray
    peaks: CurvePeaks
    labels: NDArray[np.int8]

    @classmethod
    def of(cls, values: FloatArray, step_px: FloatArray, options: SelectionOptions) -> JudgedCurves:
        """Judge curves. step_px : (j,), see `curve_peaks`."""
        peaks = curve_peaks(values, step_px, options)
        return cls(values, peaks, quality_labels(peaks.rho1, peaks.ratio, peaks.is_open, options))


@dataclass(frozen=True)
class PointCurves:
    """All that one cell's match passes through.

    order; index : (h,) float64, height indices; step_px : (j,) float64, equivalent disparity of a step; single : NCC
    with each search view, in their order; mean : SNCC of the first 1, 2, ... of them; sigma_steps : (j,) float64,
    predicted for its peak, infinite where it has no two sides; n_used : views after which the match ends; is_stopped :
    whether the mean was enough by then, else no view that helps was left (of such, `least_images` are used at least).
    """

    order: PointOrder
    index: FloatArray
    step_px: FloatArray
    single: JudgedCurves
    mean: JudgedCurves
    sigma_steps: FloatArray
    n_used: int
    is_stopped: bool

    @property
    def peak_index(self) -> float:
        """Height index of the peak of the mean where the match ends, between samples by a parabola; NaN without one."""
        return peak_of(self.index, self.mean.values[self.n_used - 1])


def peak_of(index: FloatArray, curve: FloatArray) -> float:
    """Height index of the largest value of a curve, (h,) both; the vertex of a parabola where both sides are seen."""
    if np.isnan(curve).all():
        return np.nan
    peak = int(np.nanargmax(curve))
    if not 0 < peak < len(curve) - 1:
        return float(index[peak])
    left, top, right = curve[peak - 1 : peak + 2]
    bend = left - 2 * top + right
    return float(index[peak] + (0.5 * (left - right) / bend if bend < 0 else 0.0))


def point_order(ranking: Ranking, share: FloatArray, at: FloatArray, options: SelectionOptions) -> PointOrder:
    """Reference and order of the views at one place.

    share : (i,) float64, 1 for views that show it and may be the reference; at : (2,) float64, as `Ranking.xy`.
    """
    found = order_views(ranking, share[:, None], at[None], options)
    reference, search = int(found.reference[0]), found.search[0]
    others = np.delete(np.arange(len(share)), reference)
    labels = ranking.labels[:, reference]
    order = image_order(FeaturePoints(ranking.xy, labels[:, others]), at[None], options)
    accumulated = dict(zip(others.tolist(), order.accumulated[0].tolist(), strict=True))
    features = NeighbourSearch(ranking.xy, options).of(at[None]).index
    return PointOrder(
        reference=reference,
        search=search,
        accumulated=np.array([accumulated[i] for i in search.tolist()], np.int64),
        is_worth=found.is_worth[0],
        evidence=Evidence(int(order.evidence[0])),
        features=features,
        xy=ranking.xy[features],
        distance=np.hypot(*(ranking.xy[features] - at).T),
        labels=labels[features][:, search],
    )


def cell_windows(
    views: TileViews, window: CellWindow, cell: tuple[int, int], index: float, side: int, reach: int
) -> NDArray[np.float32]:
    """Level windows of every view around a cell, (i, h, k) float32, NaN where a view does not show them.

    views : of the cells `window`; cell : row and column of the lattice; index : height index in the middle; reach :
    indices to both sides; side : cells of the window.
    """
    at = np.array([[cell[0] - window.row, cell[1] - window.col]], np.int64)
    flat = np.zeros((1, side * side), np.float32)
    samples = Samples(at, np.array([index - reach]), 2 * reach + 1, flat)
    return np.concatenate([samples.windows(views, i, slice(None)) for i in range(len(views.layout))])


def steps_px(views: TileViews, reference: int, search: IntArray) -> FloatArray:
    """Equivalent disparity of a height step of search views against the reference, (j,) float64 px."""
    at_reference = np.array(cells_per_step(views, reference))
    return np.array([np.hypot(*(np.array(cells_per_step(views, int(i))) - at_reference)) for i in search])


def point_curves(
    windows: NDArray[np.float32], order: PointOrder, step_px: FloatArray, index: FloatArray, options: SelectionOptions
) -> PointCurves:
    """Match curves of one cell, one view after the other, and after how many the match ends.

    windows : (i, h, k) float32, normalised, NaN where not seen; step_px : (j,) px; index : (h,) height indices.
    Source: Ji et al. 2014, section 3.3, step 3, and figures 3 to 7.
    """
    n_search, n_heights, window_cells = len(order.search), windows.shape[1], windows.shape[2]
    ncc = np.einsum("hk,jhk->jh", windows[order.reference], windows[order.search], dtype=np.float64)
    mean, zero = ProgressiveMean.empty(1, n_heights), np.zeros(1, np.int64)
    sncc, sigma = np.empty_like(ncc), np.empty(n_search)
    for m in range(n_search):
        mean.add(zero, ncc[m : m + 1])
        sncc[m] = mean.sncc(zero)[0]
        sigma[m] = predicted_sigma(sncc[m : m + 1], mean.count, window_cells)[0]

    def measure(_: IntArray, images: IntArray) -> NDArray[np.floating]:
        return np.asarray(ncc[images])

    plan = SearchPlan(
        order=np.where(order.is_worth, np.arange(n_search), n_search)[None], block=zero,
        seen=np.array([[True] * n_search + [False]]), step_px=np.append(step_px, 0.0), sample=np.ones(1, bool),
        window_cells=window_cells,
    )  # fmt: skip
    match = match_progressively(measure, n_heights, plan, options)
    is_stopped = bool(match.is_stopped[0])
    # Views that mislead are better than none.
    at_last = max(int(order.is_worth.sum()), min(options.least_images, n_search))
    added = int(match.n_added[0]) if is_stopped else at_last
    return PointCurves(
        order=order,
        index=index,
        step_px=step_px,
        single=JudgedCurves.of(ncc, step_px, options),
        mean=JudgedCurves.of(sncc, np.maximum.accumulate(step_px), options),
        sigma_steps=sigma,
        n_used=min(added, options.most_images),
        is_stopped=is_stopped and added <= options.most_images,
    )
