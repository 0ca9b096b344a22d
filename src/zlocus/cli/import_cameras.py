"""`zlocus import`: cameras of other programs as a scene file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.core.requests import ImportRequest


@dataclass(frozen=True)
class ImportOptions:
    """Arguments and options of `zlocus import`."""

    kind: Annotated[str, typer.Argument(help="colmap, opensfm, metashape, bundler or eo.", metavar="FORMAT")]
    source: Annotated[Path, typer.Argument(help="Folder of the cameras, or their file.", metavar="DIR")]
    out: Annotated[Path, typer.Option("-o", "--out", help="Scene file to write.")] = Path("scene.yaml")
    images: Annotated[
        Path | None, typer.Option(help="Folder of the images. Default: in DIR or beside it.", metavar="DIR")
    ] = None
    crs: Annotated[
        str | None, typer.Option(help="CRS of the scene, or of the coordinates (eo); in metres.", metavar="EPSG:N")
    ] = None
    local: Annotated[
        bool, typer.Option("--local", help="Keep the local axes of the source (opensfm: east, north, up).")
    ] = False
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Direction that becomes the z axis of a local frame.", metavar="X Y Z"),
    ] = None
    north: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Direction that becomes the y axis; needs --up.", metavar="X Y Z"),
    ] = None
    offset: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="What was subtracted from map coordinates to make the model's (colmap, bundler, eo); needs --crs.",
            metavar="X Y Z",
        ),
    ] = None
    focal: Annotated[float | None, typer.Option(help="Focal length (eo), px.", metavar="PX")] = None
    camera: Annotated[
        Path | None, typer.Option(help="File with the interior orientation (eo), as in scene.yaml.", metavar="FILE")
    ] = None
    earth: Annotated[
        str | None,
        typer.Option(
            help="Take map coordinates as on a curved Earth or a plane (eo). Default: curved.", metavar="curved|flat"
        ),
    ] = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the scene file.")] = False


def import_cameras(options: ImportOptions, console: Console) -> Answer:
    """Write a scene.yaml from the cameras of another program."""
    request = ImportRequest(**vars(options))
    from zlocus.io.importers.scene import import_scene

    scene = import_scene(request)
    return Answer(f"{request.out}: {len(scene.views)} views.", {"views": [view.name for view in scene.views]})
