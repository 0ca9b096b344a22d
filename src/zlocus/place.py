"""One place on the ground: which views show it, and its match curves with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.errors import GeometryError
from zlocus.matching.cells import CellWindow
from zlocus.matching.order import Evidence
from zlocus.matching.point import IntArray, PointCurves, cell_windows, point_curves, point_order, steps_px
from zlocus.matching.selection import Ranking, preselected, rank_views
from zlocus.matching.setup import MatchScene
from zlocus.matching.views import TileViews, pixel_window, read_pixels, tile_views
from zlocus.options import RunConfig, SelectionOptions
from zlocus.scene import View
from zlocus.sensors.model import FloatArray

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


def cell_of(xy: FloatArray, settled: MatchScene) -> tuple[int, int]:
    """Row and column of the finest lattice's cell that holds a ground point."""
    col, row = (xy - settled.anchor) * (1.0, -1.0) / settled.cell_m
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


def check_shown(asked: str, reference: str | None, xyz: FloatArray, names: Sequence[str], settled: MatchScene) -> None:
    """Refuse a point that fewer than two views show, or a reference that is not among them.

    asked : the point as it was asked for, for messages.
    """
    what = f"{asked} (E {xyz[0]:.1f}, N {xyz[1]:.1f}, height {xyz[2]:.1f} m)"
    if len(names) < 2:
        west, north = settled.transform(settled.seen, 0) * (0, 0)
        east, south = settled.transform(settled.seen, 0) * (settled.seen.cols, settled.seen.rows)
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
    settled: MatchScene,
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
    names = [view.name for view in settled.views if shows(view, place.xyz)]
    check_shown(asked, reference, place.xyz, names, settled)
    options, side = config.selection, config.measure.large_window
    index = (place.xyz[2] - settled.origin_m) / settled.step_m
    radius, at = options.radius_px, np.array(place.cell[::-1]) + 0.5
    near = () if options.neighbours == "tin" else ((radius, Evidence.NEIGHBOURS),)
    for around, enough in (*near, (options.widest * radius, Evidence.NEAREST), (farthest, Evidence.SCENE)):
        halo = min(math.ceil(around), farthest)
        window = CellWindow(*place.cell, 1, 1).at_level(0, halo).within(settled.seen)
        if not (window.rows and window.cols):
            check_shown(asked, reference, place.xyz, [], settled)
        numbers, views = views_of(settled, window, place, config)
        windows = cell_windows(views, window, place.cell, index, side, options.reach_steps)
        kept = np.flatnonzero(~np.isnan(windows[:, options.reach_steps, 0]))
        compared = tuple(settled.views[numbers[i]] for i in kept)
        check_shown(asked, reference, place.xyz, [view.name for view in compared], settled)
        ranking = ranked(settled, views, window, config)
        ranking = replace(ranking, labels=ranking.labels[:, kept][:, :, kept])
        order = point_order(ranking, references(reference, compared), at, options)
        if order.evidence <= enough:
            break
    step_px = steps_px(views, int(kept[order.reference]), kept[order.search])
    along = index + np.arange(-options.reach_steps, options.reach_steps + 1)
    curves = point_curves(windows[kept], order, step_px, along, options)
    heights_m = settled.origin_m + along * settled.step_m
    return LookedAt(place, compared, curves, index, heights_m, views, window, kept)


def references(reference: str | None, views: Sequence[View]) -> FloatArray:
    """1 for every view that may be the reference, (i,) float64."""
    return np.array([float(reference in (None, view.name)) for view in views])


def views_of(settled: MatchScene, window: CellWindow, place: Place, config: RunConfig) -> tuple[list[int], TileViews]:
    """The views worth comparing at the place, by number, and what they show of a window of cells around it."""
    z = heights_around(settled, window, place, config.selection)
    transform = settled.transform(window, 0)
    across, down = np.linspace(0, window.cols, 5), np.linspace(0, window.rows, 5)
    corners = np.array([transform * (c, r) for c in across for r in down])
    numbers, found = [], []
    which = [number for number, view in enumerate(settled.views) if shows(view, place.xyz)]
    if len(which) > config.selection.candidates + 1:
        shown = [settled.views[number] for number in which]
        rows = preselected(shown, place.middle[None], float(place.xyz[2]), config.selection)
        which = [which[row] for row in rows]
    for number in which:
        part = pixel_window(settled.views[number], corners, z, 1)
        if part is not None:
            numbers.append(number)
            found.append(read_pixels(settled.views[number], part, 1, settled.grey[number]))
    shape, lattice = (window.rows, window.cols), (settled.origin_m, settled.step_m)
    half = config.measure.large_window // 2
    return numbers, tile_views(found, 0, transform, shape, config.pyramid.block, lattice, z, half)


def heights_around(
    settled: MatchScene, window: CellWindow, place: Place, options: SelectionOptions
) -> tuple[float, float]:
    """Between which heights, m, curves of the place and of the tie points in a window are looked at: of a scene's whole
    range projections would be tabulated several times as long."""
    xy = ties_on_cells(settled)
    first, size = np.array([window.col, window.row]), np.array([window.cols, window.rows])
    inside = ((xy >= first) & (xy < first + size)).all(axis=1) & np.isfinite(settled.ties[:, 2])
    heights = np.append(settled.ties[inside, 2], place.xyz[2])
    reach = (options.reach_steps + 1) * settled.step_m
    return float(heights.min()) - reach, float(heights.max()) + reach


def ties_on_cells(settled: MatchScene) -> FloatArray:
    """Columns and rows of the finest lattice where the tie points lie, (n, 2)."""
    return np.asarray((settled.ties[:, :2] - settled.anchor) * (1.0, -1.0) / settled.cell_m)


def ranked(settled: MatchScene, views: TileViews, window: CellWindow, config: RunConfig) -> Ranking:
    """Labels of all pairs of views at the tie points of a window, on level ground."""
    xy = ties_on_cells(settled)
    index = (settled.ties[:, 2] - settled.origin_m) / settled.step_m
    side, steps_per_cell, flat = config.measure.large_window, settled.cell_m / settled.step_m, np.zeros((len(xy), 2))
    return rank_views(views, window, xy, index, flat, side, steps_per_cell, config.selection)
