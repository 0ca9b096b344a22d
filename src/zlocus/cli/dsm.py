"""`zlocus dsm`: a surface from images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import (
    AREA_AND_GRID,
    HEIGHTS,
    MATCHING,
    RESULT,
    RUN,
    Area,
    Bounds,
    ConfigFile,
    Crs,
    DemVertical,
    DryRun,
    Inputs,
    Memory,
    Overwrite,
    Partial,
    Resolution,
    ResultFolder,
    Resume,
    SearchedHeights,
    Settings,
    Vertical,
)
from zlocus.core.errors import ConfigError
from zlocus.core.redo_request import RedoRequest
from zlocus.core.requests import (
    DEFAULT_PRODUCTS,
    METHODS,
    METHODS_OF_SELECTION,
    PRODUCTS,
    DsmRequest,
    added_products,
    check_output,
)

MAPS_HELP = (
    f"Maps to make beside the {' and the '.join(DEFAULT_PRODUCTS)}: "
    f"{', '.join(name for name in PRODUCTS if name not in DEFAULT_PRODUCTS)} (separated by commas); none: no map."
)

REDO = "A part of a finished run"


@dataclass(frozen=True)
class DsmOptions:
    """Arguments and options of `zlocus dsm`."""

    inputs: Inputs
    out: ResultFolder
    resolution: Resolution = None
    crs: Crs = None
    bounds: Bounds = None
    like: Annotated[
        Path | None,
        typer.Option(
            help="Take CRS, transform and shape from a raster.", metavar="RASTER", rich_help_panel=AREA_AND_GRID
        ),
    ] = None
    area: Area = None
    mask: Annotated[
        Path | None,
        typer.Option(help="Match nothing inside these polygons.", metavar="VECTOR", rich_help_panel=AREA_AND_GRID),
    ] = None
    heights: SearchedHeights = None
    dem: Annotated[
        Path | None,
        typer.Option(help="Search only near the heights of a raster.", metavar="RASTER", rich_help_panel=HEIGHTS),
    ] = None
    dem_vertical: DemVertical = None
    reference: Annotated[
        str | None,
        typer.Option(
            help="Reference image, which sets height step and image order. With gc3-sgm: match only its pixels.",
            metavar="VIEW",
            rich_help_panel=MATCHING,
        ),
    ] = None
    views: Annotated[
        str,
        typer.Option(
            help="Images considered for a cell: the best candidates that show its tile, or all.",
            metavar="auto|all",
            rich_help_panel=MATCHING,
        ),
    ] = "auto"
    method: Annotated[
        str | None,
        typer.Option(
            help="Matching: ground grid (mvll) or image space (gc3), with or without semi-global constraint. "
            "Default: mvll-sgm; mvll with --selection paper.",
            metavar="mvll-sgm|mvll|gc3-sgm|gc3",
            rich_help_panel=MATCHING,
        ),
    ] = None
    selection: Annotated[
        str,
        typer.Option(
            help="Images used for a cell: all that are considered; a few, chosen by match curves at tie points; or "
            "those of Ji et al. (2014).",
            metavar="default|guided|paper",
            rich_help_panel=MATCHING,
        ),
    ] = "default"
    vertical: Vertical = "ellipsoid"
    fill: Annotated[
        str,
        typer.Option(
            help="Fill gaps: small ones by interpolation, or all from the DEM.",
            metavar="none|interpolate|dem",
            rich_help_panel=RESULT,
        ),
    ] = "none"
    water: Annotated[
        Path | None,
        typer.Option(
            help="Write one level inside each of these polygons of water.", metavar="VECTOR", rich_help_panel=RESULT
        ),
    ] = None
    water_level: Annotated[
        str | None,
        typer.Option(
            help="Attribute of the polygons with the level, m in the vertical datum of the result. Default, and where "
            "it is empty: found from the images.",
            metavar="FIELD",
            rich_help_panel=RESULT,
        ),
    ] = None
    level_water: Annotated[
        bool,
        typer.Option("--level-water", help="Level possible water (3 in water.tif) too.", rich_help_panel=RESULT),
    ] = False
    partial: Partial = False
    workers: Annotated[
        int | None,
        typer.Option(
            help="Tiles worked on at a time. Default: as cores, memory and work allow.",
            metavar="N",
            rich_help_panel=RUN,
        ),
    ] = None
    scheduler: Annotated[
        str | None, typer.Option(help="Dask cluster that matches the tiles.", metavar="ADDRESS", rich_help_panel=RUN)
    ] = None
    memory: Memory = None
    resume: Resume = True
    maps: Annotated[str, typer.Option("--products", help=MAPS_HELP, metavar="LIST", rich_help_panel=RESULT)] = ",".join(
        DEFAULT_PRODUCTS
    )
    overwrite: Overwrite = False
    report: Annotated[bool, typer.Option("--report/--no-report", help="Make report.html.", rich_help_panel=RESULT)] = (
        True
    )
    config: ConfigFile = None
    settings: Settings = None
    redo: Annotated[
        Path | None,
        typer.Option(
            help="Make only the cells inside these polygons of the finished run in -o again, with the options given "
            "here in place of its own.",
            metavar="VECTOR",
            rich_help_panel=REDO,
        ),
    ] = None
    redo_margin: Annotated[
        float | None,
        typer.Option(
            help="Width inside the polygons on which old and new heights are blended, m. Default: 8 cells.",
            metavar="M",
            rich_help_panel=REDO,
        ),
    ] = None
    break_lines: Annotated[
        Path | None,
        typer.Option(
            help="Lines that hold the surface at their heights, or without heights let it jump across them.",
            metavar="VECTOR",
            rich_help_panel=REDO,
        ),
    ] = None
    level: Annotated[
        str | None,
        typer.Option(
            help="Level of all cells inside the polygons, m, or the attribute of the polygons that holds it. Nothing "
            "is matched.",
            metavar="M|FIELD",
            rich_help_panel=REDO,
        ),
    ] = None
    dry_run: DryRun = False


def method_of(options: DsmOptions) -> str:
    """The method that is asked for, or the usual one of the selection."""
    return options.method or METHODS_OF_SELECTION.get(options.selection, METHODS)[0]


def dsm_request(options: DsmOptions) -> DsmRequest:
    """The surface that the options ask for."""
    return DsmRequest(
        inputs=tuple(options.inputs), out=options.out, resolution=options.resolution, crs=options.crs,
        bounds=options.bounds, like=options.like, area=options.area, mask=options.mask, heights=options.heights,
        dem=options.dem, dem_vertical=options.dem_vertical, reference=options.reference, views=options.views,
        method=method_of(options), selection=options.selection, vertical=options.vertical, fill=options.fill,
        water=options.water, water_level=options.water_level, level_water=options.level_water,
        partial=options.partial,
        workers=options.workers, scheduler=options.scheduler, memory_gb=options.memory, overwrite=options.overwrite,
        resume=options.resume, products=added_products(options.maps), report=options.report,
    )  # fmt: skip


def dsm(options: DsmOptions, console: Console) -> Answer:
    """Make a digital surface model from images."""
    request = dsm_request(options)
    if options.redo is not None:
        return redo(options, request, console)
    for name, value in (
        ("redo-margin", options.redo_margin), ("break-lines", options.break_lines), ("level", options.level)
    ):  # fmt: skip
        if value is not None:
            raise ConfigError(f"--{name} {value} is given without --redo. Give both, or leave it out.")
    check_output(request.out, request.overwrite, may_be_same=True)
    config = config_of(options.config, options.settings)
    if options.dry_run:
        from zlocus.pipeline.dry_run import plan_dsm

        dry = plan_dsm(request, config, console.progress)
        return Answer(dry.text, dry.values, is_asked_for=True)
    from zlocus.pipeline.dsm import run_dsm

    result = run_dsm(request, config, console.progress)
    return Answer(
        result.sentence,
        {**result.as_dict(), "notes": console.notes},
    )


def redo(options: DsmOptions, request: DsmRequest, console: Console) -> Answer:
    """Make a part of a finished surface again."""
    if options.dry_run:
        raise ConfigError("--dry-run plans whole runs, and not --redo. Leave one out.")
    assert options.redo is not None, "callers make sure"
    # Not given: the method of the run, and not the usual one.
    asked = request if options.method is not None else replace(request, method=DsmRequest.method)
    part = RedoRequest(
        dsm_request=asked, area=options.redo, margin_m=options.redo_margin, break_lines=options.break_lines,
        level=options.level, config=options.config, settings=tuple(options.settings or ()),
    )  # fmt: skip
    from zlocus.pipeline.redo import run_redo

    result = run_redo(part, console.progress)
    return Answer(result.sentence, {**result.as_dict(), "notes": console.notes})
