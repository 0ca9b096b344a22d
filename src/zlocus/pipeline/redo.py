"""`zlocus dsm --redo`: a part of a finished surface is made again and blended in; all other cells keep their bytes.

1. open: the finished run, its inputs and the area (`redo_options`, `redone_area`);
2. set up: the cameras of the run, from its tie points; heights, options and break lines of this command;
3. match: the tiles of the run that the area touches, kept beside the surface until it is complete (`redo_folder`);
4. write: all rasters, with the part blended in (`surface_cells`), the maps and the report made again, and run.json with
   the history; then the new folder takes the place of the old one in one step.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import OutputError, StoppedError
from zlocus.core.progress import Progress
from zlocus.core.redo_request import RedoRequest
from zlocus.core.requests import SetupRequest
from zlocus.core.resources import cores
from zlocus.io.config import config_as_dict
from zlocus.io.input_files import InputFiles
from zlocus.io.rasters import compression_threads
from zlocus.io.run_record import Stopwatch, utc_now, versions_record, write_record
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.execution.event_log import EventLog
from zlocus.pipeline.execution.plan import Tile, keep_at_most
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.fingerprint import digest_of
from zlocus.pipeline.finished_record import checksum, write_finished
from zlocus.pipeline.redo_folder import RedoFolder
from zlocus.pipeline.redo_options import differing
from zlocus.pipeline.redo_part import RedonePart, opened_part
from zlocus.pipeline.redo_rasters import RASTERS, ChangedCells, write_part
from zlocus.pipeline.redo_setup import (
    area_of_run,
    check_cameras,
    opened_images,
    setup_on_surface,
    tiles_of_part,
    with_new_heights,
)
from zlocus.pipeline.run_plan import planned
from zlocus.pipeline.setup import orient_views, set_up_run
from zlocus.pipeline.tile_run import TileProduct, TileRun, name_of, tile_job, workers_for
from zlocus.products.derived import FILES, link_all, write_derived
from zlocus.products.report.file_names import RECORD, REPORT
from zlocus.products.styles import write_styles
from zlocus.products.surface_statistics import surface_statistics
from zlocus.products.tie_observations import read_observations

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
    out = request.dsm_request.out
    folder = RedoFolder.of(out)
    keep_at_most()
    stopwatch = Stopwatch()
    with stopwatch.stage("open"), progress.stage("Opening the surface"):
        part = opened_part(request, progress)
    history = part.run.get(HISTORY, [])
    if history and history[-1].get("key_sha256") == part.digest and request.dsm_request.resume:
        folder.remove()
        last = history[-1]
        return RedoResult(out, last["cells_inside"], last["cells_changed"], float(part.run["coverage"]), True)
    with compression_threads(request.dsm_request.workers or cores()):
        if part.levels_m is not None:
            with _work(folder, part, progress, "") as checkpoint:
                changed_cells = write_part(part, folder, (), lambda tile: None, stopwatch, progress)
                return _finished(part, folder, changed_cells, "", checkpoint, stopwatch, progress)
        return _matched(part, folder, stopwatch, progress)


def _matched(part: RedonePart, folder: RedoFolder, stopwatch: Stopwatch, progress: Progress) -> RedoResult:
    """Match the tiles that the area touches, and blend them in."""
    with stopwatch.stage("images"), progress.stage("Opening images"):
        opened_inputs, inputs = opened_images(part, progress)
    with stopwatch.stage("orient"), kernels_compiling(progress):
        known = read_observations(part.dsm_request.out, len(opened_inputs.scene.views))
        orientation = orient_views(
            opened_inputs.scene, part.config.orientation, progress, threads=part.dsm_request.workers, known_ties=known
        )  # fmt: skip
        check_cameras(part, orientation.as_dict())
    with stopwatch.stage("setup"):
        opened_inputs = with_new_heights(part, opened_inputs)
        setup = set_up_run(SetupRequest.of(part.dsm_request), opened_inputs, orientation, part.config, progress)
        setup = setup_on_surface(part, setup)
        tiles = tiles_of_part(part, setup)
        plan = planned(setup.match_scene, tiles, part.config, part.dsm_request)
        area = area_of_run(part.dsm_request, opened_inputs.scene.crs)
        job = tile_job(part.dsm_request, setup, part.config, area, plan)
    digest = digest_of(setup.match_scene, orientation)
    progress.note(str(plan))
    with _work(folder, part, progress, digest, inputs) as checkpoint:
        tile_run = TileRun(job, tiles, checkpoint, EventLog(folder.work))
        try:
            with stopwatch.stage("match") as elsewhere:
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

        changed_cells = write_part(part, folder, tiles, product, stopwatch, progress, setup)
        return _finished(part, folder, changed_cells, digest, checkpoint, stopwatch, progress)


@contextmanager
def _work(
    folder: RedoFolder, part: RedonePart, progress: Progress, setup_digest: str, inputs: InputFiles | None = None
) -> Iterator[TileCheckpoint]:
    """The folder of the tiles, locked; what another command left there is dropped."""
    base = {name: part.finished.checksums.get(name) for name in RASTERS}
    key = {"redo": part.key, "surface": base, "options": config_as_dict(part.config)}
    check = (lambda n_kept: None) if inputs is None else inputs.check
    key = json.loads(json.dumps(key, default=str))
    TileCheckpoint.check_free(folder.work)
    try:
        checkpoint = TileCheckpoint.of(
            folder.work, key, part.request.dsm_request.resume, not part.request.dsm_request.resume, check
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


def _finished(
    part: RedonePart,
    folder: RedoFolder,
    changed_cells: ChangedCells,
    setup_digest: str,
    checkpoint: TileCheckpoint,
    stopwatch: Stopwatch,
    progress: Progress,
) -> RedoResult:
    """Write everything that follows from the rasters, and put the new folder in the place of the old one."""
    new, old = folder.surface, part.dsm_request.out
    with stopwatch.stage("products"):
        names = [name for name, file in FILES.items() if (old / file).is_file()]
        write_derived(new, names, part.config.products, progress)
        write_styles(new, part.config.products, [*RASTERS, *(FILES[name] for name in names)])
        statistics = surface_statistics(new)
    entry = _entry(part, changed_cells, setup_digest, stopwatch)
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
    return RedoResult(part.dsm_request.out, changed_cells.n_inside, changed_cells.n_changed, statistics.coverage)


def _entry(part: RedonePart, changed_cells: ChangedCells, setup_digest: str, stopwatch: Stopwatch) -> dict[str, Any]:
    """The entry of the history in run.json."""
    n_cells = int(np.prod(part.geobox.shape))
    return {
        "time": utc_now(), **part.files, "level": part.request.level, "margin_m": part.margin_m,
        "options": differing(part.dsm_request, part.config, part.run), "cells_inside": changed_cells.n_inside,
        "cells_changed": changed_cells.n_changed, "share_changed": round(changed_cells.n_changed / n_cells, 8),
        "versions": versions_record(), "setup_sha256": setup_digest or None, "key_sha256": part.digest,
        "stages": stopwatch.stages,
    }  # fmt: skip
