"""`zlocus tiles`: a surface made by independent processes, such as the tasks of an array job of SLURM.

1. `plan_tasks` opens and orients the images, and stores what tiles and products are made of (`array_plan`);
2. `run_task` makes the tiles of one task; any number of processes do so at a time, on any machine;
3. `assemble_tasks` writes the products, as the end of `zlocus dsm` does.
"""

from __future__ import annotations

import datetime
import math
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zlocus.core.errors import ConfigError, CoverageError, OutputError, StoppedError
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.quoting import counted
from zlocus.core.requests import DsmRequest, check_output
from zlocus.core.resources import cores
from zlocus.io.input_files import InputFiles
from zlocus.io.rasters import compression_threads
from zlocus.io.run_record import Stopwatch, WorkerUsage
from zlocus.pipeline.array_plan import (
    MAX_NAMED_GROUPS,
    TASKS,
    ArrayPlan,
    FinishedTasks,
    as_ranges,
    finished_tasks,
    most_tiles,
    packed_plan_values,
    plan_or_finished,
    stored_plan,
    write_plan,
)
from zlocus.pipeline.dsm import (
    DsmResult,
    PreparedSurface,
    check_before_opening,
    finish,
    prepare_surface,
    write_products,
    write_rasters,
)
from zlocus.pipeline.execution.checkpoint import FOLDER, TileCheckpoint, kept_tiles
from zlocus.pipeline.execution.event_log import EventLog
from zlocus.pipeline.execution.plan import Tile, keep_at_most
from zlocus.pipeline.execution.tasks import Cause, Failure, Outcome
from zlocus.pipeline.finished_run import missing_products, whole_again
from zlocus.pipeline.open_run import OpenRun, open_run
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.run_plan import Plan, planned
from zlocus.pipeline.surface_products import write_maps
from zlocus.pipeline.tile_run import Tally, TileRun, name_of, workers_for

# Names of the logs of tasks, beside their tiles, until the surface is assembled.
LOGS = "events.*.jsonl"


@dataclass(frozen=True)
class StoredRun:
    """What a plan stores. stages : times of the stages before matching, see `Stopwatch`."""

    prepared_surface: PreparedSurface
    stages: list[dict[str, Any]]


@dataclass(frozen=True)
class ArrayState:
    """What is done of a run in tasks, and what is left.

    array_plan : of the run; n_tiles_done : finished tiles; left : numbers of the tasks that are not finished.
    """

    array_plan: ArrayPlan
    n_tiles_done: int
    left: list[int]

    def as_dict(self) -> dict[str, Any]:
        """The same for programs: numbers of tasks and tiles, and the numbers of the tasks that are left."""
        array_plan = self.array_plan
        return {
            "tasks": array_plan.n_tasks, "tasks_with_tiles": len(array_plan.with_work),
            "tiles": len(array_plan.names), "tiles_done": self.n_tiles_done, "left": self.left, "is_assembled": False,
            "task_mb": round(array_plan.task_mb, 1), "task_s": round(array_plan.task_s, 1),
            "assemble_s": round(array_plan.assemble_s, 1),
        }  # fmt: skip

    def __str__(self) -> str:
        array_plan, out = self.array_plan, self.array_plan.out
        n_tasks, n_tiles = len(array_plan.with_work), len(array_plan.names)
        n_done = n_tasks - len(self.left)
        lines = [
            str(array_plan),
            f"Done: {n_done} of {counted(n_tasks, 'task')}, {self.n_tiles_done} of {counted(n_tiles, 'tile')}.",
        ]
        if len(self.left) == 1:
            (number,) = self.left
            lines.append(
                f"Left: task {number}. Run `zlocus tiles run {out} {number}`, then `zlocus tiles assemble {out}`."
            )
        elif self.left:
            lines.append(
                f"Left: tasks {as_ranges(self.left)}. Run `zlocus tiles run {out} N` for each number N of them, in any "
                f"order and any number at a time; then `zlocus tiles assemble {out}`."
            )
        else:
            lines.append(f"Left: nothing but the assembly, `zlocus tiles assemble {out}`.")
        return "\n".join(lines)


