"""`zlocus orient` and `zlocus ties`: corrected cameras, or tie points alone."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.commands import config_of
from zlocus.cli.shared_options import VERTICAL_DATUMS, ConfigFile, Crs, DemVertical, Inputs, Overwrite, TieHeights
from zlocus.core.progress import progress_for
from zlocus.core.requests import OrientRequest, check_output


@dataclass(frozen=True)
class OrientOptions:
    """Arguments and options of `zlocus orient`."""

    inputs: Inputs
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the cameras and the report.")]
    control: Annotated[Path | None, typer.Option(help="Table of ground control and check points.", metavar="CSV")] = (
        None
    )
    control_vertical: Annotated[
        str | None,
        typer.Option(help="Vertical datum of the control points. Default: ellipsoid.", metavar=VERTICAL_DATUMS),
    ] = None
    dem: Annotated[
        Path | None, typer.Option(help="Terrain model that gives heights to tie points.", metavar="RASTER")
    ] = None
    dem_vertical: DemVertical = None
    crs: Crs = None
    heights: TieHeights = None
    overwrite: Overwrite = False
    config: ConfigFile = None


@dataclass(frozen=True)
class TiesOptions:
    """Arguments and options of `zlocus ties`."""

    inputs: Inputs
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the tie points.")]
    crs: Crs = None
    heights: TieHeights = None
    overwrite: Overwrite = False
    config: ConfigFile = None


def orient(options: OrientOptions) -> None:
    """Correct all cameras by a bundle adjustment, and write them."""
    request = OrientRequest(
        inputs=tuple(options.inputs), out=options.out, control=options.control,
        control_vertical=options.control_vertical, dem=options.dem, dem_vertical=options.dem_vertical,
        crs=options.crs, heights=options.heights, overwrite=options.overwrite,
    )  # fmt: skip
    _run(request, options.config)


def ties(options: TiesOptions) -> None:
    """Find tie points between images; correct no camera."""
    request = OrientRequest(
        inputs=tuple(options.inputs), out=options.out, cameras=False, crs=options.crs, heights=options.heights,
        overwrite=options.overwrite,
    )  # fmt: skip
    _run(request, options.config)


def _run(request: OrientRequest, config_file: Path | None) -> None:
    """Run the request and print what was written."""
    check_output(request.out, request.overwrite)
    config = config_of(config_file)
    from zlocus.pipeline.orient import run_orient

    print(run_orient(request, config, progress_for(sys.stderr)))
