"""`zlocus orient` and `zlocus ties`: corrected cameras, or tie points alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import (
    HEIGHTS,
    RESULT,
    VERTICAL_DATUMS,
    ConfigFile,
    Crs,
    DemVertical,
    DryRun,
    Inputs,
    Overwrite,
    Settings,
    TieHeights,
)
from zlocus.core.orient_request import OrientRequest
from zlocus.core.requests import check_output

if TYPE_CHECKING:
    from zlocus.core.options import RunConfig


@dataclass(frozen=True)
class OrientOptions:
    """Arguments and options of `zlocus orient`."""

    inputs: Inputs
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the cameras and the report.", rich_help_panel=RESULT)
    ]
    control: Annotated[
        Path | None,
        typer.Option(help="Table of ground control and check points.", metavar="CSV", rich_help_panel="Control"),
    ] = None
    control_ortho: Annotated[
        Path | None,
        typer.Option(
            help="Ortho-photo that the images are compared with for control points; needs --control-dem.",
            metavar="RASTER",
            rich_help_panel="Control",
        ),
    ] = None
    control_dem: Annotated[
        Path | None,
        typer.Option(
            help="Terrain model for the heights of the ortho-photo.", metavar="RASTER", rich_help_panel="Control"
        ),
    ] = None
    control_vertical: Annotated[
        str | None,
        typer.Option(
            help="Vertical datum of the control points (default: ellipsoid) and of --control-dem (default: what its "
            "CRS says).",
            metavar=VERTICAL_DATUMS,
            rich_help_panel="Control",
        ),
    ] = None
    dem: Annotated[
        Path | None,
        typer.Option(help="Terrain model that gives heights to tie points.", metavar="RASTER", rich_help_panel=HEIGHTS),
    ] = None
    dem_vertical: DemVertical = None
    crs: Crs = None
    heights: TieHeights = None
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None
    dry_run: DryRun = False


@dataclass(frozen=True)
class TiesOptions:
    """Arguments and options of `zlocus ties`."""

    inputs: Inputs
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the tie points.", rich_help_panel=RESULT)]
    crs: Crs = None
    heights: TieHeights = None
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None


def orient(options: OrientOptions, console: Console) -> Answer:
    """Correct all cameras by a bundle adjustment, and write them."""
    request = OrientRequest(
        inputs=tuple(options.inputs), out=options.out, control=options.control,
        control_ortho=options.control_ortho, control_dem=options.control_dem,
        control_vertical=options.control_vertical, dem=options.dem, dem_vertical=options.dem_vertical,
        crs=options.crs, heights=options.heights, overwrite=options.overwrite,
    )  # fmt: skip
    config = config_of(options.config, options.settings)
    if options.dry_run:
        from zlocus.pipeline.dry_run import plan_orient

        check_output(request.out, request.overwrite)
        dry = plan_orient(request, config, console.progress)
        return Answer(dry.text, dry.values, is_asked_for=True)
    return _run(request, config, console)


def ties(options: TiesOptions, console: Console) -> Answer:
    """Find tie points between images; correct no camera."""
    request = OrientRequest(
        inputs=tuple(options.inputs), out=options.out, cameras=False, crs=options.crs, heights=options.heights,
        overwrite=options.overwrite,
    )  # fmt: skip
    return _run(request, config_of(options.config, options.settings), console)


def _run(request: OrientRequest, config: RunConfig, console: Console) -> Answer:
    """Run the request, and say what was written."""
    check_output(request.out, request.overwrite)
    from zlocus.io.run_record import read_record
    from zlocus.pipeline.orient import ORIENTATION, run_orient

    text = run_orient(request, config, console.progress)
    return Answer(text, {"orientation": read_record(request.out / ORIENTATION)})
