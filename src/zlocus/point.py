"""The order of a point's run: scene, orientation, the place on the ground, its match curves, and how they are shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.errors import ConfigError, GeometryError
from zlocus.io.scene_file import open_scene
from zlocus.matching.cells import CellWindow
from zlocus.matching.order import Evidence
from zlocus.matching.point import PointCurves, cell_windows, point_curves, point_order, steps_px
from zlocus.matching.selection import Ranking, preselected, rank_views
from zlocus.matching.setup import MatchScene, check_resolution, median_ground_pixel, settle
from zlocus.matching.views import TileViews, pixel_window, read_pixels, tile_views
from zlocus.options import RunConfig
from zlocus.orientation.orient import supported
from zlocus.preparing import asked_crs, heights_of_ties, made_folder, oriented, possible_heights, what_was_applied
from zlocus.products.curves import Locus, PointReport, point_text, write_point
from zlocus.progress import Progress
from zlocus.request import CurvesRequest
from zlocus.scene import Scene, View, check_overlap
from zlocus.sensors.model import FloatArray

NEAREST_TIES = 5
ROUNDS, SETTLED_M = 20, 0.01
# Cells around a point in which tie points order its images where none is nearer.
FARTHEST = 2048
# Pixels around a locus that are shown.
CROP_MARGIN_PX, LEAST_CROP_PX = 12, 48


@dataclass(frozen=True)
class Place:
    """xyz : (3,) m, the point asked for, at the height about which it is matched; height_from : what tells it; cell :
    row and column of the finest lattice; middle : (2,) m, of the cell."""

    xyz: FloatArray
    height_from: str
    cell: tuple[int, int]
    middle: FloatArray


def run_point(request: CurvesRequest, config: RunConfig, progress: Progress) -> str:
    """What is to be said of a point; figures and tables are written to `request.out`.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used, and a point that fewer than two images show.
    """
    with progress.stage("Opening images"):
        scene = open_scene(request.inputs, asked_crs(request.crs))
        scene = replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))
        check_views(request, scene)
        heights = request.heights or scene.heights
        check_overlap(scene, possible_heights(scene, heights))
    orientation = oriented(scene, config.orientation, heights, progress)
    progress.note(what_was_applied(orientation))
    ready = orientation.apply(scene)
    z_range = heights or heights_of_ties(ready, orientation, config.orientation)
    z = sum(z_range) / 2
    cell_m = request.resolution or float(f"{median_ground_pixel(ready, z):.2g}")
    check_resolution(cell_m, ready, z, "--resolution")
    settled = settle(
        ready, cell_m, (0.0, 0.0), z_range, orientation.xyz, request.reference, config.pyramid, orientation.measured
    )
    ties = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    place = located(request, settled, ties)
    check_shown(request, place.xyz, [view.name for view in settled.views if shows(view, place.xyz)], settled)
    with progress.stage("Match curves"):
        views, curves, heights_m = curves_at(request, settled, place, config)
    report = PointReport(
        asked=asked(request), crs=scene.crs.to_string().splitlines()[0], xyz=place.xyz, height_from=place.height_from,
        middle=place.middle, cell_m=cell_m, names=tuple(view.name for view in views),
        left_out=tuple(v.name for v in settled.views if v not in views), heights_m=heights_m, curves=curves,
        peak_m=settled.origin_m + curves.peak_index * settled.step_m, step_m=settled.step_m,
    )  # fmt: skip
    with made_folder(request.out), progress.stage("Drawing"):
        write_point(request.out, report, loci(views, report), config.selection)
    return point_text(report, config.selection)


def asked(request: CurvesRequest) -> str:
    """The point as it was asked for."""
    if request.at is not None:
        return f"--at {request.at[0]:.12g} {request.at[1]:.12g}"
    assert request.pixel is not None
    return f"--pixel {request.pixel[0]} {request.pixel[1]:g} {request.pixel[2]:g}"


def check_views(request: CurvesRequest, scene: Scene) -> None:
    """Refuse views that are not there, and pixels that their view does not have."""
    names = [view.name for view in scene.views]
    if request.reference is not None and request.reference not in names:
        raise ConfigError(
            f"--reference {request.reference} is not a view of this scene. Choose one of {', '.join(names)}."
        )
    if request.pixel is None:
        return
    name, row, col = request.pixel
    if name not in names:
        raise ConfigError(f"--pixel {name}: no view of this scene has that name. Choose one of {', '.join(names)}.")
    rows, cols = scene.views[names.index(name)].image.shape
    if not (-0.5 <= row <= rows - 0.5 and -0.5 <= col <= cols - 0.5):
        raise GeometryError(
            f"--pixel {name} {row:g} {col:g} lies outside the image, which has {rows} rows and {cols} columns. Give "
            f"ROW from 0 to {rows - 1} and COL from 0 to {cols - 1}."
        )


def located(request: CurvesRequest, settled: MatchScene, ties: FloatArray) -> Place:
    """The point on the ground, at the height asked for, else at that of the ties around it. ties : (n, 3) m.

    Raises
    ------
    GeometryError
        A pixel whose ray does not meet the ground, or a height that no tie tells.
    """
    if request.height is None and not len(ties):
        raise GeometryError(f"No tie point tells the height of {asked(request)}. Give it with --height Z.")
    if request.at is not None:
        xy = np.array(request.at)
        z = height_nearby(xy, ties) if request.height is None else request.height
    else:
        xy, z = pixel_on_ground(request, settled, ties)
    source = "as asked for"
    if request.height is None:
        away = float(np.hypot(*(ties[:, :2] - xy).T).min())
        n_ties = min(NEAREST_TIES, len(ties))
        source = f"the median of the {n_ties} nearest tie points, of which the first is {away:.1f} m away"
    cell = cell_of(xy, settled)
    middle = np.array(settled.transform(CellWindow(*cell, 1, 1), 0) * (0.5, 0.5))
    return Place(np.array([*xy, z]), source, cell, middle)


def cell_of(xy: FloatArray, settled: MatchScene) -> tuple[int, int]:
    """Row and column of the finest lattice's cell that holds a ground point."""
    col, row = (xy - settled.anchor) * (1.0, -1.0) / settled.cell_m
    return math.floor(row), math.floor(col)