@dataclass(frozen=True)
class TaskResult:
    """What a process made of a task.

    n_tiles : of the task; n_made : those that were not finished before; is_surface_finished : whether the surface is
    assembled already, so that the tiles are gone.
    """

    number: int
    n_tiles: int = 0
    n_made: int = 0
    is_surface_finished: bool = False

    def __str__(self) -> str:
        if self.is_surface_finished:
            return f"the surface is finished already, and nothing is left of task {self.number}."
        if not self.n_tiles:
            return f"task {self.number} is finished, for it has no tile: there are more tasks than tiles."
        if not self.n_made:
            return f"task {self.number} is finished already, with its {counted(self.n_tiles, 'tile')}."
        n_earlier = self.n_tiles - self.n_made
        earlier = f" {n_earlier} {'was' if n_earlier == 1 else 'were'} there already." if n_earlier else ""
        return f"task {self.number} is finished, {self.n_made} of its {counted(self.n_tiles, 'tile')} made.{earlier}"


def plan_tasks(
    request: DsmRequest, config: RunConfig, n_tasks: int | None, progress: Progress
) -> ArrayState | FinishedTasks:
    """Plan a surface in tasks, and store in `request.out` what the other processes need.

    Where the same run is planned there already, or finished, nothing is done. n_tasks : None makes a task of each tile.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        See `zlocus.pipeline.dsm.run_dsm`; or the method matches whole images, or the run is planned in another number
        of tasks.
    """
    _check_tasks(request, n_tasks)
    check_output(request.out, request.overwrite, may_be_same=True)
    keep_at_most()  # an earlier run of this process may have kept less
    stopwatch = Stopwatch()
    check_before_opening(request, config)
    with stopwatch.stage("open"), progress.stage("Opening images"):
        run = open_run(request, config, progress)
    if run.finished is not None:
        missing = missing_products(request, config.products, run.finished, progress)
        if not missing.matched:
            return finished_tasks(request.out) or FinishedTasks(request.out, 0)
        request = whole_again(request, run.finished, missing, progress)
    if run.checkpoint.is_of_this_run and request.resume and not request.overwrite:
        earlier = stored_plan(request.out)
        if earlier is not None and earlier.content is not None:
            _check_same_number(earlier, n_tasks)
            return state_of(earlier)
    prepared_surface = prepare_surface(replace(request, workers=None), config, run, stopwatch, progress)
    with made_folder(request.out), run.checkpoint.open(prepared_surface.digest, prepared_surface.before) as checkpoint:
        array_plan, content = _array_plan(prepared_surface, run, n_tasks, stopwatch)
        if not checkpoint.finished:
            EventLog(request.out).remove()
        write_plan(array_plan, content)
        run.inputs.check()
    return state_of(array_plan)


def _check_tasks(request: DsmRequest, n_tasks: int | None) -> None:
    """Refuse what cannot be made in tasks."""
    if n_tasks is not None and n_tasks < 1:
        raise ConfigError(f"--tasks {n_tasks} is too few; give 1 or more.")
    if request.is_in_image_space:
        raise ConfigError(
            f"--method {request.method} matches whole images in one process, and not tile by tile. Use `zlocus dsm` "
            "for it, or mvll-sgm here."
        )


def _check_same_number(array_plan: ArrayPlan, n_tasks: int | None) -> None:
    if n_tasks not in (None, array_plan.n_tasks):
        raise ConfigError(
            f"{array_plan.out} is planned in {array_plan.n_tasks} tasks already, and --tasks {n_tasks} contradicts "
            "that. Leave --tasks out, or add --overwrite to plan anew without the finished tiles."
        )


