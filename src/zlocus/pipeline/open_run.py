"""The beginning of a run: it opens what is named, compares what is there already, and refuses what cannot be done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.core.grid import Grid
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED, DsmRequest
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
from zlocus.pipeline.setup import Opened, Settled, opened
from zlocus.pipeline.tile_run import Polygons
from zlocus.products.derived import FILES, check_maps


@dataclass(frozen=True)
class OpenRun:
    """A run whose files are open. found : what the request names; inputs : all files, as they were; store : where its
    tiles are, or will be; polygons : of the area asked for; finished : the same run, where it is there already."""

    found: Opened
    inputs: InputFiles
    store: TileStore
    polygons: Polygons
    finished: Finished | None


def open_run(request: DsmRequest, config: RunConfig, progress: Progress) -> OpenRun:
    """Open what a request names, and look at what an earlier run left in its folder.

    Raises
    ------
    InputError, ConfigError, GeometryError
        For what cannot be used.
    OutputError
        The folder holds another run and may not be overwritten, or there is no room for the surface.
    """
    before = InputFiles.of(request.inputs)
    found = opened(request, progress)
    inputs = InputFiles.of(found.files, found.scene, before)
    store = TileStore.of(
        request.out, key_of(request, config, inputs), request.resume, request.overwrite, inputs.check
    )  # fmt: skip
    finished, polygons = finished_run(request, store), _area_polygons(request, found.scene.crs)
    if finished is None:
        check_maps(request.products, config.products)
        _check_room_first(request, found, store)
    return OpenRun(found, inputs, store, polygons, finished)


def may_have_terrain(request: DsmRequest) -> bool:
    """Whether the folder may hold the terrain of this same run, finished."""
    return not request.overwrite and all((request.out / name).exists() for name in (FINISHED, FILES["dtm"]))


def _area_polygons(request: DsmRequest, crs: CRS) -> Polygons:
    """Polygons of --area and --mask."""
    area = None if request.area is None else read_polygons(request.area, crs)
    mask = None if request.mask is None else read_polygons(request.mask, crs)
    return Polygons(area, mask)


def _check_room_first(request: DsmRequest, found: Opened, store: TileStore) -> None:
    """Refuse, before the images are read, what memory and the disk have no room for."""
    if request.method == "gc3-sgm":
        check_room_for_pixels(request.out, found.scene, [view.name for view in found.scene.views])
    if not store.finished:
        like = None if found.like is None else found.like.shape.yx
        check_room_before_ties(request.out, found.scene, request.resolution, request.bounds, like)


def known_ties(store: TileStore, scene: Scene, progress: Progress) -> MeasuredTies | None:
    """Tie points of the same run, where it was begun before."""
    arrays = store.found_before()
    known = None if arrays is None else MeasuredTies.of(arrays, len(scene.views))
    if known is not None:
        progress.note("Tie points are those of the run that is taken on.")
    return known


def area_matched(grid: Grid, settled: MatchScene) -> tuple[float, float, float, float]:
    """Bounds of the area asked for that two images see; refuses one without any."""
    shared = grid.window.within(settled.seen)
    if shared.rows and shared.cols:
        (west, north), (east, south) = (
            settled.transform(shared, 0) * corner for corner in ((0, 0), (shared.cols, shared.rows))
        )
        return west, south, east, north
    west, north = settled.transform(settled.seen, 0) * (0, 0)
    east, south = settled.transform(settled.seen, 0) * (settled.seen.cols, settled.seen.rows)
    asked = grid.geobox.extent.boundingbox
    raise GeometryError(
        f"The area asked for (E {asked.left:.0f} to {asked.right:.0f} m, N {asked.bottom:.0f} to {asked.top:.0f} m) "
        f"lies outside the ground that two images see (E {west:.0f} to {east:.0f} m, N {south:.0f} to {north:.0f} m). "
        "Check --bounds, --like and the CRS."
    )


def check_polygons(request: DsmRequest, settled: Settled, area: NDArray[Any] | None) -> None:
    """Refuse polygons of an area that hold no cell to be matched."""
    if area is None:
        return
    grid = settled.grid
    shared = grid.window.within(settled.matching.seen)
    row, col = shared.row - grid.window.row, shared.col - grid.window.col
    if not cells_inside(area, grid.geobox[row : row + shared.rows, col : col + shared.cols]).any():
        raise GeometryError(
            f"No cell of the ground that two images see lies inside {request.area}. Check the polygons and their CRS."
        )