def pixel_on_ground(request: CurvesRequest, settled: MatchScene, ties: FloatArray) -> tuple[FloatArray, float]:
    """Where a pixel meets the ground, (2,) m and its height: of the ties around the place, which the height moves."""
    assert request.pixel is not None
    name, row, col = request.pixel
    (sensor,) = (view.sensor for view in settled.views if view.name == name)
    z = float(np.median(ties[:, 2])) if request.height is None else request.height
    seen: list[float] = []
    while True:
        xy = sensor.ground_from_image(np.array([[col, row]]), np.array([z]))[0, :2]
        if not np.isfinite(xy).all():
            raise GeometryError(
                f"--pixel {name} {row:g} {col:g} does not meet the ground at {z:.1f} m. Give another --height."
            )
        if request.height is not None or len(seen) >= ROUNDS or any(abs(z - old) < SETTLED_M for old in seen):
            return xy, z
        seen.append(z)
        z = height_nearby(xy, ties)


def height_nearby(xy: FloatArray, ties: FloatArray) -> float:
    """Median height of the ties (n, 3) nearest to a place (2,), m."""
    away = np.hypot(*(ties[:, :2] - xy).T)
    return float(np.median(ties[np.argsort(away, kind="stable")[:NEAREST_TIES], 2]))


def shows(view: View, xyz: FloatArray) -> bool:
    """Whether a ground point (3,) lies inside an image."""
    col, row = view.sensor.image_from_ground(xyz[None])[0]
    rows, cols = view.image.shape
    return bool(0 <= row <= rows - 1 and 0 <= col <= cols - 1)


def check_shown(request: CurvesRequest, xyz: FloatArray, names: Sequence[str], settled: MatchScene) -> None:
    """Refuse a point that fewer than two views show, or a reference that is not among them."""
    what = f"{asked(request)} (E {xyz[0]:.1f}, N {xyz[1]:.1f}, height {xyz[2]:.1f} m)"
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
    if request.reference is not None and request.reference not in names:
        raise GeometryError(f"{what} is not shown by --reference {request.reference}. Choose from {', '.join(names)}.")