def _array_plan(
    prepared_surface: PreparedSurface, run: OpenRun, n_tasks: int | None, stopwatch: Stopwatch
) -> tuple[ArrayPlan, bytes]:
    """The plan of a run in tasks, and the values that it stores."""
    request, checkpoint = prepared_surface.request, run.checkpoint
    names = tuple(name_of(tile) for tile in worked_tiles(prepared_surface.tiles))
    n_tasks = n_tasks or len(names)
    plan = _plan_of(prepared_surface, prepared_surface.tiles, 1)
    checksums = run.inputs.record()
    stored_run = StoredRun(replace(prepared_surface, plan=plan), stopwatch.stages)
    content, values_sha256 = packed_plan_values(stored_run)
    share = most_tiles(len(names), n_tasks) / max(len(names), 1)
    array_plan = ArrayPlan(
        out=request.out, n_tasks=n_tasks, names=names, key=checkpoint.key, digest=prepared_surface.digest,
        values_sha256=values_sha256, started_in=str(Path.cwd()), inputs=tuple(checksums),
        task_mb=round(plan.n_bytes / 1e6, 1), task_s=round(plan.match_rate.factor * plan.seconds * share, 3),
        assemble_s=round(plan.write_rate.factor * plan.write_s, 3),
    )  # fmt: skip
    return array_plan, content


def worked_tiles(tiles: Sequence[Tile]) -> list[Tile]:
    """The tiles that have something to be matched."""
    return [tile for tile in tiles if tile.core_window.rows and tile.core_window.cols]


def _plan_of(prepared_surface: PreparedSurface, tiles: Sequence[Tile], workers: int) -> Plan:
    """How one process works on some tiles of a surface."""
    request = replace(prepared_surface.request, workers=workers, scheduler=None)
    return planned(prepared_surface.setup.match_scene, tiles, prepared_surface.config, request)


def state_of(array_plan: ArrayPlan) -> ArrayState:
    """What is done of a run in tasks. A tile counts as finished where it is listed and its file is there."""
    finished = _listed(array_plan, array_plan.checkpoint())
    return ArrayState(array_plan, len(finished), array_plan.left(finished))


def state_or_finished(out: Path) -> ArrayState | FinishedTasks:
    """What is done of the run that is planned in a folder, or what was made of it.

    Raises
    ------
    InputError
        The folder holds neither.
    """
    found = plan_or_finished(out)
    return found if isinstance(found, FinishedTasks) else state_of(found)


def _listed(array_plan: ArrayPlan, checkpoint: TileCheckpoint) -> list[str]:
    """Names of the tiles of a plan that are listed as finished and have a file, which is not read."""
    there = {path.stem for path in (array_plan.out / FOLDER).glob("*.npz")}
    return [name for name in array_plan.names if name in checkpoint.finished and name in there]


def run_task(out: Path, number: int, workers: int, progress: Progress) -> TaskResult:
    """Make the tiles of a task that are not finished yet. workers : tiles worked on at a time.

    Two processes with the same task do the same work twice, and leave what one would have left.

    Raises
    ------
    InputError, ConfigError
        Before the first tile: no plan, no such task, another installation, or an input that has changed.
    OutputError
        Another process has the folder for itself.
    StoppedError
        Tiles fail, an input changes meanwhile, or tiles cannot be written; finished tiles are kept.
    """
    found = plan_or_finished(out)
    if isinstance(found, FinishedTasks):
        if not 1 <= number <= found.n_tasks:
            raise ConfigError(
                f"The surface in {out} was made of {found.n_tasks} tasks, numbered from 1 to {found.n_tasks}, and "
                f"{number} is none of them. It is finished; give no more tasks."
            )
        return TaskResult(number, is_surface_finished=True)
    names = found.names_of(number)
    if workers < 1:
        raise ConfigError(f"--workers {workers} is too few; give 1 or more.")
    keep_at_most()
    with found.folder_of_paths() as array_plan:
        checkpoint = array_plan.checkpoint()
        with checkpoint.joined(str(number)):
            left = {name for name in names if not checkpoint.holds(name)}
            if left:
                _make_tiles(array_plan, number, left, workers, checkpoint, progress)
    return TaskResult(number, len(names), len(left))


