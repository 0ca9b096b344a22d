"""The order of a run: scene, orientation, heights, grid, tiles, products. The only file that knows it."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pyproj import CRS

from zlocus.core.errors import CoverageError, OutputError, StoppedError, ZlocusError
from zlocus.core.grid import Grid
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED, DsmRequest, check_output
from zlocus.core.resources import cores
from zlocus.core.scene import Scene
from zlocus.io.config import config_as_dict
from zlocus.io.grid_inputs import dem_datum
from zlocus.io.input_files import InputFiles
from zlocus.io.rasters import compressing
from zlocus.io.run_record import Stopwatch, now, read_record, request_as_dict, versions_record, write_record
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.view_ranking import RankedPoints
from zlocus.orientation.orientation import Orientation, supported
from zlocus.orientation.plausibility import Doubt
from zlocus.pipeline.execution.checkpoint import TileStore
from zlocus.pipeline.execution.event_log import EventLog
from zlocus.pipeline.execution.plan import Tile, plan_tiles
from zlocus.pipeline.execution.spill_arrays import Scratch
from zlocus.pipeline.fingerprint import digest_of
from zlocus.pipeline.finished_record import write_finished
from zlocus.pipeline.finished_run import Missing, make_missing, missing_products, whole_again
from zlocus.pipeline.image_tiles import Area, OrientedScene, grid_tile, match_for_grid
from zlocus.pipeline.open_run import OpenRun, area_matched, check_polygons, known_ties, may_have_terrain, open_run
from zlocus.pipeline.preparing import check_doubts, made_folder, note_orientation, oriented, taking_part
from zlocus.pipeline.required_space import check_room
from zlocus.pipeline.setup import Settled, settled_run
from zlocus.pipeline.tile_run import (
    Matching,
    Plan,
    Polygons,
    Tally,
    Terrain,
    TileJob,
    TileProduct,
    planned,
    workers_for,
)
from zlocus.products.derived import check_maps, link_all, make_maps, remove_maps
from zlocus.products.rasters import SurfaceRasters
from zlocus.products.report.file_names import CURVES, RECORD, forget_report
from zlocus.products.tie_layers import write_ranking, write_ties
from zlocus.products.tie_observations import OBSERVATIONS, write_observations

if TYPE_CHECKING:
    pass

SUFFICIENT_COVERAGE = 0.5
# Names that files have until they are complete, with the number of the process that writes them.
BEGUN = re.compile(r"\..+\.\d+\.(part|cog|cells|mask)(\.\w+)?")
DEMO_WORKERS = 2


@dataclass(frozen=True)
class DsmResult:
    """out : folder of the products; coverage : share of the cells seen by two images or more that have a height;
    was_finished : whether the surface was there already, made by the same command."""

    out: Path
    coverage: float
    was_finished: bool = False


def run_dsm(request: DsmRequest, config: RunConfig, progress: Progress) -> DsmResult:
    """Make a surface and write all products to `request.out`; where the same one is there already, those that are not.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        Before the first tile, for what cannot be used, and where `out` holds another run and may not be overwritten.
    StoppedError
        Afterwards, where tiles fail, an input has changed, or what was found cannot be written; finished tiles are
        kept.
    CoverageError
        At the end, with all products kept, where fewer than half of the cells seen by two images have a height.
    """
    check_output(request.out, request.overwrite, may_be_same=True)
    begun: list[Matching] = []
    try:
        with compressing(request.workers or cores()):
            return _run_dsm(request, config, progress, begun)
    except OutputError as error:
        if not any(matching.store.finished and matching.store.is_there for matching in begun):
            raise
        n, store = len(begun[0].store.finished), begun[0].store
        raise StoppedError(f"{error} The {n} finished tiles are kept: {store.how_to_go_on}.") from error
    except KeyboardInterrupt:
        for matching in begun:
            matching.tell_interrupted(progress)
        raise


def _run_dsm(request: DsmRequest, config: RunConfig, progress: Progress, begun: list[Matching]) -> DsmResult:
    """See `run_dsm`. begun : becomes the matching, once it begins."""
    watch = Stopwatch()
    check_maps(request.products, config.products, may_have_terrain(request))
    if request.report:
        importlib.import_module(
            "zlocus.pipeline.report_inputs"
        )  # what is broken there is to show now, not after the matching
    with watch.stage("open"), progress.stage("Opening images"):
        run = open_run(request, config, progress)
    if run.finished is not None:
        missing = missing_products(request, run.finished, progress)
        if not missing.matched:
            return _already_finished(request, config, run, missing, progress)
        request = whole_again(request, run.finished, missing, progress)
    found, inputs, store, polygons = run.found, run.inputs, run.store, run.polygons
    scene, vertical = found.scene, found.vertical
    with watch.stage("orient"):
        orientation = _oriented(request, scene, store, config, progress)
    with watch.stage("settle"):
        settled = settled_run(request, found, orientation, config, progress)
        check_room(request.out, settled.grid, settled.matching, _has_colours(request, settled))
        tiles = plan_tiles(settled.grid.window, settled.matching.seen, config.pyramid)
        plan = planned(settled.matching, tiles, config, request)
        vertical.check_covers(area_matched(settled.grid, settled.matching), scene.crs)
        check_polygons(request, settled, polygons.inside)
        progress.note(str(plan))
    out, tally = request.out, Tally()
    job, digest = _job(request, settled, config, polygons), digest_of(settled.matching, orientation)
    matching = Matching(job, tiles, store, EventLog(out))
    ties = {} if orientation.ties is None else orientation.ties.arrays()
    with made_folder(out), store.open(digest, ties):
        begun.append(matching)
        with watch.stage("match") as elsewhere:
            make = _maker(request, job, store, settled, plan, tally, progress)
            failed = matching.run(plan, workers_for(plan, make, progress), progress, elsewhere)
        inputs.check(len(store.finished), may_miss=bool(failed))
        matching.check(failed, request.partial)
        with watch.stage("record"):
            checksums = inputs.record(len(store.finished))
        with watch.stage("write"):
            _forget(out)
            with _rasters(request, settled, vertical) as rasters:
                matching.assemble(failed, rasters, tally, progress)
                inputs.check(len(store.finished))  # for a terrain model that fills gaps is read again
    with watch.stage("points"):
        _write_points(out, settled, tally.ranked, vertical)
    if request.report:
        _show(out, settled, vertical, config, watch, progress)
        _drop_curves_of_others(out, inputs, progress)
    record = {
        **_asked_record(request, config, scene, checksums), "stages": watch.stages,
        **_found_record(settled, vertical), "settled_sha256": digest, **tally.as_dict(),
    }  # fmt: skip
    _write_maps(request, config, watch, record, progress)
    matching.end(failed, tally)
    shortcoming = _shortcoming(tally, settled.doubts, out, progress)
    write_finished(out, store.key, shortcoming)
    store.remove()
    return _ended(request, DsmResult(out, tally.coverage), shortcoming)


def _already_finished(
    request: DsmRequest, config: RunConfig, run: OpenRun, missing: Missing, progress: Progress
) -> DsmResult:
    """The result of a run whose surface is there already, with all that was asked for beside it."""
    assert run.finished is not None, "callers make sure"
    make_missing(request, config, run.found, run.finished, missing, progress)
    run.store.remove()  # of a run that was stopped between its last file and its end
    coverage = float(read_record(request.out / RECORD)["coverage"])
    return _ended(request, DsmResult(request.out, coverage, was_finished=True), run.finished.shortcoming)


def _shortcoming(tally: Tally, doubts: Sequence[Doubt], out: Path, progress: Progress) -> str:
    """Why a complete surface is no success, unless it is accepted with --partial; "" where it is one."""
    try:
        _check_coverage(tally, out, False, progress)
        check_doubts(doubts, out / "dsm.tif")
    except CoverageError as error:
        return str(error)
    return ""


def _oriented(
    request: DsmRequest, scene: Scene, store: TileStore, config: RunConfig, progress: Progress
) -> Orientation:
    """The cameras corrected, from the tie points of the same run where it was begun before."""
    known = known_ties(store, scene, progress)
    orientation = oriented(scene, config.orientation, scene.heights, progress, threads=request.workers, known=known)
    note_orientation(orientation, progress)
    return orientation


def _ended(request: DsmRequest, result: DsmResult, shortcoming: str) -> DsmResult:
    """The result of a run whose products are all there.

    Raises
    ------
    CoverageError
        It is no success, and not accepted as it is.
    """
    if shortcoming and not request.partial:
        raise CoverageError(shortcoming)
    return result


def _rasters(request: DsmRequest, settled: Settled, vertical: VerticalDatum) -> SurfaceRasters:
    """The rasters of the surface; in image space the ortho-image is grey."""
    dtype = settled.matching.views[0].image.dtype
    return SurfaceRasters(request.out, settled.grid.geobox, dtype, vertical, _has_colours(request, settled))


def _has_colours(request: DsmRequest, settled: Settled) -> bool:
    """Whether the ortho-image of a surface has colours."""
    return settled.matching.has_colours and request.method != "gc3-sgm"


def _asked_record(request: DsmRequest, config: RunConfig, scene: Scene, inputs: list[dict[str, Any]]) -> dict[str, Any]:
    """What was asked of which program, when, with which files, and when the images were taken."""
    return {
        "config": {"request": request_as_dict(request), "options": config_as_dict(config)},
        "created": now(),
        "started_in": str(Path.cwd()),
        "versions": versions_record(),
        "inputs": inputs,
        "image_dates": [None if view.date is None else view.date.isoformat() for view in scene.views],
    }


def _write_maps(
    request: DsmRequest, config: RunConfig, watch: Stopwatch, record: dict[str, Any], progress: Progress
) -> None:
    """run.json and the maps: the record first, for maps may fail, and again with the time that they took; then the
    report, which shows it, and the item, which links them all, with or without the maps."""
    write_record(request.out / "run.json", record)
    failed: ZlocusError | None = None
    with watch.stage("products"):
        try:
            make_maps(request.out, request.products, config.products, progress)
        except ZlocusError as error:
            failed = error
    write_record(request.out / "run.json", record)
    if request.report:
        from zlocus.pipeline.report_inputs import try_report

        try_report(request.out, progress)
    link_all(request.out, progress)
    if failed is not None:
        raise failed


def _job(request: DsmRequest, settled: Settled, config: RunConfig, area: Polygons) -> TileJob:
    """What makes the tiles of a request."""
    terrain = None
    if request.fill == "dem":
        assert request.dem is not None, "of a request that fills from it"
        terrain = Terrain(request.dem, dem_datum(request.dem, request.dem_vertical))
    use_visibility, fill = request.views == "auto", "none" if request.fill == "dem" else request.fill
    return TileJob(settled.matching, settled.grid, config, request.method, use_visibility, fill, area, terrain)


def _maker(
    request: DsmRequest,
    job: TileJob,
    store: TileStore,
    found: Settled,
    plan: Plan,
    tally: Tally,
    progress: Progress,
) -> Callable[[Tile], TileProduct]:
    """What makes a tile: matching on the grid, or what is matched in the images first."""
    if request.method != "gc3-sgm":
        return job
    config, settled, grid, orientation = job.config, job.settled, job.grid, found.orientation
    is_supported = supported(orientation.xyz, orientation.sigma_z_m)
    used = taking_part(found.scene, orientation)
    ready = OrientedScene(used, orientation, orientation.xyz, is_supported, found.z_range)
    leading = [view.name for view in settled.views if request.reference in (None, view.name)]
    box, aside = grid.geobox.extent.boundingbox, config.pyramid.halo * grid.cell_m
    bounds = (box.left - aside, box.bottom - aside, box.right + aside, box.top + aside)
    scratch = Scratch(request.out, plan.allowed_bytes - plan.n_bytes)
    area = Area(bounds, found.z_range)
    matched = match_for_grid(ready, leading, area, config, job.use_visibility, plan.slots, progress, scratch, store)
    tally.evaluations, tally.all_images = matched.evaluations, matched.all_images
    if scratch.file_bytes:
        progress.note(
            f"What was found for the pixels of the images lies on disk, for memory has no room for it: "
            f"{scratch.file_bytes / 1e9:.2g} GB."
        )

    def make(tile: Tile) -> TileProduct:
        product = job.product(tile, grid_tile(matched, settled, tile.core, config, job.fill))
        scratch.rest()
        return product

    return make


def _forget(out: Path) -> None:
    """Remove what an earlier run left, before its rasters are replaced: nothing of it may stand beside them."""
    remove_maps(out)
    forget_report(out)
    for name in (FINISHED, "run.json", "ties.gpkg", OBSERVATIONS):
        (out / name).unlink(missing_ok=True)
    # Of runs that were killed; none of this one's is there yet, and no other writes here meanwhile.
    for path in out.iterdir():
        if BEGUN.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _write_points(out: Path, settled: Settled, ranked: list[RankedPoints], vertical: VerticalDatum) -> None:
    """Ties, also as they were measured, and ranking."""
    orientation, scene = settled.orientation, settled.scene
    write_ties(out / "ties.gpkg", orientation, scene, vertical)
    if orientation.ties is not None:
        write_observations(out, orientation.ties)
    if ranked:
        names = [view.name for view in settled.matching.views]
        write_ranking(out / "ranking.gpkg", ranked, names, scene.crs, vertical)


def _show(
    out: Path, settled: Settled, vertical: VerticalDatum, config: RunConfig, watch: Stopwatch, progress: Progress
) -> None:
    """What the report shows that no other product holds."""
    from zlocus.pipeline.report_inputs import Matched, write_shown

    scene = settled.scene
    matched = Matched(
        scene, settled.matching, settled.grid, settled.orientation.xyz, lambda xy: vertical.undulation(xy, scene.crs)
    )
    (match_s,) = (stage["wall_s"] for stage in watch.stages if stage["name"] == "match")
    with watch.stage("curves"), progress.stage("Match curves"):
        write_shown(out, matched, config, match_s, progress)


def _drop_curves_of_others(out: Path, inputs: InputFiles, progress: Progress) -> None:
    """Remove match curves that may show other images than those that were matched."""
    if changed := inputs.changed():
        (out / CURVES).unlink(missing_ok=True)
        progress.note(
            f"{CURVES} was not made: {changed[0]} has changed since the surface was matched. The surface does not "
            "depend on it."
        )


def _check_coverage(tally: Tally, out: Path, partial: bool, progress: Progress) -> None:
    """Say where images were left out, and refuse to call a run a success that found few heights, unless `partial`."""
    if tally.n_left_out:
        progress.note(
            f"In {tally.n_left_out} cells an image that may show them took no part, for it sees them too obliquely "
            "over the heights searched there (LEFT_OUT in quality.tif). Give --heights closer to those of the ground."
        )
    if tally.coverage < SUFFICIENT_COVERAGE and not partial:
        raise CoverageError(
            f"Only {100 * tally.coverage:.1f} % of the cells seen by two images or more have a height in "
            f"{out / 'dsm.tif'}. See the reasons in quality.tif; give --heights or other images, or accept it "
            "with --partial."
        )


def _found_record(settled: Settled, vertical: VerticalDatum) -> dict[str, Any]:
    """Corrections of the cameras, grid, and heights searched, as JSON can hold them."""
    return {
        "orientation": settled.orientation.as_dict(),
        "grid": _grid_record(settled.grid, settled.scene.crs),
        "vertical": vertical.as_dict(),
        "heights": _lattice_record(settled),
    }


def _grid_record(grid: Grid, crs: CRS) -> dict[str, Any]:
    """The products' grid as JSON can hold it."""
    geobox = grid.geobox
    return {"crs": crs.to_string(), "transform": list(geobox.transform)[:6], "shape": list(geobox.shape)}


def _lattice_record(settled: Settled) -> dict[str, Any]:
    """The heights searched, and their lattice, as JSON can hold them."""
    return {
        "range_m": [round(z, 3) for z in settled.z_range],
        "step_m": settled.matching.step_m,
        "levels": settled.matching.levels,
        "leading_view": settled.matching.views[0].name,
    }
