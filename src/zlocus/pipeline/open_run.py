"""Start of `zlocus dsm` and `zlocus cloud`: inputs are opened, an earlier run in the folder is recognised.

Impossible runs are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED, CloudRequest, DsmRequest, SetupRequest
from zlocus.core.scene import Scene
from zlocus.io.grid_inputs import cells_inside, read_polygons
from zlocus.io.input_files import InputFiles
from zlocus.io.water_polygons import WaterPolygons, read_water
from zlocus.orientation.tie_refinement import RefinedTies
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.fingerprint import key_of
from zlocus.pipeline.finished_record import Finished
from zlocus.pipeline.finished_run import finished_run
from zlocus.pipeline.required_space import check_room_before_ties, check_room_for_pixels
from zlocus.pipeline.setup import OpenedInputs, OverlapCheck, RunSetup, open_inputs
from zlocus.pipeline.tile_run import Polygons
from zlocus.products.derived import FILES, check_derived


@dataclass(frozen=True)
class OpenRun:
    """A run whose files are open.

    opened_inputs : what the request names; inputs : all files, with their states when the run began; checkpoint :
    finished tiles; polygons : of the requested area; finished : the record of the same run, where it has finished
    already, else None; water_polygons : of water surfaces, None where none are given.
    """

    opened_inputs: OpenedInputs
    inputs: InputFiles
    checkpoint: TileCheckpoint
    polygons: Polygons
    finished: Finished | None
    water_polygons: WaterPolygons | None = None


def open_run(request: DsmRequest, config: RunConfig, progress: Progress) -> OpenRun:
    """Open what a request names, and compare it with what an earlier run left in the folder.

    Raises
    ------
    InputError, ConfigError, GeometryError
        An input that cannot be used.
    OutputError
        The folder holds another run and may not be overwritten, or there is no room for the surface.
    """
    run = _opened(request, config, progress, "always")
    if run.finished is None:
        check_derived(request.products, config.products)
        _check_room_first(request, run.opened_inputs, run.checkpoint)
    return run


def open_cloud_run(request: CloudRequest, config: RunConfig, progress: Progress) -> OpenRun:
    """Open what the request of a cloud names, and compare it with what an earlier run left in the folder.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        See `open_run`; the room on the disk is checked later.
    """
    return _opened(request, config, progress, "later")


def _opened(
    request: DsmRequest | CloudRequest, config: RunConfig, progress: Progress, overlap_check: OverlapCheck
) -> OpenRun:
    """See `open_run`. overlap_check : see `open_inputs`."""
    before, setup_request = InputFiles.of(request.inputs), SetupRequest.of(request)
    opened_inputs = open_inputs(setup_request, progress, overlap_check)
    inputs = InputFiles.of(opened_inputs.files, opened_inputs.scene, before)
    key = key_of(request, config, inputs)
    checkpoint = TileCheckpoint.of(request.out, key, request.resume, request.overwrite, inputs.check)
    finished, polygons = finished_run(request, checkpoint), _area_polygons(setup_request, opened_inputs.scene.crs)
    return OpenRun(opened_inputs, inputs, checkpoint, polygons, finished, _water_polygons(request, opened_inputs))


def may_have_terrain(request: DsmRequest) -> bool:
    """Whether the folder may hold the terrain of this same run, which has finished."""
    return not request.overwrite and all((request.out / name).exists() for name in (FINISHED, FILES["dtm"]))


def _area_polygons(request: SetupRequest, crs: CRS) -> Polygons:
    """Polygons of --area and --mask."""
    area = None if request.area is None else read_polygons(request.area, crs)
    mask = None if request.mask is None else read_polygons(request.mask, crs)
    return Polygons(area, mask)


def _water_polygons(request: DsmRequest | CloudRequest, opened_inputs: OpenedInputs) -> WaterPolygons | None:
    """Polygons of --water."""
    if not isinstance(request, DsmRequest) or request.water is None:
        return None
    return read_water(request.water, opened_inputs.scene.crs, request.water_level)


def _check_room_first(request: DsmRequest, opened_inputs: OpenedInputs, checkpoint: TileCheckpoint) -> None:
    """Refuse, before images are read, a run that memory or the disk has no room for."""
    if request.is_in_image_space:
        check_room_for_pixels(request.out, opened_inputs.scene, [view.name for view in opened_inputs.scene.views])
    if not checkpoint.finished:
        like = None if opened_inputs.like is None else opened_inputs.like.shape.yx
        check_room_before_ties(request.out, opened_inputs.scene, request.resolution, request.bounds, like)


def known_ties(checkpoint: TileCheckpoint, scene: Scene, progress: Progress) -> RefinedTies | None:
    """Tie points that an interrupted run of the same command kept; None where there is none."""
    arrays = checkpoint.arrays_before_tiles()
    known = None if arrays is None else RefinedTies.of(arrays, len(scene.views))
    if known is not None:
        progress.note("The tie points of the interrupted run are used again.")
    return known


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
    shared = grid.window.within(setup.match_scene.overlap_window)
    row, col = shared.row - grid.window.row, shared.col - grid.window.col
    if not cells_inside(area, grid.geobox[row : row + shared.rows, col : col + shared.cols]).any():
        raise GeometryError(
            f"No cell of the ground that two images see lies inside {request.area}. Check the polygons and their CRS."
        )


def note_mask_beside(path: Path | None, mask: NDArray[Any] | None, geobox: GeoBox, progress: Progress) -> None:
    """Say that no polygon of --mask reaches the grid. path, mask : file and polygons (n,), None without any."""
    if mask is not None and not shapely.intersects(mask, shapely.box(*geobox.boundingbox.bbox)).any():
        progress.note(
            f"--mask {path} leaves nothing out, because its polygons lie outside the grid. Check the polygons and "
            "their CRS."
        )
