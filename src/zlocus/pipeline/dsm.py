"""`zlocus dsm`: the stages of a surface, in their order, with finished runs and interrupts around them.

1. open: inputs, and what an earlier run left in the folder (`open_run`);
2. orient: tie points and cameras (`setup.orient_views`);
3. setup: height range, grid and match scene (`setup.set_up_run`), and the plan of tiles (`tile_run`);
4. match: tiles on the ground grid (`tile_run`), or pixels of all images first (`image_tiles`);
5. write: rasters, points, run.json, report and maps (`surface_products`).
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from zlocus.core.errors import CoverageError, OutputError, StoppedError
from zlocus.core.footprints import matched_area
from zlocus.core.jit import CACHE
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import DsmRequest, SetupRequest, check_output
from zlocus.core.resources import cores
from zlocus.io.input_files import InputFiles
from zlocus.io.rasters import compression_threads
from zlocus.io.run_record import Stopwatch, read_record
from zlocus.io.vertical import VerticalDatum
from zlocus.io.water_polygons import WaterPolygons
from zlocus.pipeline.execution.checkpoint import TileCheckpoint, has_plan, kept_tiles
from zlocus.pipeline.execution.event_log import EventLog
from zlocus.pipeline.execution.plan import Tile, keep_at_most, plan_tiles
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.execution.tasks import Outcome
from zlocus.pipeline.extent import seen_sentence, seen_share_of_run
from zlocus.pipeline.fingerprint import digest_of
from zlocus.pipeline.finished_record import write_finished
from zlocus.pipeline.finished_run import Missing, make_missing, missing_products, whole_again
from zlocus.pipeline.messages import note_orientation
from zlocus.pipeline.open_run import OpenRun, check_polygons, known_ties, may_have_terrain, note_mask_beside, open_run
from zlocus.pipeline.output_folder import made_folder, remove_earlier_products
from zlocus.pipeline.required_space import check_room
from zlocus.pipeline.run_plan import Plan, planned, remember_run, said_before_orientation, timed_stages
from zlocus.pipeline.setup import RunSetup, orient_views, set_up_run
from zlocus.pipeline.surface_products import (
    has_colours,
    remove_outdated_curves,
    run_record,
    shortcoming_of,
    surface_rasters,
    write_maps,
    write_points,
    write_report_inputs,
    written_record,
)
from zlocus.pipeline.tile_makers import tile_maker
from zlocus.pipeline.tile_run import Tally, TileJob, TileRun, tile_job, workers_for
from zlocus.pipeline.water import far_levels, note_water, water_on_grid
from zlocus.products.derived import check_derived
from zlocus.products.ortho_colours import colour_records, colour_sentence
from zlocus.products.report.file_names import RECORD, REPORT
from zlocus.products.water import level_water

# What becomes of a plan of tasks. out : folder of the results.
TAKES_PLAN_OVER = (
    "{out} holds a plan of tasks for this surface (`zlocus tiles`). This run makes it at once, with the tiles that are "
    "finished, and removes the plan."
)


@dataclass(frozen=True)
class DsmResult:
    """Result of `run_dsm`.

    out : folder of the products; coverage : share of the cells seen by two images or more that have a height;
    was_finished : whether an earlier run of the same command had made the surface already; seen_share : share of the
    area asked for that two images see, None where it is not known.
    """

    out: Path
    coverage: float
    was_finished: bool = False
    seen_share: float | None = None

    @property
    def sentence(self) -> str:
        """How complete the surface is, and where to read more."""
        state = "already finished, " if self.was_finished else ""
        text = f"{self.out}: {state}{100 * self.coverage:.1f} % of the cells seen by two images or more have a height."
        report = self.out / REPORT
        where = f"See {report}." if report.is_file() else ""
        return " ".join(part for part in (text, seen_sentence(self.seen_share), where) if part)

    def as_dict(self) -> dict[str, Any]:
        """The surface for programs: how complete it is, its files and grid, and how long its run took, s."""
        return {
            "coverage": round(self.coverage, 6), "was_finished": self.was_finished, "area_seen": self.seen_share,
            **written_record(self.out),
        }  # fmt: skip


def run_dsm(request: DsmRequest, config: RunConfig, progress: Progress) -> DsmResult:
    """Make a surface and write all products to `request.out`.

    Where the same command has finished there already, only products that are missing are made.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        Before the first tile: an input that cannot be used, or `out` holds another run and may not be overwritten.
    StoppedError
        Later: tiles fail, an input has changed, or results cannot be written; finished tiles are kept.
    CoverageError
        At the end, with all products written: fewer than half of the cells seen by two images have a height, or the
        cameras are in grave doubt.
    """
    check_output(request.out, request.overwrite, may_be_same=True)
    keep_at_most()  # an earlier run of this process may have kept less
    tile_runs: list[TileRun] = []
    try:
        with compression_threads(request.workers or cores()):
            return _run_stages(request, config, progress, tile_runs)
    except OutputError as error:
        if not any(tile_run.checkpoint.finished and tile_run.checkpoint.is_there for tile_run in tile_runs):
            raise
        n, checkpoint = len(tile_runs[0].checkpoint.finished), tile_runs[0].checkpoint
        raise StoppedError(f"{error} {kept_tiles(n)}: {checkpoint.how_to_resume}.") from error
    except KeyboardInterrupt:
        for tile_run in tile_runs:
            tile_run.tell_interrupted(progress)
        raise


def _run_stages(request: DsmRequest, config: RunConfig, progress: Progress, tile_runs: list[TileRun]) -> DsmResult:
    """See `run_dsm`. tile_runs : takes the run of the tiles once it starts, for messages after an interrupt."""
    watch = Stopwatch()
    check_before_opening(request, config)
    TileCheckpoint.check_free(request.out)
    with watch.stage("open"), progress.stage("Opening images"):
        run = open_run(request, config, progress)
    if run.checkpoint.is_of_this_run and has_plan(request.out):
        progress.note(TAKES_PLAN_OVER.format(out=request.out))
    if run.finished is not None:
        missing = missing_products(request, config.products, run.finished, progress)
        if not missing.matched:
            return _already_finished(request, config, run, missing, progress)
        request = whole_again(request, run.finished, missing, progress)
    checkpoint, out, tally = run.checkpoint, request.out, Tally()
    is_compiled, is_whole = CACHE.is_complete, not checkpoint.finished
    prepared = prepare_surface(request, config, run, watch, progress)
    progress.note(str(prepared.plan))
    tile_run = TileRun(prepared.tile_job, prepared.tiles, checkpoint, EventLog(out))
    with made_folder(out), checkpoint.open(prepared.digest, prepared.before):
        tile_runs.append(tile_run)
        with watch.stage("match") as elsewhere:
            plan, setup = prepared.plan, prepared.setup
            make = tile_maker(request, prepared.tile_job, checkpoint, setup, plan, tally, progress)
            failed = tile_run.run(plan, workers_for(plan, make, progress), progress, elsewhere)
        run.inputs.check(len(checkpoint.finished), may_miss=bool(failed))
        tile_run.check(failed, request.partial)
        with watch.stage("record"):
            checksums = run.inputs.record(len(checkpoint.finished))
        with watch.stage("write"):
            write_rasters(prepared, tile_run, failed, tally, progress)
    if is_whole:
        views = run.opened_inputs.scene.views
        remember_run(prepared.plan, request, views, timed_stages(watch.stages, is_compiled))
    record = write_products(prepared, tally, checksums, watch, progress)
    write_maps(request, config, watch, record, progress)
    tile_run.end(failed, tally)
    return finish(prepared, checkpoint, tally, progress)


@dataclass(frozen=True)
class PreparedSurface:
    """A surface whose tiles can be matched: everything that they and the products need.

    inputs : files, with their states when the run began; tile_job : makes the tiles; digest : SHA-256 of the run setup;
    seen_share : about the share of the area asked for that two images see, None where none was asked for;
    water_polygons : of water surfaces on the grid, None where none are given.
    """

    request: DsmRequest
    config: RunConfig
    vertical_datum: VerticalDatum
    inputs: InputFiles
    setup: RunSetup
    tiles: Sequence[Tile]
    plan: Plan
    tile_job: TileJob
    digest: str
    seen_share: float | None
    water_polygons: WaterPolygons | None = None

    def seen_of(self, tally: Tally) -> float | None:
        """Share of the area asked for that two images see, by the cells; None where no area was asked for."""
        return None if self.seen_share is None else tally.seen_share

    @property
    def before(self) -> dict[str, NDArray[Any]]:
        """The tie points as arrays, which a checkpoint keeps before its first tile; none where they are not refined."""
        ties = self.setup.orientation.refined_ties
        return {} if ties is None else ties.arrays()


def check_before_opening(request: DsmRequest, config: RunConfig) -> None:
    """Refuse, before images are opened, maps and a report that could not be made after the matching."""
    check_derived(request.products, config.products, may_have_terrain(request))
    if request.report:
        importlib.import_module("zlocus.pipeline.report_inputs")  # a fault there must show now, not after the matching


def prepare_surface(
    request: DsmRequest, config: RunConfig, run: OpenRun, stopwatch: Stopwatch, progress: Progress
) -> PreparedSurface:
    """Orient the views of a run and set it up: the stages between opening and matching."""
    opened_inputs = run.opened_inputs
    if sentence := colour_sentence(colour_records(opened_inputs.scene.views)):
        progress.note(sentence)
    progress.note(said_before_orientation(opened_inputs.scene.views, request.workers))
    with stopwatch.stage("orient"), kernels_compiling(progress):
        ties = known_ties(run.checkpoint, opened_inputs.scene, progress)
        orientation = orient_views(
            opened_inputs.scene, config.orientation, progress, threads=request.workers, known_ties=ties
        )  # fmt: skip
        note_orientation(orientation, progress, request.heights is not None)
    with stopwatch.stage("setup"):
        setup = set_up_run(SetupRequest.of(request), opened_inputs, orientation, config, progress)
        tiles = plan_tiles(setup.grid.window, setup.match_scene.overlap_window, config.pyramid)
        plan = _checked_plan(request, config, run, setup, tiles)
        note_mask_beside(request.mask, run.polygons.outside, setup.grid.geobox, progress)
        water_polygons = run.water_polygons
        if water_polygons is not None:
            water_polygons = water_on_grid(water_polygons, setup.grid.geobox, progress)
            far_levels(water_polygons, setup.height_range, setup.scene.crs, opened_inputs.vertical_datum)
    job, digest = tile_job(request, setup, config, run.polygons, plan), digest_of(setup.match_scene, orientation)
    share = seen_share_of_run(setup, run.polygons, bool(request.bounds or request.like))
    if sentence := seen_sentence(share, "about "):
        progress.note(sentence)
    return PreparedSurface(
        request, config, opened_inputs.vertical_datum, run.inputs, setup, tiles, plan, job, digest, share,
        water_polygons,
    )  # fmt: skip


def write_rasters(
    prepared_surface: PreparedSurface,
    tile_run: TileRun,
    failed_outcomes: Sequence[Outcome],
    tally: Tally,
    progress: Progress,
) -> None:
    """Write the rasters in place of an earlier run's products, and level water. failed_outcomes : of the tiles that
    stay empty.

    Raises
    ------
    StoppedError
        A terrain model that fills gaps has changed, or a tile is damaged; no raster is written.
    """
    request, setup = prepared_surface.request, prepared_surface.setup
    remove_earlier_products(request.out)
    with surface_rasters(request, setup, prepared_surface.vertical_datum) as rasters:
        tile_run.assemble(failed_outcomes, rasters, tally, progress)
        water_found = level_water(
            rasters, setup.grid.geobox, prepared_surface.water_polygons, request.level_water,
            prepared_surface.config.water,
        )  # fmt: skip
        if prepared_surface.water_polygons is not None:
            water_found.doubts += far_levels(
                prepared_surface.water_polygons, setup.height_range, setup.scene.crs, prepared_surface.vertical_datum
            )
        tally.add_water(water_found)
        note_water(water_found, request, progress)
        # A terrain model that fills gaps was read again.
        prepared_surface.inputs.check(len(tile_run.checkpoint.finished))


def write_products(
    prepared_surface: PreparedSurface,
    tally: Tally,
    checksums: list[dict[str, Any]],
    stopwatch: Stopwatch,
    progress: Progress,
) -> dict[str, Any]:
    """Write points and what the report shows, and return the content of run.json. checksums : of the inputs."""
    request, config, setup = prepared_surface.request, prepared_surface.config, prepared_surface.setup
    datum = prepared_surface.vertical_datum
    with stopwatch.stage("points"):
        write_points(request.out, setup, tally.labelled_ties, datum)
    if request.report:
        write_report_inputs(request.out, setup, datum, config, stopwatch, progress)
        remove_outdated_curves(request.out, prepared_surface.inputs, progress)
    record = run_record(request, config, setup, datum, checksums, tally, prepared_surface.plan)
    return record | {
        "area_seen": prepared_surface.seen_of(tally), "setup_sha256": prepared_surface.digest,
        "stages": stopwatch.stages,
    }  # fmt: skip


def finish(
    prepared_surface: PreparedSurface, checkpoint: TileCheckpoint, tally: Tally, progress: Progress
) -> DsmResult:
    """Record that the run is finished, with the checksums of its products, and remove its tiles.

    Raises
    ------
    CoverageError
        The run has a shortcoming that --partial does not accept.
    """
    request = prepared_surface.request
    shortcoming = shortcoming_of(tally, prepared_surface.setup.doubts, request.out, progress)
    write_finished(request.out, checkpoint.key, shortcoming)
    checkpoint.remove()
    result = DsmResult(request.out, tally.coverage, seen_share=prepared_surface.seen_of(tally))
    return _accepted(request, result, shortcoming)


def _checked_plan(request: DsmRequest, config: RunConfig, run: OpenRun, setup: RunSetup, tiles: Sequence[Tile]) -> Plan:
    """How the tiles are worked on, after the checks that need the grid: disk space, geoid and polygons."""
    check_room(request.out, setup.grid, setup.match_scene, has_colours(request, setup))
    plan = planned(setup.match_scene, tiles, config, request)
    run.opened_inputs.vertical_datum.check_covers(
        matched_area(setup.grid, setup.match_scene.overlap_window), run.opened_inputs.scene.crs
    )
    check_polygons(request, setup, run.polygons.inside)
    return plan


def _already_finished(
    request: DsmRequest, config: RunConfig, run: OpenRun, missing: Missing, progress: Progress
) -> DsmResult:
    """The result of a run whose surface is there already, after products that are missing were made."""
    assert run.finished is not None, "callers make sure"
    make_missing(request, config, run.opened_inputs, run.finished, missing, progress)
    run.checkpoint.remove()  # where a run was stopped between its last file and its end
    record = read_record(request.out / RECORD)
    result = DsmResult(request.out, float(record["coverage"]), True, record.get("area_seen"))
    return _accepted(request, result, run.finished.shortcoming)


def _accepted(request: DsmRequest, result: DsmResult, shortcoming: str) -> DsmResult:
    """The result of a run whose products are all written.

    Raises
    ------
    CoverageError
        The run has a shortcoming that --partial does not accept.
    """
    if shortcoming and not request.partial:
        raise CoverageError(shortcoming)
    return result
