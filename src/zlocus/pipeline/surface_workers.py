"""Workers for the blocks of finished surfaces: this process, other processes, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from zlocus.core.errors import InputError, StoppedError
from zlocus.core.grid import CellWindow
from zlocus.core.progress import Progress
from zlocus.core.resources import cores
from zlocus.io.run_record import WorkerUsage
from zlocus.pipeline.execution.tasks import Cause, Here, Outcome, Workers, run_tasks

# Side of a block, cells: that of the blocks of a COG, so that each is written once.
BLOCK_CELLS = 512
# Fewer cells are faster in one process than others are started.
MIN_CELLS_FOR_PROCESSES = 20_000_000


def blocks_of(rows: int, cols: int, side: int = BLOCK_CELLS) -> Iterator[CellWindow]:
    """Windows that cover a grid, row by row."""
    for row in range(0, rows, side):
        for col in range(0, cols, side):
            yield CellWindow(row, col, min(side, rows - row), min(side, cols - col))


def slots_for(n_cells: int, workers: int | None) -> int:
    """Blocks worked on at a time: as requested, or as many as there are cores where there is enough to do."""
    return workers or (cores() if n_cells > MIN_CELLS_FOR_PROCESSES else 1)


def results_of(
    job: Callable[[CellWindow], Any],
    windows: Iterable[CellWindow],
    slots: int,
    scheduler: str | None,
    worker_usage: WorkerUsage,
    progress: Progress,
) -> Iterator[tuple[CellWindow, Any]]:
    """Windows with what a job makes of each, in the order in which they are ready.

    Raises
    ------
    InputError
        A raster cannot be read.
    StoppedError
        A block failed for another reason.
    ConfigError
        See `Cluster`.
    """
    with _workers(job, slots, scheduler, progress) as workers:
        for outcome in run_tasks(workers, windows):
            if not isinstance(workers, Here):
                worker_usage.cpu_s += outcome.cpu_s
                worker_usage.peak_mb = max(worker_usage.peak_mb, outcome.peak_mb)
            if outcome.failure is None:
                yield outcome.task, outcome.result
            elif outcome.is_final:
                raise _failed(outcome)


def _workers(
    job: Callable[[CellWindow], Any], slots: int, scheduler: str | None, progress: Progress
) -> AbstractContextManager[Workers]:
    if scheduler is not None:
        from zlocus.pipeline.execution.cluster import Cluster

        cluster = Cluster(job, scheduler)
        progress.note(f"Dask cluster at {scheduler}; what it does is shown at {cluster.dashboard}")
        return cluster
    if slots > 1:
        from zlocus.pipeline.execution.processes import Processes

        return Processes(job, slots)
    return nullcontext(Here(job))


def _failed(outcome: Outcome) -> Exception:
    failure, window = outcome.failure, outcome.task
    assert failure is not None, "the outcome is a failure"
    if failure.error is not None:
        return failure.error
    place = f"The block at row {window.row}, column {window.col}"
    if failure.cause is Cause.INPUT:
        return InputError(f"{place} cannot be made: {failure.reason}. Nothing was written. Check the inputs.")
    if failure.cause is Cause.FAULT:
        return RuntimeError(f"{place}: {failure.reason}\n{failure.trace}")
    return StoppedError(f"{place} cannot be made: {failure.reason}. Nothing was written. Give fewer --workers.")
