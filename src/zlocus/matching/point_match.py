"""One cell under the glass: match curve of every search view, their order, and where the mean of the first is enough.

What `zlocus.matching.view_selection` does for blocks, with all that it passes through kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_curve import (
    CurvePeaks,
    ProgressiveMean,
    SearchPlan,
    curve_peaks,
    match_progressively,
    predicted_sigma,
    quality_labels,
)
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.tile_views import TileViews, pixel_window, read_pixels, tile_views
from zlocus.matching.view_directions import cells_per_step
from zlocus.matching.view_ranking import (
    OrderSource,
    FeaturePoints,
    NeighbourSearch,
    PairLabels,
    Samples,
    order_images,
    label_pairs,
)
from zlocus.matching.view_selection import order_views, preselected

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class PointOrder:
    """The reference of a cell and the other views that show it, best first.

    reference : view; search : (j,) int64 views; accumulated : (j,) int64, their labels summed over the feature points
    around; is_worth : (j,) bool, whether they help; order_source : what the order rests on; features : (f,) int64 feature
    points, the nearest first; xy : (f, 2) float64, where they are, as `PairLabels.xy`; distance : (f,) float64 cells;
    labels : (f, j) int8, of the search views there.
    """

    reference: int
    search: IntArray
    accumulated: IntArray
    is_worth: NDArray[np.bool_]
    order_source: OrderSource
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


def point_order(ranking: PairLabels, share: FloatArray, at: FloatArray, options: SelectionOptions) -> PointOrder:
    """Reference and order of the views at one place.

    share : (i,) float64, 1 for views that show it and may be the reference; at : (2,) float64, as `PairLabels.xy`.
    """
    found = order_views(ranking, share[:, None], at[None], options)
    reference, search = int(found.reference[0]), found.search[0]
    others = np.delete(np.arange(len(share)), reference)
    labels = ranking.labels[:, reference]
    order = order_images(FeaturePoints(ranking.xy, labels[:, others]), at[None], options)
    accumulated = dict(zip(others.tolist(), order.accumulated[0].tolist(), strict=True))
    features = NeighbourSearch(ranking.xy, options).of(at[None]).index
    return PointOrder(
        reference=reference,
        search=search,
        accumulated=np.array([accumulated[i] for i in search.tolist()], np.int64),
        is_worth=found.is_worth[0],
        order_source=OrderSource(int(order.order_source[0])),
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


NEAREST_TIES = 5
# Cells around a point in which tie points order its images where none is nearer.
RANKED_WITHIN_CELLS = 2048


@dataclass(frozen=True)
class Place:
    """xyz : (3,) m, the point asked for, at the height about which it is matched; height_from : what tells it; cell :
    row and column of the finest lattice; middle : (2,) m, of the cell."""

    xyz: FloatArray
    height_from: str
    cell: tuple[int, int]
    middle: FloatArray


@dataclass(frozen=True)
class LookedAt:
    """A place and its match curves.

    views : that show it and were compared; curves : numbers of views in it are of these; index : height index of the
    place, in the middle of those sampled; heights_m : (h,) m; sampled : what all views show around it, of the cells
    `window`; kept : (i,) int64, which of them `views` are.
    """

    place: Place
    views: tuple[View, ...]
    curves: PointCurves
    index: float
    heights_m: FloatArray
    sampled: TileViews
    window: CellWindow
    kept: IntArray

    def patches(self, side: int) -> NDArray[np.float32]:
        """Windows of `side` cells around the place, (i, h, k) float32, of every view at every height.

        Normalised as those that are compared; NaN where a view does not show one whole.
        """
        reach = len(self.heights_m) // 2
        return cell_windows(self.sampled, self.window, self.place.cell, self.index, side, reach)[self.kept]


def cell_of(xy: FloatArray, match_scene: MatchScene) -> tuple[int, int]:
    """Row and column of the finest lattice's cell that holds a ground point."""
    col, row = (xy - match_scene.anchor) * (1.0, -1.0) / match_scene.cell_m
    return math.floor(row), math.floor(col)


def height_nearby(xy: FloatArray, ties: FloatArray) -> float:
    """Median height of the ties (n, 3) nearest to a place (2,), m."""
    away = np.hypot(*(ties[:, :2] - xy).T)
    return float(np.median(ties[np.argsort(away, kind="stable")[:NEAREST_TIES], 2]))


def shows(view: View, xyz: FloatArray) -> bool:
    """Whether a ground point (3,) lies inside an image."""
    col, row = view.sensor.image_from_ground(xyz[None])[0]
    rows, cols = view.image.shape
    return bool(0 <= row <= rows - 1 and 0 <= col <= cols - 1)


def check_shown(asked: str, reference: str | None, xyz: FloatArray, names: Sequence[str], match_scene: MatchScene) -> None:
    """Refuse a point that fewer than two views show, or a reference that is not among them.

    asked : the point as it was asked for, for messages.
    """
    what = f"{asked} (E {xyz[0]:.1f}, N {xyz[1]:.1f}, height {xyz[2]:.1f} m)"
    if len(names) < 2:
        west, north = match_scene.transform(match_scene.seen, 0) * (0, 0)
        east, south = match_scene.transform(match_scene.seen, 0) * (match_scene.seen.cols, match_scene.seen.rows)
        fault = (
            f"is shown, with the window around it, by {names[0]} only, and two images are needed"
            if names
            else "lies outside all images"
        )
        raise GeometryError(
            f"{what} {fault}: they share E {west:.0f} to {east:.0f} m, N {south:.0f} to {north:.0f} m. Check the point "
            "and --crs."
        )
    if reference is not None and reference not in names:
        raise GeometryError(f"{what} is not shown by --reference {reference}. Choose from {', '.join(names)}.")


