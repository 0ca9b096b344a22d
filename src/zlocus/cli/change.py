"""`zlocus change`: what has changed between two surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.shared_options import Overwrite, ResultFolder, SurfaceGeoid
from zlocus.core.surface_requests import ChangeRequest

SURFACE = "Folder that `zlocus dsm` wrote, or a raster of heights, or RASTER=SIGMA as of `zlocus mosaic`"


@dataclass(frozen=True, kw_only=True)
class ChangeOptions:
    """Arguments and options of `zlocus change`."""

    first: Annotated[str, typer.Argument(help=f"Earlier surface. {SURFACE}.", metavar="A")]
    second: Annotated[str, typer.Argument(help="Later surface, as A.", metavar="B")]
    out: ResultFolder
    area: Annotated[
        Path | None, typer.Option(help="Polygons whose volumes are wanted: ground may have changed.", metavar="VECTOR")
    ] = None
    name: Annotated[
        str | None,
        typer.Option(help="Attribute of the polygons that names them. Default: their number.", metavar="FIELD"),
    ] = None
    stable: Annotated[
        Path | None,
        typer.Option(help="Polygons of unchanged ground. Default: all outside of --area.", metavar="VECTOR"),
    ] = None
    level: Annotated[
        float, typer.Option(help="Share of unchanged cells that may be called changed by chance.", metavar="P")
    ] = 0.05
    keep_offset: Annotated[
        bool, typer.Option("--keep-offset", help="Leave the vertical offset of unchanged ground in the differences.")
    ] = False
    geoid: SurfaceGeoid = None
    overwrite: Overwrite = False


def change(options: ChangeOptions, console: Console) -> Answer:
    """Subtract two surfaces: what was raised or lowered significantly, and volumes inside polygons."""
    request = ChangeRequest(
        first=options.first, second=options.second, out=options.out, area=options.area, name=options.name,
        stable=options.stable, geoid=options.geoid, level=options.level, keep_offset=options.keep_offset,
        overwrite=options.overwrite,
    )  # fmt: skip
    from zlocus.pipeline.change import run_change

    result = run_change(request, console.progress)
    return Answer(result.text, result.values, is_asked_for=True)
