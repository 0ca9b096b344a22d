"""What `zlocus dsm` writes beside its tiles: rasters, points, run.json, the report's inputs and the maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pyproj import CRS

from zlocus.core.errors import CoverageError, ZlocusError
from zlocus.core.grid import Grid
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED, DsmRequest
from zlocus.core.scene import Scene
from zlocus.io.config import config_as_dict
from zlocus.io.input_files import InputFiles
from zlocus.io.masks.image_mask import masked_share
from zlocus.io.run_record import (
    Stopwatch,
    origin_record,
    read_record,
    request_as_dict,
    versions_record,
    write_record,
)
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.pair_labels import LabelledTies
from zlocus.orientation.plausibility import Doubt
from zlocus.pipeline.fingerprint import COMMANDS, kernels_of_package
from zlocus.pipeline.finished_record import CHECKED, checksum
from zlocus.pipeline.messages import grave_doubt
from zlocus.pipeline.run_plan import Plan
from zlocus.pipeline.setup import RunSetup
from zlocus.pipeline.tile_run import Tally
from zlocus.products.acquisitions import acquisition_records
from zlocus.products.derived import link_all, write_derived
from zlocus.products.metadata import write_metadata
from zlocus.products.ortho_colours import colour_records
from zlocus.products.rasters import SurfaceRasters
from zlocus.products.report.file_names import CURVES, RECORD
from zlocus.products.stac_item import STYLES
from zlocus.products.styles import write_styles
from zlocus.products.surface_statistics import surface_statistics
from zlocus.products.tie_layers import TIES, write_ranking, write_ties
from zlocus.products.tie_observations import write_observations

# A surface with heights for a smaller share of the cells seen by two images is no success.
SUFFICIENT_COVERAGE = 0.5
RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
STYLE_NAMES = tuple(style.name for style in STYLES)


def has_colours(request: DsmRequest, setup: RunSetup) -> bool:
    """Whether the ortho-image has colours; that of image space, and with the selection of the paper, is grey."""
    return setup.match_scene.has_colours and not request.is_in_image_space and request.selection != "paper"


def surface_rasters(request: DsmRequest, setup: RunSetup, vertical_datum: VerticalDatum) -> SurfaceRasters:
    """The rasters of the surface, to be written tile by tile."""
    dtype = setup.match_scene.views[0].image.dtype
    return SurfaceRasters(request.out, setup.grid.geobox, dtype, vertical_datum, has_colours(request, setup))


def write_points(out: Path, setup: RunSetup, labelled_ties: list[LabelledTies], vertical_datum: VerticalDatum) -> None:
    """Write tie points (ties.gpkg), their image observations, and the ranking of images where there is one."""
    orientation, scene = setup.orientation, setup.scene
    write_ties(out / TIES, orientation, scene, vertical_datum)
    if orientation.refined_ties is not None:
        write_observations(out, orientation.refined_ties)
    if labelled_ties:
        names = [view.name for view in setup.match_scene.views]
        write_ranking(out / "ranking.gpkg", labelled_ties, names, scene.crs, vertical_datum)


def write_report_inputs(
    out: Path,
    setup: RunSetup,
    vertical_datum: VerticalDatum,
    config: RunConfig,
    stopwatch: Stopwatch,
    progress: Progress,
) -> None:
    """Write what the report shows and no other product holds: footprints, and match curves of a few cells."""
    from zlocus.pipeline.report_inputs import ReportedRun, write_shown

    run = ReportedRun.of(setup, vertical_datum)
    (match_s,) = (stage["wall_s"] for stage in stopwatch.stages if stage["name"] == "match")
    with stopwatch.stage("curves"), progress.stage("Match curves"):
        write_shown(out, run, config, match_s, progress)


def remove_outdated_curves(out: Path, inputs: InputFiles, progress: Progress) -> None:
    """Remove match curves that may show other images than those that were matched."""
    if changed := inputs.changed():
        (out / CURVES).unlink(missing_ok=True)
        progress.note(
            f"{CURVES} was not made: {changed[0]} has changed since the surface was matched. The surface does not "
            "depend on it."
        )


def write_maps(
    request: DsmRequest, config: RunConfig, stopwatch: Stopwatch, record: dict[str, Any], progress: Progress
) -> None:
    """Write run.json, the maps, the report and the catalogue item, in this order.

    run.json is written before the maps, which may fail, and again after them with the time that they took. The item
    links all files, with or without the maps.

    Raises
    ------
    ZlocusError
        A map could not be made; everything else was written.
    """
    write_record(request.out / "run.json", record)
    failed: ZlocusError | None = None
    with stopwatch.stage("products"):
        try:
            write_derived(request.out, request.products, config.products, progress)
        except ZlocusError as error:
            failed = error
        write_styles(request.out, config.products)
    write_record(request.out / "run.json", record)
    if request.report:
        from zlocus.pipeline.report_inputs import try_report

        write_metadata(request.out)  # the report lists it

        try_report(request.out, progress)
    link_all(request.out, progress)
    if failed is not None:
        raise failed


def run_record(
    request: DsmRequest,
    config: RunConfig,
    setup: RunSetup,
    vertical_datum: VerticalDatum,
    inputs: Sequence[Mapping[str, Any]],
    tally: Tally,
    plan: Plan,
) -> dict[str, Any]:
    """The content of run.json, except the stages. inputs : path and checksum of each file.

    Of the rasters it has the checksums, by which `zlocus rerun` tells whether another run made the same bytes.
    """
    return {
        **_request_record(request, config, setup.scene, inputs),
        "orientation": setup.orientation.as_dict(),
        "grid": grid_record(setup.grid, setup.scene.crs),
        "vertical": vertical_datum.as_dict(),
        "heights": heights_record(setup),
        **tally.as_dict(),
        "plan": plan.as_dict(),
        **surface_statistics(request.out).as_dict(),
        "rasters": {name: checksum(request.out / name) for name in RASTERS},
    }


def _request_record(
    request: DsmRequest, config: RunConfig, scene: Scene, inputs: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Request, options, time, versions, input files, when and how the images were taken, and how much masks cover."""
    return {
        "config": {"request": request_as_dict(request), "options": config_as_dict(config)},
        **origin_record(COMMANDS[DsmRequest], kernels_of_package()),
        "versions": versions_record(),
        "inputs": list(inputs),
        "image_dates": [None if view.date is None else view.date.isoformat() for view in scene.views],
        "acquisitions": acquisition_records(scene.views),
        "colours": colour_records(scene.views),
        "masked_shares": masked_shares(scene),
    }


