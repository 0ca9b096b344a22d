"""`zlocus report`: the page of a surface that is there."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zlocus.errors import ConfigError


def report(
    out: Annotated[Path, typer.Argument(help="Folder of a surface.", metavar="OUT")],
    reference: Annotated[
        Path | None, typer.Option(help="Reference heights on a projected grid, to compare with.", metavar="RASTER")
    ] = None,
    classes: Annotated[
        Path | None,
        typer.Option(help="Classes on the reference's grid: 0-1 ground, 2 building, 3 tree.", metavar="RASTER"),
    ] = None,
    align: Annotated[
        bool, typer.Option("--align", help="First find and remove the best shift; it is reported.")
    ] = False,
    margin: Annotated[float, typer.Option(help="Rim of the reference left out, m.", metavar="M")] = 10.0,
    threshold: Annotated[float, typer.Option(help="An error below this is within, m.", metavar="M")] = 1.0,
) -> None:
    """Make report.html of a surface again, with a reference where one is given."""
    if reference is None and (classes is not None or align):
        given = "--classes" if classes is not None else "--align"
        raise ConfigError(f"{given} is about a reference, and none is given. Add --reference RASTER, or leave it out.")
    from zlocus.products.report.page import Compared, write_report

    compared = None if reference is None else Compared(reference, classes, align, margin, threshold)
    print(f"{write_report(out, compared)}: open it in a browser.")
