"""Start of `zlocus dsm`: inputs are opened, an earlier run in the folder is recognised, impossible runs are refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.core.grid import Grid
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED, DsmRequest, SetupRequest
from zlocus.core.scene import Scene
from zlocus.io.grid_inputs import cells_inside, read_polygons
from zlocus.io.input_files import InputFiles
from zlocus.matching.match_scene import MatchScene
from zlocus.orientation.orientation import MeasuredTies
from zlocus.pipeline.execution.checkpoint import TileStore
from zlocus.pipeline.fingerprint import key_of
from zlocus.pipeline.finished_record import Finished
from zlocus.pipeline.finished_run import finished_run
from zlocus.pipeline.required_space import check_room_before_ties, check_room_for_pixels
from zlocus.pipeline.setup import OpenedInputs, RunSetup, open_inputs
from zlocus.pipeline.tile_run import Polygons
from zlocus.products.derived import FILES, check_maps


@dataclass(frozen=True)
class OpenRun:
    """A run whose files are open.

    opened : what the request names; inputs : all files, with their states when the run began; store : finished tiles;
    polygons : of the requested area; finished : the record of the same run, where it has finished already, else None.
    """

    opened: OpenedInputs
    inputs: InputFiles
    store: TileStore
    polygons: Polygons
    finished: Finished | None


def open_run(request: DsmRequest, config: RunConfig, progress: Progress) -> OpenRun:
    """Open what a request names, and compare it with what an earlier run left in the folder.

    Raises
    ------
    InputError, ConfigError, GeometryError
        An input that cannot be used.
    OutputError
        The folder holds another run and may not be overwritten, or there is no room for the surface.
    """
    before = InputFiles.of(request.inputs)
    opened = open_inputs(SetupRequest.of(request), progress)
    inputs = InputFiles.of(opened.files, opened.scene, before)
    key = key_of(request, config, inputs)
    store = TileStore.of(request.out, key, request.resume, request.overwrite, inputs.check)
    finished, polygons = finished_run(request, store), _area_polygons(request, opened.scene.crs)
    if finished is None:
        check_maps(request.products, config.products)
        _check_room_first(request, opened, store)
    return OpenRun(opened, inputs, store, polygons, finished)


def may_have_terrain(request: DsmRequest) -> bool:
    """Whether the folder may hold the terrain of this same run, which has finished."""
    return not request.overwrite and all((request.out / name).exists() for name in (FINISHED, FILES["dtm"]))


def _area_polygons(request: DsmRequest, crs: CRS) -> Polygons:
    """Polygons of --area and --mask."""
    area = None if request.area is None else read_polygons(request.area, crs)
    mask = None if request.mask is None else read_polygons(request.mask, crs)
    return Polygons(area, mask)


def _check_room_first(request: DsmRequest, opened: OpenedInputs, store: TileStore) -> None:
    """Refuse, before images are read, a run that memory or the disk has no room for."""
    if request.method == "gc3-sgm":
        check_room_for_pixels(request.out, opened.scene, [view.name for view in opened.scene.views])
    if not store.finished:
        like = None if opened.like is None else opened.like.shape.yx
        check_room_before_ties(request.out, opened.scene, request.resolution, request.bounds, like)


def known_ties(store: TileStore, scene: Scene, progress: Progress) -> MeasuredTies | None:
    """Tie points that an interrupted run of the same command kept; None where there is none."""
    arrays = store.found_before()
    known = None if arrays is None else MeasuredTies.of(arrays, len(scene.views))
    if known is not None:
        progress.note("The tie points of the interrupted run are used again.")
    return known


def area_matched(grid: Grid, match_scene: MatchScene) -> tuple[float, float, float, float]:
    """Bounds (xmin, ymin, xmax, ymax), m, of the part of the requested area that two images see.

    Raises
    ------
    GeometryError
        Two images see none of it.
    """
    shared = grid.window.within(match_scene.seen)
    if shared.rows and shared.cols:
        (west, north), (east, south) = (
            match_scene.transform(shared, 0) * corner for corner in ((0, 0), (shared.cols, shared.rows))
        )
        return west, south, east, north
    west, north = match_scene.transform(match_scene.seen, 0) * (0, 0)
    east, south = match_scene.transform(match_scene.seen, 0) * (match_scene.seen.cols, match_scene.seen.rows)
    asked = grid.geobox.extent.boundingbox
    raise GeometryError(
        f"The area asked for (E {asked.left:.0f} to {asked.right:.0f} m, N {asked.bottom:.0f} to {asked.top:.0f} m) "
        f"lies outside the ground that two images see (E {west:.0f} to {east:.0f} m, N {south:.0f} to {north:.0f} m). "
        "Check --bounds, --like and the CRS."
    )


def check_polygons(request: DsmRequest, setup: RunSetup, area: NDArray[Any] | None) -> None:
    """Refuse polygons of an area that contain no cell to be matched.

    Raises
    ------
    GeometryError
        They contain none.
    """
    if area is None:
        return
    grid = setup.grid
    shared = grid.window.within(setup.match_scene.seen)
    row, col = shared.row - grid.window.row, shared.col - grid.window.col
    if not cells_inside(area, grid.geobox[row : row + shared.rows, col : col + shared.cols]).any():
        raise GeometryError(
            f"No cell of the ground that two images see lies inside {request.area}. Check the polygons and their CRS."
        )
