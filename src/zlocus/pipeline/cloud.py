"""`zlocus cloud`: setup, images matched in their own spaces, cross-consistency check, cloud and maps, in this order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import CoverageError
from zlocus.core.footprints import AREA_MARGIN
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import CloudRequest, SetupRequest, check_output
from zlocus.core.resources import DEFAULT_MEMORY_SHARE, free_bytes
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import Stopwatch, result_record, write_record
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.image_space import depth_options, is_by_depth
from zlocus.matching.quality import Quality
from zlocus.pipeline.execution.plan import keep_at_most
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.image_tiles import (
    ImageMatching,
    ImageSetup,
    MatchedPixels,
    build_image_scenes,
    cross_checked_images,
    match_images,
    reference_names,
    set_up_images,
)
from zlocus.pipeline.messages import check_doubts, note_orientation
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.pixel_products import write_cloud, write_maps
from zlocus.pipeline.required_space import check_room_for_pixels
from zlocus.pipeline.setup import open_inputs
from zlocus.pipeline.tile_run import MatchMethod
from zlocus.products.point_cloud import file_names
from zlocus.sensors.image_rays import DepthRays

# A cloud with heights for a smaller share of the pixels seen by two images is no success.
SUFFICIENT_COVERAGE = 0.5


@dataclass(frozen=True)
class CloudResult:
    """out : folder of the products; n_points : of the cloud; coverage : share of the reference images' pixels seen by
    two images or more that have a height which other images confirm."""

    out: Path
    n_points: int
    coverage: float


def run_cloud(request: CloudRequest, config: RunConfig, progress: Progress) -> CloudResult:
    """Match the pixels of the reference images and write all products to `request.out`.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        Before the first tile, for what cannot be used.
    StoppedError
        Where an input has changed meanwhile; nothing is written.
    CoverageError
        At the end, with all products kept, where fewer than half of the pixels seen by two images have a height.
    """
    check_output(request.out, request.overwrite)
    keep_at_most()  # an earlier run of this process may have kept less
    watch, before = Stopwatch(), InputFiles.of(request.inputs)
    with watch.stage("open"), progress.stage("Opening images"):
        opened_inputs = open_inputs(SetupRequest.of(request), progress, "later")
        scene, vertical = opened_inputs.scene, opened_inputs.vertical_datum
        references = reference_names(scene, request.references)
        check_room_for_pixels(request.out, scene, references)
        inputs = InputFiles.of(opened_inputs.files, scene, before)
    config = depth_options(config) if is_by_depth(scene) else config
    with watch.stage("orient"), kernels_compiling(progress):
        setup = set_up_images(scene, config, progress)
        note_orientation(setup.orientation, progress)
        references = supported_references(references, setup)
    with watch.stage("setup"):
        image_scenes, config = build_image_scenes(setup, references, config)
        check_geoid(vertical, setup)
    with watch.stage("match"):
        spill_arrays = SpillArrays(request.out, DEFAULT_MEMORY_SHARE * free_bytes())
        matching = ImageMatching(config, MatchMethod("gc3-sgm"), request.workers, spill_arrays)
        matched = match_images(image_scenes, matching, progress)
    with watch.stage("cross-check"):
        matched = cross_checked_images(matched, progress, spill_arrays)
    checksums = inputs.record()
    with watch.stage("write"), made_folder(request.out), progress.stage("Writing", len(matched)) as stage:
        n_points = write_cloud(request.out, matched, scene, vertical)
        for one, name in zip(matched, file_names(references), strict=True):
            write_maps(request.out, name, one, request.fill, scene.crs, vertical)
            stage.advance()
    coverage = share_with_height(matched, n_points)
    write_record(
        request.out / "run.json",
        {
            **result_record(request, config, checksums, watch),
            "orientation": setup.orientation.as_dict(),
            "vertical": vertical.as_dict(),
            "images": {name: image_record(m) for name, m in zip(references, matched, strict=True)},
            "points": n_points,
            "coverage": round(coverage, 6),
        },
    )
    if not request.partial:
        check_success(request.out / "cloud.laz", coverage, setup)
    return CloudResult(request.out, n_points, coverage)


def share_with_height(matched: Sequence[MatchedPixels], n_points: int) -> float:
    """Share of the pixels seen by two images or more that have a height."""
    not_seen = np.uint16(Quality.UNSEEN | Quality.OUTSIDE)
    n_seen = sum(int(((m.quality & not_seen) == 0).sum()) for m in matched)
    return n_points / n_seen if n_seen else 0.0


def check_success(cloud: Path, coverage: float, setup: ImageSetup) -> None:
    """Refuse to call a run a success that has few points, or whose cameras are in grave doubt.

    Raises
    ------
    CoverageError
        It is no success.
    """
    if coverage < SUFFICIENT_COVERAGE:
        raise CoverageError(
            f"Only {100 * coverage:.1f} % of the pixels seen by two images or more have a height that other images "
            f"confirm in {cloud}. See the reasons in the quality maps; give --heights or other images, or accept it "
            "with --partial."
        )
    check_doubts(setup.orientation.doubts, cloud)


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


def check_geoid(vertical_datum: VerticalDatum, setup: ImageSetup) -> None:
    """Refuse, before the long work, a geoid raster that does not cover the tie points and their surroundings."""
    xy = setup.ties[setup.is_supported, :2]
    if vertical_datum.geoid is not None and len(xy):
        low, high = xy.min(axis=0), xy.max(axis=0)
        (west, south), (east, north) = low - AREA_MARGIN * (high - low), high + AREA_MARGIN * (high - low)
        vertical_datum.check_covers((west, south, east, north), setup.scene.crs)


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
