"""What a part of a surface is matched with: the cameras of its run, and the heights and options of this command."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.break_lines import BreakLines
from zlocus.core.errors import InputError, OutputError
from zlocus.core.grid import CellWindow, Grid
from zlocus.core.height_range import HeightRange
from zlocus.core.progress import Progress
from zlocus.core.requests import DsmRequest, SetupRequest
from zlocus.io.break_lines import GivenLines
from zlocus.io.grid_inputs import read_polygons
from zlocus.io.input_files import InputFiles, files_of
from zlocus.io.run_record import inputs_record
from zlocus.pipeline.execution.plan import Tile, plan_tiles
from zlocus.pipeline.height_range import with_heights
from zlocus.pipeline.redo_part import RedonePart
from zlocus.pipeline.request_fit import check_heights_of_cameras
from zlocus.pipeline.setup import OpenedInputs, RunSetup, open_inputs
from zlocus.pipeline.tile_run import Polygons


def opened_images(part: RedonePart, progress: Progress) -> tuple[OpenedInputs, InputFiles]:
    """The images as the run has opened them, which must be those of the run.

    Raises
    ------
    InputError
        They are not.
    """
    asked = part.run["config"]["request"]
    recorded = replace(
        SetupRequest.of(part.dsm_request), heights=_recorded_heights(part), reference=asked.get("reference"),
        method=asked["method"], dem=None, dem_vertical=None,
    )  # fmt: skip
    opened_inputs = open_inputs(recorded, progress, "later")
    images = files_of(opened_inputs.scene)
    inputs = InputFiles.of(
        [*images, *([] if part.dsm_request.dem is None else [part.dsm_request.dem])], opened_inputs.scene
    )
    names, of_run = {view.name for view in opened_inputs.scene.views}, set(part.run["orientation"]["views"])
    if names != of_run:
        raise InputError(
            f"The images are not those of the run in {part.dsm_request.out}: {', '.join(sorted(names ^ of_run)[:3])}. "
            "Give the same inputs; --redo keeps the cameras."
        )
    known = part.finished.key["inputs"]
    if any(known.get(str(path)) != inputs.states[str(path)] for path in images):  # seen from another folder, or copied
        checksums = {record["sha256"] for record in part.run["inputs"]}
        if changed := [record["path"] for record in inputs_record(images) if record["sha256"] not in checksums]:
            raise InputError(
                f"{changed[0]} is not what the run in {part.dsm_request.out} has read. Put the file of that run back, "
                "or make a new surface without --redo."
            )
    return opened_inputs, inputs


def check_cameras(part: RedonePart, orientation: Mapping[str, Any]) -> None:
    """Refuse cameras that came out otherwise than in the run: the part would not lie where its surroundings lie."""
    now = json.loads(json.dumps(orientation["views"]))
    if now != part.run["orientation"]["views"]:
        raise OutputError(
            f"The cameras came out otherwise than in the run in {part.dsm_request.out}, as they may on another machine "
            "or with another version, and the part would not fit. Make the whole surface anew with --overwrite."
        )


def with_new_heights(part: RedonePart, opened_inputs: OpenedInputs) -> OpenedInputs:
    """The opened inputs, with the heights that are searched this time."""
    heights = part.dsm_request.heights
    bounds = part.geobox.boundingbox.bbox
    if heights == _recorded_heights(part):
        return opened_inputs
    scene = replace(opened_inputs.scene, heights=None)
    scene = with_heights(scene, heights, opened_inputs.vertical_datum, bounds)
    check_heights_of_cameras(scene.heights, scene)
    return replace(opened_inputs, scene=scene)


def _recorded_heights(part: RedonePart) -> tuple[float, float] | None:
    found = part.run["config"]["request"].get("heights")
    return None if found is None else (float(found[0]), float(found[1]))


def setup_on_surface(part: RedonePart, setup: RunSetup) -> RunSetup:
    """The setup on the grid of the surface, with the break lines.

    Raises
    ------
    InputError
        Heights of break lines are not among those that are searched.
    """
    grid, transform = setup.grid, part.geobox.transform
    row, col = (grid.anchor[1] - transform.f) / grid.cell_m, (transform.c - grid.anchor[0]) / grid.cell_m
    rows, cols = part.geobox.shape
    grid = Grid(part.geobox, grid.anchor, CellWindow(round(row), round(col), rows, cols))
    match_scene = setup.match_scene
    if part.given_lines is not None:
        given_lines = part.given_lines
        held = given_lines.held.copy()
        held[:, 2] += part.vertical_datum.undulation(held[:, :2], part.crs)
        _check_held(given_lines, held, setup.height_range)
        match_scene = replace(match_scene, break_lines=BreakLines(given_lines.jumps, held))
    return replace(setup, grid=grid, match_scene=match_scene)


def _check_held(given_lines: GivenLines, held: NDArray[np.float64], height_range: HeightRange) -> None:
    low, high = height_range.searched
    beyond = (held[:, 2] < low) | (held[:, 2] > high)
    if beyond.any():
        z = given_lines.held[beyond, 2]
        raise InputError(
            f"{given_lines.path} has heights from {z.min():.2f} to {z.max():.2f} m outside those that are searched "
            f"({low:.1f} to {high:.1f} m above the ellipsoid). Correct them, or give --heights that contain them."
        )


def tiles_of_part(part: RedonePart, setup: RunSetup) -> list[Tile]:
    """The tiles of the surface that the area touches."""
    window = setup.grid.window
    return [
        tile
        for tile in plan_tiles(window, setup.match_scene.overlap_window, part.config.pyramid)
        if part.redone_area.has_cells(
            tile.kept_window.row - window.row, tile.kept_window.col - window.col,
            (tile.kept_window.rows, tile.kept_window.cols),
        )
    ]  # fmt: skip


def area_of_run(request: DsmRequest, crs: CRS) -> Polygons:
    """Polygons of --area and --mask of the run."""
    area = None if request.area is None else read_polygons(request.area, crs)
    mask = None if request.mask is None else read_polygons(request.mask, crs)
    return Polygons(area, mask)