def _make_tiles(
    array_plan: ArrayPlan,
    number: int,
    left: set[str],
    workers: int,
    checkpoint: TileCheckpoint,
    progress: Progress,
) -> None:
    """Make the tiles of a task that are left, see `run_task`."""
    stored_run: StoredRun = array_plan.values()
    prepared_surface, inputs = stored_run.prepared_surface, array_plan.current_inputs()
    checkpoint.check = _unchanged(inputs, array_plan, number)
    tiles = [tile for tile in prepared_surface.tiles if name_of(tile) in left]
    plan = _plan_of(prepared_surface, tiles, workers)
    progress.note(str(plan))
    tile_job = replace(prepared_surface.tile_job, kept_bytes=plan.kept_bytes)
    log = EventLog(checkpoint.folder, LOGS.replace("*", f"{number}.{secrets.token_hex(4)}"))
    tile_run = TileRun(tile_job, tiles, checkpoint, log)
    try:
        failed = tile_run.run(plan, workers_for(plan, tile_job, progress), progress, WorkerUsage())
    except KeyboardInterrupt:
        tile_run.tell_interrupted(progress)
        raise
    if failed:
        log.add("stopped", failed=len(failed))
        checkpoint.check(len(checkpoint.finished))
        raise StoppedError(
            f"Task {number}: {tile_run.what_failed(failed)} The others are kept: give the same command again to try "
            "those once more."
        )


def _unchanged(inputs: InputFiles, array_plan: ArrayPlan, number: int) -> Callable[[int], None]:
    """A check, before each tile is kept, that no input has changed since the task began."""

    def check(n_finished: int) -> None:
        changed = inputs.changed()
        if changed:
            raise StoppedError(
                f"The input {changed[0]} was replaced, written to or removed while task {number} of {array_plan.out} "
                "read it. Finished tiles are kept: put the file back and give the same command again."
            )

    return check


def assemble_tasks(out: Path, partial: bool, progress: Progress) -> DsmResult:
    """Write the surface of a run whose tasks are finished, with all products, and remove the tiles.

    partial : accept, beside what the plan accepts, few heights and doubtful cameras; tiles that are missing are empty
    then, and the run stays unfinished.

    Raises
    ------
    InputError, ConfigError, OutputError
        No plan, another installation, an input that has changed, or a folder that cannot be written.
    StoppedError
        Tasks are not finished; without `partial` nothing is written.
    CoverageError
        See `zlocus.pipeline.dsm.run_dsm`.
    """
    found = plan_or_finished(out)
    if isinstance(found, FinishedTasks):
        if found.shortcoming and not partial:
            raise CoverageError(found.shortcoming)
        return DsmResult(out, found.coverage, was_finished=True)
    keep_at_most()
    with found.folder_of_paths() as array_plan:
        checkpoint = array_plan.checkpoint()
        stored_run: StoredRun = array_plan.values()
        request = stored_run.prepared_surface.request
        request = replace(request, out=array_plan.out, partial=partial or request.partial)
        _check_tasks_left(array_plan, _listed(array_plan, checkpoint), request.partial)
        inputs = array_plan.current_inputs()
        prepared_surface = replace(stored_run.prepared_surface, request=request, inputs=inputs)
        stopwatch = Stopwatch(list(stored_run.stages))
        with compression_threads(cores()), checkpoint.open(prepared_surface.digest, prepared_surface.before):
            result = _assemble(array_plan, prepared_surface, checkpoint, stopwatch, progress)
    return replace(result, out=out)


def _check_tasks_left(array_plan: ArrayPlan, finished: Sequence[str], partial: bool) -> None:
    """Refuse a run whose tasks are not finished, unless some tiles are there and an incomplete surface is accepted.

    Raises
    ------
    StoppedError
        It names the tasks.
    """
    left = array_plan.left(finished)
    if not left or (partial and finished):
        return
    n_tiles, out = len(array_plan.names) - len(finished), array_plan.out
    also = f", or add --partial for a surface without {counted(n_tiles, 'tile')}" if finished else ""
    raise StoppedError(
        f"{out} cannot be assembled: {len(left)} of {counted(len(array_plan.with_work), 'task')} "
        f"{'is' if len(left) == 1 else 'are'} not finished ({as_ranges(left, MAX_NAMED_GROUPS)}). Run "
        f"{'it' if len(left) == 1 else 'them'} with `zlocus tiles run {out} N`{also}; nothing was written."
    )


