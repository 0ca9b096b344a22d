"""Match curves, order of images and stopping point of one cell, for `zlocus curves` and the inspector.

The same steps as `zlocus.matching.view_selection` takes for blocks, with every intermediate result kept. Heights are
lattice indices (`zlocus.matching.height_lattice`).
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
from zlocus.matching.locus_windows import CurveSamples
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
from zlocus.matching.pair_labels import GridTies, PairLabels, label_pairs
from zlocus.matching.tile_views import TileGrid, TileViews, tile_views
from zlocus.matching.view_directions import cells_per_step
from zlocus.matching.view_pixels import read_pixels, window_showing
from zlocus.matching.view_ranking import FeaturePoints, NeighbourSearch, OrderSource, order_images
from zlocus.matching.view_selection import order_views, preselected

IntArray = NDArray[np.int64]

# The height of a place where none is given is the median height of this many nearest tie points.
NEAREST_TIES = 5
# Tie points within this distance order the images of a cell where none is nearer.
RANKED_WITHIN_CELLS = 2048


@dataclass(frozen=True)
class PointOrder:
    """The reference image of a cell and the other views that show it, best first.

    reference : number of the view; search : (j,) int64 views; accumulated : (j,) int64, their labels accumulated over
    the feature points around; is_helpful : (j,) bool, whether they improve the match; order_source : which feature
    points the order rests on; features : (f,) int64, numbers of these feature points, the nearest first; xy : (f, 2)
    float64, where they are, as `PairLabels.xy`; distance : (f,) float64 cells; labels : (f, j) int8, of the search
    views there.
    """

    reference: int
    search: IntArray
    accumulated: IntArray
    is_helpful: NDArray[np.bool_]
    order_source: OrderSource
    features: IntArray
    xy: FloatArray
    distance: FloatArray
    labels: NDArray[np.int8]


@dataclass(frozen=True)
class JudgedCurves:
    """Match curves with their peaks and labels.

    values : (j, h) float64, NaN where not visible; labels : (j,) int8, by table 1 of Ji et al. 2014.
    """

    values: FloatArray
    peaks: CurvePeaks
    labels: NDArray[np.int8]

    @classmethod
    def of(cls, values: FloatArray, step_px: FloatArray, options: SelectionOptions) -> JudgedCurves:
        """Peaks and labels of curves. step_px : (j,), see `curve_peaks`."""
        peaks = curve_peaks(values, step_px, options)
        return cls(values, peaks, quality_labels(peaks.rho1, peaks.ratio, peaks.is_open, options))


@dataclass(frozen=True)
class PointCurves:
    """The match of one cell.

    order : reference and search views; lattice_index : (h,) float64, heights of the curves; step_px : (j,) float64,
    equivalent disparity of a height step; single_curves : correlation of the reference with each search view, in their
    order; mean_curves : mean correlation of the first 1, 2, ... of them; sigma_steps : (j,) float64, predicted standard
    deviation of the peak of each mean, infinite where the peak lies at an end; n_used : number of search views with
    which the match ends; is_stopped : whether the mean was good enough by then; if not, no helpful view was left (at
    least `min_images` are used all the same).
    """

    order: PointOrder
    lattice_index: FloatArray
    step_px: FloatArray
    single_curves: JudgedCurves
    mean_curves: JudgedCurves
    sigma_steps: FloatArray
    n_used: int
    is_stopped: bool

    @property
    def peak_index(self) -> float:
        """Lattice index of the peak of the mean with which the match ends, refined by a parabola; NaN without a
        peak."""
        return peak_of(self.lattice_index, self.mean_curves.values[self.n_used - 1])


def peak_of(lattice_index: FloatArray, curve: FloatArray) -> float:
    """Lattice index of the largest value of a curve, (h,) both: the vertex of a parabola where both sides are visible.

    NaN where no value is.
    """
    if np.isnan(curve).all():
        return np.nan
    peak = int(np.nanargmax(curve))
    if not 0 < peak < len(curve) - 1:
        return float(lattice_index[peak])
    left, top, right = curve[peak - 1 : peak + 2]
    bend = left - 2 * top + right
    return float(lattice_index[peak] + (0.5 * (left - right) / bend if bend < 0 else 0.0))


def point_order(pair_labels: PairLabels, share: FloatArray, xy: FloatArray, options: SelectionOptions) -> PointOrder:
    """Reference image and order of the views at one place.

    share : (i,) float64, 1 for views that show the place and may be the reference; xy : (2,) float64, as
    `PairLabels.xy`.
    """
    view_order = order_views(pair_labels, share[:, None], xy[None], options)
    reference, search = int(view_order.reference[0]), view_order.search[0]
    others = np.delete(np.arange(len(share)), reference)
    labels = pair_labels.labels[:, reference]
    image_order = order_images(FeaturePoints(pair_labels.xy, labels[:, others]), xy[None], options)
    accumulated = dict(zip(others.tolist(), image_order.accumulated[0].tolist(), strict=True))
    features = NeighbourSearch(pair_labels.xy, options).of(xy[None]).index
    return PointOrder(
        reference=reference,
        search=search,
        accumulated=np.array([accumulated[i] for i in search.tolist()], np.int64),
        is_helpful=view_order.is_helpful[0],
        order_source=OrderSource(int(image_order.order_source[0])),
        features=features,
        xy=pair_labels.xy[features],
        distance=np.hypot(*(pair_labels.xy[features] - xy).T),
        labels=labels[features][:, search],
    )


def cell_windows(
    tile_views: TileViews, window: CellWindow, cell: tuple[int, int], lattice_index: float, side: int, reach: int
) -> NDArray[np.float32]:
    """Level correlation windows of every view around a cell, (i, h, k) float32, NaN where a view does not show them.

    tile_views : of the cells `window`; cell : row and column of the lattice; lattice_index : the middle of the heights;
    side : cells along the side of a correlation window; reach : height steps to both sides.
    """
    cells = np.array([[cell[0] - window.row, cell[1] - window.col]], np.int64)
    level = np.zeros((1, side * side), np.float32)
    samples = CurveSamples(cells, np.array([lattice_index - reach]), 2 * reach + 1, level)
    return np.concatenate([samples.windows(tile_views, i, slice(None)) for i in range(len(tile_views.layout))])


def steps_px(tile_views: TileViews, reference: int, search: IntArray) -> FloatArray:
    """Equivalent disparity of a height step of search views against the reference, (j,) float64 px."""
    of_reference = np.array(cells_per_step(tile_views, reference))
    return np.array([np.hypot(*(np.array(cells_per_step(tile_views, int(i))) - of_reference)) for i in search])


def point_curves(
    windows: NDArray[np.float32],
    order: PointOrder,
    step_px: FloatArray,
    lattice_index: FloatArray,
    options: SelectionOptions,
) -> PointCurves:
    """Match curves of one cell, one search view after the other, and after how many of them the match ends.

    windows : (i, h, k) float32, of mean 0 and length 1, NaN where not visible; step_px : (j,); lattice_index : (h,).
    Source: Ji et al. 2014, section 3.3, step 3, and figures 3 to 7.
    """
    n_search, n_heights, window_cells = len(order.search), windows.shape[1], windows.shape[2]
    ncc = np.einsum("hk,jhk->jh", windows[order.reference], windows[order.search], dtype=np.float64)
    mean, cell = ProgressiveMean.empty(1, n_heights), np.zeros(1, np.int64)
    mean_ncc, sigma_steps = np.empty_like(ncc), np.empty(n_search)
    for m in range(n_search):
        mean.add(cell, ncc[m : m + 1])
        mean_ncc[m] = mean.of(cell)[0]
        sigma_steps[m] = predicted_sigma(mean_ncc[m : m + 1], mean.count, window_cells)[0]
    n_used, is_stopped = _stopping_point(ncc, order, step_px, window_cells, options)
    return PointCurves(
        order=order,
        lattice_index=lattice_index,
        step_px=step_px,
        single_curves=JudgedCurves.of(ncc, step_px, options),
        mean_curves=JudgedCurves.of(mean_ncc, np.maximum.accumulate(step_px), options),
        sigma_steps=sigma_steps,
        n_used=n_used,
        is_stopped=is_stopped,
    )


def _stopping_point(
    ncc: FloatArray, order: PointOrder, step_px: FloatArray, window_cells: int, options: SelectionOptions
) -> tuple[int, bool]:
    """After how many search views the match of a cell ends, and whether its mean curve is good enough then.

    ncc : (j, h), correlation of the reference with each search view.
    """

    def correlate(_: IntArray, images: IntArray) -> NDArray[np.floating]:
        return np.asarray(ncc[images])

    n_search, n_heights = ncc.shape
    # View number n_search stands for "no view": a view that does not help is never added.
    search_plan = SearchPlan(
        order=np.where(order.is_helpful, np.arange(n_search), n_search)[None],
        block=np.zeros(1, np.int64),
        covered=np.array([[True] * n_search + [False]]),
        step_px=np.append(step_px, 0.0),
        sample=np.ones(1, bool),
        window_cells=window_cells,
    )
    match = match_progressively(correlate, n_heights, search_plan, options)
    is_stopped = bool(match.is_stopped[0])
    # Views that do not help are better than none.
    n_at_end = max(int(order.is_helpful.sum()), min(options.min_images, n_search))
    n_added = int(match.n_added[0]) if is_stopped else n_at_end
    return min(n_added, options.max_images), is_stopped and n_added <= options.max_images


@dataclass(frozen=True)
class Place:
    """A place whose cell is matched.

    xyz : (3,) m, the requested point, at the height around which it is matched; height_from : where that height comes
    from, in words; cell : row and column of the finest lattice; middle : (2,) m, of the cell.
    """

    xyz: FloatArray
    height_from: str
    cell: tuple[int, int]
    middle: FloatArray


@dataclass(frozen=True)
class PlaceCurves:
    """A place and its match curves.

    views : those that show the place and were compared, to which the numbers in `curves` refer; lattice_index : of the
    place, in the middle of the sampled heights; heights_m : (h,) m; tile_views : all views near the place, over the
    cells `window`; view_rows : (i,) int64, which of them `views` are; ties : (f,) int64, numbers of the tie points that
    order the images, as `PointOrder.features`.
    """

    place: Place
    views: tuple[View, ...]
    curves: PointCurves
    lattice_index: float
    heights_m: FloatArray
    tile_views: TileViews
    window: CellWindow
    view_rows: IntArray
    ties: IntArray

    def patches(self, side: int) -> NDArray[np.float32]:
        """Windows of `side` cells around the place, (i, h, k) float32, of every view at every height.

        Normalised like those that are compared; NaN where a view does not show the whole window.
        """
        reach = len(self.heights_m) // 2
        windows = cell_windows(self.tile_views, self.window, self.place.cell, self.lattice_index, side, reach)
        return windows[self.view_rows]


def cell_of(xy: FloatArray, match_scene: MatchScene) -> tuple[int, int]:
    """Row and column of the cell of the finest lattice that contains a ground point (2,) m."""
    col, row = (xy - match_scene.anchor) * (1.0, -1.0) / match_scene.cell_size
    return math.floor(row), math.floor(col)


def height_nearby(xy: FloatArray, ties: FloatArray) -> float:
    """Median height (m) of the tie points (n, 3) m that are nearest to a place (2,) m."""
    distance = np.hypot(*(ties[:, :2] - xy).T)
    return float(np.median(ties[np.argsort(distance, kind="stable")[:NEAREST_TIES], 2]))


def shows(view: View, xyz: FloatArray) -> bool:
    """Whether a ground point (3,) m lies inside an image."""
    col, row = view.sensor.image_from_ground(xyz[None])[0]
    rows, cols = view.image.shape
    return bool(0 <= row <= rows - 1 and 0 <= col <= cols - 1)


def check_shown(
    point_name: str, reference: str | None, xyz: FloatArray, names: Sequence[str], match_scene: MatchScene
) -> None:
    """Refuse a point that fewer than two views show, or that the requested reference image does not show.

    point_name : the point as it was requested, for the message; names : of the views that show it.

    Raises
    ------
    GeometryError
        In both cases.
    """
    what = f"{point_name} (E {xyz[0]:.1f}, N {xyz[1]:.1f}, height {xyz[2]:.1f} m)"
    if len(names) < 2:
        west, south, east, north = match_scene.overlap_bounds
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
    point_name: str,
    reference: str | None,
    match_scene: MatchScene,
    place: Place,
    config: RunConfig,
    max_distance_cells: int = RANKED_WITHIN_CELLS,
) -> PlaceCurves:
    """Match curves of a place with the views that show it.

    The tie points that order the views are looked for in growing windows around the place: within the radius, within
    `max_radii` radii, and within `max_distance_cells` at most. point_name : the point as it was requested, for
    messages; reference : name of the reference image, None for the best one.

    Raises
    ------
    GeometryError
        Fewer than two views show the place, or the reference image does not.
    """
    names = [view.name for view in match_scene.views if shows(view, place.xyz)]
    check_shown(point_name, reference, place.xyz, names, match_scene)
    options = config.selection
    lattice_index = (place.xyz[2] - match_scene.height_origin) / match_scene.height_step
    for distance_cells, sufficient_source in _tie_windows(options, max_distance_cells):
        halo = min(math.ceil(distance_cells), max_distance_cells)
        window = CellWindow(*place.cell, 1, 1).at_level(0, halo).within(match_scene.overlap_window)
        if not (window.rows and window.cols):
            check_shown(point_name, reference, place.xyz, [], match_scene)
        numbers, views = views_around(match_scene, window, place, config)
        side = large_window_side(config.cost)
        windows = cell_windows(views, window, place.cell, lattice_index, side, options.reach_steps)
        view_rows = np.flatnonzero(~np.isnan(windows[:, options.reach_steps, 0]))
        compared = tuple(match_scene.views[numbers[i]] for i in view_rows)
        check_shown(point_name, reference, place.xyz, [view.name for view in compared], match_scene)
        pair_labels = labels_around(match_scene, views, window, config)
        pair_labels = replace(pair_labels, labels=pair_labels.labels[:, view_rows][:, :, view_rows])
        middle = np.array(place.cell[::-1]) + 0.5
        order = point_order(pair_labels, may_be_reference(reference, compared), middle, options)
        if order.order_source <= sufficient_source:
            break
    step_px = steps_px(views, int(view_rows[order.reference]), view_rows[order.search])
    along = lattice_index + np.arange(-options.reach_steps, options.reach_steps + 1)
    curves = point_curves(windows[view_rows], order, step_px, along, options)
    heights_m = match_scene.height_origin + along * match_scene.height_step
    ties = pair_labels.tie[order.features]
    return PlaceCurves(place, compared, curves, lattice_index, heights_m, views, window, view_rows, ties)


def _tie_windows(options: SelectionOptions, max_distance_cells: int) -> list[tuple[float, OrderSource]]:
    """Distances, cells, within which tie points are looked for one after the other, each with the source that is found
    in no smaller window."""
    within_radius = [] if options.neighbours == "tin" else [(options.radius_px, OrderSource.NEIGHBOURS)]
    nearest = (options.max_radii * options.radius_px, OrderSource.NEAREST)
    return [*within_radius, nearest, (max_distance_cells, OrderSource.SCENE)]


def may_be_reference(reference: str | None, views: Sequence[View]) -> FloatArray:
    """1 for every view that may be the reference image, else 0, (i,) float64."""
    return np.array([float(reference in (None, view.name)) for view in views])


def views_around(
    match_scene: MatchScene, window: CellWindow, place: Place, config: RunConfig
) -> tuple[list[int], TileViews]:
    """Numbers of the views to compare at a place, and their pixels and projections over a window of cells around it."""
    z_range = heights_around(match_scene, window, place, config.selection)
    transform, ground_xy = match_scene.transform(window, 0), match_scene.points_of(window, 0)
    candidates = [number for number, view in enumerate(match_scene.views) if shows(view, place.xyz)]
    if len(candidates) > config.selection.max_candidates + 1:
        showing = [match_scene.views[number] for number in candidates]
        rows = preselected(showing, place.middle[None], float(place.xyz[2]), config.selection)
        candidates = [candidates[row] for row in rows]
    numbers, view_pixels = [], []
    for number in candidates:
        view_window = window_showing(match_scene.views[number], ground_xy, z_range)
        if view_window is not None:
            numbers.append(number)
            view_pixels.append(read_pixels(match_scene.views[number], view_window, match_scene.grey_scales[number]))
    shape, lattice = (window.rows, window.cols), (match_scene.height_origin, match_scene.height_step)
    half = large_window_side(config.cost) // 2
    cells = TileGrid(0, transform, shape, config.pyramid.block, *lattice)
    return numbers, tile_views(view_pixels, cells, z_range, half)


def heights_around(
    match_scene: MatchScene, window: CellWindow, place: Place, options: SelectionOptions
) -> tuple[float, float]:
    """Lowest and highest height (m) of the match curves of a place and of the tie points in a window.

    Projections are tabulated over these heights only: over the height range of the scene that would take several times
    as long.
    """
    inside = GridTies.of(match_scene).inside(window) & np.isfinite(match_scene.ties[:, 2])
    heights = np.append(match_scene.ties[inside, 2], place.xyz[2])
    reach = (options.reach_steps + 1) * match_scene.height_step
    return float(heights.min()) - reach, float(heights.max()) + reach


def labels_around(match_scene: MatchScene, tile_views: TileViews, window: CellWindow, config: RunConfig) -> PairLabels:
    """Labels of all pairs of views at the tie points of a window, as on level ground."""
    ties, steps_per_cell = GridTies.of(match_scene), match_scene.cell_size / match_scene.height_step
    return label_pairs(tile_views, window, ties, large_window_side(config.cost), steps_per_cell, config.selection)
