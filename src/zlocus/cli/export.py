"""`zlocus export`: cameras, images and surfaces for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.shared_options import Overwrite, ResultFolder
from zlocus.core.export_request import DEFAULT_MAX_ERROR_PX, EXPORT_FORMATS, EXPORT_RECORD, ExportRequest

CAMERAS, MESH = "Cameras", "Mesh"


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Arguments and options of `zlocus export`."""

    kind: Annotated[str, typer.Argument(help=f"{', '.join(EXPORT_FORMATS)}.", metavar="FORMAT")]
    inputs: Annotated[
        list[Path],
        typer.Argument(
            help="Folder of `zlocus orient` or `zlocus dsm`, a scene.yaml, or images with RPC. For a mesh: the folder "
            "of a surface or a cloud, or a raster of heights and then its images.",
            metavar="INPUT",
        ),
    ]
    out: ResultFolder
    crs: Annotated[
        str | None, typer.Option(help="Projected CRS of --bounds. Default: that of the scene.", metavar="EPSG:N")
    ] = None
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Area to be exported. Default: what two images or more see.", metavar="XMIN YMIN XMAX YMAX"),
    ] = None
    heights: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Ellipsoidal heights over which cameras are fitted, m. Default: those of the tie points, or of the "
            "RPC (asp, rpc).", metavar="ZMIN ZMAX", rich_help_panel=CAMERAS,
        ),
    ] = None  # fmt: skip
    max_error: Annotated[
        float | None,
        typer.Option(
            help=f"Largest error of a camera that is not exact. Default: {DEFAULT_MAX_ERROR_PX:g}.", metavar="PX",
            rich_help_panel=CAMERAS,
        ),
    ] = None  # fmt: skip
    points: Annotated[
        bool | None,
        typer.Option(
            "--points/--no-points", help="Write tie points (colmap, nerf). Default: write them.",
            rich_help_panel=CAMERAS,
        ),
    ] = None  # fmt: skip
    resolution: Annotated[
        float | None,
        typer.Option(
            help="Side of the mesh's cells. Default: that of the surface, or 1.5 ground pixels of a cloud.",
            metavar="M",
            rich_help_panel=MESH,
        ),
    ] = None
    jump: Annotated[
        float | None,
        typer.Option(
            help="Difference of neighbouring heights of a surface from which on a wall stands between them. Default: "
            "two cells.",
            metavar="M", rich_help_panel=MESH,
        ),
    ] = None  # fmt: skip
    overwrite: Overwrite = False


def export(options: ExportOptions, console: Console) -> Answer:
    """Write cameras for COLMAP, NeRF tools or Ames Stereo Pipeline, images with corrected RPC, or a textured mesh."""
    request = ExportRequest(**{**vars(options), "inputs": tuple(options.inputs)})
    from zlocus.core.requests import check_output

    check_output(request.out, request.overwrite, (EXPORT_RECORD,), "export")
    from zlocus.pipeline.export import run_export

    result = run_export(request, console.progress)
    return Answer(result.text, result.values)
