"""Labels of all pairs of views at the tie points in and around a tile: how well each view matches each other one there.

A label is the verdict on a match curve (Ji et al. 2014, table 1; see `zlocus.matching.match_curve`). The labels order
the views (`zlocus.matching.view_ranking`) and are written as `ranking.gpkg`. Heights here are lattice indices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.level_records import LevelResult, TileInputs
from zlocus.matching.locus_windows import CurveSamples
from zlocus.matching.match_curve import GOOD, POOR, curve_labels
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.subpixel import smoothed
from zlocus.matching.tile_views import TileGrid, TileViews, tile_views
from zlocus.matching.view_directions import cells_per_step

IntArray = NDArray[np.int64]
# Stands where there is no label: an image with itself, or one that was not compared. It becomes NULL in tables.
NOT_RANKED = -128


@dataclass(frozen=True)
class PairLabels:
    """Labels of all pairs of a tile's views.

    tie : (n,) int64, numbers of the tie points; xy : (n, 2) float64, columns and rows of the finest level's cells where
    they lie; labels : (n, i, i) int8, of search image (last axis) against reference, POOR of a view with itself;
    angle_deg : (i, i) float64 degrees, between the rays of two views at the tile's centre; evaluations : points x
    heights x views that were sampled.
    """

    tie: IntArray
    xy: FloatArray
    labels: NDArray[np.int8]
    angle_deg: FloatArray
    evaluations: int = 0


@dataclass(frozen=True)
class TileLabels:
    """Pair labels of a tile, and which views of the scene are compared: `view_numbers`, in the order of the labels."""

    pair_labels: PairLabels
    view_numbers: Sequence[int]


class GridTies(NamedTuple):
    """Tie points on the finest level's cells.

    xy : (n, 2) float64, column and row; lattice_index : (n,) float64, height; slope : (n, 2) float64, of the ground
    there, steps per cell down and across.
    """

    xy: FloatArray
    lattice_index: FloatArray
    slope: FloatArray

    @classmethod
    def of(cls, match_scene: MatchScene, slope: FloatArray | None = None) -> GridTies:
        """All tie points of a scene, by default on level ground."""
        ties = match_scene.ties
        xy = (ties[:, :2] - match_scene.anchor) * (1.0, -1.0) / match_scene.cell_size
        lattice_index = (ties[:, 2] - match_scene.height_origin) / match_scene.height_step
        return cls(xy, lattice_index, np.zeros((len(xy), 2)) if slope is None else slope)

    def inside(self, window: CellWindow) -> NDArray[np.bool_]:
        """Which tie points lie in a window of finest cells, (n,) bool."""
        first, end = (window.col, window.row), (window.col + window.cols, window.row + window.rows)
        return np.asarray(((self.xy >= first) & (self.xy < end)).all(axis=1))


def label_pairs_at_ties(tile: TileInputs, coarsest_result: LevelResult | None) -> PairLabels:
    """Labels of all pairs of a tile's views at the tie points in and around its core.

    coarsest_result : the coarsest level, whose slopes the correlation windows follow; None where it is not matched yet,
    then the windows are level.
    """
    match_scene, config = tile.match_scene, tile.config
    window = tile.core_window.at_level(0, math.ceil(config.selection.radius_px)).within(match_scene.overlap_window)
    ties = GridTies.of(match_scene)
    if coarsest_result is not None:
        ties = ties._replace(slope=slope_at(coarsest_result, ties.xy, config))
    views = _views_around_ties(tile, window, ties)
    steps_per_cell = match_scene.cell_size / match_scene.height_step
    return label_pairs(views, window, ties, large_window_side(config.cost), steps_per_cell, config.selection)


def slope_at(result: LevelResult, xy: FloatArray, config: RunConfig) -> FloatArray:
    """Slope of a level's surface at places, (n, 2) steps per cell down and across, the same number at every level.

    xy : (n, 2) column and row of finest cells.
    """
    surface, level = smoothed(result.heights.vertex, config.refine.jump_steps), result.level
    cell = np.floor(xy[:, ::-1] / 2**level.number).astype(np.int64)
    row, col = np.clip(cell - (level.window.row, level.window.col), 1, np.subtract(surface.shape, 2)).T
    by_axis = [(surface[row + i, col + j] - surface[row - i, col - j]) / 2 for i, j in ((1, 0), (0, 1))]
    return np.stack(by_axis, axis=1)


def _views_around_ties(tile: TileInputs, window: CellWindow, ties: GridTies) -> TileViews:
    """A tile's views over a window of finest cells, at all heights of match curves at the tie points in it."""
    match_scene, config = tile.match_scene, tile.config
    reach = config.selection.reach_steps * match_scene.height_step
    z_range = (
        match_scene.height_origin - reach,
        match_scene.height_origin + match_scene.n_steps * match_scene.height_step + reach,
    )
    z = match_scene.ties[ties.inside(window), 2]
    z = z[np.isfinite(z)]
    z_reachable = (float(z.min()) - reach, float(z.max()) + reach) if len(z) else None
    cells = TileGrid(
        0, match_scene.transform(window, 0), (window.rows, window.cols), config.pyramid.block,
        match_scene.height_origin, match_scene.height_step,
    )  # fmt: skip
    view_pixels = tile.read(window, 0, z_reachable or z_range)
    return tile_views(view_pixels, cells, z_range, large_window_side(config.cost) // 2, z_reachable)


def label_pairs(
    tile_views: TileViews,
    window: CellWindow,
    ties: GridTies,
    side: int,
    steps_per_cell: float,
    options: SelectionOptions,
) -> PairLabels:
    """Labels of all pairs of views at tie points.

    tile_views : of the finest level's cells `window`; side : cells along the side of the correlation window;
    steps_per_cell : side of a cell in height steps. In each square of `feature_cells` cells only the northernmost tie
    point counts.
    """
    rows = _one_tie_per_square(window, ties, options)
    cells = np.floor(ties.xy[rows][:, ::-1]).astype(np.int64) - (window.row, window.col)
    offsets = np.stack([v.ravel() for v in np.indices((side, side)) - side // 2]).astype(float)
    samples = CurveSamples(
        np.ascontiguousarray(cells), ties.lattice_index[rows] - options.reach_steps, 2 * options.reach_steps + 1,
        np.ascontiguousarray(ties.slope[rows] @ offsets, np.float32),
    )  # fmt: skip
    n_views = len(tile_views.layout)
    labels = np.full((len(rows), n_views, n_views), POOR, np.int8)
    windows = [samples.windows(tile_views, view, slice(None)) for view in range(n_views)]
    per_step = np.array([cells_per_step(tile_views, view) for view in range(n_views)])
    step_px = np.hypot(*np.moveaxis(per_step[:, None] - per_step[None], -1, 0))
    for i in range(n_views):
        for j in range(i):
            curves = np.einsum("nhk,nhk->nh", windows[i], windows[j])
            labels[:, i, j] = labels[:, j, i] = curve_labels(curves, float(step_px[i, j]), options)
    angle_deg = np.degrees(np.arctan(step_px * steps_per_cell))
    return PairLabels(rows, ties.xy[rows], labels, angle_deg, len(rows) * n_views * samples.n_heights)


def _one_tie_per_square(window: CellWindow, ties: GridTies, options: SelectionOptions) -> IntArray:
    """Numbers of the northernmost tie points of all squares of `feature_cells` cells in a window, ascending."""
    square = np.floor(ties.xy / options.feature_cells).astype(np.int64)
    candidates = np.flatnonzero(ties.inside(window) & np.isfinite(ties.lattice_index))
    candidates = candidates[np.lexsort((ties.xy[candidates, 0], ties.xy[candidates, 1]))]
    _, first_of_square = np.unique(square[candidates], axis=0, return_index=True)
    return candidates[np.sort(first_of_square)]


@dataclass(frozen=True)
class LabelledTies:
    """Tie points of one tile with the labels of its views, as tables take them.

    xyz : (n, 3) m; labels : (n, k, k) int8, of search image (last axis) against reference; views : (k,) int64, which of
    the scene's views they are.
    """

    xyz: FloatArray
    labels: NDArray[np.int8]
    views: NDArray[np.int64]

    @classmethod
    def of(cls, tile_labels: TileLabels, ties: FloatArray, core_window: CellWindow) -> LabelledTies:
        """The tie points inside a tile's core, so that no point of two tiles counts twice. ties : (n, 3) m, all."""
        pair_labels = tile_labels.pair_labels
        first, size = np.array([core_window.col, core_window.row]), np.array([core_window.cols, core_window.rows])
        inside = ((pair_labels.xy >= first) & (pair_labels.xy < first + size)).all(axis=1)
        view_numbers = np.array(tile_labels.view_numbers, np.int64)
        return cls(ties[pair_labels.tie[inside]], pair_labels.labels[inside], view_numbers)

    def rows(self, n_views: int) -> LabelRows:
        """A row for each point and reference, with a column of labels for every view of the scene, (m, n_views);
        `NOT_RANKED` where the view is the reference or was not compared."""
        n, k = self.labels.shape[:2]
        labels = np.full((n, k, n_views), NOT_RANKED, np.int16)
        labels[:, :, self.views] = self._of_others()
        return self._rows(labels.reshape(n * k, n_views))

    def texts(self, names: Sequence[str]) -> LabelRows:
        """The same for scenes of very many views: the labels of a row are one text, NAME=LABEL of each view that was
        compared, separated by commas. names : of the scene's views; a comma in a name becomes a blank."""
        own_names = [names[number].replace(",", " ") for number in self.views]
        labels = self._of_others().reshape(-1, len(own_names)).tolist()
        texts = [
            ",".join(f"{name}={label}" for name, label in zip(own_names, row, strict=True) if label != NOT_RANKED)
            for row in labels
        ]
        return self._rows(np.array(texts, dtype=object))

    def _of_others(self) -> NDArray[np.int8]:
        """Labels (n, k, k) with `NOT_RANKED` for a view with itself."""
        labels, itself = self.labels.copy(), np.arange(len(self.views))
        labels[:, itself, itself] = NOT_RANKED
        return labels

    def _rows(self, labels: NDArray[np.int16] | NDArray[np.object_]) -> LabelRows:
        """A row for each point and reference with these labels."""
        n, k = self.labels.shape[:2]
        n_good = (self._of_others() == GOOD).sum(axis=2).astype(np.int32)
        return LabelRows(np.repeat(self.xyz, k, axis=0), np.tile(self.views, n), n_good.reshape(n * k), labels)


class LabelRows(NamedTuple):
    """Rows of a table of labels, one for each tie point and reference image.

    xyz : (m, 3) m; reference : (m,) int64, number of the view; n_good : (m,) int32, how many of its labels are good;
    labels : (m, i) int16, or (m,) texts.
    """

    xyz: FloatArray
    reference: NDArray[np.int64]
    n_good: NDArray[np.int32]
    labels: NDArray[np.int16] | NDArray[np.object_]
