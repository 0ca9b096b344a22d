"""The order of a cloud's run: scene, orientation, images matched in their own spaces, matched back, written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.errors import ConfigError, CoverageError, TileError, ZlocusError
from zlocus.execution.local import run_all
from zlocus.execution.plan import Tile, plan_tiles
from zlocus.io.colour import read_colours
from zlocus.io.config import config_as_dict
from zlocus.io.scene_file import open_scene
from zlocus.matching.cells import CellWindow
from zlocus.matching.confirm import ROWS_AT_ONCE, Confirmation, MatchedImage, confirm
from zlocus.matching.gc3 import (
    ImageSpace,
    beyond_range,
    depth_options,
    fitting_block,
    hypotheses_of_heights,
    hypotheses_of_ties,
    image_space,
    is_by_depth,
    settle_image,
    widest_disparities,
)
from zlocus.matching.setup import FEWEST_LEVELS, MatchScene
from zlocus.options import OrientationOptions, RunConfig
from zlocus.orientation.orient import Orientation, supported
from zlocus.preparing import asked_crs, heights_of_ties, made_folder, oriented, possible_heights, what_was_applied
from zlocus.products.cloud import PointCloud, file_names, write_map
from zlocus.products.record import Stopwatch, inputs_record, versions_record, write_record
from zlocus.progress import Progress
from zlocus.request import CloudRequest
from zlocus.scene import Scene, View, check_overlap
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.model import FloatArray
from zlocus.sensors.rays import DepthRays
from zlocus.surface.behind import filled_from_behind
from zlocus.surface.reasons import Quality
from zlocus.surface.surface import Surface
from zlocus.tile import match_tile

AGREE_PX = 1.0
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


@dataclass(frozen=True)
class OrientedScene:
    """views with corrected sensors; ties : (n, 3) m, ground points; trusted : (n,) whether neighbours confirm them;
    z_range : heights searched, m, None where each image takes its depths from the ties."""

    scene: Scene
    orientation: Orientation
    ties: FloatArray
    trusted: NDArray[np.bool_]
    z_range: tuple[float, float] | None


@dataclass(frozen=True)
class Matched:
    """A reference image: what was found for its pixels, quality included, before other images confirm it."""

    image: MatchedImage
    settled: MatchScene
    quality: NDArray[np.uint16]


def run_cloud(request: CloudRequest, config: RunConfig, progress: Progress) -> CloudResult:
    """Match the pixels of the reference images and write all products to `request.out`.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        Before the first tile, for what cannot be used.
    CoverageError
        At the end, with all products kept, where fewer than half of the pixels seen by two images have a height.
    """
    watch = Stopwatch()
    with watch.stage("open"), progress.stage("Opening images"):
        scene = open_scene(request.inputs, asked_crs(request.crs))
        scene = replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))
        references = chosen_references(scene, request.references)
    options = depth_options(config) if is_by_depth(scene) else config
    with watch.stage("orient"):
        ready = orient_scene(scene, request.heights or scene.heights, config.orientation, progress)
        progress.note(what_was_applied(ready.orientation))
    with watch.stage("settle"):
        settled, options = settle_all(ready, references, options)
    with watch.stage("match"):
        matched = match_images(settled, options, len(scene.views) > 2, request.workers, progress)
    with watch.stage("match back"):
        matched = confirmed_images(matched, progress)
    with watch.stage("write"), made_folder(request.out), progress.stage("Writing", len(matched)) as stage:
        n_points = write_cloud(request.out, matched, scene)
        for one, name in zip(matched, file_names(references), strict=True):
            write_maps(request.out, name, one, request.fill)
            stage.advance()
    n_seen = sum(int(((m.quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) == 0).sum()) for m in matched)
    coverage = n_points / n_seen if n_seen else 0.0
    files = [path for view in scene.views for path in (view.path, *view.camera_files)]
    write_record(
        request.out / "run.json",
        {
            "config": {"request": request_record(request), "options": config_as_dict(options)},
            "versions": versions_record(),
            "inputs": inputs_record(dict.fromkeys([*request.inputs, *files])),
            "stages": watch.stages,
            "orientation": ready.orientation.as_dict(),
            "images": {name: image_record(m) for name, m in zip(references, matched, strict=True)},
            "points": n_points,
            "coverage": round(coverage, 6),
        },
    )
    if coverage < SUFFICIENT_COVERAGE and not request.partial:
        raise CoverageError(
            f"Only {100 * coverage:.1f} % of the pixels seen by two images or more have a height that other images "
            f"confirm in {request.out / 'cloud.laz'}. See the reasons in the quality maps; give --heights or other "
            "images, or accept it with --partial."
        )
    return CloudResult(request.out, n_points, coverage)


def chosen_references(scene: Scene, asked: Sequence[str]) -> list[str]:
    """Names of the views to be matched, in the scene's order."""
    names = [view.name for view in scene.views]
    for name in asked:
        if name not in names:
            raise ConfigError(f"--reference {name} is not a view of this scene. Choose from {', '.join(names)}.")
    return [name for name in names if not asked or name in asked]