def masked_shares(scene: Scene) -> dict[str, float]:
    """Share of the pixels that the mask of each view covers, by its name; views without a mask are left out."""
    shares = ((view.name, masked_share(view.image)) for view in scene.views)
    return {name: round(share, 4) for name, share in shares if share is not None}


def grid_record(grid: Grid, crs: CRS) -> dict[str, Any]:
    """The products' grid."""
    geobox = grid.geobox
    return {"crs": crs.to_string(), "transform": list(geobox.transform)[:6], "shape": list(geobox.shape)}


def written_record(out: Path) -> dict[str, Any]:
    """What a finished run has written to a folder: files, grid and bounds (m), and the time of its stages, s."""
    record = read_record(out / RECORD)
    a, _, xmin, _, e, ymax = record["grid"]["transform"]
    rows, cols = record["grid"]["shape"]
    return {
        "run_record": str(out / RECORD),
        "files": [str(out / name) for name in (*CHECKED, FINISHED, *STYLE_NAMES) if (out / name).is_file()],
        "grid": {
            "crs": record["grid"]["crs"], "shape": [rows, cols],
            "bounds": [xmin, round(ymax + rows * e, 6), round(xmin + cols * a, 6), ymax],
        },
        "wall_s": round(sum(float(stage["wall_s"]) for stage in record["stages"]), 3),
    }  # fmt: skip


def heights_record(setup: RunSetup) -> dict[str, Any]:
    """The heights at which the surface was expected and those searched, and the reference image of the scene."""
    return {
        "range_m": [round(z, 3) for z in setup.height_range.expected],
        "searched_m": [round(z, 3) for z in setup.height_range.searched],
        "step_m": setup.match_scene.height_step,
        "levels": setup.match_scene.levels,
        "reference_image": setup.match_scene.views[0].name,
    }


def shortcoming_of(tally: Tally, doubts: Sequence[Doubt], out: Path, progress: Progress) -> str:
    """Why a complete surface is no success, unless --partial accepts it; "" where it is one."""
    try:
        check_coverage(tally, out, progress)
    except CoverageError as error:
        return str(error)
    return grave_doubt(doubts, out / "dsm.tif")


def check_coverage(tally: Tally, out: Path, progress: Progress) -> None:
    """Note where images were excluded or masked, and refuse to call a run a success that has few heights.

    Raises
    ------
    CoverageError
        Fewer than half of the cells seen by two images or more have a height.
    """
    if tally.n_left_out:
        progress.note(
            f"In {tally.n_left_out} cells an image that may show them took no part, for it sees them too obliquely "
            "over the heights searched there (IMAGE_EXCLUDED in quality.tif). Give --heights closer to those of the "
            "ground."
        )
    if tally.n_masked:
        progress.note(
            f"In {tally.n_masked} cells masks left fewer than two images (UNSEEN and IMAGE_EXCLUDED in quality.tif)."
        )
    if tally.coverage < SUFFICIENT_COVERAGE:
        raise CoverageError(
            f"Only {100 * tally.coverage:.1f} % of the cells seen by two images or more have a height in "
            f"{out / 'dsm.tif'}. See the reasons in quality.tif; give --heights or other images, or accept it "
            "with --partial."
        )
