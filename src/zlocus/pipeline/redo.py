"""`zlocus dsm --redo`: a part of a finished surface is made again and blended in; all other cells keep their bytes.

1. open: the finished run, its inputs and the area (`redo_options`, `redone_area`);
2. set up: the cameras of the run, from its tie points; heights, options and break lines of this command;
3. match: the tiles of the run that the area touches, kept beside the surface until it is complete (`redo_folder`);
4. write: all rasters, with the part blended in (`surface_cells`), the maps and the report made again, and run.json with
   the history; then the new folder takes the place of the old one in one step.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.break_lines import BreakLines
from zlocus.core.errors import GeometryError, InputError, OutputError, StoppedError
from zlocus.core.grid import CellWindow, Grid
from zlocus.core.height_range import HeightRange
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.redo_request import RedoRequest
from zlocus.core.requests import FINISHED, DsmRequest, SetupRequest
from zlocus.core.resources import cores
from zlocus.io.break_lines import GivenLines, read_break_lines
from zlocus.io.config import config_as_dict
from zlocus.io.grid_inputs import cells_of_each, read_polygons
from zlocus.io.input_files import InputFiles, files_of
from zlocus.io.rasters import compression_threads
from zlocus.io.row_strips import strips_of
from zlocus.io.run_record import Stopwatch, inputs_record, read_record, utc_now, versions_record, write_record
from zlocus.io.vertical import VerticalDatum, grid_crs, named_vertical_datum
from zlocus.io.water_polygons import files_of_water, read_water
from zlocus.matching.break_lines import held_heights
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.execution.event_log import EventLog
from zlocus.pipeline.execution.plan import Tile, keep_at_most, plan_tiles
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.fingerprint import digest_of, kernels_of_package
from zlocus.pipeline.finished_record import ITEM, Finished, checksum, read_finished, write_finished
from zlocus.pipeline.finished_run import files_gone
from zlocus.pipeline.height_range import with_heights
from zlocus.pipeline.redo_folder import RedoFolder
from zlocus.pipeline.redo_options import differing, redo_config, redo_request
from zlocus.pipeline.request_fit import check_heights_of_cameras
from zlocus.pipeline.run_plan import planned
from zlocus.pipeline.setup import OpenedInputs, RunSetup, open_inputs, orient_views, set_up_run
from zlocus.pipeline.tile_run import Polygons, TileProduct, TileRun, name_of, tile_job, workers_for
from zlocus.pipeline.water import far_levels
from zlocus.products.derived import FILES, link_all, write_derived
from zlocus.products.metadata import METADATA
from zlocus.products.rasters import SurfaceRasters
from zlocus.products.redone_area import RAMP_CELLS, RedoneArea
from zlocus.products.report.file_names import RECORD, REPORT
from zlocus.products.surface_cells import SurfaceCells, SurfaceReader, blended, with_fixed
from zlocus.products.surface_statistics import surface_statistics
from zlocus.products.tie_observations import read_observations

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
# The history in run.json: one entry for each part that was redone, the oldest first.
HISTORY = "redone"


@dataclass(frozen=True)
class RedoResult:
    """Result of `run_redo`. n_inside : cells inside the area; n_changed : cells of which a raster has another value."""

    out: Path
    n_inside: int
    n_changed: int
    coverage: float
    was_finished: bool = False

    @property
    def sentence(self) -> str:
        """What was redone."""
        state = "already redone, " if self.was_finished else ""
        return (
            f"{self.out}: {state}{self.n_changed} of {self.n_inside} cells inside the area changed; all others are as "
            f"they were. {100 * self.coverage:.1f} % of the cells seen by two images or more have a height."
        )

    def as_dict(self) -> dict[str, Any]:
        """The result for programs."""
        return {
            "cells_inside": self.n_inside, "cells_changed": self.n_changed, "coverage": round(self.coverage, 6),
            "was_finished": self.was_finished, "run_record": str(self.out / RECORD),
        }  # fmt: skip


@dataclass(frozen=True)
class _Part:
    """A part of a finished surface that is to be redone.

    merged : request of the matching; run, finished : records of the surface; geobox : of the surface; area : on it;
    levels : of polygons with a level, in their order, and the polygons; given_lines : break lines; files : area and
    break lines, with their checksums.
    """

    request: RedoRequest
    merged: DsmRequest
    config: RunConfig
    run: dict[str, Any]
    finished: Finished
    geobox: GeoBox
    area: RedoneArea
    datum: VerticalDatum
    level_polygons: NDArray[Any] | None = None
    levels_m: NDArray[np.float64] | None = None
    given_lines: GivenLines | None = None
    files: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    @property
    def crs(self) -> CRS:
        """The CRS of the grid."""
        return grid_crs(self.geobox)

    @property
    def margin_m(self) -> float | None:
        """Width of the ramp; None where there is none."""
        if self.levels_m is not None:
            return None
        return RAMP_CELLS * float(self.geobox.transform.a) if self.request.margin_m is None else self.request.margin_m

    @property
    def key(self) -> dict[str, Any]:
        """Everything that the part depends on, beside the surface."""
        return {
            **self.files, "level": self.request.level, "margin_m": self.request.margin_m,
            "options": differing(self.merged, self.config, self.run), "versions": versions_record(),
            "kernels": kernels_of_package(),
        }  # fmt: skip

    @property
    def digest(self) -> str:
        """SHA-256 of the key."""
        return hashlib.sha256(json.dumps(self.key, sort_keys=True, default=str).encode()).hexdigest()


@dataclass
class _Changes:
    """Cells of a surface that was written anew. n_inside : of the area; n_changed : with another value."""

    n_inside: int = 0
    n_changed: int = 0


def run_redo(request: RedoRequest, progress: Progress) -> RedoResult:
    """Make a part of a finished surface again, in the place of what is there.

    The surface is replaced as a whole when everything is written. Until then, and after any error, it is as it was;
    finished tiles are kept, and the same command resumes.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        There is no finished surface, an input is not that of its run, or an option cannot be used.
    StoppedError
        A tile failed, or an input has changed.
    """
    out = request.surface.out
    folder = RedoFolder.of(out)
    keep_at_most()
    watch = Stopwatch()
    with watch.stage("open"), progress.stage("Opening the surface"):
        part = _opened(request, progress)
    history = part.run.get(HISTORY, [])
    if history and history[-1].get("key_sha256") == part.digest and request.surface.resume:
        folder.remove()
        last = history[-1]
        return RedoResult(out, last["cells_inside"], last["cells_changed"], float(part.run["coverage"]), True)
    with compression_threads(request.surface.workers or cores()):
        if part.levels_m is not None:
            with _work(folder, part, progress, "") as checkpoint:
                changes = _written(part, folder, (), lambda tile: None, watch, progress)
                return _finished(part, folder, changes, "", checkpoint, watch, progress)
        return _matched(part, folder, watch, progress)


def _opened(request: RedoRequest, progress: Progress) -> _Part:
    """Open the finished run and everything that is given, except images."""
    out = request.surface.out
    finished = read_finished(out)
    if finished is None or not finished.key or not (out / RECORD).is_file():
        raise OutputError(
            f"{out} holds no finished surface, and --redo changes a part of one. Give the same command without --redo "
            "first."
        )
    TileCheckpoint.check_free(out)
    if gone := files_gone(out, finished, progress) - {REPORT, ITEM, METADATA}:
        raise OutputError(
            f"{out} lacks {', '.join(sorted(gone))} of its run. Give the command of the run again, without --redo, and "
            "then this one."
        )
    run = read_record(out / RECORD)
    merged, config = redo_request(request, run), redo_config(request, run)
    with SurfaceReader(out) as reader:
        geobox = reader.geobox
    datum, crs = named_vertical_datum(merged.vertical), grid_crs(geobox)
    level_polygons, levels = _levels(request, run, crs, datum, progress)
    polygons = read_polygons(request.area, crs) if level_polygons is None else level_polygons
    area = RedoneArea.of(polygons, geobox, request.margin_m)
    rows, cols = geobox.shape
    if not any(area.has_cells(strip.row, 0, (strip.rows, cols)) for strip in strips_of(rows)):
        xmin, ymin, xmax, ymax = geobox.boundingbox.bbox
        raise GeometryError(
            f"No polygon of {request.area} holds a cell of the surface in {out} (E {xmin:.0f} to {xmax:.0f} m, N "
            f"{ymin:.0f} to {ymax:.0f} m). Check the polygons and their CRS."
        )
    lines = None
    if request.break_lines is not None:
        lines = read_break_lines(request.break_lines, crs, float(geobox.transform.a))
        _check_lines(lines, area)
    files = {"area": inputs_record(files_of_water(request.area))}
    if request.break_lines is not None:
        files["break_lines"] = inputs_record(files_of_water(request.break_lines))
    return _Part(request, merged, config, run, finished, geobox, area, datum, level_polygons, levels, lines, files)


def _levels(
    request: RedoRequest, run: Mapping[str, Any], crs: CRS, datum: VerticalDatum, progress: Progress
) -> tuple[NDArray[Any] | None, NDArray[np.float64] | None]:
    """Polygons (n,) of --redo and their levels (n,) m; None where no level is given."""
    if request.level is None:
        return None, None
    found = read_water(request.area, crs, request.level_field)
    if request.level_m is not None:
        found = replace(found, levels_m=np.full(len(found.polygons), request.level_m))
    if without := [name for name, level in zip(found.names, found.levels_m, strict=True) if np.isnan(level)]:
        raise InputError(
            f"{without[0].capitalize()} of {request.area} has no level in {request.level_field}. Fill it in, or take "
            "the polygon out."
        )
    searched = run["heights"]["searched_m"]
    height_range = HeightRange.limited_to((float(searched[0]), float(searched[1])))
    for sentence in far_levels(found, height_range, crs, datum):
        progress.note(sentence)
    return found.polygons, found.levels_m


def _check_lines(lines: GivenLines, area: RedoneArea) -> None:
    """Refuse break lines that do not meet the area."""
    points = shapely.points(lines.held[:, :2])
    segments = shapely.linestrings(lines.jumps)
    union = shapely.union_all(area.polygons)
    shapely.prepare(union)
    if not (shapely.intersects(union, points).any() or shapely.intersects(union, segments).any()):
        raise GeometryError(f"No line of {lines.path} meets the area that is redone. Check the lines and their CRS.")


def _matched(part: _Part, folder: RedoFolder, watch: Stopwatch, progress: Progress) -> RedoResult:
    """Match the tiles that the area touches, and blend them in."""
    with watch.stage("open"), progress.stage("Opening images"):
        opened, inputs = _opened_images(part, progress)
    with watch.stage("orient"), kernels_compiling(progress):
        known = read_observations(part.merged.out, len(opened.scene.views))
        orientation = orient_views(
            opened.scene, part.config.orientation, progress, threads=part.merged.workers, known_ties=known
        )  # fmt: skip
        _check_cameras(part, orientation.as_dict())
    with watch.stage("setup"):
        opened = _with_new_heights(part, opened)
        setup = set_up_run(SetupRequest.of(part.merged), opened, orientation, part.config, progress)
        setup = _on_surface(part, setup)
        tiles = _tiles(part, setup)
        plan = planned(setup.match_scene, tiles, part.config, part.merged)
        job = tile_job(part.merged, setup, part.config, _area_of_run(part.merged, opened.scene.crs), plan)
    digest = digest_of(setup.match_scene, orientation)
    progress.note(str(plan))
    with _work(folder, part, progress, digest, inputs) as checkpoint:
        tile_run = TileRun(job, tiles, checkpoint, EventLog(folder.work))
        try:
            with watch.stage("match") as elsewhere:
                failed = tile_run.run(plan, workers_for(plan, job, progress), progress, elsewhere)
        except KeyboardInterrupt:
            tile_run.tell_interrupted(progress)
            raise
        inputs.check(len(checkpoint.finished))
        tile_run.check(failed, partial=False)

        def product(tile: Tile) -> TileProduct | None:
            arrays = checkpoint.load(name_of(tile)) if tile.core_window.rows and tile.core_window.cols else None
            if arrays is None and tile.core_window.rows and tile.core_window.cols:
                raise StoppedError(
                    f"{folder.work} was damaged since its tiles were written. Give the same command again."
                )
            return None if arrays is None else TileProduct.of(arrays)

        changes = _written(part, folder, tiles, product, watch, progress, setup)
        return _finished(part, folder, changes, digest, checkpoint, watch, progress)


def _opened_images(part: _Part, progress: Progress) -> tuple[OpenedInputs, InputFiles]:
    """The images as the run has opened them, which must be those of the run.

    Raises
    ------
    InputError
        They are not.
    """
    asked = part.run["config"]["request"]
    recorded = replace(
        SetupRequest.of(part.merged), heights=_recorded_heights(part), reference=asked.get("reference"),
        method=asked["method"], dem=None, dem_vertical=None,
    )  # fmt: skip
    opened = open_inputs(recorded, progress, "later")
    images = files_of(opened.scene)
    inputs = InputFiles.of([*images, *([] if part.merged.dem is None else [part.merged.dem])], opened.scene)
    names, of_run = {view.name for view in opened.scene.views}, set(part.run["orientation"]["views"])
    if names != of_run:
        raise InputError(
            f"The images are not those of the run in {part.merged.out}: {', '.join(sorted(names ^ of_run)[:3])}. "
            "Give the same inputs; --redo keeps the cameras."
        )
    known = part.finished.key["inputs"]
    if any(known.get(str(path)) != inputs.states[str(path)] for path in images):  # seen from another folder, or copied
        checksums = {record["sha256"] for record in part.run["inputs"]}
        if changed := [record["path"] for record in inputs_record(images) if record["sha256"] not in checksums]:
            raise InputError(
                f"{changed[0]} is not what the run in {part.merged.out} has read. Put the file of that run back, or "
                "make a new surface without --redo."
            )
    return opened, inputs


def _check_cameras(part: _Part, orientation: Mapping[str, Any]) -> None:
    """Refuse cameras that came out otherwise than in the run: the part would not lie where its surroundings lie."""
    now = json.loads(json.dumps(orientation["views"]))
    if now != part.run["orientation"]["views"]:
        raise OutputError(
            f"The cameras came out otherwise than in the run in {part.merged.out}, as they may on another machine or "
            "with another version, and the part would not fit. Make the whole surface anew with --overwrite."
        )


def _with_new_heights(part: _Part, opened: OpenedInputs) -> OpenedInputs:
    """The opened inputs, with the heights that are searched this time."""
    heights = part.merged.heights
    bounds = part.geobox.boundingbox.bbox
    if heights == _recorded_heights(part):
        return opened
    scene = replace(opened.scene, heights=None)
    scene = with_heights(scene, heights, opened.vertical_datum, bounds)
    check_heights_of_cameras(scene.heights, scene)
    return replace(opened, scene=scene)


def _recorded_heights(part: _Part) -> tuple[float, float] | None:
    found = part.run["config"]["request"].get("heights")
    return None if found is None else (float(found[0]), float(found[1]))


def _on_surface(part: _Part, setup: RunSetup) -> RunSetup:
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
        lines = part.given_lines
        held = lines.held.copy()
        held[:, 2] += part.datum.undulation(held[:, :2], part.crs)
        _check_held(lines, held, setup.height_range)
        match_scene = replace(match_scene, break_lines=BreakLines(lines.jumps, held))
    return replace(setup, grid=grid, match_scene=match_scene)


def _check_held(lines: GivenLines, held: NDArray[np.float64], height_range: HeightRange) -> None:
    low, high = height_range.searched
    beyond = (held[:, 2] < low) | (held[:, 2] > high)
    if beyond.any():
        z = lines.held[beyond, 2]
        raise InputError(
            f"{lines.path} has heights from {z.min():.2f} to {z.max():.2f} m outside the heights that are searched "
            f"({low:.1f} to {high:.1f} m above the ellipsoid). Correct them, or give --heights that contain them."
        )


def _tiles(part: _Part, setup: RunSetup) -> list[Tile]:
    """The tiles of the surface that the area touches."""
    window = setup.grid.window
    return [
        tile
        for tile in plan_tiles(window, setup.match_scene.overlap_window, part.config.pyramid)
        if part.area.has_cells(
            tile.kept_window.row - window.row, tile.kept_window.col - window.col,
            (tile.kept_window.rows, tile.kept_window.cols),
        )
    ]  # fmt: skip


def _area_of_run(request: DsmRequest, crs: CRS) -> Polygons:
    """Polygons of --area and --mask of the run."""
    area = None if request.area is None else read_polygons(request.area, crs)
    mask = None if request.mask is None else read_polygons(request.mask, crs)
    return Polygons(area, mask)


@contextmanager
def _work(
    folder: RedoFolder, part: _Part, progress: Progress, setup_digest: str, inputs: InputFiles | None = None
) -> Iterator[TileCheckpoint]:
    """The folder of the tiles, locked; what another command left there is dropped."""
    base = {name: part.finished.checksums.get(name) for name in RASTERS}
    key = {"redo": part.key, "surface": base, "options": config_as_dict(part.config)}
    check = (lambda n_kept: None) if inputs is None else inputs.check
    key = json.loads(json.dumps(key, default=str))
    TileCheckpoint.check_free(folder.work)
    try:
        checkpoint = TileCheckpoint.of(
            folder.work, key, part.request.surface.resume, not part.request.surface.resume, check
        )
    except OutputError:
        progress.note("An interrupted --redo with other options is dropped.")
        checkpoint = TileCheckpoint.of(folder.work, key, True, True, check)
    made = not folder.work.exists()
    try:
        with checkpoint.open(setup_digest):
            yield checkpoint
    except BaseException:
        if not checkpoint.finished and (made or part.levels_m is not None):
            folder.remove()
        raise


def _written(
    part: _Part,
    folder: RedoFolder,
    tiles: Sequence[Tile],
    product: Callable[[Tile], TileProduct | None],
    watch: Stopwatch,
    progress: Progress,
    setup: RunSetup | None = None,
) -> _Changes:
    """Write all rasters of the new folder: the old cells, and those of the part."""
    derived = {name for name in FILES.values() if (part.merged.out / name).is_file()}
    folder.begin_surface({*RASTERS, *derived, RECORD, FINISHED, ITEM, METADATA, REPORT})
    changes = _Changes()
    with watch.stage("write"), SurfaceReader(part.merged.out) as reader:
        rasters = SurfaceRasters(folder.surface, part.geobox, reader.ortho_dtype, part.datum, reader.has_colours)
        rows, cols = part.geobox.shape
        strips = list(strips_of(rows))
        with rasters, progress.stage("Writing", len(strips) + len(tiles)) as stage:
            for strip in strips:
                shape = (strip.rows, cols)
                cells = reader.read(strip.row, 0, shape)
                if part.levels_m is not None:
                    cells = _levelled(part, strip.row, shape, cells, changes)
                rasters.write_cells(strip.row, 0, cells)
                stage.advance()
            for tile in tiles:
                made = product(tile)
                if made is not None:
                    assert setup is not None, "tiles are those of a setup"
                    _blend(part, setup, tile, made, reader, rasters, changes)
                stage.advance()
    return changes


def _levelled(part: _Part, row: int, shape: tuple[int, int], old: SurfaceCells, changes: _Changes) -> SurfaceCells:
    """Cells of a strip, with the level of their polygon."""
    assert part.level_polygons is not None, "callers make sure"
    assert part.levels_m is not None, "polygons have levels"
    numbers = np.arange(1, len(part.level_polygons) + 1)
    of_polygon = cells_of_each(part.level_polygons, numbers, part.geobox[row : row + shape[0], : shape[1]])
    heights = np.concatenate([[np.nan], part.levels_m])[of_polygon]
    cells = with_fixed(old, heights)
    changes.n_inside += int((of_polygon > 0).sum())
    changes.n_changed += int(cells.differs_from(old).sum())
    return cells


def _blend(
    part: _Part,
    setup: RunSetup,
    tile: Tile,
    made: TileProduct,
    reader: SurfaceReader,
    rasters: SurfaceRasters,
    changes: _Changes,
) -> None:
    """Blend a tile into the rasters."""
    window, grid = tile.kept_window, setup.grid
    row, col, shape = window.row - grid.window.row, window.col - grid.window.col, (window.rows, window.cols)
    weight = part.area.weights(row, col, shape)
    old = reader.read(row, col, shape)
    cells = blended(old, rasters.cells_of(row, col, made.surface), weight)
    if part.given_lines is not None and len(part.given_lines.held):
        box = part.geobox[row : row + shape[0], col : col + shape[1]]
        heights = held_heights(part.given_lines.held, ~box.transform, shape)
        cells = with_fixed(cells, np.where(weight > 0, heights, np.nan))
    changes.n_inside += int((weight > 0).sum())
    changes.n_changed += int(cells.differs_from(old).sum())
    rasters.write_cells(row, col, cells)


def _finished(
    part: _Part,
    folder: RedoFolder,
    changes: _Changes,
    setup_digest: str,
    checkpoint: TileCheckpoint,
    watch: Stopwatch,
    progress: Progress,
) -> RedoResult:
    """Write everything that follows from the rasters, and put the new folder in the place of the old one."""
    new, old = folder.surface, part.merged.out
    with watch.stage("products"):
        names = [name for name, file in FILES.items() if (old / file).is_file()]
        write_derived(new, names, part.config.products, progress)
        statistics = surface_statistics(new)
    entry = _entry(part, changes, setup_digest, watch)
    run = part.run | {
        "coverage": round(statistics.coverage, 6), **statistics.as_dict(),
        "rasters": {name: checksum(new / name) for name in RASTERS}, HISTORY: [*part.run.get(HISTORY, []), entry],
    }  # fmt: skip
    run.pop("schema", None)
    write_record(new / RECORD, run)
    if (old / REPORT).is_file():
        from zlocus.pipeline.report_inputs import try_report

        try_report(new, progress)
    link_all(new, progress)
    write_finished(new, part.finished.key, part.finished.shortcoming, n_redone=len(run[HISTORY]))
    folder.replace()
    checkpoint.finished.clear()
    return RedoResult(part.merged.out, changes.n_inside, changes.n_changed, statistics.coverage)


def _entry(part: _Part, changes: _Changes, setup_digest: str, watch: Stopwatch) -> dict[str, Any]:
    """The entry of the history in run.json."""
    n_cells = int(np.prod(part.geobox.shape))
    return {
        "time": utc_now(), **part.files, "level": part.request.level, "margin_m": part.margin_m,
        "options": differing(part.merged, part.config, part.run), "cells_inside": changes.n_inside,
        "cells_changed": changes.n_changed, "share_changed": round(changes.n_changed / n_cells, 8),
        "versions": versions_record(), "setup_sha256": setup_digest or None, "key_sha256": part.digest,
        "stages": watch.stages,
    }  # fmt: skip
