"""Matching in image space: every pixel of a reference image gets a height, for clouds and for surfaces.

The steps, in order: `set_up_images` (orientation and height range), `build_image_scenes` (a match scene for each
reference image), `match_images` (all tiles of all images), `cross_checked_images` (heights that other images contradict
are removed), and for a surface `heights_for_grid` and `grid_tile` (the heights on the ground grid).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, TileError, ZlocusError
from zlocus.core.footprints import check_overlap, ground_sample_distance
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.core.scene import Scene, View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.fill import filled
from zlocus.matching.fusion import GridCells, PixelHeights, gridded
from zlocus.matching.image_space import (
    ROWS_AT_ONCE,
    ImageSpace,
    MatchedImage,
    beyond_range,
    build_image_match_scene,
    check_cross_consistency,
    depth_options,
    fitting_block,
    height_space,
    hypotheses_of_heights,
    hypotheses_of_ties,
    image_space,
    is_by_depth,
    widest_disparities,
)
from zlocus.matching.match_scene import MIN_LEVELS, MatchScene
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.tile import TileResult
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.tie_heights import supported
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.execution.plan import Tile, plan_tiles
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.height_range import possible_heights, range_from_ties
from zlocus.pipeline.setup import RunSetup, orient_views, reference_features, supported_views
from zlocus.pipeline.tile_run import MatchMethod, TileProduct
from zlocus.sensors.frame import FrameModel

# Two images agree on a height where it moves the pixel by at most this much.
MAX_DISAGREEMENT_PX = 1.0
# A limit that no spread of heights reaches.
NO_SPREAD_LIMIT_STEPS = 1e4
# Margin around a window of pixels that may show an area.
MARGIN_PX = 16
# Rays followed along each side of a window of pixels: lenses and unsteady scanners bend its outline on the ground.
N_RAYS = 9


@dataclass(frozen=True)
class GroundArea:
    """Ground to be matched. bounds : (xmin, ymin, xmax, ymax) m; z_range : lowest and highest height, m."""

    bounds: tuple[float, float, float, float]
    z_range: tuple[float, float]

    def may_show(self, image_space: ImageSpace, pixel_window: CellWindow) -> bool:
        """Whether a window of pixels of a reference image, with a margin, may show the area between its two heights."""
        col, row = (np.linspace(start - MARGIN_PX, start + n + MARGIN_PX, N_RAYS) for start, n in (
            (pixel_window.col, pixel_window.cols), (pixel_window.row, pixel_window.rows)))  # fmt: skip
        x, y, z = (v.ravel() for v in np.meshgrid(col, row, self.z_range))
        ground = image_space.reference_view.sensor.ground_from_image(np.column_stack([x, y]), z)[:, :2]
        if not np.isfinite(ground).all():
            return True
        (west, south), (east, north) = ground.min(axis=0), ground.max(axis=0)
        return bool(
            west <= self.bounds[2] and east >= self.bounds[0] and south <= self.bounds[3] and north >= self.bounds[1]
        )


@dataclass(frozen=True)
class ImageSetup:
    """What the matching of images in their own spaces starts from.

    scene : the views that take part, with corrected cameras; ties : (n, 3) m, ground points; is_supported : (n,)
    whether the tie points around confirm them; z_range : heights searched, m, None where each image takes its range of
    depths from the tie points.
    """

    scene: Scene
    orientation: Orientation
    ties: FloatArray
    is_supported: NDArray[np.bool_]
    z_range: tuple[float, float] | None


@dataclass(frozen=True)
class ImageScene:
    """A reference image: its image space, and the match scene of its tiles."""

    image_space: ImageSpace
    match_scene: MatchScene


@dataclass(frozen=True)
class ImageMatching:
    """How reference images are matched.

    config : options, with the blocks and levels that suit the images; method : how tiles are matched; workers : tiles
    at a time; spill_arrays : makes the arrays of all pixels; ground_area : tiles that cannot show it are left
    out, None leaves none out; checkpoint : keeps finished tiles, and holds those of a run that is resumed, None keeps
    none.
    """

    config: RunConfig
    method: MatchMethod
    workers: int
    spill_arrays: SpillArrays
    ground_area: GroundArea | None = None
    checkpoint: TileCheckpoint | None = None


@dataclass(frozen=True)
class MatchedPixels:
    """A reference image and what was found for its pixels, in hypotheses of its image space.

    surface : of the pixels; its heights are those of `image`, and its quality says why others are missing;
    evaluations, all_images : see `TileResult`.
    """

    image: MatchedImage
    match_scene: MatchScene
    surface: Surface
    evaluations: int = 0
    all_images: int = 0

    @property
    def quality(self) -> NDArray[np.uint16]:
        """(r, c), see `Quality`."""
        return self.surface.quality

    def copied(self, spill_arrays: SpillArrays) -> MatchedPixels:
        """A copy whose heights and quality may be changed."""
        height, quality = spill_arrays.copied(self.image.height), spill_arrays.copied(self.quality)
        surface = replace(self.surface, height=height, quality=quality)
        return replace(self, image=replace(self.image, height=height), surface=surface)

    def remove_heights(self, rows: slice, pixels: NDArray[np.bool_], reason: Quality) -> None:
        """Remove the heights of some pixels and set the reason; changes the arrays. pixels : (r, c) of those rows."""
        self.image.height[rows][pixels] = np.nan
        self.quality[rows][pixels] |= np.uint16(reason)


@dataclass(frozen=True)
class GridImages:
    """Matched images for a surface on the ground grid.

    images : those whose heights are used, in the order in which they give grey values; all_matched : every matched
    image; evaluations, all_images : see `TileResult`.
    """

    images: list[PixelHeights]
    all_matched: list[PixelHeights]
    evaluations: int
    all_images: int


def reference_names(scene: Scene, requested: Sequence[str]) -> list[str]:
    """Names of the reference images in the scene's order; all of them where none is requested.

    Raises
    ------
    ConfigError
        A requested name is not a view of the scene.
    """
    names = [view.name for view in scene.views]
    for name in requested:
        if name not in names:
            raise ConfigError(f"--reference {name} is not a view of this scene. Choose from {', '.join(names)}.")
    return [name for name in names if not requested or name in requested]


def set_up_images(scene: Scene, config: RunConfig, progress: Progress) -> ImageSetup:
    """Orient the views, and find the range of heights to search.

    Frame cameras may look in any direction. They are oriented over the pixels and disparities of the first image: a
    shift of an image is the same there, and disparities, unlike heights, are linear along every epipolar line.
    """
    options = config.orientation
    if not is_by_depth(scene):
        check_overlap(scene, possible_heights(scene, scene.heights))
        orientation = orient_views(scene, options, progress)
        is_supported = supported(orientation.xyz, orientation.sigma_z_m)
        z_range = scene.heights or range_from_ties(scene, orientation, options).expected
        used = supported_views(orientation.apply(scene), orientation)
        return ImageSetup(used, orientation, orientation.xyz, is_supported, z_range)
    space = image_space(scene, scene.views[0].name, (0.0, 0.0))
    given = None if scene.heights is None else hypotheses_of_heights(space, scene.heights)
    in_first_image = Scene(space.views, scene.crs, heights=given or widest_disparities(space))
    orientation = orient_views(in_first_image, options, progress)
    views = tuple(shifted(view, v.shift_px) for view, v in zip(scene.views, orientation.views, strict=True))
    ground = space.rays.ground(orientation.xyz[:, :2] * [1.0, -1.0], orientation.xyz[:, 2])
    is_supported = supported(orientation.xyz, orientation.sigma_z_m) & np.isfinite(ground).all(axis=1)
    used = supported_views(replace(scene, views=views), orientation)
    return ImageSetup(used, orientation, ground, is_supported, scene.heights)


def shifted(view: View, shift_px: tuple[float, float]) -> View:
    """A view whose frame camera is moved by a shift in its image, px."""
    assert isinstance(view.sensor, FrameModel), "only frame cameras are matched by depth"
    return replace(view, sensor=view.sensor.moved(*shift_px))


class ImageScenes(NamedTuple):
    """The reference images to be matched, and the configuration with blocks and levels that suit all of them."""

    image_scenes: list[ImageScene]
    config: RunConfig


def build_image_scenes(setup: ImageSetup, references: Sequence[str], config: RunConfig) -> ImageScenes:
    """The match scene of every reference image, and the configuration that suits them.

    Where frame cameras look from very different directions, projections bend too much within the blocks of a coarse
    level for the projection tables: then there are fewer levels, and the coarsest one searches more steps.
    """
    while True:
        image_scenes = [build_image_scene(setup, name, config) for name in references]
        block = fitting_block([each.match_scene for each in image_scenes], config.pyramid.block)
        levels = max(each.match_scene.levels for each in image_scenes)
        if block is not None or levels <= MIN_LEVELS:
            pyramid = replace(config.pyramid, block=block or config.pyramid.block)
            return ImageScenes(image_scenes, replace(config, pyramid=pyramid))
        config = replace(config, pyramid=replace(config.pyramid, max_levels=levels - 1))


def build_image_scene(setup: ImageSetup, reference: str, config: RunConfig) -> ImageScene:
    """A reference image's space, and the match scene of its pixels."""
    space = image_space(setup.scene, reference, setup.z_range or (0.0, 0.0))
    ties = space.frame_from_ground(setup.ties)
    is_known = np.isfinite(ties).all(axis=1)
    span = None if setup.z_range is None else hypotheses_of_heights(space, setup.z_range)
    if span is None:
        span = hypotheses_of_ties(space, ties[is_known & setup.is_supported], config.orientation)
    measured = ties[: setup.orientation.n_refined]
    measured = measured[np.isfinite(measured).all(axis=1)]
    return ImageScene(space, build_image_match_scene(space, span, ties[is_known], config.pyramid, measured))


