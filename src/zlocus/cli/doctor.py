"""`zlocus doctor`: the inputs checked before a long run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import Bounds, ConfigFile, Crs, Inputs, Resolution, Settings, TieHeights
from zlocus.core.requests import DoctorRequest, check_output

EXIT_WILL_FAIL = 2


@dataclass(frozen=True)
class DoctorOptions:
    """Arguments and options of `zlocus doctor`."""

    inputs: Inputs
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for the report and footprints. Default: print only.")
    ] = None
    resolution: Resolution = None
    crs: Crs = None
    bounds: Bounds = None
    heights: TieHeights = None
    workers: Annotated[int, typer.Option(help="Tiles worked on at a time in the planned run.", metavar="N")] = 1
    memory: Annotated[float | None, typer.Option(help="Memory limit of the planned run, GB.", metavar="GB")] = None
    config: ConfigFile = None
    settings: Settings = None


def doctor(options: DoctorOptions, console: Console) -> Answer:
    """Check inputs, overlap, tie points and memory before a run."""
    request = DoctorRequest(
        inputs=tuple(options.inputs), out=options.out, resolution=options.resolution, crs=options.crs,
        bounds=options.bounds, heights=options.heights, workers=options.workers, memory_gb=options.memory,
    )  # fmt: skip
    if request.out is not None:
        # No run writes a file of the same name, so the folder may hold a run.
        check_output(request.out, overwrite=True)
    config = config_of(options.config, options.settings)
    from zlocus.pipeline.doctor.run import run_doctor

    diagnosis = run_doctor(request, config, console.progress)
    status = EXIT_WILL_FAIL if diagnosis.will_fail else 0
    return Answer(diagnosis.text, diagnosis.as_dict(), is_asked_for=True, exit_status=status)