def orient_scene(
    scene: Scene, heights: tuple[float, float] | None, options: OrientationOptions, progress: Progress
) -> OrientedScene:
    """Corrected sensors, ties, and the range of heights.

    Frame cameras, which may look anywhere, are oriented over the pixels and disparities of the first image: a shift of
    an image is the same there, and disparities, unlike heights, are linear along every locus.
    """
    if not is_by_depth(scene):
        check_overlap(scene, possible_heights(scene, heights))
        found = oriented(scene, options, heights, progress)
        trusted = supported(found.xyz, found.sigma_z_m)
        z_range = heights or heights_of_ties(scene, found, options)
        return OrientedScene(found.apply(scene), found, found.xyz, trusted, z_range)
    space = image_space(scene, scene.views[0].name, (0.0, 0.0))
    given = None if heights is None else hypotheses_of_heights(space, heights)
    found = oriented(Scene(space.views, scene.crs), options, given or widest_disparities(space), progress)
    views = tuple(corrected(view, v.shift_px) for view, v in zip(scene.views, found.views, strict=True))
    ground = space.rays.ground(found.xyz[:, :2] * [1.0, -1.0], found.xyz[:, 2])
    trusted = supported(found.xyz, found.sigma_z_m) & np.isfinite(ground).all(axis=1)
    return OrientedScene(replace(scene, views=views), found, ground, trusted, heights)


def corrected(view: View, shift_px: tuple[float, float]) -> View:
    """A view with a frame camera moved in its image."""
    assert isinstance(view.sensor, FrameModel), "only frame cameras are matched by depth"
    return replace(view, sensor=view.sensor.moved(*shift_px))


def settle_all(
    ready: OrientedScene, references: Sequence[str], options: RunConfig
) -> tuple[list[tuple[ImageSpace, MatchScene]], RunConfig]:
    """Each reference image's space and lattice, and the options with blocks, and if need be levels, that suit them.

    Of frame cameras that look from very different directions, the projections of a coarse level's blocks are too bent
    for the tables: then fewer levels search more steps at the coarsest.
    """
    while True:
        settled = [settle(ready, name, options) for name in references]
        block = fitting_block([scene for _, scene in settled], options.pyramid.block)
        levels = max(scene.levels for _, scene in settled)
        if block is not None or levels <= FEWEST_LEVELS:
            pyramid = replace(options.pyramid, block=block or options.pyramid.block)
            return settled, replace(options, pyramid=pyramid)
        options = replace(options, pyramid=replace(options.pyramid, max_levels=levels - 1))


def settle(ready: OrientedScene, reference: str, options: RunConfig) -> tuple[ImageSpace, MatchScene]:
    """A reference image's space, and the lattice that is searched there."""
    space = image_space(ready.scene, reference, ready.z_range or (0.0, 0.0))
    ties = space.frame_from_ground(ready.ties)
    known = np.isfinite(ties).all(axis=1)
    span = None if ready.z_range is None else hypotheses_of_heights(space, ready.z_range)
    if span is None:
        span = hypotheses_of_ties(space, ties[known & ready.trusted], options.orientation)
    return space, settle_image(space, span, ties[known], options.pyramid)