def reference_scene(setup: RunSetup, config: RunConfig) -> ImageScene:
    """The pixels of the reference image of a run, with heights along its rays whatever its camera is (GC3).

    Its tie points are the feature points of the reference image.
    """
    scene, z_range = supported_views(setup.scene, setup.orientation), setup.height_range.expected
    space = height_space(scene, setup.match_scene.views[0].name, z_range)
    span = hypotheses_of_heights(space, z_range)
    assert span is not None, "hypotheses are heights"
    ties = space.frame_from_ground(reference_features(setup))
    ties = ties[np.isfinite(ties).all(axis=1)]
    return ImageScene(space, build_image_match_scene(space, span, ties, config.pyramid))


def match_images(
    image_scenes: Sequence[ImageScene], matching: ImageMatching, progress: Progress
) -> list[MatchedPixels]:
    """Match the tiles of every reference image.

    Heights of any precision are kept: in image space they are not in metres, and the ground grid judges them later.
    """
    checks = replace(matching.config.checks, max_sigma_m=None, max_overlap_edge_sigma_steps=NO_SPREAD_LIMIT_STEPS)
    config = replace(matching.config, checks=checks)
    images = [CellWindow(0, 0, *one.image_space.reference_view.image.shape) for one in image_scenes]
    surfaces = [Surface.nothing(window, full=matching.spill_arrays.full) for window in images]
    tasks = [
        (number, tile)
        for number, one in enumerate(image_scenes)
        for tile in plan_tiles(images[number], one.match_scene.overlap_window, config.pyramid)
        if matching.ground_area is None or matching.ground_area.may_show(one.image_space, tile.kept_window)
    ]
    tallies = np.zeros((len(image_scenes), 2), np.int64)

    def work(task: tuple[int, Tile]) -> tuple[TileProduct, bool]:
        """The product of a tile, and whether it was matched now instead of loaded."""
        arrays = None if matching.checkpoint is None else matching.checkpoint.load(tile_name(*task))
        if arrays is not None:
            return TileProduct.of(arrays), False
        return matched_tile(image_scenes[task[0]], task[1], config, matching.method), True

    with progress.stage("Matching", len(tasks)) as stage, _interruption(matching.checkpoint, tasks, progress):
        for (number, tile), (product, is_new) in run_all(work, tasks, matching.workers):
            if matching.checkpoint is not None and is_new:
                matching.checkpoint.keep(tile_name(number, tile), product.arrays())
            kept = tile.kept_window.slices_in(images[number])
            for of_image, of_tile in zip(surfaces[number].arrays, product.surface.arrays, strict=True):
                of_image[kept] = of_tile
            matching.spill_arrays.rest()
            tallies[number] += product.evaluations, product.all_images
            stage.advance()
    matched = [matched_pixels(one, surface) for one, surface in zip(image_scenes, surfaces, strict=True)]
    return [replace(m, evaluations=int(t[0]), all_images=int(t[1])) for m, t in zip(matched, tallies, strict=True)]


