"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

# Headings under which the help shows options.
AREA_AND_GRID, HEIGHTS, MATCHING, RUN, RESULT = "Area and grid", "Heights", "Matching", "Run", "Result"
VERTICAL_DATUMS = "ellipsoid|egm96|egm2008|FILE"

INPUTS = "Images with RPC, folders or archives of deliveries, or one scene.yaml."
Inputs = Annotated[list[Path], typer.Argument(help=INPUTS, metavar="INPUT")]
ResultFolder = Annotated[Path, typer.Option("-o", "--out", help="Folder for the result.", rich_help_panel=RESULT)]
Resolution = Annotated[
    float | None,
    typer.Option(help="Cell size, m. Default: median ground pixel.", metavar="M", rich_help_panel=AREA_AND_GRID),
]
Crs = Annotated[
    str | None,
    typer.Option(help="Projected CRS. Default: the scene's UTM zone.", metavar="EPSG:N", rich_help_panel=AREA_AND_GRID),
]
Bounds = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(
        help="Area in the CRS of the result. Default: ground seen by two images or more.",
        metavar="XMIN YMIN XMAX YMAX",
        rich_help_panel=AREA_AND_GRID,
    ),
]
Area = Annotated[
    Path | None, typer.Option(help="Match only inside these polygons.", metavar="VECTOR", rich_help_panel=AREA_AND_GRID)
]
DemVertical = Annotated[
    str | None,
    typer.Option(
        help="Vertical datum of the DEM. Default: what its CRS says.", metavar=VERTICAL_DATUMS, rich_help_panel=HEIGHTS
    ),
]
Vertical = Annotated[
    str,
    typer.Option(
        help="Vertical datum of all heights, including --heights. FILE is a geoid raster.",
        metavar=VERTICAL_DATUMS,
        rich_help_panel=HEIGHTS,
    ),
]
TieHeights = Annotated[
    tuple[float, float] | None,
    typer.Option(
        help="Height range of tie points and matching, m. Default: from the cameras and tie points.",
        metavar="ZMIN ZMAX",
        rich_help_panel=HEIGHTS,
    ),
]
SearchedHeights = Annotated[
    tuple[float, float] | None,
    typer.Option(
        help="Height range to search, m. Default: found from tie points.", metavar="ZMIN ZMAX", rich_help_panel=HEIGHTS
    ),
]
Workers = Annotated[int, typer.Option(help="Tiles worked on at a time.", metavar="N", rich_help_panel=RUN)]
Memory = Annotated[
    float | None,
    typer.Option(help="Memory limit, GB. Default: 60 % of what is free.", metavar="GB", rich_help_panel=RUN),
]
Resume = Annotated[
    bool,
    typer.Option("--resume/--no-resume", help="Resume the same run where it was interrupted.", rich_help_panel=RUN),
]
Partial = Annotated[
    bool,
    typer.Option(
        "--partial",
        help="End with status 0 although the result is incomplete or cameras are doubtful.",
        rich_help_panel=RUN,
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace another run in the output folder.", rich_help_panel=RESULT)
]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="File with options of every stage; see `zlocus config`.",
        metavar="FILE",
        rich_help_panel=MATCHING,
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Set one option of `zlocus config`, such as selection.order=labels; may be repeated.",
        metavar="NAME=VALUE", rich_help_panel=MATCHING),
]  # fmt: skip
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Print the plan, which takes tie points, and make nothing.", rich_help_panel=RUN),
]
SurfaceFolderArgument = Annotated[Path, typer.Argument(help="Folder of a surface made by `zlocus dsm`.", metavar="OUT")]
SurfaceGeoid = Annotated[
    Path | None,
    typer.Option(
        help="Geoid of the heights that are not ellipsoidal, where vertical datums differ. Default: what the CRS says.",
        metavar="RASTER",
    ),
]
Reference = Annotated[Path | None, typer.Option(help="Raster of reference heights to compare with.", metavar="RASTER")]
