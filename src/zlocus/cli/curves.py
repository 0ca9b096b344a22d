"""`zlocus curves`: the match curves of one point."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import ConfigFile, Crs, Inputs, Overwrite, Resolution, Settings, TieHeights
from zlocus.core.requests import CurvesRequest, check_output


@dataclass(frozen=True)
class CurvesOptions:
    """Arguments and options of `zlocus curves`."""

    inputs: Inputs
    at: Annotated[tuple[float, float] | None, typer.Option(help="Point on the ground, in the CRS.", metavar="X Y")] = (
        None
    )
    pixel: Annotated[
        tuple[str, float, float] | None,
        typer.Option(help="Point in an image; (0, 0) is the centre of the first pixel.", metavar="VIEW ROW COL"),
    ] = None
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for figures and tables.")] = Path("curves")
    height: Annotated[
        float | None,
        typer.Option(help="Middle of the heights searched, m. Default: height of the nearest tie points.", metavar="Z"),
    ] = None
    resolution: Resolution = None
    crs: Crs = None
    heights: TieHeights = None
    reference: Annotated[
        str | None, typer.Option(help="Reference image. Default: chosen for the point.", metavar="VIEW")
    ] = None
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None


def curves(options: CurvesOptions, console: Console) -> Answer:
    """Show the match curves of one point.

    Give the point with --at or --pixel. The text and figures show how distinct the peak of each image is, in which
    order the images are used, and after how many of them matching stops.
    """
    request = CurvesRequest(
        inputs=tuple(options.inputs), out=options.out, at=options.at, pixel=options.pixel, height=options.height,
        resolution=options.resolution, crs=options.crs, heights=options.heights, reference=options.reference,
        overwrite=options.overwrite,
    )  # fmt: skip
    check_output(request.out, request.overwrite)
    config = config_of(options.config, options.settings)
    from zlocus.io.run_record import read_record
    from zlocus.pipeline.match_curves import run_curves
    from zlocus.products.match_curve_figures import POINT

    text = run_curves(request, config, console.progress)
    return Answer(text, {"point": read_record(request.out / POINT)}, is_asked_for=True)