def curves_at(
    request: CurvesRequest, settled: MatchScene, place: Place, config: RunConfig
) -> tuple[tuple[View, ...], PointCurves, FloatArray]:
    """The views that show the place, its match curves with them, and their heights (h,) m.

    Tie points are looked for farther and farther away, as far as the rules of the order reach.
    """
    options, side = config.selection, config.measure.large_window
    index = (place.xyz[2] - settled.origin_m) / settled.step_m
    radius, at = options.radius_px, np.array(place.cell[::-1]) + 0.5
    near = () if options.neighbours == "tin" else ((radius, Evidence.NEIGHBOURS),)
    for around, enough in (*near, (options.widest * radius, Evidence.NEAREST), (FARTHEST, Evidence.SCENE)):
        halo = min(math.ceil(around), FARTHEST)
        window = CellWindow(*place.cell, 1, 1).at_level(0, halo).within(settled.seen)
        if not (window.rows and window.cols):
            check_shown(request, place.xyz, [], settled)
        numbers, views = views_of(settled, window, place, config)
        windows = cell_windows(views, window, place.cell, index, side, options.reach_steps)
        kept = np.flatnonzero(~np.isnan(windows[:, options.reach_steps, 0]))
        check_shown(request, place.xyz, [settled.views[numbers[i]].name for i in kept], settled)
        ranking = ranked(settled, views, window, config)
        ranking = replace(ranking, labels=ranking.labels[:, kept][:, :, kept])
        order = point_order(ranking, references(request, [settled.views[numbers[i]] for i in kept]), at, options)
        if order.evidence <= enough:
            break
    step_px = steps_px(views, int(kept[order.reference]), kept[order.search])
    along = index + np.arange(-options.reach_steps, options.reach_steps + 1)
    curves = point_curves(windows[kept], order, step_px, along, options)
    return tuple(settled.views[numbers[i]] for i in kept), curves, settled.origin_m + along * settled.step_m


def references(request: CurvesRequest, views: Sequence[View]) -> FloatArray:
    """1 for every view that may be the reference, (i,) float64."""
    return np.array([float(request.reference in (None, view.name)) for view in views])


def views_of(settled: MatchScene, window: CellWindow, place: Place, config: RunConfig) -> tuple[list[int], TileViews]:
    """The views worth comparing at the place, by number, and what they show of a window of cells around it."""
    reach = config.selection.reach_steps * settled.step_m
    z = (
        min(settled.origin_m, place.xyz[2]) - reach,
        max(settled.origin_m + settled.n_steps * settled.step_m, place.xyz[2]) + reach,
    )
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


def ranked(settled: MatchScene, views: TileViews, window: CellWindow, config: RunConfig) -> Ranking:
    """Labels of all pairs of views at the tie points of a window, on level ground."""
    xy = (settled.ties[:, :2] - settled.anchor) * (1.0, -1.0) / settled.cell_m
    index = (settled.ties[:, 2] - settled.origin_m) / settled.step_m
    side, steps_per_cell, flat = config.measure.large_window, settled.cell_m / settled.step_m, np.zeros((len(xy), 2))
    return rank_views(views, window, xy, index, flat, side, steps_per_cell, config.selection)


def loci(views: Sequence[View], report: PointReport) -> list[Locus]:
    """The vertical line in every image, the reference first, then the others in their order."""
    order, found = report.curves.order, []
    peak_m = report.peak_m if math.isfinite(report.peak_m) else float(report.xyz[2])
    heights = np.concatenate([report.heights_m, [report.xyz[2], peak_m]])
    xyz = np.column_stack([np.broadcast_to(report.middle, (len(heights), 2)), heights])
    for i in (order.reference, *order.search.tolist()):
        xy = views[i].sensor.image_from_ground(xyz)
        row, col, pixels, valid = crop(views[i], xy[np.isfinite(xy).all(axis=1)])
        grey = np.where(valid, pixels, np.float32(np.nan))
        found.append(Locus(views[i].name, (row, col), grey, xy[:-2], xy[-2], xy[-1]))
    return found


def crop(view: View, xy: FloatArray) -> tuple[int, int, NDArray[np.float32], NDArray[np.bool_]]:
    """The square around image points (n, 2) px: its first row and column, pixels and which of them are valid."""
    shape, centre = np.array(view.image.shape), (xy.min(axis=0) + xy.max(axis=0))[::-1] / 2
    side = max(float(np.ptp(xy, axis=0).max()) + 2 * CROP_MARGIN_PX, LEAST_CROP_PX)
    first = np.clip(np.floor(centre - side / 2), 0, shape - 1).astype(int)
    last = np.clip(np.ceil(centre + side / 2), first + 1, shape).astype(int)
    read = view.image.read(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))
    return int(first[0]), int(first[1]), read.pixels, read.valid
