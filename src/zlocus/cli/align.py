"""`zlocus align`: options in, a moved surface out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.evaluate import Geoid
from zlocus.cli.point_options import POINT_FILES, PointFileOptions, check_for_points
from zlocus.cli.shared_options import ResultFolder
from zlocus.core.align_request import DEFAULT_MAX_SHIFT_M, AlignRequest


@dataclass(frozen=True, kw_only=True)
class MoveOptions:
    """How a surface is moved onto a reference."""

    surface: Annotated[
        Path, typer.Argument(help="Folder of a finished run of `zlocus dsm`, or raster of heights.", metavar="SURFACE")
    ]
    references: Annotated[
        list[Path],
        typer.Argument(
            help=f"What it is moved onto: a raster, points ({POINT_FILES}), or several clouds.", metavar="REFERENCE"
        ),
    ]
    out: ResultFolder
    tilt: Annotated[bool, typer.Option("--tilt", help="Remove a tilt too.")] = False
    height_only: Annotated[
        bool, typer.Option("--height-only", help="Move the surface up and down only, not sideways.")
    ] = False
    max_shift: Annotated[float, typer.Option(help="How far a shift is sought, m.", metavar="M")] = DEFAULT_MAX_SHIFT_M
    keep_grid: Annotated[
        bool,
        typer.Option(
            "--keep-grid",
            help="Keep the grid, and interpolate heights. Default: the grid moves, and nothing is interpolated.",
        ),
    ] = False
    geoid: Geoid = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace another result in the output folder.")] = False


@dataclass(frozen=True, kw_only=True)
class AlignOptions(PointFileOptions, MoveOptions):
    """Arguments and options of `zlocus align`."""


def align(options: AlignOptions, console: Console) -> Answer:
    """Move a surface onto points or onto another surface, and state by how much."""
    request = AlignRequest(
        surface=options.surface, references=tuple(options.references), out=options.out, tilt=options.tilt,
        height_only=options.height_only, max_shift_m=options.max_shift, keep_grid=options.keep_grid,
        geoid=options.geoid, overwrite=options.overwrite,
    )  # fmt: skip
    from zlocus.io.points.open_points import are_points

    if not are_points(options.references):
        check_for_points(options.given(), str(options.references[0]))
    point_options = options.point_options()
    from zlocus.pipeline.align import run_align

    result = run_align(request, point_options, console.progress)
    return Answer(str(result), {"alignment": result.record, "files": [str(result.out / name) for name in result.files]})
