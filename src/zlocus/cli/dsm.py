"""`zlocus dsm`: a surface from images."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.commands import config_of
from zlocus.cli.products import PRODUCTS_HELP
from zlocus.cli.shared_options import (
    Area,
    Bounds,
    ConfigFile,
    Crs,
    DemVertical,
    Inputs,
    Memory,
    Overwrite,
    Partial,
    Resolution,
    ResultFolder,
    Resume,
    SearchedHeights,
    Vertical,
)
from zlocus.core.progress import progress_for
from zlocus.core.requests import (
    DEFAULT_PRODUCTS,
    METHODS,
    METHODS_OF_SELECTION,
    DsmRequest,
    check_output,
    product_names,
)


@dataclass(frozen=True)
class DsmOptions:
    """Arguments and options of `zlocus dsm`."""

    inputs: Inputs
    out: ResultFolder
    resolution: Resolution = None
    crs: Crs = None
    bounds: Bounds = None
    like: Annotated[
        Path | None, typer.Option(help="Take CRS, transform and shape from a raster.", metavar="RASTER")
    ] = None
    area: Area = None
    mask: Annotated[Path | None, typer.Option(help="Match nothing inside these polygons.", metavar="VECTOR")] = None
    heights: SearchedHeights = None
    dem: Annotated[Path | None, typer.Option(help="Search only near the heights of a raster.", metavar="RASTER")] = None
    dem_vertical: DemVertical = None
    reference: Annotated[
        str | None,
        typer.Option(
            help="Reference image, which sets height step and image order. With gc3-sgm: match only its pixels.",
            metavar="VIEW",
        ),
    ] = None
    views: Annotated[
        str,
        typer.Option(
            help="Images considered for a cell: the best candidates that show its tile, or all.", metavar="auto|all"
        ),
    ] = "auto"
    method: Annotated[
        str | None,
        typer.Option(
            help="Matching: ground grid (mvll) or image space (gc3), with or without semi-global constraint. "
            "Default: mvll-sgm; mvll with --selection paper.",
            metavar="mvll-sgm|mvll|gc3-sgm|gc3",
        ),
    ] = None
    selection: Annotated[
        str,
        typer.Option(
            help="Images used for a cell: all that are considered; a few, chosen by match curves at tie points; or "
            "those of Ji et al. (2014).",
            metavar="default|guided|paper",
        ),
    ] = "default"
    vertical: Vertical = "ellipsoid"
    fill: Annotated[
        str,
        typer.Option(
            help="Fill gaps: small ones by interpolation, or all from the DEM.", metavar="none|interpolate|dem"
        ),
    ] = "none"
    partial: Partial = False
    workers: Annotated[
        int | None,
        typer.Option(help="Tiles worked on at a time. Default: as cores, memory and work allow.", metavar="N"),
    ] = None
    scheduler: Annotated[str | None, typer.Option(help="Dask cluster that matches the tiles.", metavar="ADDRESS")] = (
        None
    )
    memory: Memory = None
    resume: Resume = True
    maps: Annotated[str, typer.Option("--products", help=PRODUCTS_HELP, metavar="LIST")] = ",".join(DEFAULT_PRODUCTS)
    overwrite: Overwrite = False
    report: Annotated[bool, typer.Option("--report/--no-report", help="Make report.html.")] = True
    config: ConfigFile = None


def method_of(options: DsmOptions) -> str:
    """The method that is asked for, or the usual one of the selection."""
    return options.method or METHODS_OF_SELECTION.get(options.selection, METHODS)[0]


def dsm(options: DsmOptions) -> None:
    """Make a digital surface model from images."""
    request = DsmRequest(
        inputs=tuple(options.inputs), out=options.out, resolution=options.resolution, crs=options.crs,
        bounds=options.bounds, like=options.like, area=options.area, mask=options.mask, heights=options.heights,
        dem=options.dem, dem_vertical=options.dem_vertical, reference=options.reference, views=options.views,
        method=method_of(options), selection=options.selection, vertical=options.vertical, fill=options.fill,
        partial=options.partial,
        workers=options.workers, scheduler=options.scheduler, memory_gb=options.memory, overwrite=options.overwrite,
        resume=options.resume, products=product_names(options.maps), report=options.report,
    )  # fmt: skip
    check_output(request.out, request.overwrite, may_be_same=True)
    config = config_of(options.config)
    from zlocus.pipeline.dsm import run_dsm

    result = run_dsm(request, config, progress_for(sys.stderr))
    state = "already finished, " if result.was_finished else ""
    print(f"{result.out}: {state}{100 * result.coverage:.1f} % of the cells seen by two images or more have a height.")