def curves_at(
    asked: str,
    reference: str | None,
    match_scene: MatchScene,
    place: Place,
    config: RunConfig,
    farthest: int = RANKED_WITHIN_CELLS,
) -> LookedAt:
    """Match curves of a place with the views that show it.

    Tie points are looked for farther and farther away, as far as the rules of the order reach, and `farthest` cells at
    most. asked : the point as it was asked for, for messages; reference : name of the view to be it, None for the best.

    Raises
    ------
    GeometryError
        Fewer than two views show the place, or not the reference.
    """
    names = [view.name for view in match_scene.views if shows(view, place.xyz)]
    check_shown(asked, reference, place.xyz, names, match_scene)
    options, side = config.selection, large_window_side(config.cost)
    index = (place.xyz[2] - match_scene.origin_m) / match_scene.step_m
    radius, at = options.radius_px, np.array(place.cell[::-1]) + 0.5
    near = () if options.neighbours == "tin" else ((radius, OrderSource.NEIGHBOURS),)
    for around, enough in (*near, (options.widest * radius, OrderSource.NEAREST), (farthest, OrderSource.SCENE)):
        halo = min(math.ceil(around), farthest)
        window = CellWindow(*place.cell, 1, 1).at_level(0, halo).within(match_scene.seen)
        if not (window.rows and window.cols):
            check_shown(asked, reference, place.xyz, [], match_scene)
        numbers, views = views_of(match_scene, window, place, config)
        windows = cell_windows(views, window, place.cell, index, side, options.reach_steps)
        kept = np.flatnonzero(~np.isnan(windows[:, options.reach_steps, 0]))
        compared = tuple(match_scene.views[numbers[i]] for i in kept)
        check_shown(asked, reference, place.xyz, [view.name for view in compared], match_scene)
        ranking = ranked(match_scene, views, window, config)
        ranking = replace(ranking, labels=ranking.labels[:, kept][:, :, kept])
        order = point_order(ranking, references(reference, compared), at, options)
        if order.order_source <= enough:
            break
    step_px = steps_px(views, int(kept[order.reference]), kept[order.search])
    along = index + np.arange(-options.reach_steps, options.reach_steps + 1)
    curves = point_curves(windows[kept], order, step_px, along, options)
    heights_m = match_scene.origin_m + along * match_scene.step_m
    return LookedAt(place, compared, curves, index, heights_m, views, window, kept)


def references(reference: str | None, views: Sequence[View]) -> FloatArray:
    """1 for every view that may be the reference, (i,) float64."""
    return np.array([float(reference in (None, view.name)) for view in views])


def views_of(match_scene: MatchScene, window: CellWindow, place: Place, config: RunConfig) -> tuple[list[int], TileViews]:
    """The views worth comparing at the place, by number, and what they show of a window of cells around it."""
    z = heights_around(match_scene, window, place, config.selection)
    transform = match_scene.transform(window, 0)
    across, down = np.linspace(0, window.cols, 5), np.linspace(0, window.rows, 5)
    corners = np.array([transform * (c, r) for c in across for r in down])
    numbers, found = [], []
    which = [number for number, view in enumerate(match_scene.views) if shows(view, place.xyz)]
    if len(which) > config.selection.candidates + 1:
        shown = [match_scene.views[number] for number in which]
        rows = preselected(shown, place.middle[None], float(place.xyz[2]), config.selection)
        which = [which[row] for row in rows]
    for number in which:
        part = pixel_window(match_scene.views[number], corners, z, 1)
        if part is not None:
            numbers.append(number)
            found.append(read_pixels(match_scene.views[number], part, 1, match_scene.grey[number]))
    shape, lattice = (window.rows, window.cols), (match_scene.origin_m, match_scene.step_m)
    half = large_window_side(config.cost) // 2
    return numbers, tile_views(found, 0, transform, shape, config.pyramid.block, lattice, z, half)


def heights_around(
    match_scene: MatchScene, window: CellWindow, place: Place, options: SelectionOptions
) -> tuple[float, float]:
    """Between which heights, m, curves of the place and of the tie points in a window are looked at: of a scene's whole
    range projections would be tabulated several times as long."""
    xy = ties_on_cells(match_scene)
    first, size = np.array([window.col, window.row]), np.array([window.cols, window.rows])
    inside = ((xy >= first) & (xy < first + size)).all(axis=1) & np.isfinite(match_scene.ties[:, 2])
    heights = np.append(match_scene.ties[inside, 2], place.xyz[2])
    reach = (options.reach_steps + 1) * match_scene.step_m
    return float(heights.min()) - reach, float(heights.max()) + reach


def ties_on_cells(match_scene: MatchScene) -> FloatArray:
    """Columns and rows of the finest lattice where the tie points lie, (n, 2)."""
    return np.asarray((match_scene.ties[:, :2] - match_scene.anchor) * (1.0, -1.0) / match_scene.cell_m)


def ranked(match_scene: MatchScene, views: TileViews, window: CellWindow, config: RunConfig) -> PairLabels:
    """Labels of all pairs of views at the tie points of a window, on level ground."""
    xy = ties_on_cells(match_scene)
    index = (match_scene.ties[:, 2] - match_scene.origin_m) / match_scene.step_m
    side, steps_per_cell, flat = large_window_side(config.cost), match_scene.cell_m / match_scene.step_m, np.zeros((len(xy), 2))
    return label_pairs(views, window, xy, index, flat, side, steps_per_cell, config.selection)
