"""`zlocus ortho`: ortho-images of any images on a finished surface, and their mosaic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import (
    AREA_AND_GRID,
    HEIGHTS,
    INPUTS,
    RESULT,
    RUN,
    VERTICAL_DATUMS,
    ConfigFile,
    Overwrite,
    Settings,
)
from zlocus.core.ortho_request import ORTHO_FILES, OrthoRequest
from zlocus.core.requests import check_output

CAMERAS = "Cameras"


@dataclass(frozen=True)
class OrthoOptions:
    """Arguments and options of `zlocus ortho`."""

    surface: Annotated[
        Path, typer.Argument(help="Folder that `zlocus dsm` wrote, or a raster of heights.", metavar="SURFACE")
    ]
    inputs: Annotated[list[Path], typer.Argument(help=INPUTS, metavar="INPUT")]
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the ortho-images.", rich_help_panel=RESULT)] = (
        Path("ortho")
    )
    mosaic: Annotated[
        bool | None,
        typer.Option(
            "--mosaic/--no-mosaic", help="Make a mosaic. Default: of two or more images with the same bands.",
            rich_help_panel=RESULT,
        ),
    ] = None  # fmt: skip
    level: Annotated[
        bool,
        typer.Option("--level/--no-level", help="Level the colours of the mosaic.", rich_help_panel=RESULT),
    ] = True
    resolution: Annotated[
        float | None,
        typer.Option(help="Pixel size, m. Default: that of each image.", metavar="M", rich_help_panel=AREA_AND_GRID),
    ] = None
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            help="Area in the CRS of the surface. Default: all of it.", metavar="XMIN YMIN XMAX YMAX",
            rich_help_panel=AREA_AND_GRID,
        ),
    ] = None  # fmt: skip
    surface_vertical: Annotated[
        str | None,
        typer.Option(
            help="Vertical datum of the surface. Default: what its CRS says.", metavar=VERTICAL_DATUMS,
            rich_help_panel=HEIGHTS,
        ),
    ] = None  # fmt: skip
    pointing: Annotated[
        str,
        typer.Option(
            help="Cameras of images that took no part in the surface: corrected against an ortho-image of it, or as "
            "delivered.", metavar="corrected|delivered", rich_help_panel=CAMERAS,
        ),
    ] = "corrected"  # fmt: skip
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Ortho-image to correct them against. Default: that of the run.", metavar="RASTER",
            rich_help_panel=CAMERAS,
        ),
    ] = None  # fmt: skip
    workers: Annotated[
        int | None, typer.Option(help="Blocks worked on at a time. Default: one per core.", metavar="N",
                                 rich_help_panel=RUN),
    ] = None  # fmt: skip
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None


def ortho(options: OrthoOptions, console: Console) -> Answer:
    """Make ortho-images of any images on a finished surface, with all bands, and their mosaic."""
    request = OrthoRequest(
        surface=options.surface, inputs=tuple(options.inputs), out=options.out, resolution=options.resolution,
        bounds=options.bounds, pointing=options.pointing, reference=options.reference,
        surface_vertical=options.surface_vertical, mosaic=options.mosaic, level_colours=options.level,
        workers=options.workers, overwrite=options.overwrite,
    )  # fmt: skip
    config = config_of(options.config, options.settings)
    check_output(request.out, request.overwrite, ORTHO_FILES, "set of ortho-images")
    from zlocus.pipeline.ortho import run_ortho

    record = run_ortho(request, config, console.progress)
    return Answer(_text(request.out, record), record)


def _text(out: Path, record: dict[str, Any]) -> str:
    """What was written, a line for each file."""
    lines = []
    for each in record["images"].values():
        pixels = each["pixels"]
        seen = sum(pixels.values())
        hidden = 100 * pixels["hidden"] / seen if seen else 0.0
        bands = f"{each['bands']} band{'s' if each['bands'] > 1 else ''} of {each['dtype']}"
        lines.append(
            f"{out / each['file']}: {bands}, pixels of {each['pixel_m']:g} m; {hidden:.1f} % of the ground is hidden."
        )
    if "mosaic" in record:
        mosaic = record["mosaic"]
        n_images, pixel_m = len(mosaic["images"]), mosaic["pixel_m"]
        lines.append(f"{out / mosaic['file']}: mosaic of {n_images} images, pixels of {pixel_m:g} m.")
    return "\n".join(lines)
