"""Run setup: the one place where inputs become views, orientation, heights, grid and match scene.

Every command that orients or matches images, the inspector and the Python interface start here, in this order:

1. `open_inputs`: the scene that the request names, with its vertical datum and every file that the result depends on;
2. `orient_views`: tie points and corrected cameras;
3. `set_up_run`: the views that take part, the height range (`zlocus.pipeline.height_range`), the grid and the match
   scene.

Matching in image space needs no grid: `zlocus.pipeline.image_tiles` replaces the third step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from odc.geo.geobox import GeoBox
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError, CoverageError, GeometryError, ZlocusError
from zlocus.core.footprints import (
    Bounds,
    area_not_seen,
    area_to_match,
    check_overlap,
    ground_sample_distance,
    shared_ground,
    views_near,
)
from zlocus.core.grid import Grid, grid_from_bounds, grid_from_geobox
from zlocus.core.height_range import HeightRange
from zlocus.core.options import OrientationOptions, PyramidOptions, RunConfig
from zlocus.core.progress import Progress, SilentProgress, Stage
from zlocus.core.request_checks import is_scene_file
from zlocus.core.requests import SetupRequest
from zlocus.core.resources import cores
from zlocus.core.scene import Scene, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import checked_crs
from zlocus.io.grid_inputs import dem_datum, read_dem, read_geobox
from zlocus.io.input_files import files_of
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import VerticalDatum, named_vertical_datum
from zlocus.io.water_polygons import files_of_water
from zlocus.matching.ground_pixels import (
    cell_side,
    check_cells_in_overlap,
    check_resolution,
    ground_pixels,
    median_ground_pixel,
)
from zlocus.matching.match_scene import MatchScene, build_match_scene, height_step
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.orientation import Orientation, OrientationRequest, orient
from zlocus.orientation.plausibility import Doubt
from zlocus.orientation.tie_heights import supported
from zlocus.orientation.tie_refinement import RefinedTies
from zlocus.orientation.ties import Ties, find_ties
from zlocus.pipeline.height_range import height_range_of_run, heights_below_cameras, possible_heights, with_heights
from zlocus.pipeline.messages import MIN_VIEWS, note_dem, note_doubts, note_excluded, some_names
from zlocus.pipeline.request_fit import check_bounds_in_metres, check_heights_of_cameras

# Fewer tie points than this do not cast doubt on a terrain model.
MIN_TIES_TO_COMPARE = 20
# Progress of the stage "Tie points": where each step begins, and its share of the time.
TIE_STEPS = {"features": (0.0, 0.4), "matches": (0.4, 0.35)}

OverlapCheck = Literal["always", "unless local", "later"]


@dataclass(frozen=True)
class OpenedInputs:
    """What a request names, opened.

    scene : views sorted by name, with the heights asked for (ellipsoidal, m); vertical_datum : of the heights to be
    written; like : grid of --like; files : every file whose content the result depends on.
    """

    scene: Scene
    vertical_datum: VerticalDatum
    like: GeoBox | None
    files: list[Path]


@dataclass(frozen=True)
class RunSetup:
    """What all tiles of a surface share.

    scene : all views, with corrected cameras; orientation : tie points and corrections; height_range : heights at
    which the surface is expected, and those searched; grid : of the products; match_scene : the views that take part,
    and everything that a tile is matched with; doubts : about the cameras.
    """

    scene: Scene
    orientation: Orientation
    height_range: HeightRange
    grid: Grid
    match_scene: MatchScene
    doubts: tuple[Doubt, ...] = ()


def open_inputs(request: SetupRequest, progress: Progress, overlap_check: OverlapCheck = "always") -> OpenedInputs:
    """Open everything that a request names, except polygons.

    overlap_check : whether views must be found to overlap. "unless local" leaves the check out in a local frame without
    heights, where cameras are oriented without them; "later" leaves it to the matching of frame images by depth.

    Raises
    ------
    InputError, ConfigError, GeometryError
        An input that cannot be used, or views that do not overlap.
    """
    like = read_geobox(request.like) if request.like else None
    datum = named_vertical_datum(request.vertical)
    bounds = request.bounds if like is None else like.boundingbox.bbox

    def chosen(scene: Scene) -> Scene:
        if is_local(scene.crs):
            _refuse_maps_in_local_frame(request)
        check_bounds_in_metres(request.bounds, scene)
        scene = sorted_views(with_heights(scene, request.heights, datum, bounds))
        check_heights_of_cameras(scene.heights, scene)
        return views_of_area(scene, bounds or scene.bounds, (request.reference, *request.references), progress)

    scene = open_scene(request.inputs, requested_crs(request.crs) if like is None else _crs_of(like), chosen)
    is_unknown = is_local(scene.crs) and scene.heights is None
    if overlap_check == "always" or (overlap_check == "unless local" and not is_unknown):
        check_overlap(scene, possible_heights(scene, scene.heights))
    note_dem(request.dem, request.dem_vertical, progress)
    return OpenedInputs(scene, datum, like, _files_read(request, scene, datum))


def requested_crs(text: str | None) -> CRS | None:
    """The CRS of --crs; None where none is given.

    Raises
    ------
    ConfigError
        The CRS is not known, or not projected in metres.
    """
    if text is None:
        return None
    try:
        return checked_crs(CRS.from_user_input(text))
    except CRSError as error:
        raise ConfigError(f"--crs {text} is not a known CRS. Give a projected one, such as EPSG:32632.") from error


def sorted_views(scene: Scene) -> Scene:
    """The scene with its views sorted by name, so that the order of the inputs changes nothing."""
    return replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))


def views_of_area(scene: Scene, area: Bounds | None, always: Sequence[str | None], progress: Progress) -> Scene:
    """The scene of the views that may show the area that is asked for, so that the others are not read at all.

    area : bounds in the frame of the scene, m; None is all of it; always : names of views that stay whatever they show.
    All views stay in a local frame, and where nothing tells at which heights the ground may be.

    Raises
    ------
    GeometryError
        Fewer than two views may show the area.
    """
    if area is None or is_local(scene.crs):
        return scene
    try:
        heights = possible_heights(scene, scene.heights)
    except GeometryError:  # a later check says so, where heights are needed
        return scene
    z_range = heights[0], heights[-1]
    near = {view.name for view in views_near(scene.views, area, z_range)}
    if len(near) < MIN_VIEWS:
        raise area_not_seen(area, shared_ground(scene, z_range), "--bounds, --like")
    views = tuple(view for view in scene.views if view.name in near or view.name in always)
    if len(views) < len(scene.views):
        progress.note(
            f"{len(views)} of {len(scene.views)} images may show the area asked for. The pixels of the others are not "
            "read."
        )
    return replace(scene, views=views)


def orient_views(
    scene: Scene,
    options: OrientationOptions,
    progress: Progress,
    *,
    control: GroundControl | None = None,
    terrain: TerrainHeights | None = None,
    threads: int | None = None,
    known_ties: RefinedTies | None = None,
) -> Orientation:
    """Find tie points and correct the cameras of a scene.

    control, terrain, known_ties : see `OrientationRequest`; threads : None uses every core.
    """
    with progress.stage("Tie points", 1.0) as stage, opencv_in_one_thread():
        request = OrientationRequest(_heights_of_ties(scene), control, terrain, known_ties)
        return orient(scene, options, request, _report_to(stage), threads or cores())


def ties_of_views(scene: Scene, options: OrientationOptions, progress: Progress) -> Ties:
    """Find the tie points of a scene, as the first step of `orient_views` does, without a correction."""
    with progress.stage("Tie points", 1.0) as stage, opencv_in_one_thread():
        return find_ties(scene, options, _heights_of_ties(scene), _report_to(stage), cores())


def _heights_of_ties(scene: Scene) -> tuple[float, float] | None:
    """Heights at which tie points are searched; None: those for which the sensor models were made."""
    if scene.heights is None and all(view.sensor.height_bounds() is None for view in scene.views):
        return heights_below_cameras(scene)
    return scene.heights


def _report_to(stage: Stage) -> Callable[[str, float], None]:
    """A function that advances the stage of the tie points when a share of one of its steps is done."""
    done = 0.0

    def report(step: str, share: float) -> None:
        nonlocal done
        start, length = TIE_STEPS[step]
        stage.advance(start + length * share - done)
        done = start + length * share

    return report


@contextmanager
def opencv_in_one_thread() -> Iterator[None]:
    """Let OpenCV use one thread, because several threads call it at the same time."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def set_up_run(
    request: SetupRequest, opened_inputs: OpenedInputs, orientation: Orientation, config: RunConfig, progress: Progress
) -> RunSetup:
    """Choose views, height range, grid and match scene of a scene whose orientation is known.

    Raises
    ------
    CoverageError
        Tie points support fewer than two views.
    GeometryError, ConfigError
        Heights, area or resolution that cannot be used.
    """
    corrected = orientation.apply(opened_inputs.scene)
    try:
        scene = supported_views(corrected, orientation)
    except CoverageError as error:
        if request.heights is None:
            raise
        if wrong := wrong_heights(request.heights, opened_inputs.scene, config):
            raise wrong from error
        note_excluded(orientation, progress)
        raise
    height_range = height_range_of_run(request, scene, orientation, config, progress)
    grid = grid_of_run(request, opened_inputs.like, scene, orientation, height_range)
    check_cells(request, scene, height_range, grid, config)
    match_scene = match_scene_of_run(request, scene, orientation, height_range, grid, config)
    far = doubts_from_dem(request, scene, orientation, config)
    note_doubts(far, progress)
    match_scene = limited_by_dem(request, match_scene, scene.crs, config)
    match_scene = with_line_shifts(match_scene, orientation, config.pyramid)
    return RunSetup(corrected, orientation, height_range, grid, match_scene, (*orientation.doubts, *far))


