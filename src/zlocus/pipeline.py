"""The order of a run: scene, orientation, heights, grid, tiles, products. The only file that knows it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.errors import CoverageError, GeometryError, OutputError, StoppedError, ZlocusError
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.evaluate import evaluate as compare
from zlocus.execution.events import EventLog
from zlocus.execution.memory import cores
from zlocus.execution.plan import Tile, plan_tiles
from zlocus.execution.scratch import Scratch
from zlocus.execution.store import TileStore
from zlocus.execution.warm import kernels_compiling
from zlocus.grid import Grid, grid_from_bounds, grid_from_geobox
from zlocus.identity import digest_of, key_of
from zlocus.io.config import config_as_dict
from zlocus.io.raster import compressing
from zlocus.io.reference import cells_inside, dem_datum, read_dem, read_geobox, read_polygons
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import VerticalDatum, vertical_datum
from zlocus.job import Polygons, Terrain, TileJob, TileProduct
from zlocus.matching.ranking import RankedPoints
from zlocus.matching.setup import MatchScene, check_resolution, median_ground_pixel, settle, shared_ground
from zlocus.options import RunConfig
from zlocus.orientation.orient import MeasuredTies, Orientation, supported
from zlocus.per_image import Area, OrientedScene, grid_tile, match_for_grid
from zlocus.preparing import (
    area_to_match,
    asked_crs,
    heights_asked_for,
    heights_of_ties,
    made_folder,
    note_dem,
    oriented,
    possible_heights,
    what_was_applied,
    with_heights,
)
from zlocus.products.maps import check_maps, link_all, make_maps, remove_maps
from zlocus.products.picture import picture_beside_truth
from zlocus.products.points import write_ranking, write_ties
from zlocus.products.rasters import SurfaceRasters
from zlocus.products.record import Stopwatch, inputs_record, now, request_as_dict, versions_record, write_record
from zlocus.progress import Progress
from zlocus.reporting import Matched, forget_report, try_report, write_shown
from zlocus.request import DsmRequest
from zlocus.scene import Scene, check_overlap, is_local
from zlocus.tiles import Matching, Plan, Tally, planned, workers_for

SUFFICIENT_COVERAGE = 0.5
# Names that files have until they are complete, with the number of the process that writes them.
BEGUN = re.compile(r"\..+\.\d+\.(part|cog|cells|mask)(\.\w+)?")
DEMO_WORKERS = 2


@dataclass(frozen=True)
class DsmResult:
    """out : folder of the products; coverage : share of the cells seen by two images or more that have a height."""

    out: Path
    coverage: float


@dataclass(frozen=True)
class DemoResult:
    """out : folder of the products; evaluations : against the truth, within two ground pixels and within 1 m."""

    out: Path
    evaluations: tuple[Evaluation, ...]


def run_dsm(request: DsmRequest, config: RunConfig, progress: Progress) -> DsmResult:
    """Make a surface and write all products to `request.out`.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        Before the first tile, for what cannot be used.
    StoppedError
        Afterwards, where tiles fail or what was found cannot be written; finished tiles are kept.
    CoverageError
        At the end, with all products kept, where fewer than half of the cells seen by two images have a height.
    """
    kept: list[TileStore] = []
    try:
        with compressing(request.workers or cores()):
            return _run_dsm(request, config, progress, kept)
    except OutputError as error:
        if not any(store.finished for store in kept):
            raise
        raise StoppedError(
            f"{error} The {len(kept[0].finished)} finished tiles are kept: give the same command again to go on."
        ) from error


def _run_dsm(request: DsmRequest, config: RunConfig, progress: Progress, kept: list[TileStore]) -> DsmResult:
    """See `run_dsm`. kept : becomes where the tiles are, once they are made."""
    watch = Stopwatch()
    check_maps(request.products, config.products)
    with watch.stage("open"), progress.stage("Opening images"):
        opened = _opened(request, config, progress)
        scene, vertical = opened.scene, opened.vertical
    with watch.stage("orient"):
        known = _known_ties(opened.store, scene, progress)
        orientation = oriented(scene, config.orientation, scene.heights, progress, threads=request.workers, known=known)
        progress.note(what_was_applied(orientation))
    with watch.stage("settle"):
        corrected = orientation.apply(scene)
        z_range = _searched_heights(request, corrected, orientation, config, progress)
        grid = _grid(request, opened.like, corrected, orientation, z_range)
        settled = _settled(request, grid, corrected, orientation, z_range, config)
        tiles = plan_tiles(grid.window, settled.seen, config.pyramid)
        plan = planned(settled, tiles, config, request)
        vertical.check_covers(_area_matched(grid, settled), scene.crs)
        _check_polygons(request, grid, settled, opened.polygons.inside)
        progress.note(str(plan))
    out, tally = request.out, Tally()
    job = _job(request, settled, grid, config, opened.polygons)
    matching = Matching(job, tiles, opened.store, EventLog(out))
    ties = {} if orientation.ties is None else orientation.ties.arrays()
    with made_folder(out), opened.store.open(digest_of(settled, orientation), ties):
        kept.append(opened.store)
        with watch.stage("match") as elsewhere:
            make = _maker(request, job, opened.store, corrected, orientation, z_range, plan, tally, progress)
            failed = matching.run(plan, workers_for(plan, make, progress), progress, elsewhere)
        matching.check(failed, request.partial)
        with watch.stage("write"):
            _forget(out)
            with _rasters(request, grid, settled, vertical) as rasters:
                matching.assemble(failed, rasters, tally, progress)
    with watch.stage("points"):
        _write_points(out, orientation, corrected, tally.ranked, settled, vertical)
    matched = Matched(corrected, settled, grid, orientation.xyz, lambda xy: vertical.undulation(xy, scene.crs))
    _show(request, matched, config, watch, progress)
    with watch.stage("record"):
        asked = _asked_record(request, config, scene, opened.files)
    record = {
        **asked,
        "stages": watch.stages,
        "orientation": orientation.as_dict(),
        "grid": _grid_record(grid, scene.crs),
        "vertical": vertical.as_dict(),
        "heights": _lattice_record(settled, z_range),
        **tally.as_dict(),
    }
    _write_maps(request, config, watch, record, progress)
    matching.end(failed, tally)
    _check_coverage(tally, out, request.partial, progress)
    return DsmResult(out, tally.coverage)


def _known_ties(store: TileStore, scene: Scene, progress: Progress) -> MeasuredTies | None:
    """Tie points of the same run, where it was begun before."""
    arrays = store.found_before()
    known = None if arrays is None else MeasuredTies.of(arrays, len(scene.views))
    if known is not None:
        progress.note("Tie points are those of the run that is taken on.")
    return known


def _settled(
    request: DsmRequest,
    grid: Grid,
    scene: Scene,
    orientation: Orientation,
    z_range: tuple[float, float],
    config: RunConfig,
) -> MatchScene:
    """What is settled before the first tile, with limits of heights from a DEM."""
    settled = settle(
        scene, grid.cell_m, grid.anchor, z_range, orientation.xyz, request.reference, config.pyramid,
        orientation.measured,
    )  # fmt: skip
    return _with_dem(request, settled, scene.crs, config)


def _rasters(request: DsmRequest, grid: Grid, settled: MatchScene, vertical: VerticalDatum) -> SurfaceRasters:
    """The rasters of the surface; in image space the ortho-image is grey."""
    has_colours = settled.has_colours and request.method != "gc3-sgm"
    return SurfaceRasters(request.out, grid.geobox, settled.views[0].image.dtype, vertical, has_colours)


def _asked_record(request: DsmRequest, config: RunConfig, scene: Scene, files: list[Path]) -> dict[str, Any]:
    """What was asked of which program, when, with which files, and when the images were taken."""
    return {
        "config": {"request": request_as_dict(request), "options": config_as_dict(config)},
        "created": now(),
        "versions": versions_record(),
        "inputs": inputs_record(files),
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
        try_report(request.out, progress)
    link_all(request.out, progress)
    if failed is not None:
        raise failed


@dataclass(frozen=True)
class Opened:
    """What a request names. like : grid of --like; files : whose content the result depends on; store : tiles that are
    there already."""

    scene: Scene
    vertical: VerticalDatum
    like: GeoBox | None
    polygons: Polygons
    files: list[Path]
    store: TileStore


def _opened(request: DsmRequest, config: RunConfig, progress: Progress) -> Opened:
    """Everything that a request names, open."""
    like, vertical = read_geobox(request.like) if request.like else None, vertical_datum(request.vertical)
    scene = _scene(request, like, vertical)
    note_dem(request.dem, request.dem_vertical, progress)
    files = _files(request, scene, vertical)
    store = TileStore.of(request.out, key_of(request, config, files), request.resume, request.overwrite)
    return Opened(scene, vertical, like, _area_polygons(request, scene.crs), files, store)


def _scene(request: DsmRequest, like: GeoBox | None, vertical: VerticalDatum) -> Scene:
    """The scene, its views by name, so that the order of the inputs changes nothing, with the heights asked for."""
    crs = asked_crs(request.crs) if like is None else CRS.from_wkt(like.crs.to_wkt())  # type: ignore[union-attr]
    scene = open_scene(request.inputs, crs)
    if is_local(scene.crs):
        _check_local(request)
    bounds = request.bounds if like is None else like.boundingbox.bbox
    scene = with_heights(scene, request.heights, vertical, bounds)
    check_overlap(scene, possible_heights(scene, scene.heights))
    return replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))


def _check_local(request: DsmRequest) -> None:
    """Refuse what has a place on the Earth, in a local frame."""
    for name in ("dem", "area", "mask"):
        if path := getattr(request, name):
            raise GeometryError(
                f"The scene's frame is local, where {path} has no place. Leave --{name} out; --bounds and --heights "
                "are in that frame."
            )


def run_demo(out: Path, progress: Progress) -> DemoResult:
    """Render the built-in block (line scanners, six images in two strips), match it, and compare it with its truth."""
    from zlocus.synthetic.files import render_scene
    from zlocus.synthetic.linescan import TrajectoryNoise
    from zlocus.synthetic.scenes import LEVEL_1_M, demo_spec

    spec = demo_spec()
    folder = out / "scene"
    if folder.exists():
        shutil.rmtree(folder)
    with made_folder(out), progress.stage("Rendering the scene", len(spec.views)) as stage, kernels_compiling():
        # The files say how the aircraft flew, which is what the images saw.
        rendered = render_scene(spec, folder, lambda step: stage.advance(), TrajectoryNoise())
    request = DsmRequest(
        inputs=rendered.inputs, out=out, resolution=spec.gsd_m, overwrite=True, workers=DEMO_WORKERS
    )  # fmt: skip
    result = run_dsm(request, RunConfig(), progress)
    evaluations = (
        compare(result.out / "dsm.tif", rendered.truth_dsm, classes=rendered.truth_class, threshold_m=limit)
        for limit in (2 * LEVEL_1_M, 1.0)
    )
    picture_beside_truth(result.out / "dsm.tif", rendered.truth_dsm, result.out / "demo.png")
    return DemoResult(result.out, tuple(evaluations))


def _job(request: DsmRequest, settled: MatchScene, grid: Grid, config: RunConfig, area: Polygons) -> TileJob:
    """What makes the tiles of a request."""
    terrain = None
    if request.fill == "dem":
        assert request.dem is not None, "of a request that fills from it"
        terrain = Terrain(request.dem, dem_datum(request.dem, request.dem_vertical))
    use_visibility, fill = request.views == "auto", "none" if request.fill == "dem" else request.fill
    return TileJob(settled, grid, config, request.method, use_visibility, fill, area, terrain)


def _maker(
    request: DsmRequest,
    job: TileJob,
    store: TileStore,
    scene: Scene,
    orientation: Orientation,
    z_range: tuple[float, float],
    plan: Plan,
    tally: Tally,
    progress: Progress,
) -> Callable[[Tile], TileProduct]:
    """What makes a tile: matching on the grid, or what is matched in the images first."""
    if request.method != "gc3-sgm":
        return job
    config, settled, grid = job.config, job.settled, job.grid
    xyz = orientation.xyz
    ready = OrientedScene(scene, orientation, xyz, supported(xyz, orientation.sigma_z_m), z_range)
    leading = [view.name for view in settled.views if request.reference in (None, view.name)]
    box, aside = grid.geobox.extent.boundingbox, config.pyramid.halo * grid.cell_m
    bounds = (box.left - aside, box.bottom - aside, box.right + aside, box.top + aside)
    scratch = Scratch(request.out, plan.allowed_bytes - plan.n_bytes)
    area = Area(bounds, z_range)
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
    for name in ("run.json", "ties.gpkg"):
        (out / name).unlink(missing_ok=True)
    # Of runs that were killed; none of this one's is there yet, and no other writes here meanwhile.
    for path in out.iterdir():
        if BEGUN.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _write_points(
    out: Path, orientation: Orientation, corrected: Scene, ranked: list[RankedPoints], settled: MatchScene,
    vertical: VerticalDatum,
) -> None:  # fmt: skip
    """Ties and ranking."""
    write_ties(out / "ties.gpkg", orientation, corrected, vertical)
    if ranked:
        write_ranking(out / "ranking.gpkg", ranked, [view.name for view in settled.views], corrected.crs, vertical)


def _show(request: DsmRequest, matched: Matched, config: RunConfig, watch: Stopwatch, progress: Progress) -> None:
    """What the report shows that no other product holds."""
    if not request.report:
        return
    (match_s,) = (stage["wall_s"] for stage in watch.stages if stage["name"] == "match")
    with watch.stage("curves"), progress.stage("Match curves"):
        write_shown(request.out, matched, config, match_s, progress)


def _searched_heights(
    request: DsmRequest, scene: Scene, orientation: Orientation, config: RunConfig, progress: Progress
) -> tuple[float, float]:
    """Height range of the search: as asked for, else from the DEM, else from the ties."""
    if scene.heights:
        return heights_asked_for(scene, scene.heights, progress)
    if request.dem is None:
        return heights_of_ties(scene, orientation, config.orientation)
    z = possible_heights(scene, None)
    bounds = shared_ground(scene, (z[0], z[-1]))
    cell = median_ground_pixel(scene, sum(z) / len(z)) * 16
    geobox = grid_from_bounds(bounds, cell, scene.crs).geobox
    heights = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical))
    if not np.isfinite(heights).any():
        raise GeometryError(f"{request.dem} has no heights where the images overlap. Give one that covers them.")
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    low, high = low - config.pyramid.dem_down_m, high + config.pyramid.dem_up_m
    return heights_asked_for(scene, (low, high), progress, f"The heights around {request.dem}")


def _with_dem(request: DsmRequest, settled: MatchScene, crs: CRS, config: RunConfig) -> MatchScene:
    """Limits from the DEM for the coarsest level."""
    if request.dem is None:
        return settled
    level = settled.levels - 1
    window = settled.seen.at_level(level, 0)
    geobox = GeoBox((window.rows, window.cols), settled.transform(window, level), crs)
    dem = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical))
    limits = np.stack([dem - config.pyramid.dem_down_m, dem + config.pyramid.dem_up_m]).astype(np.float32)
    return replace(settled, prior=limits)


def _grid(
    request: DsmRequest, like: GeoBox | None, scene: Scene, orientation: Orientation, z_range: tuple[float, float]
) -> Grid:
    """The grid asked for: another raster's, or the area at a resolution, both with defaults."""
    z = (z_range[0] + z_range[1]) / 2
    if like is not None:
        grid = grid_from_geobox(like, str(request.like))
        check_resolution(grid.cell_m, scene, z, f"--like {request.like}: its cell of")
        return grid
    cell = request.resolution or float(f"{median_ground_pixel(scene, z):.2g}")
    check_resolution(cell, scene, z, "--resolution")
    bounds = request.bounds or area_to_match(scene, orientation, z_range)
    return grid_from_bounds(bounds, cell, scene.crs)


