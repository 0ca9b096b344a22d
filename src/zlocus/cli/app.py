"""The command line: options in, one sentence out for whatever goes wrong.

Heavy modules are imported inside the commands, so that `zlocus --help` answers at once.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

# Threads that wait for the small matrices of a run burn more than they save; set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from zlocus import __version__
from zlocus.cli.evaluate import evaluate
from zlocus.cli.exit_status import explained, show_our_warnings
from zlocus.cli.inspect import inspect
from zlocus.cli.products import PRODUCTS_HELP, products
from zlocus.cli.report import report
from zlocus.core.errors import OutputError
from zlocus.core.progress import progress_for
from zlocus.core.requests import (
    DEFAULT_PRODUCTS,
    DEMO_ACCURACY,
    DEMO_BEGUN,
    CloudRequest,
    CurvesRequest,
    DoctorRequest,
    DsmRequest,
    ImportRequest,
    OrientRequest,
    RankRequest,
    check_output,
    product_names,
)
from zlocus.core.signals import handle_signals
from zlocus.core.startup import prepare

if TYPE_CHECKING:
    from zlocus.core.options import RunConfig
    from zlocus.evaluation.evaluate import Evaluation

EXIT_WILL_FAIL = 2

# Arguments and options that several commands share.
Inputs = Annotated[list[Path], typer.Argument(help="Images with RPC, or one scene.yaml.", metavar="INPUT")]
Resolution = Annotated[float | None, typer.Option(help="Cell size, m. Default: median ground pixel.", metavar="M")]
Crs = Annotated[str | None, typer.Option(help="Projected CRS. Default: the scene's UTM zone.", metavar="EPSG:N")]
ABOVE = "ellipsoid|egm96|egm2008|FILE"
DemVertical = Annotated[
    str | None, typer.Option(help="What the DEM's heights are above. Default: what its CRS says.", metavar=ABOVE)
]
Vertical = Annotated[
    str, typer.Option(help="What heights are above, --heights too: FILE is a raster of a geoid.", metavar=ABOVE)
]
TieHeights = Annotated[
    tuple[float, float] | None,
    typer.Option(help="Range in which ties are looked for, m. Default: found.", metavar="ZMIN ZMAX"),
]
SearchedHeights = Annotated[
    tuple[float, float] | None,
    typer.Option(help="Range searched, m. Default: found from tie points.", metavar="ZMIN ZMAX"),
]
Workers = Annotated[int, typer.Option(help="Tiles worked on at a time.", metavar="N")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace another run in the output folder.")]
ConfigFile = Annotated[Path | None, typer.Option(help="Options of every stage; see `zlocus config`.", metavar="FILE")]

app = typer.Typer(
    name="zlocus",
    help="Digital surface models from images, by multi-view vertical line locus matching.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"zlocus {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    """Options before the command."""


@app.command()
@explained
def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the scene and the result.")] = Path("demo"),
) -> None:
    """Render the built-in scene, run everything, and report the accuracy against its truth."""
    # A folder of an earlier demo may be used again, one of any other run not.
    check_output(out, overwrite=any((out / name).exists() for name in (DEMO_ACCURACY, DEMO_BEGUN)))
    from zlocus.io.run_record import write_atomically
    from zlocus.pipeline.demo import run_demo

    result = run_demo(out, progress_for(sys.stderr))
    accuracy = {f"within_{each.threshold_m:g}_m": each.as_dict() for each in result.evaluations}
    text = json.dumps(accuracy, indent=2) + "\n"
    write_atomically(out / DEMO_ACCURACY, lambda part: part.write_text(text, encoding="utf-8"))
    print(f"Accuracy of {result.out} against the rendered truth:")
    for evaluation in result.evaluations:
        print()
        _print_evaluation(evaluation)


@app.command()
@explained
def dsm(
    inputs: Inputs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the result.")],
    resolution: Resolution = None,
    crs: Crs = None,
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            help="Area in the CRS of the grid. Default: ground seen by two images or more.",
            metavar="XMIN YMIN XMAX YMAX",
        ),
    ] = None,
    like: Annotated[
        Path | None, typer.Option(help="Take CRS, transform and shape from a raster.", metavar="RASTER")
    ] = None,
    area: Annotated[Path | None, typer.Option(help="Polygons to work in.", metavar="VECTOR")] = None,
    mask: Annotated[Path | None, typer.Option(help="Polygons to leave out.", metavar="VECTOR")] = None,
    heights: SearchedHeights = None,
    dem: Annotated[Path | None, typer.Option(help="Search around the heights of a raster.", metavar="RASTER")] = None,
    dem_vertical: DemVertical = None,
    reference: Annotated[
        str | None, typer.Option(help="Name of the view that leads; of gc3-sgm, that gives heights.", metavar="VIEW")
    ] = None,
    views: Annotated[str, typer.Option(help="Views used for a cell.", metavar="auto|all")] = "auto",
    method: Annotated[str, typer.Option(help="How heights are found.", metavar="mvll-sgm|mvll|gc3-sgm")] = "mvll-sgm",
    vertical: Vertical = "ellipsoid",
    fill: Annotated[
        str, typer.Option(help="What to do with gaps: small ones, or all.", metavar="none|interpolate|dem")
    ] = "none",
    partial: Annotated[
        bool, typer.Option("--partial", help="Accept a surface that is incomplete or whose cameras are doubtful.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(help="Tiles worked on at a time. Default: by cores, memory and work.", metavar="N")
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="Dask cluster that works on them.", metavar="ADDRESS")] = None,
    memory: Annotated[
        float | None, typer.Option(help="Most memory to use, GB. Default: 60 % of what is free.", metavar="GB")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume/--no-resume", help="Go on where the same run was stopped.")] = True,
    maps: Annotated[str, typer.Option("--products", help=PRODUCTS_HELP, metavar="LIST")] = ",".join(DEFAULT_PRODUCTS),
    overwrite: Overwrite = False,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Make report.html.")] = True,
    config: ConfigFile = None,
) -> None:
    """Make a surface from images."""
    request = DsmRequest(
        inputs=tuple(inputs), out=out, resolution=resolution, crs=crs, bounds=bounds, like=like, area=area, mask=mask,
        heights=heights, dem=dem, dem_vertical=dem_vertical, reference=reference, views=views, method=method,
        vertical=vertical, fill=fill, partial=partial, workers=workers, scheduler=scheduler,
        memory_gb=memory, overwrite=overwrite, resume=resume, products=product_names(maps), report=report,
    )  # fmt: skip
    check_output(out, overwrite, may_be_same=True)
    run_config = _run_config(config)
    from zlocus.pipeline.dsm import run_dsm

    result = run_dsm(request, run_config, progress_for(sys.stderr))
    state = "already finished, " if result.was_finished else ""
    print(f"{result.out}: {state}{100 * result.coverage:.1f} % of the cells seen by two images or more have a height.")


app.command()(explained(products))


@app.command()
@explained
def cloud(
    inputs: Inputs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the result.")],
    reference: Annotated[
        list[str] | None,
        typer.Option(help="Name of a view whose pixels get heights; may be repeated. Default: all.", metavar="VIEW"),
    ] = None,
    crs: Crs = None,
    heights: SearchedHeights = None,
    vertical: Vertical = "ellipsoid",
    fill: Annotated[
        str, typer.Option(help="What to do with gaps of the height maps.", metavar="none|interpolate")
    ] = "none",
    partial: Annotated[
        bool, typer.Option("--partial", help="Accept a cloud that is incomplete or whose cameras are doubtful.")
    ] = False,
    workers: Workers = 1,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
) -> None:
    """Make a coloured point cloud, with a height for every pixel of the images."""
    request = CloudRequest(
        inputs=tuple(inputs), out=out, references=tuple(reference or ()), crs=crs, heights=heights, vertical=vertical,
        fill=fill, partial=partial, workers=workers, overwrite=overwrite,
    )  # fmt: skip
    check_output(out, overwrite)
    run_config = _run_config(config)
    from zlocus.pipeline.cloud import run_cloud

    result = run_cloud(request, run_config, progress_for(sys.stderr))
    print(
        f"{result.out}: {result.n_points} points, a height for {100 * result.coverage:.1f} % of the pixels seen by two "
        "images or more."
    )


@app.command()
@explained
def curves(
    inputs: Inputs,
    at: Annotated[
        tuple[float, float] | None, typer.Option(help="The point on the ground, in the CRS.", metavar="X Y")
    ] = None,
    pixel: Annotated[
        tuple[str, float, float] | None,
        typer.Option(help="The point in an image; (0, 0) is the first pixel's centre.", metavar="VIEW ROW COL"),
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for figures and tables.")] = Path("curves"),
    height: Annotated[
        float | None, typer.Option(help="Look around this height, m. Default: that of the nearest ties.", metavar="Z")
    ] = None,
    resolution: Resolution = None,
    crs: Crs = None,
    heights: TieHeights = None,
    reference: Annotated[
        str | None, typer.Option(help="Name of the reference view. Default: chosen for the point.", metavar="VIEW")
    ] = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
) -> None:
    """Show the match curves of one point: labels, order of the images, and where the match ends."""
    request = CurvesRequest(
        inputs=tuple(inputs), out=out, at=at, pixel=pixel, height=height, resolution=resolution, crs=crs,
        heights=heights, reference=reference, overwrite=overwrite,
    )  # fmt: skip
    check_output(out, overwrite)
    run_config = _run_config(config)
    from zlocus.pipeline.match_curves import run_curves

    print(run_curves(request, run_config, progress_for(sys.stderr)))


@app.command()
@explained
def orient(
    inputs: Inputs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the cameras and the report.")],
    control: Annotated[
        Path | None, typer.Option(help="Ground control and check points, a row per image point.", metavar="CSV")
    ] = None,
    control_vertical: Annotated[
        str | None, typer.Option(help="What their heights are above. Default: the ellipsoid.", metavar=ABOVE)
    ] = None,
    dem: Annotated[Path | None, typer.Option(help="Heights that the ties should have.", metavar="RASTER")] = None,
    dem_vertical: DemVertical = None,
    crs: Crs = None,
    heights: TieHeights = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
) -> None:
    """Correct the cameras of all images jointly, and write them with a report."""
    request = OrientRequest(
        inputs=tuple(inputs), out=out, control=control, control_vertical=control_vertical, dem=dem,
        dem_vertical=dem_vertical, crs=crs, heights=heights, overwrite=overwrite,
    )  # fmt: skip
    check_output(out, overwrite)
    run_config = _run_config(config)
    from zlocus.pipeline.orient import run_orient

    print(run_orient(request, run_config, progress_for(sys.stderr)))


@app.command()
@explained
def ties(
    inputs: Inputs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the tie points.")],
    crs: Crs = None,
    heights: TieHeights = None,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
) -> None:
    """Find tie points, and nothing more."""
    request = OrientRequest(inputs=tuple(inputs), out=out, cameras=False, crs=crs, heights=heights, overwrite=overwrite)
    check_output(out, overwrite)
    run_config = _run_config(config)
    from zlocus.pipeline.orient import run_orient

    print(run_orient(request, run_config, progress_for(sys.stderr)))


@app.command()
@explained
def rank(
    inputs: Inputs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the ranking.")],
    resolution: Resolution = None,
    crs: Crs = None,
    heights: TieHeights = None,
    workers: Workers = 1,
    overwrite: Overwrite = False,
    config: ConfigFile = None,
) -> None:
    """Say how well each image matches each other, at the tie points."""
    request = RankRequest(tuple(inputs), out, resolution, crs, heights, workers, overwrite)
    check_output(out, overwrite)
    run_config = _run_config(config)
    from zlocus.pipeline.rank import run_rank

    print(run_rank(request, run_config, progress_for(sys.stderr)))


@app.command()
@explained
def doctor(
    inputs: Inputs,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for the report and footprints. Default: print only.")
    ] = None,
    resolution: Resolution = None,
    crs: Crs = None,
    heights: TieHeights = None,
    workers: Workers = 1,
    memory: Annotated[float | None, typer.Option(help="Most memory that the run may use, GB.", metavar="GB")] = None,
    config: ConfigFile = None,
) -> None:
    """Look at the inputs before a long run: what will not work, and why."""
    request = DoctorRequest(
        inputs=tuple(inputs), out=out, resolution=resolution, crs=crs, heights=heights, workers=workers,
        memory_gb=memory,
    )  # fmt: skip
    if out is not None:
        # It writes no file that a run does.
        check_output(out, overwrite=True)
    run_config = _run_config(config)
    from zlocus.pipeline.doctor.run import run_doctor

    diagnosis = run_doctor(request, run_config, progress_for(sys.stderr))
    print(diagnosis.text)
    if diagnosis.will_fail:
        raise typer.Exit(EXIT_WILL_FAIL)


@app.command("import")
@explained
def import_cameras(
    kind: Annotated[str, typer.Argument(help="colmap, opensfm, metashape, bundler or eo.", metavar="FORMAT")],
    source: Annotated[Path, typer.Argument(help="Folder of the cameras, or their file.", metavar="DIR")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Scene file to write.")] = Path("scene.yaml"),
    images: Annotated[
        Path | None, typer.Option(help="Folder of the images. Default: in DIR or beside it.", metavar="DIR")
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="Map of the result, in metres, or of the coordinates.", metavar="EPSG:N")
    ] = None,
    local: Annotated[bool, typer.Option("--local", help="Keep local axes (opensfm: east, north, up).")] = False,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Direction that becomes z of a local frame.", metavar="X Y Z"),
    ] = None,
    north: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Direction that becomes y, with --up.", metavar="X Y Z"),
    ] = None,
    focal: Annotated[float | None, typer.Option(help="Focal length (eo), px.", metavar="PX")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Interior orientation (eo), as scene.yaml has it.", metavar="FILE")
    ] = None,
    earth: Annotated[
        str | None, typer.Option(help="How the map is understood (eo). Default: curved.", metavar="curved|flat")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the scene file.")] = False,
) -> None:
    """Make a scene.yaml of the cameras of another program."""
    request = ImportRequest(
        kind=kind, source=source, out=out, images=images, crs=crs, local=local, up=up, north=north, focal=focal,
        camera=camera, earth=earth, overwrite=overwrite,
    )  # fmt: skip
    from zlocus.io.importers.scene import import_scene

    scene = import_scene(request)
    print(f"{out}: {len(scene.views)} views.")


for command in (evaluate, report, inspect):
    app.command()(explained(command))


@app.command()
@explained
def config(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="File to write. Default, and -: print.")] = None,
) -> None:
    """Write a complete commented configuration."""
    from zlocus.core.options import RunConfig
    from zlocus.io.atomic_write import atomic_file
    from zlocus.io.config import write_config

    text = write_config(RunConfig())
    if out is None or str(out) == "-":
        print(text, end="")
        return
    if out.exists():
        raise OutputError(f"{out} exists already and may hold your settings. Choose another name with -o.")
    try:
        with atomic_file(out) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error.strerror}. Choose another name with -o.") from error


def _run_config(path: Path | None) -> RunConfig:
    from zlocus.core.options import RunConfig
    from zlocus.io.config import read_config

    return RunConfig() if path is None else read_config(path)


def _print_evaluation(evaluation: Evaluation) -> None:
    from zlocus.evaluation.table import evaluation_table

    print(evaluation_table(evaluation))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit, in a process of its own; `arguments` default to those of the process."""
    handle_signals()
    prepare()
    show_our_warnings()
    app(arguments, prog_name="zlocus")
