"""Stereo selection, literally as Ji et al. (2014) describe it: heights of single points by SNCC, with the images that
feature points choose.

The steps of their section 3.3, for every cell of a match scene, whose first view is the reference image:

1. find the feature points around the cell, by a radius or a TIN (`zlocus.matching.view_ranking`);
2. accumulate the labels that table 1 gives each search image there, and order the search images by them;
3. add the search images one after the other (equation 3), and stop as soon as table 1 calls the mean curve distinct.

The cells may lie on the ground, where heights follow the vertical line (MVLL), or be the pixels of the reference image,
where they follow its rays (GC3): `zlocus.matching.image_space` makes such a match scene. Nothing else takes part: no
pyramid, no semi-global constraint, no occlusion, no evidence, no refinement between two height steps.

Where the paper says nothing, our reading is that of the other modules:

- the secondary peak is a strict local maximum at least `second_peak_distance_px` away from the peak, and a curve whose
  peak lies at an end, or of which little is visible, is fair at best (`zlocus.matching.match_curve`);
- points without feature points nearby take the nearest ones, then all (`zlocus.matching.view_ranking`);
- the correlation window has `cost.large_window` cells on a side and lies level;
- the initial height is interpolated between the feature points, in their TIN; outside it, the nearest one counts;
- a cell whose last mean curve is poor has no height, because table 1 says of such curves that they only yield wrong
  matches; nor has a cell whose peak lies at an end of the search range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.locus_windows import CurveSamples
from zlocus.matching.match_curve import (
    CurvePeaks,
    IntArray,
    ProgressiveMatch,
    SearchPlan,
    curve_labels,
    curve_peaks,
    match_progressively,
)
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.pair_labels import GridTies
from zlocus.matching.point_match import PointCurves, PointOrder, cell_windows, point_curves, steps_px
from zlocus.matching.tile_views import TileGrid, TileViews, tile_views
from zlocus.matching.view_pixels import read_pixels, window_showing
from zlocus.matching.view_ranking import FeaturePoints, NeighbourSearch, OrderSource, order_images, triangulated

# Number of the reference image among the views of a match scene, and of `SelectionArea`.
REFERENCE = 0
# Cells whose windows are in memory at once: those of one image are 81 heights x 25 cells x 4 bytes each.
CELLS_AT_ONCE = 4096
# With a limit of sigma this large, the label alone decides when a point stops.
UNLIMITED_SIGMA_STEPS = 1000.0
MAX_IMAGES = 254


def options_of_paper(options: SelectionOptions) -> SelectionOptions:
    """The options with everything switched off that the paper does not describe.

    What it leaves open stays as it is: how many steps are searched, how feature points are found and their labels
    accumulated, and what a secondary peak is.
    """
    return replace(
        options, order="labels", min_label_share=0.0, max_sigma_steps=UNLIMITED_SIGMA_STEPS, stopped_share=1.0,
        min_images=1, max_images=MAX_IMAGES,
    )  # fmt: skip


@dataclass(frozen=True)
class SelectionArea:
    """A window of cells with everything that its points are matched from.

    window : finest cells; tile_views : their views, the reference image first; view_numbers : which views of the scene
    they are; ties : the feature points of the whole scene; initial : (r, c) float64 lattice indices, initial height of
    every cell; features : the feature points in the window, with the labels (n, i) of the search images; numbers : (n,)
    int64, which of `ties` these are; step_px : (i + 1,) float64, equivalent disparity of a height step in each view
    against the reference image.
    """

    window: CellWindow
    tile_views: TileViews
    view_numbers: tuple[int, ...]
    ties: GridTies
    initial: FloatArray
    features: FeaturePoints
    numbers: IntArray
    step_px: FloatArray

    @property
    def search(self) -> IntArray:
        """Numbers of the search images among the views of the area, (i,) int64."""
        return np.arange(1, len(self.view_numbers), dtype=np.int64)


def selection_area(match_scene: MatchScene, window: CellWindow, config: RunConfig) -> SelectionArea | None:
    """Read the views of a window of finest cells, and label its feature points.

    Every tie point of the match scene inside the window is a feature point. None where there is none in the whole
    scene, or where the reference image, or every search image, does not show the window.
    """
    ties = feature_points(match_scene)
    if not len(ties.xy) or not (window.rows and window.cols):
        return None
    half, reach = large_window_side(config.cost) // 2, config.selection.reach_steps + 1
    initial = initial_heights(ties, cell_middles(all_cells(window), window)).reshape(window.rows, window.cols)
    low, high = float(initial.min()), float(initial.max())
    inside = np.flatnonzero(ties.inside(window))
    if len(inside):
        low, high = min(low, ties.lattice_index[inside].min()), max(high, ties.lattice_index[inside].max())
    step, origin = match_scene.height_step, match_scene.height_origin
    z_range = (origin + (low - reach) * step, origin + (high + reach) * step)
    ground_xy = match_scene.points_of(window.at_level(0, half), 0)
    windows = {n: window_showing(view, ground_xy, z_range) for n, view in enumerate(match_scene.views)}
    numbers = tuple(number for number, view_window in windows.items() if view_window is not None)
    if REFERENCE not in numbers or len(numbers) < 2:
        return None
    view_pixels = [
        read_pixels(match_scene.views[n], view_window, match_scene.grey_scales[n])
        for n, view_window in windows.items()
        if view_window is not None
    ]
    shape = (window.rows, window.cols)
    cells = TileGrid(0, match_scene.transform(window, 0), shape, config.pyramid.block, origin, step)
    views = tile_views(view_pixels, cells, z_range, half, z_range)
    step_px = np.append(0.0, steps_px(views, REFERENCE, np.arange(1, len(numbers))))
    labels = feature_labels(views, window, ties, inside, step_px, config)
    features = FeaturePoints(ties.xy[inside], labels)
    return SelectionArea(window, views, numbers, ties, initial, features, inside, step_px)


def feature_points(match_scene: MatchScene) -> GridTies:
    """The tie points with a height, one in each cell: SIFT finds a point of two orientations twice."""
    ties = GridTies.of(match_scene)
    known = np.flatnonzero(np.isfinite(ties.lattice_index))
    _, first = np.unique(np.floor(ties.xy[known]), axis=0, return_index=True)
    kept = known[np.sort(first)]
    return GridTies(*(each[kept] for each in ties))


def all_cells(window: CellWindow) -> IntArray:
    """Row and column in the window of all its cells, (n, 2) int64, row by row."""
    row, col = np.indices((window.rows, window.cols), np.int64)
    return np.column_stack([row.ravel(), col.ravel()])


def cell_middles(cells: IntArray, window: CellWindow) -> FloatArray:
    """Column and row of the middles of cells on the lattice, (n, 2) float64. cells : (n, 2), in the window."""
    return np.asarray(cells[:, ::-1] + (window.col + 0.5, window.row + 0.5), np.float64)


def initial_heights(ties: GridTies, xy: FloatArray) -> FloatArray:
    """Initial heights around which points are searched, (c,) float64 lattice indices.

    They are interpolated between the three feature points around a point; outside the TIN the nearest one counts. xy :
    (c, 2) column and row.
    Source: Ji et al. 2014, the initial heights of figures 3 to 7. The paper does not say where these come from.
    """
    from scipy.spatial import cKDTree

    centre = ties.xy.mean(axis=0)
    tin, at = triangulated(ties.xy - centre), xy - centre
    nearest = cKDTree(ties.xy - centre).query(at)[1]
    heights = ties.lattice_index[nearest].astype(np.float64)
    if tin is None:
        return heights
    triangle = tin.find_simplex(at)
    inside = triangle >= 0
    to_weights = tin.transform[triangle[inside]]
    first_two = np.einsum("nij,nj->ni", to_weights[:, :2], at[inside] - to_weights[:, 2])
    weights = np.column_stack([first_two, 1.0 - first_two.sum(axis=1)])
    interpolated = (weights * ties.lattice_index[tin.simplices[triangle[inside]]]).sum(axis=1)
    # The corners of a triangle without area have no weights.
    heights[inside] = np.where(np.isfinite(interpolated), interpolated, heights[inside])
    return heights


def samples_of(cells: IntArray, initial: FloatArray, config: RunConfig) -> CurveSamples:
    """Cells with the heights of their match curves: `reach_steps` on both sides of the initial height, level windows.

    cells : (n, 2) row and column in the window; initial : (n,) lattice indices.
    """
    reach, side = config.selection.reach_steps, large_window_side(config.cost)
    level = np.zeros((len(cells), side * side), np.float32)
    return CurveSamples(np.ascontiguousarray(cells), initial - float(reach), 2 * reach + 1, level)


def feature_labels(
    tile_views: TileViews, window: CellWindow, ties: GridTies, numbers: IntArray, step_px: FloatArray, config: RunConfig
) -> NDArray[np.int8]:
    """Labels of the search images at feature points, (n, i) int8.

    numbers : (n,) which of the ties; step_px : (i + 1,), see `SelectionArea`.
    Source: Ji et al. 2014, section 2.2, steps 2 to 4, and table 1.
    """
    labels = np.zeros((len(numbers), len(step_px) - 1), np.int8)
    for first in range(0, len(numbers), CELLS_AT_ONCE):
        rows = numbers[first : first + CELLS_AT_ONCE]
        cells = np.floor(ties.xy[rows][:, ::-1]).astype(np.int64) - (window.row, window.col)
        samples = samples_of(cells, ties.lattice_index[rows], config)
        reference = samples.windows(tile_views, REFERENCE, slice(None))
        for view in range(1, len(step_px)):
            ncc = np.einsum("nhk,nhk->nh", reference, samples.windows(tile_views, view, slice(None)))
            of_view = curve_labels(ncc, float(step_px[view]), config.selection)
            labels[first : first + CELLS_AT_ONCE, view - 1] = of_view
    return labels


@dataclass(frozen=True)
class SelectedMatch:
    """Matched cells.

    initial : (n,) float64, lattice indices in the middle of their curves; progressive_match : their mean curves, labels
    and numbers of images; peaks : of the mean curves.
    """

    initial: FloatArray
    progressive_match: ProgressiveMatch
    peaks: CurvePeaks

    def lattice_index(self, reach_steps: int) -> FloatArray:
        """Lattice indices of the peaks, (n,) float64; NaN for cells without a curve."""
        found = self.initial - reach_steps + self.peaks.peak
        return np.where(np.isnan(self.peaks.rho1), np.nan, found)


def match_cells(area: SelectionArea, cells: IntArray, config: RunConfig) -> SelectedMatch:
    """Match cells, each with as few of the search images as its mean curve needs.

    cells : (n, 2) int64, row and column in the area's window, at most a few thousand, because all windows of the
    reference image are in memory.
    Source: Ji et al. 2014, section 3.3.
    """
    options = options_of_paper(config.selection)
    xy = cell_middles(cells, area.window)
    initial = area.initial[cells[:, 0], cells[:, 1]]
    samples = samples_of(cells, initial, config)
    reference = samples.windows(area.tile_views, REFERENCE, slice(None))

    def correlate(rows: IntArray, views: IntArray) -> NDArray[np.floating]:
        ncc = np.empty((len(rows), samples.n_heights), np.float64)
        for view in np.unique(views).tolist():
            of_view = np.flatnonzero(views == view)
            shown = samples.windows(area.tile_views, view, rows[of_view])
            ncc[of_view] = np.einsum("nhk,nhk->nh", reference[rows[of_view]], shown)
        return ncc

    order = order_images(area.features, xy, options).images + 1
    plan = SearchPlan.by_cell(order, np.ones((len(cells), len(area.view_numbers)), bool), area.step_px)
    progressive_match = match_progressively(correlate, samples.n_heights, plan, options)
    widest_px = np.maximum.accumulate(area.step_px[order], axis=1)
    n_added = np.maximum(progressive_match.n_added, 1)[:, None] - 1
    step_px = np.take_along_axis(widest_px, n_added, axis=1)[:, 0]
    return SelectedMatch(initial, progressive_match, curve_peaks(progressive_match.mean_ncc, step_px, options))


def point_curves_of_paper(area: SelectionArea, cell: tuple[int, int], initial: float, config: RunConfig) -> PointCurves:
    """Match curves of one cell with all search images, their order, and after how many of them it stops.

    cell : row and column of the lattice; initial : lattice index in the middle of the curves. Search images that do not
    show the cell keep their place in the order.
    """
    options = options_of_paper(config.selection)
    order = point_order_of_paper(area, np.array(cell[::-1]) + 0.5, options)
    return _curves_in_order(area, cell, initial, order, config)


def feature_curves(area: SelectionArea, feature: int, config: RunConfig) -> PointCurves:
    """Match curves of one feature point with all search images, these in the order of the area.

    feature : number of the point among `SelectionArea.features`. The labels of the single curves are those by which
    images are ordered.
    """
    xy, labels = area.features.xy[feature], area.features.labels[feature]
    alone = PointOrder(
        reference=REFERENCE, search=area.search, accumulated=labels.astype(np.int64),
        is_helpful=np.ones(len(labels), bool), order_source=OrderSource.NEIGHBOURS, features=np.array([feature]),
        xy=xy[None], distance=np.zeros(1), labels=labels[None],
    )  # fmt: skip
    col, row = np.floor(xy).astype(int).tolist()
    return _curves_in_order(area, (row, col), float(area.ties.lattice_index[area.numbers[feature]]), alone, config)


def _curves_in_order(
    area: SelectionArea, cell: tuple[int, int], initial: float, order: PointOrder, config: RunConfig
) -> PointCurves:
    """See `point_curves_of_paper`; with the search images in a given order."""
    side, reach = large_window_side(config.cost), config.selection.reach_steps
    windows = cell_windows(area.tile_views, area.window, cell, initial, side, reach)
    along = initial + np.arange(-reach, reach + 1, dtype=np.float64)
    return point_curves(windows, order, area.step_px[order.search], along, options_of_paper(config.selection))


def point_order_of_paper(area: SelectionArea, xy: FloatArray, options: SelectionOptions) -> PointOrder:
    """The search images of one point, best first, with the feature points that the order rests on.

    xy : (2,) column and row of the lattice.
    Source: Ji et al. 2014, section 3.3, steps 1 and 2, and table 4.
    """
    found = order_images(area.features, xy[None], options)
    images = found.images[0]
    features = NeighbourSearch(area.features.xy, options).of(xy[None]).index
    return PointOrder(
        reference=REFERENCE,
        search=images + 1,
        accumulated=found.accumulated[0][images],
        is_helpful=np.ones(len(images), bool),
        order_source=OrderSource(int(found.order_source[0])),
        features=features,
        xy=area.features.xy[features],
        distance=np.hypot(*(area.features.xy[features] - xy).T),
        labels=area.features.labels[features][:, images],
    )
