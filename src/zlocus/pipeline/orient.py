"""`zlocus orient` and `zlocus ties`: inputs, tie points, cameras, and their files, in this order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import GeometryError
from zlocus.core.footprints import footprint, ground_sample_distance
from zlocus.core.grid import grid_from_bounds
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import Progress
from zlocus.core.requests import SetupRequest, check_output
from zlocus.core.scene import Scene, is_local
from zlocus.io.control_points import read_control, write_control
from zlocus.io.grid_inputs import dem_datum, read_dem
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import Stopwatch, result_record, write_record
from zlocus.io.vertical import ELLIPSOID, VerticalDatum, named_vertical_datum
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.ortho_control import joined
from zlocus.pipeline.height_range import possible_heights
from zlocus.pipeline.messages import note_orientation, some_names
from zlocus.pipeline.ortho_control import ortho_control
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.setup import open_inputs, orient_views
from zlocus.products.corrected_cameras import SCENE, check_cameras_can_be_written, write_cameras
from zlocus.products.orientation import orientation_record
from zlocus.products.other_styles import write_other_styles
from zlocus.products.tie_layers import TIES, write_ties
from zlocus.products.tie_observations import write_observations

# Cells of the terrain model are this many ground pixels, its own resolution being coarser.
TERRAIN_PX = 16.0
# Tie points that an orientation needs at least, all images together.
MIN_TIES = 4
ORIENTATION = "orientation.json"
# The points found in an ortho-photo, in the form of --control.
CONTROL_POINTS = "control_points.csv"


def run_orient(request: OrientRequest, config: RunConfig, progress: Progress) -> str:
    """Find tie points, correct the cameras where `request.cameras` is set, and write all products to `request.out`.

    Returns a sentence that says what was written.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used, before anything is written.
    StoppedError
        Where an input has changed meanwhile; nothing is written.
    """
    check_output(request.out, request.overwrite)
    watch, before = Stopwatch(), InputFiles.of(request.inputs)
    with watch.stage("open"), progress.stage("Opening images"):
        opened_inputs = open_inputs(SetupRequest.of(request), progress, "unless local")
        scene = opened_inputs.scene
        if request.cameras:
            check_cameras_can_be_written(request.inputs)
        options = options_of_command(config.orientation, request.cameras)
        control = None if request.control is None else control_points(request, scene)
        terrain = None if request.dem is None else terrain_heights(request.dem, scene, request.dem_vertical)
    inputs = InputFiles.of([*opened_inputs.files, *control_files(request)], scene, before)
    of_ortho = None
    if request.control_ortho is not None:
        with watch.stage("ortho-photo"):
            of_ortho = ortho_control(request, scene, options, progress)
        control = of_ortho.control if control is None else joined(control, of_ortho.control)
    with watch.stage("orient"):
        orientation = orient_views(scene, options, progress, control=control, terrain=terrain)
        check_ties(orientation, scene)
        note_orientation(orientation, progress)
    corrected, checksums = orientation.apply(scene), inputs.record()
    with watch.stage("write"), made_folder(request.out):
        write_ties(request.out / TIES, orientation, corrected)
        write_other_styles(request.out, (TIES,), config.products)
        record: dict[str, Any] = orientation_record(orientation, scene)
        if of_ortho is not None:
            record["control_ortho"] = of_ortho.found
            write_control(request.out / CONTROL_POINTS, of_ortho.control, scene.views)
        if request.cameras:
            record["cameras"] = write_cameras(request.out, request.inputs, corrected)
            if orientation.refined_ties is not None:
                write_observations(request.out, orientation.refined_ties)
        write_record(request.out / ORIENTATION, record)
    write_record(request.out / "run.json", result_record(request, config, checksums, watch))
    if not request.cameras:
        return f"{request.out / TIES}: {len(orientation.xyz)} tie points."
    return f"{request.out / SCENE}: {len(scene.views)} cameras, from {len(orientation.refined_xyz)} tie points."


def options_of_command(options: OrientationOptions, cameras: bool) -> OrientationOptions:
    """The options of the command: no correction for `zlocus ties`, a bundle adjustment for `zlocus orient` unless a
    configuration file names another model."""
    if not cameras:
        return replace(options, model="none")
    return replace(options, model="joint") if options.model == "auto" else options


def check_ties(orientation: Orientation, scene: Scene) -> None:
    """Refuse an orientation from too few tie points.

    Raises
    ------
    GeometryError
        There are fewer than `MIN_TIES`.
    """
    if len(orientation.refined_xyz) < MIN_TIES:
        names = some_names([view.name for view in scene.views])
        raise GeometryError(
            f"Only {len(orientation.refined_xyz)} tie points were found between {names}, too few to orient the cameras "
            f"({MIN_TIES} are needed). Give --heights ZMIN ZMAX, or check that the images overlap."
        )


def control_datum(request: OrientRequest) -> VerticalDatum:
    """Vertical datum of the control points' heights."""
    return named_vertical_datum(request.control_vertical or ELLIPSOID, "--control-vertical")


def control_points(request: OrientRequest, scene: Scene) -> GroundControl:
    """The control points of the request, with ellipsoidal heights.

    Raises
    ------
    GeometryError
        Where the frame is local, and nothing in it is above a geoid.
    InputError
        See `read_control`.
    """
    assert request.control is not None, "callers make sure"
    vertical = control_datum(request)
    if vertical.geoid is not None and is_local(scene.crs):
        raise GeometryError(
            f"The scene's frame is local, where no place is above {vertical.surface_name}. Leave --control-vertical "
            "out."
        )
    return read_control(request.control, scene.views, vertical, scene.crs)


def terrain_heights(dem: Path, scene: Scene, vertical: str | None = None) -> TerrainHeights:
    """Ellipsoidal heights of a DEM over all ground that the images may see. vertical : see `dem_datum`.

    Raises
    ------
    GeometryError
        Where the frame is local, and a DEM has no place in it.
    InputError
        For a file that is no DEM or covers nothing of the ground.
    """
    if is_local(scene.crs):
        raise GeometryError(f"The scene's frame is local, where {dem} has no place. Leave --dem out.")
    levels = possible_heights(scene, scene.heights)
    outlines = np.concatenate([footprint(view, z) for view in scene.views for z in (levels[0], levels[-1])])
    middle = levels[len(levels) // 2]
    cell = TERRAIN_PX * float(np.nanmedian([ground_sample_distance(view, middle) for view in scene.views]))
    (west, south), (east, north) = outlines.min(axis=0), outlines.max(axis=0)
    geobox = grid_from_bounds((west, south, east, north), cell, scene.crs).geobox
    z = read_dem(dem, geobox, dem_datum(dem, vertical)).astype(float)
    first = geobox.transform * (0.5, 0.5)
    return TerrainHeights(z, float(first[0]), float(first[1]), cell)


def control_files(request: OrientRequest) -> list[Path]:
    """Files that the control is read from."""
    given = [path for path in (request.control, request.control_ortho, request.control_dem) if path is not None]
    if request.control_dem is not None:
        given += dem_datum(request.control_dem, request.control_vertical).files
    return list(dict.fromkeys([*given, *control_datum(request).files]))
