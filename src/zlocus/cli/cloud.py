"""`zlocus cloud`: a coloured point cloud from images."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated

import typer

from zlocus.cli.commands import config_of
from zlocus.cli.shared_options import (
    Area,
    Bounds,
    ConfigFile,
    Crs,
    Inputs,
    Memory,
    Overwrite,
    Partial,
    ResultFolder,
    Resume,
    SearchedHeights,
    Vertical,
    Workers,
)
from zlocus.core.progress import progress_for
from zlocus.core.requests import CloudRequest, check_output


@dataclass(frozen=True)
class CloudOptions:
    """Arguments and options of `zlocus cloud`."""

    inputs: Inputs
    out: ResultFolder
    reference: Annotated[
        list[str] | None,
        typer.Option(help="Image whose pixels get heights; may be repeated. Default: all images.", metavar="VIEW"),
    ] = None
    crs: Crs = None
    bounds: Bounds = None
    area: Area = None
    heights: SearchedHeights = None
    vertical: Vertical = "ellipsoid"
    fill: Annotated[str, typer.Option(help="Fill gaps of the height maps.", metavar="none|interpolate")] = "none"
    partial: Partial = False
    workers: Workers = 1
    memory: Memory = None
    resume: Resume = True
    overwrite: Overwrite = False
    config: ConfigFile = None


def cloud(options: CloudOptions) -> None:
    """Make a coloured point cloud with a height for every pixel."""
    request = CloudRequest(
        inputs=tuple(options.inputs), out=options.out, references=tuple(options.reference or ()), crs=options.crs,
        bounds=options.bounds, area=options.area, heights=options.heights, vertical=options.vertical,
        fill=options.fill, partial=options.partial, workers=options.workers, memory_gb=options.memory,
        overwrite=options.overwrite, resume=options.resume,
    )  # fmt: skip
    check_output(request.out, request.overwrite, may_be_same=True)
    config = config_of(options.config)
    from zlocus.pipeline.cloud import run_cloud

    result = run_cloud(request, config, progress_for(sys.stderr))
    state = "already finished, " if result.was_finished else ""
    print(
        f"{result.out}: {state}{result.n_points} points, a height for {100 * result.coverage:.1f} % of the pixels "
        "seen by two images or more."
    )