def _area_matched(grid: Grid, settled: MatchScene) -> tuple[float, float, float, float]:
    """Bounds of the area asked for that two images see; refuses one without any."""
    shared = grid.window.within(settled.seen)
    if shared.rows and shared.cols:
        (west, north), (east, south) = (
            settled.transform(shared, 0) * corner for corner in ((0, 0), (shared.cols, shared.rows))
        )
        return west, south, east, north
    west, north = settled.transform(settled.seen, 0) * (0, 0)
    east, south = settled.transform(settled.seen, 0) * (settled.seen.cols, settled.seen.rows)
    asked = grid.geobox.extent.boundingbox
    raise GeometryError(
        f"The area asked for (E {asked.left:.0f} to {asked.right:.0f} m, N {asked.bottom:.0f} to {asked.top:.0f} m) "
        f"lies outside the ground that two images see (E {west:.0f} to {east:.0f} m, N {south:.0f} to {north:.0f} m). "
        "Check --bounds, --like and the CRS."
    )


def _check_polygons(request: DsmRequest, grid: Grid, settled: MatchScene, area: NDArray[Any] | None) -> None:
    """Refuse polygons of an area that hold no cell to be matched."""
    if area is None:
        return
    shared = grid.window.within(settled.seen)
    row, col = shared.row - grid.window.row, shared.col - grid.window.col
    if not cells_inside(area, grid.geobox[row : row + shared.rows, col : col + shared.cols]).any():
        raise GeometryError(
            f"No cell of the ground that two images see lies inside {request.area}. Check the polygons and their CRS."
        )


