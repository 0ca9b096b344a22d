"""`zlocus paper`: tables and figures of Ji et al. (2014)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import INPUTS, ConfigFile, Crs, Overwrite, Resolution, Settings, TieHeights
from zlocus.core.paper_request import PaperRequest
from zlocus.core.requests import check_output


@dataclass(frozen=True)
class PaperOptions:
    """Arguments and options of `zlocus paper`."""

    what: Annotated[str, typer.Argument(help="table3, table4, or figure3 to figure8.", metavar="FIGURE")]
    inputs: Annotated[
        list[Path] | None,
        typer.Argument(
            help=f"{INPUTS} Default: the demo's block, rendered into OUT/scene.",
            metavar="INPUT",
        ),
    ] = None
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for tables and figures.")] = Path("paper")
    space: Annotated[
        str,
        typer.Option(
            help="Search along rays of the reference image (GC3), or along the vertical line (MVLL).",
            metavar="image|ground",
        ),
    ] = "image"
    pixel: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Point P0 in the reference image. Default: the first that serves.", metavar="ROW COL"),
    ] = None
    at: Annotated[
        tuple[float, float] | None, typer.Option(help="Point P0 on the ground, in the CRS.", metavar="X Y")
    ] = None
    neighbours: Annotated[
        str,
        typer.Option(help="Feature points around P0: within a radius, or TIN corners.", metavar="radius|tin"),
    ] = "radius"
    radius: Annotated[
        float | None, typer.Option(help="Radius, px. Default: reaches the third nearest feature point.", metavar="PX")
    ] = None
    points: Annotated[
        int, typer.Option(help="With figure7: compare chosen and all images at about N points.", metavar="N")
    ] = 0
    reference: Annotated[
        str | None, typer.Option(help="Reference image. Default: the most nadir one.", metavar="VIEW")
    ] = None
    resolution: Resolution = None
    crs: Crs = None
    heights: TieHeights = None
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None


def paper(options: PaperOptions, console: Console) -> Answer:
    """Make a table or figure of Ji et al. (2014).

    FIGURE is table3, table4, or one of figure3 to figure8. Images are chosen, and points are matched, literally as the
    paper describes it.
    """
    request = PaperRequest(
        what=options.what, out=options.out, inputs=tuple(options.inputs or ()), space=options.space, at=options.at,
        pixel=options.pixel, neighbours=options.neighbours, radius_px=options.radius, points=options.points,
        reference=options.reference, crs=options.crs, heights=options.heights, resolution=options.resolution,
        overwrite=options.overwrite,
    )  # fmt: skip
    check_output(request.out, request.overwrite, request.files, request.what)
    config = config_of(options.config, options.settings)
    from zlocus.pipeline.paper import run_paper

    text = run_paper(request, config, console.progress)
    return Answer(text, {"what": request.what, "files": list(request.files)}, is_asked_for=True)