def match_images(
    settled: Sequence[tuple[ImageSpace, MatchScene]],
    options: RunConfig,
    use_visibility: bool,
    workers: int,
    progress: Progress,
) -> list[Matched]:
    """Every tile of every reference image."""
    images = [CellWindow(0, 0, *space.reference.image.shape) for space, _ in settled]
    surfaces = [Surface.nothing(window) for window in images]
    tasks = [
        (number, tile)
        for number, (_, scene) in enumerate(settled)
        for tile in plan_tiles(images[number], scene.seen, options.pyramid)
    ]

    def work(task: tuple[int, Tile]) -> Surface:
        space, scene = settled[task[0]]
        core = task[1].core
        try:
            return match_tile(scene, core, options, use_visibility=use_visibility).surface
        except ZlocusError:
            raise
        except Exception as error:
            where = f"The pixels from row {core.row}, column {core.col} on of {space.reference.name}"
            what = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
            raise TileError(f"{where} failed with {what}. This is a fault of zlocus, not of the input.") from error

    with progress.stage("Matching", len(tasks)) as stage:
        for (number, tile), surface in run_all(work, tasks, workers):
            to = tile.kept.slices_in(images[number])
            for mine, theirs in zip(surfaces[number].arrays, surface.part(tile.kept, tile.core).arrays, strict=True):
                mine[to] = theirs
            stage.advance()
    return [matched_image(*one, surface) for one, surface in zip(settled, surfaces, strict=True)]


def matched_image(space: ImageSpace, scene: MatchScene, surface: Surface) -> Matched:
    """What the tiles of an image found, without heights beyond the range that was asked for."""
    beyond = beyond_range(scene, surface.height)
    quality = np.where(beyond, surface.quality | np.uint16(Quality.RANGE_END), surface.quality)
    height = np.where(beyond, np.float32(np.nan), surface.height)
    return Matched(MatchedImage(space, height, scene.origin_m + scene.n_steps * scene.step_m / 2), scene, quality)


def confirmed_images(matched: Sequence[Matched], progress: Progress) -> list[Matched]:
    """The images without the heights that no other one confirms; as they are where only one was matched."""
    if len(matched) < 2:
        progress.note("Only one image was matched, so no other one could confirm its heights: all are kept.")
        return list(matched)
    images, found = [m.image for m in matched], []
    with progress.stage("Matching back", len(images)) as stage:
        for k, one in enumerate(matched):
            result = confirm(one.image, images[:k] + images[k + 1 :], AGREE_PX)
            found.append(without_unconfirmed(one, result))
            stage.advance()
    return found


def without_unconfirmed(one: Matched, result: Confirmation) -> Matched:
    """The image without the heights that are not confirmed, which are marked."""
    doubtful = np.isfinite(one.image.height) & ~result.is_confirmed
    quality = np.where(doubtful, one.quality | np.uint16(Quality.UNCONFIRMED), one.quality)
    height = np.where(doubtful, np.float32(np.nan), one.image.height)
    return Matched(replace(one.image, height=height), one.settled, quality)


def write_cloud(out: Path, matched: Sequence[Matched], scene: Scene) -> int:
    """All points with their colours; their number."""
    n_points = sum(int(np.isfinite(m.image.height).sum()) for m in matched)
    white = white_level(scene.views)
    number = {view.name: k for k, view in enumerate(scene.views, 1)}
    with PointCloud(out, n_points, scene.crs) as cloud:
        for one in matched:
            view, height = one.image.space.reference, one.image.height
            for row, rows in strips(len(height)):
                known = np.isfinite(height[row : row + rows])
                if known.any():
                    xyz = one.image.space.ground(row, height[row : row + rows])[known]
                    share = np.clip(read_colours(view.path, row, rows)[known] / white, 0.0, 1.0)
                    cloud.write(number[view.name], xyz, np.rint(share * 65535.0).astype(np.uint16))
    return n_points


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


def write_maps(out: Path, name: str, one: Matched, fill: str) -> None:
    """NAME_height.tif, NAME_quality.tif and, for frame cameras, NAME_depth.tif."""
    space, height, quality = one.image.space, one.image.height, one.quality
    if fill == "interpolate":
        beyond = (quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
        whole = filled_from_behind(height, beyond)
        quality = np.where(np.isnan(height) & np.isfinite(whole), quality | np.uint16(Quality.FILLED), quality)
        height = whole
    z = np.empty(height.shape, np.float32)
    for row, rows in strips(len(height)):
        z[row : row + rows] = space.ground(row, height[row : row + rows])[..., 2]
    write_map(out / f"{name}_height.tif", z, "height of what the pixel shows", "m")
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


def request_record(request: CloudRequest) -> dict[str, Any]:
    """The request as JSON can hold it."""
    record = {name: str(v) if isinstance(v, Path) else v for name, v in vars(request).items()}
    record["inputs"] = [str(path) for path in request.inputs]
    return record
