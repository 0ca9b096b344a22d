"""`zlocus rerun`: a run made again from its record."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.shared_options import Memory, Overwrite, ResultFolder, Resume
from zlocus.core.rerun_request import RerunRequest


@dataclass(frozen=True)
class RerunOptions:
    """Arguments and options of `zlocus rerun`."""

    record: Annotated[
        Path, typer.Argument(help="run.json of a surface or a cloud, or the folder that holds it.", metavar="RUN.json")
    ]
    out: ResultFolder
    inputs: Annotated[
        Path | None,
        typer.Option(
            help="Folder that holds the inputs now. Default: where they were, or beside the record.", metavar="FOLDER"
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(help="Tiles worked on at a time. Default: that of `zlocus dsm` or `zlocus cloud`.", metavar="N"),
    ] = None
    scheduler: Annotated[
        str | None, typer.Option(help="Dask cluster that matches the tiles of a surface.", metavar="ADDRESS")
    ] = None
    memory: Memory = None
    resume: Resume = True
    overwrite: Overwrite = False


def rerun(options: RerunOptions, console: Console) -> Answer:
    """Repeat a run from its record: the same inputs, by their checksums, and the same options."""
    request = RerunRequest(
        record=options.record, out=options.out, inputs=options.inputs, workers=options.workers,
        memory_gb=options.memory, scheduler=options.scheduler, overwrite=options.overwrite, resume=options.resume,
    )  # fmt: skip
    from zlocus.pipeline.rerun import run_again

    result = run_again(request, console.progress)
    return Answer(str(result), {"coverage": result.coverage, "was_finished": result.was_finished})
