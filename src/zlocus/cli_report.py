"""`zlocus report`: the page of a surface that is there."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zlocus.errors import ConfigError
from zlocus.evaluation.command import Align, Classes, Margin


def report(
    out: Annotated[Path, typer.Argument(help="Folder of a surface.", metavar="OUT")],
    reference: Annotated[
        Path | None, typer.Option(help="Reference heights on a projected grid, to compare with.", metavar="RASTER")
    ] = None,
    classes: Classes = None,
    align: Align = False,
    margin: Margin = 10.0,
    threshold: Annotated[float, typer.Option(help="An error below this is within, m.", metavar="M")] = 1.0,
) -> None:
    """Make report.html of a surface again, with a reference where one is given."""
    if reference is None and (classes is not None or align):
        given = "--classes" if classes is not None else "--align"
        raise ConfigError(f"{given} is about a reference, and none is given. Add --reference RASTER, or leave it out.")
    from zlocus.products.report.page import Compared, write_report

    compared = None if reference is None else Compared(reference, classes, align, margin, threshold)
    print(f"{write_report(out, compared)}: open it in a browser.")