def matched_tile(image_scene: ImageScene, tile: Tile, config: RunConfig, method: MatchMethod) -> TileProduct:
    """One tile of a reference image.

    Raises
    ------
    TileError
        A fault of our own, with the tile in which it happened.
    """
    try:
        result = method.match(image_scene.match_scene, tile, config)
    except ZlocusError:
        raise
    except Exception as error:
        window, name = tile.core_window, image_scene.image_space.reference_view.name
        where = f"The pixels from row {window.row}, column {window.col} on of {name}"
        what = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
        raise TileError(f"{where} failed with {what}. This is a fault of zlocus, not of the input.") from error
    return TileProduct(result.surface.part(tile.kept_window, tile.core_window), result.evaluations, result.all_images)


@contextmanager
def _interruption(
    checkpoint: TileCheckpoint | None, tasks: Sequence[tuple[int, Tile]], progress: Progress
) -> Iterator[None]:
    """Say which finished tiles are kept after an interrupt."""
    try:
        yield
    except KeyboardInterrupt:
        if checkpoint is not None:
            checkpoint.count_from_disk()
            done = sum(tile_name(*task) in checkpoint.finished for task in tasks)
            if done:
                kept = f"{done} of {len(tasks)} tiles of images are finished and kept"
                progress.note(f"{kept}: {checkpoint.how_to_resume}.")
        raise


