"""The plans of `--dry-run`: what a command would do, without a file written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from zlocus.core.options import RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import Progress, duration
from zlocus.core.quoting import counted
from zlocus.core.requests import CloudRequest, DsmRequest, SetupRequest
from zlocus.io.run_record import Stopwatch
from zlocus.orientation.ortho_control import joined
from zlocus.pipeline.cloud import oriented_cloud
from zlocus.pipeline.dsm import TAKES_PLAN_OVER, check_before_opening, prepare_surface
from zlocus.pipeline.execution.checkpoint import has_plan
from zlocus.pipeline.extent import Extent, above
from zlocus.pipeline.open_run import OpenRun, open_cloud_run, open_run
from zlocus.pipeline.orient import control_points, options_of_command, terrain_heights
from zlocus.pipeline.ortho_control import ortho_control
from zlocus.pipeline.run_plan import Plan, orientation_s
from zlocus.pipeline.setup import open_inputs
from zlocus.pipeline.surface_products import grid_record, heights_record
from zlocus.products.corrected_cameras import check_cameras_can_be_written


@dataclass(frozen=True)
class DryRun:
    """What a command would do. text : in sentences; values : the same for programs."""

    text: str
    values: Mapping[str, Any]


def plan_dsm(request: DsmRequest, config: RunConfig, progress: Progress) -> DryRun:
    """The plan of `zlocus dsm`: images, grid, heights, tiles, memory and time.

    Errors as `run_dsm` before its first tile.
    """
    check_before_opening(request, config)
    with progress.stage("Opening images"):
        run = open_run(request, config, progress)
    surface = prepare_surface(request, config, run, Stopwatch(), progress)
    setup, scene = surface.setup, surface.setup.match_scene
    (rows, cols), names = setup.grid.geobox.shape.yx, [view.name for view in scene.views]
    grid, heights = grid_record(setup.grid, setup.scene.crs), heights_record(setup)
    low, high = heights["searched_m"]
    extent = Extent.of(setup.grid, setup.scene.crs)
    lines = [
        f"Surface: {rows} rows x {cols} columns of {scene.cell_size:g} m in {extent.crs_text}, from {len(names)} of "
        f"{len(setup.scene.views)} images.",
        f"Area: {extent}.",
        f"Heights: {low:.1f} to {high:.1f} m {above(setup.scene.crs)}, in steps of {scene.height_step:.3g} m.",
    ]
    values = {
        "grid": grid, "extent": extent.as_dict(), "heights": heights, "images": names, "area_seen": surface.seen_share,
        **_plan_values(surface.plan, run),
    }  # fmt: skip
    if surface.water_polygons is not None:
        values["water_polygons"] = n_water = len(surface.water_polygons.names)
        lines.append(
            f"Water: {n_water} polygon{'s' if n_water > 1 else ''} of {surface.water_polygons.path} will be levelled."
        )
    if run.checkpoint.is_of_this_run and has_plan(request.out):
        lines.append(TAKES_PLAN_OVER.format(out=request.out))
    lines += _end_of(surface.plan, run)
    return DryRun("\n".join(lines), values)


def plan_cloud(request: CloudRequest, config: RunConfig, progress: Progress) -> DryRun:
    """The plan of `zlocus cloud`: reference images, tiles, memory and time.

    Errors as `run_cloud` before its first tile.
    """
    with progress.stage("Opening images"):
        run = open_cloud_run(request, config, progress)
    cloud = oriented_cloud(request, config, run, Stopwatch(), progress)
    named = ", ".join(cloud.references)
    lines = [f"Cloud: the pixels of {counted(len(cloud.references), 'image')} ({named}).", *_end_of(cloud.plan, run)]
    return DryRun("\n".join(lines), {"images": cloud.references, **_plan_values(cloud.plan, run)})


def plan_orient(request: OrientRequest, config: RunConfig, progress: Progress) -> DryRun:
    """The plan of `zlocus orient` and `zlocus ties`: images, time for tie points, and the corrections.

    Errors as `run_orient` before tie points are found.
    """
    with progress.stage("Opening images"):
        opened_inputs = open_inputs(SetupRequest.of(request), progress, "unless local")
        scene = opened_inputs.scene
        if request.cameras:
            check_cameras_can_be_written(request.inputs)
        control = None if request.control is None else control_points(request, scene)
        if request.dem is not None:
            terrain_heights(request.dem, scene, request.dem_vertical)
    options, seconds = options_of_command(config.orientation, request.cameras), orientation_s(scene.views, None)
    if request.control_ortho is not None:
        found = ortho_control(request, scene, options, progress).control
        control = found if control is None else joined(control, found)
    n_pixels, n_control = (
        sum(math.prod(view.image.shape) for view in scene.views),
        0 if control is None else len(control.names),
    )
    what = f"cameras corrected by the model {options.model}" if request.cameras else "no camera corrected"
    text = (
        f"Orientation: {len(scene.views)} images of {n_pixels / 1e6:.3g} Mpx together, {n_control} control and check "
        f"points, {what}.\nTie points take about {duration(seconds)} at the typical rate.\nNothing was written."
    )
    names = [view.name for view in scene.views]
    return DryRun(
        text, {"images": names, "model": options.model, "control_points": n_control, "ties_s": round(seconds, 1)}
    )


def _end_of(plan: Plan, run: OpenRun) -> list[str]:
    """The last lines of a plan. run : with what an earlier run left in the folder."""
    lines = [str(plan)]
    if run.finished is not None:
        lines.append("The folder holds this very result already: the command would make what is missing only.")
    elif run.checkpoint.finished:
        lines.append(
            f"The folder holds {counted(len(run.checkpoint.finished), 'finished tile')} of this run, kept for it."
        )
    return [*lines, "Nothing was written."]


def _plan_values(plan: Plan, run: OpenRun) -> dict[str, Any]:
    """The plan for programs."""
    there = {"is_finished": run.finished is not None, "finished_tiles": len(run.checkpoint.finished)}
    return {"plan": plan.as_dict() | there}