def _assemble(
    array_plan: ArrayPlan,
    prepared_surface: PreparedSurface,
    checkpoint: TileCheckpoint,
    stopwatch: Stopwatch,
    progress: Progress,
) -> DsmResult:
    """Write all products of a run and end it, see `assemble_tasks`. Damaged tiles count as missing."""
    worked = worked_tiles(prepared_surface.tiles)
    with progress.stage("Checking tiles", len(worked)) as stage:
        lost = []
        for tile in worked:
            if not checkpoint.holds(name_of(tile)):
                lost.append(tile)
            stage.advance()
    lost_names = {name_of(tile) for tile in lost}
    held = [name for name in array_plan.names if name not in lost_names]
    _check_tasks_left(array_plan, held, prepared_surface.request.partial)
    log = EventLog(array_plan.out)
    events = log.take_over(sorted(checkpoint.folder.glob(LOGS)))
    stopwatch.stages.append(matching_of_tasks(events))
    tile_run = TileRun(prepared_surface.tile_job, prepared_surface.tiles, checkpoint, log)
    failed = [Outcome(tile, failure=Failure(Cause.LOST, "its task has not made it")) for tile in lost]
    try:
        return _written(array_plan, prepared_surface, tile_run, failed, stopwatch, progress)
    except OutputError as error:
        raise StoppedError(
            f"{error} {kept_tiles(len(held))}: {checkpoint.how_to_resume}."
        ) from error  # fmt: skip
    except KeyboardInterrupt:
        tile_run.tell_interrupted(progress)
        raise


def _written(
    array_plan: ArrayPlan,
    prepared_surface: PreparedSurface,
    tile_run: TileRun,
    failed_outcomes: list[Outcome],
    stopwatch: Stopwatch,
    progress: Progress,
) -> DsmResult:
    """See `_assemble`. failed_outcomes : of the tiles that stay empty."""
    request, checkpoint, tally = prepared_surface.request, tile_run.checkpoint, Tally()
    with stopwatch.stage("record"):
        checksums = prepared_surface.inputs.record(len(checkpoint.finished))
        array_plan.check_content(checksums)
    with stopwatch.stage("write"):
        write_rasters(prepared_surface, tile_run, failed_outcomes, tally, progress)
    record = write_products(prepared_surface, tally, checksums, stopwatch, progress)
    write_maps(request, prepared_surface.config, stopwatch, record | {TASKS: array_plan.n_tasks}, progress)
    tile_run.log.add("ended", coverage=round(tally.coverage, 6), failed=len(failed_outcomes))
    if failed_outcomes:
        lost = {name_of(outcome.task) for outcome in failed_outcomes}
        left = array_plan.left(name for name in array_plan.names if name not in lost)
        raise StoppedError(
            f"{len(lost)} of {counted(len(array_plan.names), 'tile')} {'is' if len(lost) == 1 else 'are'} empty in the "
            "surface (FAILED in quality.tif), for some tasks are not finished: "
            f"{as_ranges(left, MAX_NAMED_GROUPS)}. Run these, and assemble {request.out} again."
        )
    checkpoint.key["inputs"] = dict(prepared_surface.inputs.states)  # the content is that of the plan
    return finish(prepared_surface, checkpoint, tally, progress)


def matching_of_tasks(events: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The stage "match" of run.json from the events of all tasks: the time while any of them worked, the CPU time of
    all, and the memory of the largest process."""
    tiles = [event for event in events if event.get("event") in ("tile", "tile failed")]
    return {
        "name": "match",
        "wall_s": round(time_at_work_s(tiles), 3),
        "cpu_s": round(sum(float(event.get("cpu_s", 0.0)) for event in tiles), 3),
        "peak_mb": max((float(event.get("peak_mb", 0.0)) for event in tiles), default=0.0),
    }


def time_at_work_s(events: Sequence[Mapping[str, Any]]) -> float:
    """Seconds during which at least one of some events lasted. Each has the time of its end, and took `wall_s`."""
    spans = []
    for event in events:
        end = datetime.datetime.fromisoformat(event["time"]).timestamp()
        spans.append((end - float(event.get("wall_s", 0.0)), end))
    total, until = 0.0, -math.inf
    for begin, end in sorted(spans):
        total += max(end - max(begin, until), 0.0)
        until = max(until, end)
    return total
