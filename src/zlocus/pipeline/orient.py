"""The order of an orientation that stands alone: scene, ties, cameras, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import GeometryError
from zlocus.core.grid import grid_from_bounds
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import OrientRequest, check_output
from zlocus.core.scene import Scene, footprint, ground_sample_distance, is_local
from zlocus.io.control_points import read_control
from zlocus.io.grid_inputs import dem_datum, read_dem
from zlocus.io.input_files import InputFiles, files_of
from zlocus.io.run_record import Stopwatch, made_record, write_record
from zlocus.io.vertical import ELLIPSOID, VerticalDatum, vertical_datum
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.orientation import Orientation
from zlocus.pipeline.preparing import made_folder, note_dem, note_orientation, opened_alone, oriented, possible_heights
from zlocus.products.corrected_cameras import SCENE, write_cameras
from zlocus.products.orientation import orientation_record
from zlocus.products.tie_layers import write_ties

# Cells of the terrain model are this many ground pixels, its own resolution being coarser.
TERRAIN_PX = 16.0
# Tie points that an orientation needs at least, all images together.
FEWEST_TIES = 4


def run_orient(request: OrientRequest, config: RunConfig, progress: Progress) -> str:
    """Find ties, correct the cameras where that is asked for, and write all products to `request.out`; a sentence on
    what came out.

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
        scene = opened_alone(request.inputs, request.crs, request.heights)
        control = None if request.control is None else control_points(request, scene)
        terrain = None if request.dem is None else terrain_heights(request.dem, scene, request.dem_vertical)
    inputs = InputFiles.of(files_read(request, scene), scene, before)
    note_dem(request.dem, request.dem_vertical, progress)
    with watch.stage("orient"):
        options = alone(config.orientation, request.cameras)
        found = oriented(scene, options, scene.heights, progress, control, terrain)
        check_ties(found, scene)
        note_orientation(found, progress)
    corrected, checksums = found.apply(scene), inputs.record()
    with watch.stage("write"), made_folder(request.out):
        write_ties(request.out / "ties.gpkg", found, corrected)
        record: dict[str, Any] = orientation_record(found, scene)
        if request.cameras:
            record["cameras"] = write_cameras(request.out, request.inputs, corrected)
        write_record(request.out / "orientation.json", record)
    write_record(request.out / "run.json", made_record(request, config, checksums, watch))
    if not request.cameras:
        return f"{request.out / 'ties.gpkg'}: {len(found.xyz)} tie points."
    return f"{request.out / SCENE}: {len(scene.views)} cameras, from {len(found.measured)} tie points."


def alone(options: OrientationOptions, cameras: bool) -> OrientationOptions:
    """The options of a stage that stands alone: no correction for ties alone, all cameras jointly unless a file of
    options says otherwise."""
    if not cameras:
        return replace(options, model="none")
    return replace(options, model="joint") if options.model == "auto" else options


def check_ties(found: Orientation, scene: Scene) -> None:
    """Refuse an orientation that nothing holds together."""
    if len(found.measured) < FEWEST_TIES:
        raise GeometryError(
            f"Only {len(found.measured)} tie points were found between {', '.join(v.name for v in scene.views)}, too "
            f"few to orient the cameras ({FEWEST_TIES} are needed). Give --heights ZMIN ZMAX, or check that the images "
            "overlap."
        )


def control_datum(request: OrientRequest) -> VerticalDatum:
    """What the heights of control points are above."""
    return vertical_datum(request.control_vertical or ELLIPSOID, "--control-vertical")


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
            f"The scene's frame is local, where no place is above {vertical.surface}. Leave --control-vertical out."
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


def files_read(request: OrientRequest, scene: Scene) -> list[Path]:
    """Every file whose content the result depends on."""
    extra = [path for path in (request.control, request.dem) if path is not None]
    extra += control_datum(request).files
    if request.dem is not None:
        extra += dem_datum(request.dem, request.dem_vertical).files
    return [*request.inputs, *files_of(scene), *extra]
