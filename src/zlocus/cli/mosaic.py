"""`zlocus mosaic`: surfaces of several runs joined."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.shared_options import RESULT, RUN, Overwrite, ResultFolder, SurfaceGeoid
from zlocus.core.surface_requests import MosaicRequest


@dataclass(frozen=True, kw_only=True)
class MosaicOptions:
    """Arguments and options of `zlocus mosaic`."""

    inputs: Annotated[
        list[str],
        typer.Argument(
            help="Folders that `zlocus dsm` wrote, and rasters of heights. RASTER=SIGMA gives the standard deviation "
            "of a raster, as another raster or in metres.",
            metavar="RUN",
        ),
    ]
    out: ResultFolder
    like: Annotated[
        Path | None,
        typer.Option(
            help="Take the grid of this raster. Default: that of the first RUN, extended.", metavar="RASTER",
            rich_help_panel=RESULT,
        ),
    ] = None  # fmt: skip
    feather: Annotated[
        float | None,
        typer.Option(
            help="Distance from its end at which a run has its full weight, m. Default: 32 cells.", metavar="M",
            rich_help_panel=RESULT,
        ),
    ] = None  # fmt: skip
    keep_offsets: Annotated[
        bool,
        typer.Option(
            "--keep-offsets", help="Leave vertical offsets between runs as they are.", rich_help_panel=RESULT
        ),
    ] = False  # fmt: skip
    workers: Annotated[
        int | None,
        typer.Option(
            help="Blocks worked on at a time. Default: as many as cores, for large mosaics.", metavar="N",
            rich_help_panel=RUN,
        ),
    ] = None  # fmt: skip
    scheduler: Annotated[
        str | None, typer.Option(help="Dask cluster that joins the blocks.", metavar="ADDRESS", rich_help_panel=RUN)
    ] = None
    geoid: SurfaceGeoid = None
    overwrite: Overwrite = False


def mosaic(options: MosaicOptions, console: Console) -> Answer:
    """Join the surfaces of several runs, weighted by their precision, without steps at their seams."""
    request = MosaicRequest(
        inputs=tuple(options.inputs), out=options.out, like=options.like, geoid=options.geoid,
        feather_m=options.feather, keep_offsets=options.keep_offsets, workers=options.workers,
        scheduler=options.scheduler, overwrite=options.overwrite,
    )  # fmt: skip
    from zlocus.pipeline.mosaic import run_mosaic

    result = run_mosaic(request, console.progress)
    return Answer(result.text, result.values)