def _area_polygons(request: DsmRequest, crs: CRS) -> Polygons:
    """Polygons of --area and --mask."""
    area = None if request.area is None else read_polygons(request.area, crs)
    mask = None if request.mask is None else read_polygons(request.mask, crs)
    return Polygons(area, mask)


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


def _grid_record(grid: Grid, crs: CRS) -> dict[str, Any]:
    """The products' grid as JSON can hold it."""
    geobox = grid.geobox
    return {"crs": crs.to_string(), "transform": list(geobox.transform)[:6], "shape": list(geobox.shape)}


def _lattice_record(settled: MatchScene, z_range: tuple[float, float]) -> dict[str, Any]:
    """The heights searched, and their lattice, as JSON can hold them."""
    range_m = [round(z, 3) for z in z_range]
    return {
        "range_m": range_m,
        "step_m": settled.step_m,
        "levels": settled.levels,
        "leading_view": settled.views[0].name,
    }


def _files(request: DsmRequest, scene: Scene, vertical: VerticalDatum) -> list[Path]:
    """Every file whose content the result depends on."""
    extra = [path for path in (request.like, request.dem, request.area, request.mask) if path is not None]
    extra += vertical.files
    if request.dem is not None:
        extra += dem_datum(request.dem, request.dem_vertical).files
    listed = list(request.inputs) + [path for view in scene.views for path in (view.path, *view.camera_files)] + extra
    return list(dict.fromkeys(listed))