def tile_name(number: int, tile: Tile) -> str:
    """Name under which the tile of an image is kept."""
    return f"image{number}_{tile.core_window.row}_{tile.core_window.col}"


def matched_pixels(image_scene: ImageScene, surface: Surface) -> MatchedPixels:
    """The surface of a reference image without the heights that lie beyond the requested range."""
    match_scene = image_scene.match_scene
    middle = match_scene.height_origin + match_scene.n_steps * match_scene.height_step / 2
    matched = MatchedPixels(MatchedImage(image_scene.image_space, surface.height, middle), match_scene, surface)
    for row in range(0, len(surface.height), ROWS_AT_ONCE):
        rows = slice(row, row + ROWS_AT_ONCE)
        matched.remove_heights(rows, beyond_range(match_scene, surface.height[rows]), Quality.RANGE_END)
    return matched


def cross_checked_images(
    matched: Sequence[MatchedPixels], progress: Progress, spill_arrays: SpillArrays
) -> list[MatchedPixels]:
    """The images without the heights that no other image confirms.

    Where only one image was matched there is no other to check it: all its heights are kept, and a note says so.
    """
    if len(matched) < 2:
        progress.note("Only one image was matched, so no other one could confirm its heights: all are kept.")
        return list(matched)
    images, checked = [m.image for m in matched], []
    with progress.stage("Checking across images", len(images)) as stage:
        for k, one in enumerate(matched):
            kept = one.copied(spill_arrays)
            for rows, result in check_cross_consistency(one.image, images[:k] + images[k + 1 :], MAX_DISAGREEMENT_PX):
                is_inconsistent = np.isfinite(one.image.height[rows]) & ~result.is_consistent
                kept.remove_heights(rows, is_inconsistent, Quality.INCONSISTENT)
                spill_arrays.rest()
            checked.append(kept)
            stage.advance()
    return checked


def heights_for_grid(
    setup: ImageSetup, references: Sequence[str], matching: ImageMatching, progress: Progress
) -> GridImages:
    """Match all views in their own spaces and check them against each other, for a surface.

    references : names of the images whose heights the surface takes, in the order in which they give grey values.
    """
    assert matching.ground_area is not None, "a surface has an area"
    config = depth_options(matching.config) if is_by_depth(setup.scene) else matching.config
    image_scenes, config = build_image_scenes(setup, [view.name for view in setup.scene.views], config)
    matched = match_images(image_scenes, replace(matching, config=config), progress)
    checked = cross_checked_images(matched, progress, matching.spill_arrays)
    z = sum(matching.ground_area.z_range) / 2
    images = {
        kept.image.image_space.reference_view.name: pixel_heights(kept, every, z)
        for kept, every in zip(checked, matched, strict=True)
    }
    evaluations = sum(one.evaluations for one in matched), sum(one.all_images for one in matched)
    return GridImages([images[name] for name in references], list(images.values()), *evaluations)


def pixel_heights(checked: MatchedPixels, unchecked: MatchedPixels, z: float) -> PixelHeights:
    """A matched image as the ground grid takes it. z : height (m) at which its ground pixel is measured."""
    space, step, middle = checked.image.image_space, checked.match_scene.height_step, checked.image.middle
    rows, cols = checked.image.height.shape
    half_step = np.array([[middle - step / 2], [middle + step / 2]], np.float32)
    low, high = (space.ground(rows // 2, hypothesis[None], cols // 2)[0, 0, 2] for hypothesis in half_step)
    pixel_m = ground_sample_distance(space.reference_view, z)
    return PixelHeights(checked.image, checked.surface, unchecked.surface, step, abs(float(high - low)), pixel_m)


def grid_tile(
    grid_images: GridImages, match_scene: MatchScene, core_window: CellWindow, config: RunConfig, fill: str
) -> TileResult:
    """A tile of the ground grid from the heights of the pixels that fall on it."""
    if not (core_window.rows and core_window.cols):
        return TileResult(Surface.nothing(core_window))
    halo = config.pyramid.halo
    window = core_window.at_level(0, halo)
    z_range = (match_scene.height_origin, match_scene.height_origin + match_scene.n_steps * match_scene.height_step)
    grid_cells = GridCells((window.rows, window.cols), match_scene.transform(window, 0), z_range)
    surface = gridded(grid_images.images, grid_cells, grid_images.all_matched).precise(config.checks.max_sigma_m)
    if fill == "interpolate":
        surface = filled(surface, halo // 2)
    return TileResult(surface.part(core_window, window))
