"""The points of `zlocus paper`: the space in which they are matched, the point P0, and many points for figure 7."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pyproj import CRS

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.paper_request import PaperRequest
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.image_space import ImageSpace
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.pair_labels import GridTies
from zlocus.matching.point_match import PointCurves, cell_of
from zlocus.matching.stereo_selection import (
    SelectionArea,
    feature_curves,
    initial_heights,
    point_curves_of_paper,
    selection_area,
)
from zlocus.pipeline.image_scenes import reference_scene
from zlocus.pipeline.setup import RunSetup, reference_features, supported_views
from zlocus.products.paper_figures import ComparedPoint, PaperPoint
from zlocus.products.point_report import PointReport, loci_through

# Points are looked for on a grid of so many cells, within an area of at most so many cells around the middle.
CANDIDATE_SPACING, AREA_CELLS = 10, 1024
# The paper's circle holds three feature points.
N_FEATURES = 3
# The radius that reaches a feature point is this much longer than its distance, because of rounding.
REACHES = 1.0 + 1e-9
IN_IMAGE = "The ray of the reference image"
ON_GROUND = "The vertical line"


@dataclass(frozen=True)
class PaperSpace:
    """The cells in which points are matched, on the ground or in the reference image.

    match_scene : whose tie points are the feature points of the reference image; views : with the cameras of the
    ground, in the order of its views; image_space : None on the ground; features : (n, 3) m, the same feature points on
    the ground.
    """

    match_scene: MatchScene
    views: tuple[View, ...]
    image_space: ImageSpace | None
    features: FloatArray
    crs: CRS

    def points(self, cell: tuple[int, int], lattice_index: FloatArray) -> FloatArray:
        """Ground points (h, 3) m of the middle of a cell at lattice indices (h,), along what its heights follow."""
        (col, row), match_scene = np.array(cell[::-1]) + 0.5, self.match_scene
        z = match_scene.height_origin + lattice_index * match_scene.height_step
        x = match_scene.anchor[0] + col * match_scene.cell_size
        y = match_scene.anchor[1] - row * match_scene.cell_size
        if self.image_space is None:
            return np.column_stack([np.full(len(z), x), np.full(len(z), y), z])
        return self.image_space.rays.ground(np.broadcast_to([[x, -y]], (len(z), 2)), z)

    def cell_of_ground(self, xy: FloatArray) -> tuple[int, int]:
        """The cell that holds a ground point (2,) m, in image space at the height of the feature points around it."""
        if self.image_space is None:
            return cell_of(xy, self.match_scene)
        z = initial_heights(_ties(self.features[:, :2], self.features[:, 2]), xy[None])
        col, row = self.image_space.reference_view.sensor.image_from_ground(np.array([[*xy, z[0]]]))[0]
        return _whole(row), _whole(col)

    def cell_of_pixel(self, row: float, col: float) -> tuple[int, int]:
        """The cell that a pixel of the reference image shows, at the height of the feature points around it."""
        if self.image_space is not None:
            return _whole(row), _whole(col)
        sensor, at = self.views[0].sensor, np.array([[col, row]])
        z = initial_heights(_ties(sensor.image_from_ground(self.features), self.features[:, 2]), at)
        return cell_of(sensor.ground_from_image(at, z)[0, :2], self.match_scene)


def _ties(xy: FloatArray, z: FloatArray) -> GridTies:
    return GridTies(xy, z, np.zeros((len(xy), 2)))


def _whole(value: float) -> int:
    """The nearest whole number; -1, which lies outside every image, where the value is not finite."""
    return int(np.rint(value)) if np.isfinite(value) else -1


def paper_space(setup: RunSetup, request: PaperRequest, config: RunConfig) -> PaperSpace:
    """The space that is asked for, with the feature points of the reference image.

    Raises
    ------
    GeometryError
        The reference image has no feature points.
    """
    name, scene = setup.match_scene.views[0].name, supported_views(setup.scene, setup.orientation)
    features = reference_features(setup)
    if len(features) < N_FEATURES:
        raise GeometryError(
            f"{name} has {len(features)} feature points, and {N_FEATURES} are needed. Name another image with "
            "--reference, or check that the images overlap."
        )
    if request.space == "ground":
        match_scene = replace(setup.match_scene, ties=features)
        return PaperSpace(match_scene, match_scene.views, None, features, scene.crs)
    image_scene, by_name = reference_scene(setup, config), {view.name: view for view in scene.views}
    views = tuple(by_name[view.name] for view in image_scene.image_space.views)
    return PaperSpace(image_scene.match_scene, views, image_scene.image_space, features, scene.crs)


@dataclass(frozen=True)
class MatchedPoint:
    """A matched point. cell : row and column of the lattice; initial : lattice index in the middle of its curves."""

    cell: tuple[int, int]
    initial: float
    curves: PointCurves


def find_point(space: PaperSpace, request: PaperRequest, config: RunConfig) -> tuple[SelectionArea, MatchedPoint]:
    """The requested point P0, or the first one that serves as an example, and the area around it.

    Where none is requested, points are tried on a grid of `CANDIDATE_SPACING` cells, from the middle of the reference
    image (on the ground: of the overlap) outwards. The first one is taken that is like the paper's: its match stops
    before the last search image, but not at the first one, of which there is no mean; an image that is left out is poor
    around it; and the peak of all search images is the same within a step, so that both means show one surface.

    Raises
    ------
    GeometryError
        The requested point cannot be matched, or no point serves.
    """
    if request.at is not None:
        cell, what = space.cell_of_ground(np.array(request.at)), f"--at {request.at[0]:.12g} {request.at[1]:.12g}"
    elif request.pixel is not None:
        cell, what = space.cell_of_pixel(*request.pixel), f"--pixel {request.pixel[0]:g} {request.pixel[1]:g}"
    else:
        return _example(space, request, config)
    area = area_around(space, cell, what, config)
    found = match_point(area, cell, request, config)
    if isinstance(found, str):
        raise GeometryError(f"{what} cannot be shown: {found}")
    return area, found


def area_around(space: PaperSpace, cell: tuple[int, int], what: str, config: RunConfig) -> SelectionArea:
    """The area of `AREA_CELLS` around a cell.

    Raises
    ------
    GeometryError
        The reference image or all search images do not show it.
    """
    overlap = space.match_scene.overlap_window
    window = CellWindow(cell[0] - AREA_CELLS // 2, cell[1] - AREA_CELLS // 2, AREA_CELLS, AREA_CELLS).within(overlap)
    row, col = cell[0] - window.row, cell[1] - window.col
    area = None
    if 0 <= row < window.rows and 0 <= col < window.cols:
        area = selection_area(space.match_scene, window, config)
    if area is None:
        name = space.views[0].name
        raise GeometryError(
            f"{what} is not shown by the reference image {name} and another image. Give a point that both show, or "
            "leave it out to have one chosen."
        )
    return area


def match_point(
    area: SelectionArea, cell: tuple[int, int], request: PaperRequest, config: RunConfig
) -> MatchedPoint | str:
    """The match of a point with the feature points that the request asks for, or why there is none, in a sentence."""
    xy, initial = np.array(cell[::-1]) + 0.5, float(area.initial[cell[0] - area.window.row, cell[1] - area.window.col])
    distance = np.sort(np.hypot(*(area.features.xy - xy).T))
    if len(distance) < N_FEATURES:
        return f"only {len(distance)} feature points lie around it, and {N_FEATURES} are needed. Give another point."
    radius = float(distance[N_FEATURES - 1]) * REACHES if request.radius_px is None else request.radius_px
    selection = replace(config.selection, neighbours=request.neighbours, radius_px=max(radius, 1.0))
    curves = point_curves_of_paper(area, cell, initial, replace(config, selection=selection))
    if curves.order.order_source != 0 or len(curves.order.features) < N_FEATURES:
        if request.neighbours == "tin":
            return "no triangle of feature points lies around it. Give another point, or --neighbours radius."
        return f"fewer than {N_FEATURES} feature points lie within {radius:g} px. Give a larger --radius."
    if not np.isfinite(curves.single_curves.peaks.rho1).any():
        return "no two images show it. Give another point."
    return MatchedPoint(cell, initial, curves)


def _example(space: PaperSpace, request: PaperRequest, config: RunConfig) -> tuple[SelectionArea, MatchedPoint]:
    """See `find_point`, without a requested point."""
    window = space.match_scene.overlap_window
    middle = (window.row + window.rows // 2, window.col + window.cols // 2)
    area = area_around(space, middle, "The middle of the images", config)
    for point in matched_points(area, candidates(area.window, CANDIDATE_SPACING, middle), request, config):
        curves = point.curves
        peaks, n_search = curves.mean_curves.peaks.peak, len(curves.order.search)
        is_one_surface = abs(int(peaks[curves.n_used - 1]) - int(peaks[-1])) <= 1
        has_mean = curves.n_used > 1 or n_search == 2
        if is_stopped_early(point) and leaves_out_poor(point) and is_one_surface and has_mean:
            return area, point
    raise GeometryError(
        f"No point within {AREA_CELLS // 2} px of the middle stops after several search images, leaves out a poor one, "
        "and has the height that all of them show. Give a point with --pixel ROW COL or --at X Y."
    )


def is_stopped_early(point: MatchedPoint) -> bool:
    """Whether the match of a point stops before the last search image."""
    return point.curves.is_stopped and point.curves.n_used < len(point.curves.order.search)


def leaves_out_poor(point: MatchedPoint) -> bool:
    """Whether an image that is not used has an accumulated label below 0: it is poor around the point."""
    return bool((point.curves.order.accumulated[point.curves.n_used :] < 0).any())


def candidates(window: CellWindow, spacing: int, middle: tuple[int, int]) -> list[tuple[int, int]]:
    """Cells of a grid through the middle, inside a window, the nearest first (of equal ones the upper, then the left
    one)."""
    rows, cols = (
        np.arange(first + (at - first) % spacing, first + n, spacing)
        for first, n, at in ((window.row, window.rows, middle[0]), (window.col, window.cols, middle[1]))
    )
    row, col = (each.ravel() for each in np.meshgrid(rows, cols, indexing="ij"))
    nearest = np.lexsort((col, row, (row - middle[0]) ** 2 + (col - middle[1]) ** 2))
    return [(int(row[k]), int(col[k])) for k in nearest]


def matched_points(
    area: SelectionArea, cells: list[tuple[int, int]], request: PaperRequest, config: RunConfig
) -> Iterator[MatchedPoint]:
    """The matches of cells, one after the other, without those that cannot be matched."""
    for cell in cells:
        found = match_point(area, cell, request, config)
        if isinstance(found, MatchedPoint):
            yield found


def paper_point(
    space: PaperSpace, area: SelectionArea, point: MatchedPoint, request: PaperRequest, config: RunConfig
) -> PaperPoint:
    """Everything that the tables and figures show of a point."""
    views = tuple(space.views[number] for number in area.view_numbers)
    place, pixel = space.points(point.cell, np.array([point.initial]))[0], views[0].sensor
    col, row = pixel.image_from_ground(place[None])[0]
    where = f"E {place[0]:.2f}, N {place[1]:.2f}, {place[2]:.2f} m; {views[0].name} row {row:.1f}, column {col:.1f}"
    features = []
    for number, feature in enumerate(point.curves.order.features.tolist(), 1):
        of_col, of_row = np.floor(area.features.xy[feature]).astype(int).tolist()
        initial = float(area.ties.lattice_index[area.numbers[feature]])
        at = MatchedPoint((of_row, of_col), initial, feature_curves(area, feature, config))
        features.append(report_of(f"P{number}", space, views, at))
    report = report_of("P0", space, views, point)
    peak = point.curves.peak_index if np.isfinite(point.curves.peak_index) else point.initial
    along = np.concatenate([point.curves.lattice_index, [point.initial, peak]])
    in_order = [views[0], *(views[i] for i in point.curves.order.search)]
    compared, looked_at = compared_points(space, area, request, config) if request.points else ((), 0)
    return PaperPoint(
        report, tuple(features), where, ON_GROUND if space.image_space is None else IN_IMAGE,
        tuple(loci_through(in_order, space.points(point.cell, along))), compared, looked_at,
    )  # fmt: skip


def report_of(name: str, space: PaperSpace, views: tuple[View, ...], point: MatchedPoint) -> PointReport:
    """A point as figures take it. views : of the area, which were compared."""
    curves, match_scene = point.curves, space.match_scene
    along = space.points(point.cell, np.append(curves.lattice_index, point.initial))
    rays = None if space.image_space is None else space.image_space.rays
    unit = 1.0 if rays is None else float(rays.metres_per_unit(np.zeros((1, 2)), np.zeros(1))[0])
    step_m, middle = match_scene.height_step * unit, along[-1]
    names = tuple(view.name for view in views)
    return PointReport(
        request=name, crs=space.crs.to_string().splitlines()[0], xyz=middle,
        height_from="interpolated between the feature points", middle=middle[:2], cell_m=match_scene.cell_size * unit,
        names=names, not_compared=tuple(view.name for view in space.views if view.name not in names),
        heights_m=along[:-1, 2], step_m=step_m, curves=curves,
        peak_m=float(middle[2] + (curves.peak_index - point.initial) * step_m),
    )  # fmt: skip


def compared_points(
    space: PaperSpace, area: SelectionArea, request: PaperRequest, config: RunConfig
) -> tuple[tuple[ComparedPoint, ...], int]:
    """Points of a regular grid whose match stops early, with chosen and with all images; and how many were matched."""
    window = area.window
    spacing = max(int(np.sqrt(window.rows * window.cols / request.points)), 1)
    middle = (window.row + window.rows // 2, window.col + window.cols // 2)
    found, n_matched = [], 0
    for point in matched_points(area, candidates(window, spacing, middle), request, config):
        n_matched += 1
        if is_stopped_early(point):
            peaks, n = point.curves.mean_curves.peaks, point.curves.n_used
            chosen, every = ((float(peaks.rho1[k]), float(peaks.rho2[k]), float(peaks.ratio[k])) for k in (n - 1, -1))
            x, y, z = space.points(point.cell, np.array([point.curves.peak_index]))[0].tolist()
            found.append(ComparedPoint((x, y, z), n, chosen, every, leaves_out_poor(point)))
    return tuple(found), n_matched


def check_reference(request: PaperRequest, names: list[str]) -> None:
    """Refuse a reference image that is none of the views.

    Raises
    ------
    ConfigError
        It is none.
    """
    if request.reference is not None and request.reference not in names:
        raise ConfigError(
            f"--reference {request.reference} is not a view of this scene. Choose one of {', '.join(names)}."
        )