def supported_views(scene: Scene, orientation: Orientation) -> Scene:
    """The scene of the views that tie points support; the others take no part in the matching.

    Raises
    ------
    CoverageError
        Tie points support fewer than two views, so that nothing can be matched.
    GeometryError
        They do so because all images look along the same line.
    """
    excluded = {each.name for each in orientation.excluded_images}
    views = tuple(view for view in scene.views if view.name not in excluded)
    if len(views) >= MIN_VIEWS:
        return replace(scene, views=views)
    if all(view.sensor.height_bounds() is not None for view in scene.views):
        levels = possible_heights(scene, scene.heights)
        middle = levels[len(levels) // 2]
        height_step(scene.views, middle, ground_sample_distance(scene.views[0], middle), 1.0)  # refuses such images
    raise CoverageError(
        f"No two images are held together by tie points (looked at: {some_names([v.name for v in scene.views])}), so "
        "nothing was matched. Check that they show the same ground and that each camera belongs to its image; where "
        "cameras may be far off, set a larger orientation.max_pointing_px in --config."
    )


def wrong_heights(heights: tuple[float, float], scene: Scene, config: RunConfig) -> GeometryError | None:
    """The error of requested heights that do not contain the ground, where tie points are found without them."""
    try:
        orientation = orient_views(replace(scene, heights=None), config.orientation, SilentProgress())
    except ZlocusError:
        return None
    z = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m), 2]
    if len(z) < MIN_TIES_TO_COMPARE:
        return None
    low, high = np.percentile(z, (1, 99))
    return GeometryError(
        f"No tie point has one of the heights asked for, {heights[0]:.6g} to {heights[1]:.6g} m: those "
        f"of these images lie between {low:.0f} and {high:.0f} m above the ellipsoid. Give --heights that contain the "
        "ground, or leave it out."
    )


