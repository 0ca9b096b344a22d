"""`zlocus cloud`: the stages of a cloud, in their order, with finished runs and interrupts around them.

1. open: inputs, and what an earlier run left in the folder (`open_run`);
2. orient: tie points and cameras (`image_scenes`);
3. setup: a match scene for each reference image (`image_scenes`), and the plan of tiles (`run_plan`);
4. match: tiles of images (`image_tiles`), checked across images (`checked_tiles`); points of final tiles are written
   while others are matched (`pixel_products`);
5. write: maps of the images, run.json.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import CoverageError, GeometryError, OutputError, StoppedError
from zlocus.core.footprints import overlap_of
from zlocus.core.jit import CACHE
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import CloudRequest, check_output
from zlocus.io.atomic_write import remove_earlier
from zlocus.io.run_record import Stopwatch, origin_record, read_record, result_record, write_record
from zlocus.io.styles.file_names import remove_styles
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.image_space import depth_options, is_by_depth
from zlocus.matching.quality import Quality
from zlocus.pipeline.checked_tiles import CheckedTiles, strip_by_strip
from zlocus.pipeline.execution.checkpoint import TileCheckpoint, kept_tiles
from zlocus.pipeline.execution.plan import keep_at_most
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.fingerprint import COMMANDS, digest_of_images, kernels_of_package
from zlocus.pipeline.finished_record import (
    CLOUD_COPC,
    checksum,
    is_map_of_image,
    read_finished,
    update_finished,
    write_finished,
)
from zlocus.pipeline.finished_run import files_gone
from zlocus.pipeline.image_scenes import (
    GroundArea,
    ImageScene,
    ImageSetup,
    area_of,
    bounds_of_ties,
    build_image_scenes,
    pixels_of,
    reference_names,
    set_up_images,
)
from zlocus.pipeline.image_tiles import (
    ImageMatching,
    ImageTile,
    MatchedPixels,
    interruption,
    matched_tiles,
    tiles_of_images,
)
from zlocus.pipeline.messages import grave_doubt, note_orientation
from zlocus.pipeline.open_run import OpenRun, known_ties, open_cloud_run
from zlocus.pipeline.output_folder import made_folder, remove_earlier_products, remove_incomplete_files
from zlocus.pipeline.pixel_products import PointWriter, write_maps
from zlocus.pipeline.required_space import CLOUD_PIXEL_BYTES, check_room_for_cloud, n_pixels_of
from zlocus.pipeline.run_plan import (
    Plan,
    SceneTiles,
    planned_pixels,
    remember_run,
    said_before_orientation,
    timed_stages,
)
from zlocus.pipeline.tile_run import MatchMethod
from zlocus.products.other_styles import write_other_styles
from zlocus.products.point_cloud import PointCloud, file_names, write_cloud_copc
from zlocus.products.tie_observations import write_observations
from zlocus.sensors.image_rays import DepthRays

# A cloud with heights for a smaller share of the pixels seen by two images is no success.
SUFFICIENT_COVERAGE = 0.5
RECORD, CLOUD_FILES = "run.json", ("cloud.laz", "cloud.ply")


@dataclass(frozen=True)
class CloudResult:
    """Result of `run_cloud`.

    out : folder of the products; n_points : of the cloud; coverage : share of the reference images' pixels seen by two
    images or more that have a height which other images confirm; was_finished : whether an earlier run of the same
    command had made the cloud already; shortcoming : why it is no success unless that is accepted, "" where it is one.
    """

    out: Path
    n_points: int
    coverage: float
    was_finished: bool = False
    shortcoming: str = ""


@dataclass(frozen=True)
class PreparedCloud:
    """Everything that the matching of a cloud starts from.

    references : names of the reference images; image_scenes, image_tiles : of them; config : options, with the blocks
    and levels that suit the images; ground_area : of the points, None takes all.
    """

    setup: ImageSetup
    references: list[str]
    image_scenes: list[ImageScene]
    image_tiles: list[ImageTile]
    config: RunConfig
    ground_area: GroundArea | None
    plan: Plan


def run_cloud(request: CloudRequest, config: RunConfig, progress: Progress) -> CloudResult:
    """Match the pixels of the reference images and write all products to `request.out`.

    Where the same command has finished there already, nothing is made.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        Before the first tile: an input that cannot be used, or `out` holds another run and may not be overwritten.
    StoppedError
        Later: an input has changed, or results cannot be written; finished tiles are kept.
    CoverageError
        At the end, with all products kept: fewer than half of the pixels seen by two images have a height, or the
        cameras are in grave doubt.
    """
    check_output(request.out, request.overwrite, may_be_same=True)
    keep_at_most()  # an earlier run of this process may have kept less
    watch = Stopwatch()
    TileCheckpoint.check_free(request.out)
    with watch.stage("open"), progress.stage("Opening images"):
        run = open_cloud_run(request, config, progress)
        reference_names(run.opened_inputs.scene, request.references)  # refuses names that are none
    finished = _already_finished(request, config, run, progress)
    if finished is not None:
        return finished
    if run.finished is not None and CLOUD_COPC in run.finished.checksums:  # made again with the rest
        request = replace(request, copc=True)
    is_compiled, is_whole = CACHE.is_complete, not run.checkpoint.finished
    prepared_cloud = oriented_cloud(request, config, run, watch, progress)
    progress.note(str(prepared_cloud.plan))
    scene = run.opened_inputs.scene
    result = _made(request, run, prepared_cloud, watch, progress)
    if is_whole:
        remember_run(prepared_cloud.plan, request, scene.views, timed_stages(watch.stages, is_compiled))
    return _accepted(request, result)


def oriented_cloud(
    request: CloudRequest, config: RunConfig, run: OpenRun, stopwatch: Stopwatch, progress: Progress
) -> PreparedCloud:
    """Orient the images of a run and prepare the cloud: the stages between opening and matching.

    Errors as `prepare_cloud`, and those of the orientation.
    """
    scene = run.opened_inputs.scene
    references = reference_names(scene, request.references)
    if request.bounds is None and request.area is None:
        # All pixels are matched: what has no room is refused before tie points are measured.
        check_room_for_cloud(request.out, n_pixels_of(scene, references), len(references), request.copc)
    config = depth_options(config) if is_by_depth(scene) else config
    progress.note(said_before_orientation(scene.views, None))
    with stopwatch.stage("orient"), kernels_compiling(progress):
        setup = set_up_images(scene, config, progress, known_ties(run.checkpoint, scene, progress))
        note_orientation(setup.orientation, progress)
        references = supported_references(references, setup)
    with stopwatch.stage("setup"):
        return prepare_cloud(request, config, run, setup, references)


def _made(
    request: CloudRequest, run: OpenRun, prepared_cloud: PreparedCloud, stopwatch: Stopwatch, progress: Progress
) -> CloudResult:
    """Match the tiles and write all products."""
    out, scene, vertical_datum = request.out, run.opened_inputs.scene, run.opened_inputs.vertical_datum
    orientation = prepared_cloud.setup.orientation
    digest = digest_of_images([each.match_scene for each in prepared_cloud.image_scenes], orientation)
    before = {} if orientation.refined_ties is None else orientation.refined_ties.arrays()
    with (
        made_folder(out),
        run.checkpoint.open(digest, before) as checkpoint,
        tiles_are_kept(checkpoint, prepared_cloud.image_tiles, progress),
    ):
        remove_incomplete_files(out)
        with PointCloud(out, vertical_datum.compound_crs(scene.crs)) as cloud:
            with stopwatch.stage("match"):
                matched = match_cloud(request, prepared_cloud, run, cloud, progress)
            checksums = run.inputs.record(len(checkpoint.finished))
            with stopwatch.stage("write"), progress.stage("Writing", len(matched)) as stage:
                remove_earlier_cloud(out)
                names = [RECORD, *CLOUD_FILES]
                for one, name in zip(matched, file_names(prepared_cloud.references), strict=True):
                    names += write_maps(out, name, one, request.fill, scene.crs, vertical_datum)
                    stage.advance()
        if request.copc:
            names.append(CLOUD_COPC)
            with stopwatch.stage("copc"), progress.stage("COPC"):
                write_cloud_copc(out)
        with stopwatch.stage("styles"):
            write_other_styles(out, names, prepared_cloud.config.products)
        coverage = share_with_height(matched, cloud.n_points)
        shortcoming = shortcoming_of(out / CLOUD_FILES[0], coverage, prepared_cloud.setup)
        record = {
            **result_record(request, prepared_cloud.config, checksums, stopwatch),
            **origin_record(COMMANDS[CloudRequest], kernels_of_package()),
            "given_options": checkpoint.key["options"],
            "rasters": {name: checksum(out / name) for name in names if is_map_of_image(name)},
            "orientation": orientation.as_dict(),
            "vertical": vertical_datum.as_dict(),
            "images": {name: image_record(m) for name, m in zip(prepared_cloud.references, matched, strict=True)},
            "points": cloud.n_points,
            "coverage": round(coverage, 6),
            "plan": prepared_cloud.plan.as_dict(),
        }
        if orientation.refined_ties is not None:
            # Not among the checked products: ties that are missing are searched again.
            write_observations(out, orientation.refined_ties)
        write_record(out / RECORD, record)
        write_finished(out, checkpoint.key, shortcoming, names)
        checkpoint.remove()
    return CloudResult(out, cloud.n_points, coverage, shortcoming=shortcoming)


@contextmanager
def tiles_are_kept(checkpoint: TileCheckpoint, image_tiles: Sequence[ImageTile], progress: Progress) -> Iterator[None]:
    """Say after an interrupt, and after a failure to write, which finished tiles are kept.

    Raises
    ------
    StoppedError
        Results cannot be written, and finished tiles are kept.
    """
    try:
        with interruption(checkpoint, image_tiles, progress):
            yield
    except OutputError as error:
        n = len(checkpoint.finished)
        if not (n and checkpoint.is_there):
            raise
        raise StoppedError(f"{error} {kept_tiles(n)}: {checkpoint.how_to_resume}.") from error


def remove_earlier_cloud(out: Path) -> None:
    """Remove the products of an earlier run, so that old and new products never stand together."""
    earlier = read_finished(out)
    maps = [] if earlier is None else [name for name in earlier.checksums if is_map_of_image(name)]
    remove_earlier(out, (*CLOUD_FILES, CLOUD_COPC, *maps))
    remove_styles(out, (*CLOUD_FILES, CLOUD_COPC, *maps))
    remove_earlier_products(out, has_incomplete=False)


def prepare_cloud(
    request: CloudRequest, config: RunConfig, run: OpenRun, setup: ImageSetup, references: list[str]
) -> PreparedCloud:
    """Build the match scenes, choose the tiles that may show the area, and plan how they are worked on.

    Raises
    ------
    GeometryError, InputError
        No image shows the area, or the geoid does not cover it.
    OutputError
        The disk has no room for the heights.
    ConfigError
        One tile needs more memory than it may take.
    """
    image_scenes, config = build_image_scenes(setup, references, config)
    area = area_of(request, run.polygons.inside, setup)
    check_geoid(run.opened_inputs.vertical_datum, setup, area)
    image_tiles = tiles_of_images(image_scenes, config, area)
    if not image_tiles:
        what = f"inside {request.area}" if request.area is not None else "inside --bounds"
        raise GeometryError(
            f"No pixel of {', '.join(references)} may show ground {what}. Check the area and its CRS, or name other "
            "images with --reference."
        )
    shown = {image_tile.number for image_tile in image_tiles}
    n_pixels = sum(pixels_of(image_scenes[number]).rows * pixels_of(image_scenes[number]).cols for number in shown)
    check_room_for_cloud(request.out, n_pixels, len(shown), request.copc)
    scenes = [
        SceneTiles(one.match_scene, [each.tile for each in image_tiles if each.number == number])
        for number, one in enumerate(image_scenes)
    ]
    plan = planned_pixels(scenes, run.opened_inputs.scene.views, config, request)
    ordered = strip_by_strip(image_scenes, image_tiles)
    return PreparedCloud(setup, references, image_scenes, ordered, config, area, plan)


def match_cloud(
    request: CloudRequest, prepared_cloud: PreparedCloud, run: OpenRun, cloud: PointCloud, progress: Progress
) -> list[MatchedPixels]:
    """Match all tiles; the points of each go to the cloud as soon as they are final."""
    keep_at_most(prepared_cloud.plan.kept_bytes, prepared_cloud.setup.scene.views)
    scenes = prepared_cloud.image_scenes
    n_pixels = sum(pixels_of(one).rows * pixels_of(one).cols for one in scenes)
    # Memory takes none of them, so that it does not grow with the number of pixels.
    spill_arrays = SpillArrays(request.out, 0.0, int(n_pixels * (CLOUD_PIXEL_BYTES + 1)))
    if len(scenes) < 2:
        progress.note("Only one image was matched, so no other one could confirm its heights: all are kept.")
    matching = ImageMatching(
        prepared_cloud.config,
        MatchMethod("gc3-sgm"),
        prepared_cloud.plan.slots,
        spill_arrays,
        checkpoint=run.checkpoint,
    )
    writer = PointWriter(cloud, run.opened_inputs.scene, run.opened_inputs.vertical_datum)
    checked = CheckedTiles(scenes, prepared_cloud.image_tiles, spill_arrays, prepared_cloud.ground_area)
    for image_tile in checked.final_tiles(matched_tiles(scenes, prepared_cloud.image_tiles, matching, progress)):
        writer.write(checked.pixels[image_tile.number], image_tile.tile.kept_window)
    return checked.result()


def _already_finished(request: CloudRequest, config: RunConfig, run: OpenRun, progress: Progress) -> CloudResult | None:
    """The result of a run that has finished before; None where there is none, or products of it are missing.

    COPC that is asked for and not there is made from the points, and so are missing styles.
    """
    if run.finished is None:
        return None
    gone = sorted(files_gone(request.out, run.finished, progress) - {CLOUD_COPC})
    if gone:
        progress.note(f"The finished run in {request.out} lacks {', '.join(gone)}: it is made again.")
        return None
    run.checkpoint.remove()  # where a run was stopped between its last file and its end
    names, made = list(run.finished.checksums), list[str]()
    if request.copc and not (request.out / CLOUD_COPC).is_file():
        with progress.stage("COPC"):
            write_cloud_copc(request.out)
        update_finished(request.out, (CLOUD_COPC,))
        names, made = [*names, CLOUD_COPC], [CLOUD_COPC]
    made += write_other_styles(request.out, names, config.products, is_new=False)
    if made:
        progress.note(f"Made, for it was not there: {', '.join(made)}.")
    record = read_record(request.out / RECORD)
    n_points, coverage = int(record["points"]), float(record["coverage"])
    return _accepted(request, CloudResult(request.out, n_points, coverage, True, run.finished.shortcoming))


def _accepted(request: CloudRequest, result: CloudResult) -> CloudResult:
    """The result of a run whose products are all written.

    Raises
    ------
    CoverageError
        The run has a shortcoming that --partial does not accept.
    """
    if result.shortcoming and not request.partial:
        raise CoverageError(result.shortcoming)
    return result


def share_with_height(matched: Sequence[MatchedPixels], n_points: int) -> float:
    """Share of the pixels seen by two images or more that have a height."""
    not_seen = np.uint16(Quality.UNSEEN | Quality.OUTSIDE)
    n_seen = sum(int(((m.quality & not_seen) == 0).sum()) for m in matched)
    return n_points / n_seen if n_seen else 0.0


def shortcoming_of(cloud: Path, coverage: float, setup: ImageSetup) -> str:
    """Why a run is no success unless that is accepted: it has few points, or cameras are in grave doubt; else ""."""
    if coverage < SUFFICIENT_COVERAGE:
        return (
            f"Only {100 * coverage:.1f} % of the pixels seen by two images or more have a height that other images "
            f"confirm in {cloud}. See the reasons in the quality maps; give --heights or other images, or accept it "
            "with --partial."
        )
    return grave_doubt(setup.orientation.doubts, cloud)


def supported_references(references: Sequence[str], setup: ImageSetup) -> list[str]:
    """Names of the reference images that tie points support.

    Raises
    ------
    CoverageError
        No tie point supports any of them.
    """
    used = {view.name for view in setup.scene.views}
    supported = [name for name in references if name in used]
    if not supported:
        raise CoverageError(
            f"No tie point supports {', '.join(references)}, so no pixel was matched. Choose another --reference, or "
            "check that the camera belongs to the image."
        )
    return supported


def check_geoid(vertical_datum: VerticalDatum, setup: ImageSetup, ground_area: GroundArea | None) -> None:
    """Refuse, before the long work, a geoid raster that does not cover the tie points and their surroundings, or the
    part of them that lies in the area."""
    if vertical_datum.geoid is None or not setup.is_supported.any():
        return
    bounds = bounds_of_ties(setup)
    vertical_datum.check_covers(
        bounds if ground_area is None else overlap_of(bounds, ground_area.bounds), setup.scene.crs
    )


def image_record(matched_pixels: MatchedPixels) -> dict[str, Any]:
    """What run.json says of a reference image."""
    match_scene, rays = matched_pixels.match_scene, matched_pixels.image.image_space.rays
    record: dict[str, Any] = {
        "points": int(np.isfinite(matched_pixels.image.height).sum()),
        "levels": match_scene.levels,
        "steps": match_scene.n_steps,
    }
    if isinstance(rays, DepthRays):
        span = (match_scene.height_origin, match_scene.height_origin + match_scene.n_steps * match_scene.height_step)
        return record | {"disparities_px": [round(v, 3) for v in span], "disparity_times_depth_px_m": rays.scale}
    return record | {"step_m": match_scene.height_step * getattr(rays, "unit", 1.0)}
