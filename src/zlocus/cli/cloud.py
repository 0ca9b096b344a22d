"""`zlocus cloud`: a coloured point cloud from images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import (
    MATCHING,
    RESULT,
    Area,
    Bounds,
    ConfigFile,
    Crs,
    DryRun,
    Inputs,
    Memory,
    Overwrite,
    Partial,
    ResultFolder,
    Resume,
    SearchedHeights,
    Settings,
    Vertical,
    Workers,
)
from zlocus.core.requests import CloudRequest, check_output


@dataclass(frozen=True)
class CloudOptions:
    """Arguments and options of `zlocus cloud`."""

    inputs: Inputs
    out: ResultFolder
    reference: Annotated[
        list[str] | None,
        typer.Option(
            help="Image whose pixels get heights; may be repeated. Default: all images.",
            metavar="VIEW",
            rich_help_panel=MATCHING,
        ),
    ] = None
    crs: Crs = None
    bounds: Bounds = None
    area: Area = None
    heights: SearchedHeights = None
    vertical: Vertical = "ellipsoid"
    fill: Annotated[
        str, typer.Option(help="Fill gaps of the height maps.", metavar="none|interpolate", rich_help_panel=RESULT)
    ] = "none"
    copc: Annotated[
        bool,
        typer.Option(
            "--copc", help="Also write the points as COPC (cloud.copc.laz), for viewers.", rich_help_panel=RESULT
        ),
    ] = False
    partial: Partial = False
    workers: Workers = 1
    memory: Memory = None
    resume: Resume = True
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None
    dry_run: DryRun = False


def cloud(options: CloudOptions, console: Console) -> Answer:
    """Make a coloured point cloud with a height for every pixel."""
    request = CloudRequest(
        inputs=tuple(options.inputs), out=options.out, references=tuple(options.reference or ()), crs=options.crs,
        bounds=options.bounds, area=options.area, heights=options.heights, vertical=options.vertical,
        fill=options.fill, partial=options.partial, workers=options.workers, memory_gb=options.memory,
        overwrite=options.overwrite, resume=options.resume, copc=options.copc,
    )  # fmt: skip
    check_output(request.out, request.overwrite, may_be_same=True)
    config = config_of(options.config, options.settings)
    if options.dry_run:
        from zlocus.pipeline.dry_run import plan_cloud

        dry = plan_cloud(request, config, console.progress)
        return Answer(dry.text, dry.values, is_asked_for=True)
    from zlocus.pipeline.cloud import run_cloud

    result = run_cloud(request, config, console.progress)
    state = "already finished, " if result.was_finished else ""
    return Answer(
        f"{result.out}: {state}{result.n_points} points, a height for {100 * result.coverage:.1f} % of the pixels "
        "seen by two images or more.",
        {"n_points": result.n_points, "coverage": result.coverage, "was_finished": result.was_finished},
    )