def reference_features(setup: RunSetup) -> FloatArray:
    """Ground points (n, 3) m of the tie points in the reference image, which are the feature points of the paper.

    SIFT has found them in the reference image and in another one, and the cameras confirm them.
    """
    observations, name = setup.orientation.observations, setup.match_scene.views[0].name
    number = [view.name for view in setup.scene.views].index(name)
    return np.asarray(setup.orientation.xyz[np.unique(observations.point[observations.view == number])])


def doubts_from_dem(
    request: SetupRequest, scene: Scene, orientation: Orientation, config: RunConfig
) -> tuple[Doubt, ...]:
    """A doubt about the cameras where tie points lie farther from the DEM than is searched around it; else none."""
    if request.dem is None:
        return ()
    xyz = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    if len(xyz) < MIN_TIES_TO_COMPARE:
        return ()
    (west, south), (east, north) = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    cell = median_ground_pixel(scene, float(np.median(xyz[:, 2]))) * 16
    geobox = grid_from_bounds((west - cell, south - cell, east + cell, north + cell), cell, scene.crs).geobox
    heights = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical), may_miss=True)
    col, row = ~geobox.transform * (xyz[:, 0], xyz[:, 1])
    above = xyz[:, 2] - heights[np.floor(row).astype(int), np.floor(col).astype(int)]
    above = above[np.isfinite(above)]
    if not len(above) or -config.pyramid.dem_down_m <= np.median(above) <= config.pyramid.dem_up_m:
        return ()
    return (
        Doubt(
            f"The tie points lie {np.median(above):+.0f} m from {request.dem} (median), beyond what is searched around "
            "it. Check the cameras, and with --dem-vertical the vertical datum of the DEM.",
            is_grave=True,
        ),
    )


