"""The order of a cloud's run: scene, orientation, images matched in their own spaces, matched back, written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import CoverageError
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import CloudRequest, check_output
from zlocus.core.resources import SHARE, free_bytes
from zlocus.core.scene import Scene, View, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.colour import read_colours
from zlocus.io.input_files import InputFiles, files_of
from zlocus.io.run_record import Stopwatch, made_record, write_record
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum, vertical_datum
from zlocus.matching.fill import filled_from_behind
from zlocus.matching.image_space import ROWS_AT_ONCE, depth_options, is_by_depth
from zlocus.matching.quality import Quality
from zlocus.pipeline.execution.spill_arrays import Scratch
from zlocus.pipeline.image_tiles import (
    Matched,
    OrientedScene,
    chosen_references,
    confirmed_images,
    match_images,
    orient_scene,
    settle_all,
)
from zlocus.pipeline.preparing import AREA_MARGIN, asked_crs, check_doubts, made_folder, note_orientation, with_heights
from zlocus.pipeline.required_space import check_room_for_pixels
from zlocus.products.point_cloud import PointCloud, file_names, write_map
from zlocus.sensors.image_rays import DepthRays

# A cloud with fewer heights than this share of the pixels seen by two images is no success.
SUFFICIENT_COVERAGE = 0.5
WHITE_PERCENT = 99.5
WHITE_ROWS = 16


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
    watch, before = Stopwatch(), InputFiles.of(request.inputs)
    with watch.stage("open"), progress.stage("Opening images"):
        scene = open_scene(request.inputs, asked_crs(request.crs))
        scene = replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))
        vertical = vertical_datum(request.vertical)
        scene = with_heights(scene, request.heights, vertical)
        references = chosen_references(scene, request.references)
        check_room_for_pixels(request.out, scene, references)
        inputs = InputFiles.of([*request.inputs, *files_of(scene), *vertical.files], scene, before)
    options = depth_options(config) if is_by_depth(scene) else config
    with watch.stage("orient"):
        ready = orient_scene(scene, scene.heights, config.orientation, progress)
        note_orientation(ready.orientation, progress)
        references = references_taking_part(references, ready)
    with watch.stage("settle"):
        settled, options = settle_all(ready, references, options)
        check_geoid(vertical, ready)
    with watch.stage("match"):
        scratch = Scratch(request.out, SHARE * free_bytes())
        matched = match_images(settled, options, True, request.workers, progress, scratch)
    with watch.stage("match back"):
        matched = confirmed_images(matched, progress, scratch)
    checksums = inputs.record()
    with watch.stage("write"), made_folder(request.out), progress.stage("Writing", len(matched)) as stage:
        n_points = write_cloud(request.out, matched, scene, vertical)
        for one, name in zip(matched, file_names(references), strict=True):
            write_maps(request.out, name, one, request.fill, scene.crs, vertical)
            stage.advance()
    n_seen = sum(int(((m.quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) == 0).sum()) for m in matched)
    coverage = n_points / n_seen if n_seen else 0.0
    write_record(
        request.out / "run.json",
        {
            **made_record(request, options, checksums, watch),
            "orientation": ready.orientation.as_dict(),
            "vertical": vertical.as_dict(),
            "images": {name: image_record(m) for name, m in zip(references, matched, strict=True)},
            "points": n_points,
            "coverage": round(coverage, 6),
        },
    )
    if not request.partial:
        _check_success(request.out / "cloud.laz", coverage, ready)
    return CloudResult(request.out, n_points, coverage)


def _check_success(cloud: Path, coverage: float, ready: OrientedScene) -> None:
    """Refuse to call a run a success that found few points, or whose cameras are in grave doubt."""
    if coverage < SUFFICIENT_COVERAGE:
        raise CoverageError(
            f"Only {100 * coverage:.1f} % of the pixels seen by two images or more have a height that other images "
            f"confirm in {cloud}. See the reasons in the quality maps; give --heights or other images, or accept it "
            "with --partial."
        )
    check_doubts(ready.orientation.doubts, cloud)


def references_taking_part(references: Sequence[str], ready: OrientedScene) -> list[str]:
    """The reference images that tie points support.

    Raises
    ------
    CoverageError
        Where none of them is.
    """
    used = {view.name for view in ready.scene.views}
    found = [name for name in references if name in used]
    if not found:
        raise CoverageError(
            f"No tie point supports {', '.join(references)}, so no pixel was matched. Choose another --reference, or "
            "check that the camera belongs to the image."
        )
    return found


def check_geoid(vertical: VerticalDatum, ready: OrientedScene) -> None:
    """Refuse, before the long work, a geoid that does not cover the tie points and a little beside them."""
    xy = ready.ties[ready.trusted, :2]
    if vertical.geoid is not None and len(xy):
        low, high = xy.min(axis=0), xy.max(axis=0)
        (west, south), (east, north) = low - AREA_MARGIN * (high - low), high + AREA_MARGIN * (high - low)
        vertical.check_covers((west, south, east, north), ready.scene.crs)


def write_cloud(out: Path, matched: Sequence[Matched], scene: Scene, vertical: VerticalDatum = ELLIPSOIDAL) -> int:
    """All points with their colours, their heights above what is asked for; their number."""
    n_points = sum(int(np.isfinite(m.image.height).sum()) for m in matched)
    white = white_level(scene.views)
    number = {view.name: k for k, view in enumerate(scene.views, 1)}
    with PointCloud(out, n_points, vertical.compound(scene.crs)) as cloud:
        for one in matched:
            view, height = one.image.space.reference, one.image.height
            for row, rows in strips(len(height)):
                known = np.isfinite(height[row : row + rows])
                if known.any():
                    part = slice(row, row + rows)
                    xyz = one.image.space.ground(row, height[part])[known]
                    xyz[:, 2] -= vertical.undulation(xyz[:, :2], scene.crs)
                    share = np.clip(read_colours(view.path, row, rows)[known] / white, 0.0, 1.0)
                    rgb = np.rint(share * 65535.0).astype(np.uint16)
                    sigma_m = precision_m(one, row, known)
                    cloud.write(number[view.name], xyz, rgb, sigma_m, one.surface.views[part][known])
    return n_points


def precision_m(one: Matched, row: int, known: NDArray[np.bool_]) -> FloatArray:
    """Standard deviations (n,) m of some pixels of the rows from `row` on: of height, or along the rays of cameras that
    are asked for depths. known : (r, c)."""
    rows, cols = np.nonzero(known)
    part = slice(row, row + len(known))
    z, sigma = one.image.height[part][known], one.surface.sigma[part][known]
    xy = np.column_stack([cols, rows + row]).astype(float)
    return np.asarray(sigma * one.image.space.rays.metres_per_unit(xy, z.astype(float)))


def strips(n_rows: int) -> Iterator[tuple[int, int]]:
    """First row and number of rows of strips of an image."""
    edges = [*range(0, n_rows, ROWS_AT_ONCE), n_rows]
    return ((first, end - first) for first, end in pairwise(edges))


def white_level(views: Sequence[View]) -> float:
    """The number that is shown white: 255 in 8-bit images, else what few pixels of the images exceed."""
    if all(view.image.dtype == "uint8" for view in views):
        return 255.0
    numbers = []
    for view in views:
        rows, cols = view.image.shape
        for row in np.unique(np.linspace(0, rows - 1, WHITE_ROWS).astype(int)):
            valid = view.image.read(int(row), 0, 1, cols).valid
            numbers.append(read_colours(view.path, int(row), 1)[valid].max(axis=-1))
    known = np.concatenate(numbers)
    return max(float(np.percentile(known, WHITE_PERCENT)), 1e-6) if len(known) else 1.0


def write_maps(out: Path, name: str, one: Matched, fill: str, crs: CRS, vertical: VerticalDatum = ELLIPSOIDAL) -> None:
    """NAME_height.tif, NAME_quality.tif and, for frame cameras, NAME_depth.tif."""
    space, height, quality = one.image.space, one.image.height, one.quality
    if fill == "interpolate":
        beyond = (quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
        whole = filled_from_behind(height, beyond)
        quality = np.where(np.isnan(height) & np.isfinite(whole), quality | np.uint16(Quality.FILLED), quality)
        height = whole
    z = np.empty(height.shape, np.float32)
    for row, rows in strips(len(height)):
        xyz = space.ground(row, height[row : row + rows])
        known = np.isfinite(xyz).all(axis=-1)
        xyz[known, 2] -= vertical.undulation(xyz[known, :2], crs)
        z[row : row + rows] = xyz[..., 2]
    above = "" if is_local(crs) else f" above {vertical.surface}"
    write_map(out / f"{name}_height.tif", z, f"height{above} of what the pixel shows", "m")
    if isinstance(space.rays, DepthRays):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(height > 0, np.float32(space.rays.scale) / height, np.float32(np.nan))
        write_map(out / f"{name}_depth.tif", depth, "depth along the optical axis", "m")
    write_map(out / f"{name}_quality.tif", quality, "quality bit flags")


def image_record(one: Matched) -> dict[str, Any]:
    """A reference image as run.json holds it."""
    scene, rays = one.settled, one.image.space.rays
    record: dict[str, Any] = {
        "points": int(np.isfinite(one.image.height).sum()), "levels": scene.levels, "steps": scene.n_steps,
    }  # fmt: skip
    if isinstance(rays, DepthRays):
        span = (scene.origin_m, scene.origin_m + scene.n_steps * scene.step_m)
        return record | {"disparities_px": [round(v, 3) for v in span], "disparity_times_depth_px_m": rays.scale}
    return record | {"step_m": scene.step_m * getattr(rays, "unit", 1.0)}