def grid_of_run(
    request: SetupRequest,
    like: GeoBox | None,
    scene: Scene,
    orientation: Orientation,
    height_range: HeightRange,
) -> Grid:
    """The grid of the products: that of --like, or the area to match at the resolution asked for.

    Both follow from the heights at which the surface is expected: ground pixels differ where cameras are near.
    """
    z = height_range.middle
    if like is not None:
        grid = grid_from_geobox(like, str(request.like))
        check_resolution(grid.cell_m, scene, z, f"--like {request.like}: its cell of")
        return grid
    cell_m = cell_side(request.resolution, scene, z)
    check_resolution(cell_m, scene, z, "--resolution")
    ties = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    bounds = request.bounds or area_to_match(scene, height_range.expected, ties)
    return grid_from_bounds(bounds, cell_m, scene.crs)


def check_cells(request: SetupRequest, scene: Scene, height_range: HeightRange, grid: Grid, config: RunConfig) -> None:
    """Refuse a grid whose cells are too large for the ground that two images share.

    Raises
    ------
    ConfigError
        See `check_cells_in_overlap`.
    GeometryError
        No two images share any.
    """
    if request.method.startswith("gc3"):  # which compares pixels
        return
    given = "--resolution" if request.like is None else f"--like {request.like}: its cell of"
    shared = shared_ground(scene, height_range.searched)
    pixel_m = median_ground_pixel(scene, height_range.middle)
    check_cells_in_overlap(grid.cell_m, config.cost.small_window, shared, pixel_m, given)


def match_scene_of_run(
    request: SetupRequest,
    scene: Scene,
    orientation: Orientation,
    height_range: HeightRange,
    grid: Grid,
    config: RunConfig,
) -> MatchScene:
    """The match scene of the views that take part, on the lattice of a grid. scene : with corrected cameras."""
    match_scene = build_match_scene(
        scene, grid.cell_m, grid.anchor, height_range, orientation.xyz, request.reference, config.pyramid,
        orientation.refined_xyz,
    )  # fmt: skip
    return replace(match_scene, trusted_ties=orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)])


def limited_by_dem(request: SetupRequest, match_scene: MatchScene, crs: CRS, config: RunConfig) -> MatchScene:
    """The match scene with heights limited around the DEM at the coarsest level, where one is given."""
    if request.dem is None:
        return match_scene
    level = match_scene.levels - 1
    window = match_scene.overlap_window.at_level(level, 0)
    geobox = GeoBox((window.rows, window.cols), match_scene.transform(window, level), crs)
    dem = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical))
    limits = np.stack([dem - config.pyramid.dem_down_m, dem + config.pyramid.dem_up_m]).astype(np.float32)
    return replace(match_scene, dem_limits=limits)


def with_line_shifts(match_scene: MatchScene, orientation: Orientation, options: PyramidOptions) -> MatchScene:
    """The match scene with the size of the displacements of lines, as a height: a step shifts an image by
    `pyramid.max_shift_px` of its pixels, or of the cells where these are larger."""
    found = [v.line_shifts.rms_px for v in orientation.views if v.line_shifts is not None]
    if not found:
        return match_scene
    pixel = float(np.median(ground_pixels(match_scene.views, match_scene.ground_height)))
    shift_px = float(np.sqrt(np.mean(np.square(found).sum(axis=1))))
    step_px = options.max_shift_px * max(match_scene.cell_size / pixel, 1.0)
    return replace(match_scene, line_shift_steps=shift_px / step_px)


def _crs_of(geobox: GeoBox) -> CRS:
    """The CRS of a grid, as pyproj's."""
    return CRS.from_wkt(geobox.crs.to_wkt())  # type: ignore[union-attr]


def _refuse_maps_in_local_frame(request: SetupRequest) -> None:
    """Refuse files with a place on the Earth where the scene's frame is local.

    Raises
    ------
    GeometryError
        Such a file is given.
    """
    for name in ("dem", "area", "mask", "water"):
        if path := getattr(request, name):
            raise GeometryError(
                f"The scene's frame is local, where {path} has no place. Leave --{name} out; --bounds and --heights "
                "are in that frame."
            )


def _files_read(request: SetupRequest, scene: Scene, vertical_datum: VerticalDatum) -> list[Path]:
    """Every file whose content the result depends on, each once."""
    extra = [path for path in (request.like, request.dem, request.area, request.mask) if path is not None]
    extra += vertical_datum.files
    if request.water is not None:
        extra += files_of_water(request.water)
    if request.dem is not None:
        extra += dem_datum(request.dem, request.dem_vertical).files
    read = files_of(scene)
    # Images on the command line that show nothing of the area are not read.
    given = [path for path in request.inputs if is_scene_file(path) or path in read]
    return list(dict.fromkeys([*given, *read, *extra]))
