"""Reference images matched in their own spaces and confirmed by each other, for clouds and for surfaces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, TileError, ZlocusError
from zlocus.core.grid import CellWindow
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.core.scene import Scene, View, check_overlap, ground_sample_distance
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.fill import filled
from zlocus.matching.fusion import Cells, PixelHeights, gridded
from zlocus.matching.image_space import (
    ROWS_AT_ONCE,
    ImageSpace,
    MatchedImage,
    beyond_range,
    confirm,
    depth_options,
    fitting_block,
    hypotheses_of_heights,
    hypotheses_of_ties,
    image_space,
    is_by_depth,
    settle_image,
    widest_disparities,
)
from zlocus.matching.match_scene import FEWEST_LEVELS, MatchScene
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.tile import TileResult, match_tile
from zlocus.orientation.orientation import Orientation, supported
from zlocus.pipeline.execution.checkpoint import TileStore
from zlocus.pipeline.execution.plan import Tile, plan_tiles
from zlocus.pipeline.execution.spill_arrays import Scratch
from zlocus.pipeline.preparing import heights_of_ties, oriented, possible_heights, taking_part
from zlocus.pipeline.tile_run import TileProduct
from zlocus.sensors.frame import FrameModel

AGREE_PX = 1.0
# A limit that no spread of heights reaches.
ANY_SPREAD_STEPS = 1e4
BESIDE_PX = 16
# Along a side of a window of pixels, at which rays are followed: outlines are bent by lenses and by unsteady scanners.
SAMPLES = 9


@dataclass(frozen=True)
class Area:
    """Ground that is asked for. bounds : (xmin, ymin, xmax, ymax) m; z_range : m."""

    bounds: tuple[float, float, float, float]
    z_range: tuple[float, float]

    def may_show(self, space: ImageSpace, pixels: CellWindow) -> bool:
        """Whether pixels of a reference image may show the area, between its heights and some pixels aside."""
        col, row = (np.linspace(start - BESIDE_PX, start + n + BESIDE_PX, SAMPLES) for start, n in (
            (pixels.col, pixels.cols), (pixels.row, pixels.rows)))  # fmt: skip
        x, y, z = (v.ravel() for v in np.meshgrid(col, row, self.z_range))
        ground = space.reference.sensor.ground_from_image(np.column_stack([x, y]), z)[:, :2]
        if not np.isfinite(ground).all():
            return True
        (west, south), (east, north) = ground.min(axis=0), ground.max(axis=0)
        return bool(
            west <= self.bounds[2] and east >= self.bounds[0] and south <= self.bounds[3] and north >= self.bounds[1]
        )


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
    """A reference image: what was found for its pixels, in hypotheses.

    surface : of the pixels; its heights are those of `image`, and its quality says why others are missing;
    evaluations, all_images : see `TileResult`.
    """

    image: MatchedImage
    settled: MatchScene
    surface: Surface
    evaluations: int = 0
    all_images: int = 0

    @property
    def quality(self) -> NDArray[np.uint16]:
        """(r, c), see `Quality`."""
        return self.surface.quality

    def copied(self, scratch: Scratch) -> Matched:
        """The image with heights and reasons of its own."""
        height, quality = scratch.copied(self.image.height), scratch.copied(self.quality)
        surface = replace(self.surface, height=height, quality=quality)
        return replace(self, image=replace(self.image, height=height), surface=surface)

    def leave_out(self, rows: slice, cells: NDArray[np.bool_], reason: Quality) -> None:
        """Take the heights of some pixels of some rows away, which get a reason; changes the arrays. cells : (r, c)."""
        self.image.height[rows][cells] = np.nan
        self.quality[rows][cells] |= np.uint16(reason)


@dataclass(frozen=True)
class GridImages:
    """images : to be put on a grid, in the order in which they give grey values; matched : all of them; evaluations,
    all_images : see `TileResult`."""

    images: list[PixelHeights]
    matched: list[PixelHeights]
    evaluations: int
    all_images: int


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
        return OrientedScene(taking_part(found.apply(scene), found), found, found.xyz, trusted, z_range)
    space = image_space(scene, scene.views[0].name, (0.0, 0.0))
    given = None if heights is None else hypotheses_of_heights(space, heights)
    found = oriented(Scene(space.views, scene.crs), options, given or widest_disparities(space), progress)
    views = tuple(corrected(view, v.shift_px) for view, v in zip(scene.views, found.views, strict=True))
    ground = space.rays.ground(found.xyz[:, :2] * [1.0, -1.0], found.xyz[:, 2])
    trusted = supported(found.xyz, found.sigma_z_m) & np.isfinite(ground).all(axis=1)
    return OrientedScene(taking_part(replace(scene, views=views), found), found, ground, trusted, heights)


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
    n_measured = ready.orientation.n_measured
    ground = ties[:n_measured]
    ground = ground[np.isfinite(ground).all(axis=1)]
    return space, settle_image(space, span, ties[known], options.pyramid, ground)


def match_images(
    settled: Sequence[tuple[ImageSpace, MatchScene]],
    options: RunConfig,
    use_visibility: bool,
    workers: int,
    progress: Progress,
    scratch: Scratch,
    area: Area | None = None,
    store: TileStore | None = None,
) -> list[Matched]:
    """Every tile of every reference image, or those that may show an area; of any precision, for there it is not in
    metres. scratch : makes the arrays of all pixels; store : keeps tiles, and has those of a run that is taken on."""
    options = replace(options, checks=replace(options.checks, most_sigma_m=None, most_spread_steps=ANY_SPREAD_STEPS))
    images = [CellWindow(0, 0, *space.reference.image.shape) for space, _ in settled]
    surfaces = [Surface.nothing(window, full=scratch.full) for window in images]
    tasks = [
        (number, tile)
        for number, (_, scene) in enumerate(settled)
        for tile in plan_tiles(images[number], scene.seen, options.pyramid)
        if area is None or area.may_show(settled[number][0], tile.kept)
    ]
    tallies = np.zeros((len(settled), 2), np.int64)

    def work(task: tuple[int, Tile]) -> tuple[TileProduct, bool]:
        """What was found for a tile, and whether it was found anew."""
        space, scene = settled[task[0]]
        core = task[1].core
        known = None if store is None else store.load(tile_name(*task))
        if known is not None:
            return TileProduct.of(known), False
        try:
            result = match_tile(scene, core, options, use_visibility=use_visibility)
        except ZlocusError:
            raise
        except Exception as error:
            where = f"The pixels from row {core.row}, column {core.col} on of {space.reference.name}"
            what = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
            raise TileError(f"{where} failed with {what}. This is a fault of zlocus, not of the input.") from error
        return TileProduct(result.surface.part(task[1].kept, core), result.evaluations, result.all_images), True

    with progress.stage("Matching", len(tasks)) as stage, _interruption(store, tasks, progress):
        for (number, tile), (product, is_new) in run_all(work, tasks, workers):
            if store is not None and is_new:
                store.keep(tile_name(number, tile), product.arrays())
            to = tile.kept.slices_in(images[number])
            for mine, theirs in zip(surfaces[number].arrays, product.surface.arrays, strict=True):
                mine[to] = theirs
            scratch.rest()
            tallies[number] += product.evaluations, product.all_images
            stage.advance()
    found = [matched_image(*one, surface) for one, surface in zip(settled, surfaces, strict=True)]
    return [replace(m, evaluations=int(t[0]), all_images=int(t[1])) for m, t in zip(found, tallies, strict=True)]


@contextmanager
def _interruption(store: TileStore | None, tasks: Sequence[tuple[int, Tile]], progress: Progress) -> Iterator[None]:
    """Says what is kept after an interrupt."""
    try:
        yield
    except KeyboardInterrupt:
        if store is not None:
            done = sum(tile_name(*task) in store.finished for task in tasks)
            if done:
                progress.note(f"{done} of {len(tasks)} tiles of images are finished and kept: {store.how_to_go_on}.")
        raise


def tile_name(number: int, tile: Tile) -> str:
    """Of a tile of an image, where it is kept."""
    return f"image{number}_{tile.core.row}_{tile.core.col}"


def matched_image(space: ImageSpace, scene: MatchScene, surface: Surface) -> Matched:
    """What the tiles of an image found, without heights beyond the range that was asked for."""
    image = MatchedImage(space, surface.height, scene.origin_m + scene.n_steps * scene.step_m / 2)
    found = Matched(image, scene, surface)
    for row in range(0, len(surface.height), ROWS_AT_ONCE):
        rows = slice(row, row + ROWS_AT_ONCE)
        found.leave_out(rows, beyond_range(scene, surface.height[rows]), Quality.RANGE_END)
    return found


def confirmed_images(matched: Sequence[Matched], progress: Progress, scratch: Scratch) -> list[Matched]:
    """The images without the heights that no other one confirms; as they are where only one was matched."""
    if len(matched) < 2:
        progress.note("Only one image was matched, so no other one could confirm its heights: all are kept.")
        return list(matched)
    images, found = [m.image for m in matched], []
    with progress.stage("Matching back", len(images)) as stage:
        for k, one in enumerate(matched):
            kept = one.copied(scratch)
            for rows, result in confirm(one.image, images[:k] + images[k + 1 :], AGREE_PX):
                unsure = np.isfinite(one.image.height[rows]) & ~result.is_confirmed
                kept.leave_out(rows, unsure, Quality.UNCONFIRMED)
                scratch.rest()
            found.append(kept)
            stage.advance()
    return found


def match_for_grid(
    ready: OrientedScene,
    leading: Sequence[str],
    area: Area,
    config: RunConfig,
    use_visibility: bool,
    workers: int,
    progress: Progress,
    scratch: Scratch,
    store: TileStore,
) -> GridImages:
    """All views matched in their own spaces and confirmed by each other, for a surface. leading : names of those whose
    heights it takes, in the order in which they give grey values; scratch, store : see `match_images`."""
    options = depth_options(config) if is_by_depth(ready.scene) else config
    settled, options = settle_all(ready, [view.name for view in ready.scene.views], options)
    before = match_images(settled, options, use_visibility, workers, progress, scratch, area, store)
    after = confirmed_images(before, progress, scratch)
    z = sum(area.z_range) / 2
    images = {one.image.space.reference.name: pixel_heights(one, b, z) for one, b in zip(after, before, strict=True)}
    evaluations = sum(one.evaluations for one in before), sum(one.all_images for one in before)
    return GridImages([images[name] for name in leading], list(images.values()), *evaluations)


def pixel_heights(one: Matched, before: Matched, z: float) -> PixelHeights:
    """A matched image as a grid takes it. z : m, about where its ground pixel is measured."""
    space, step, middle = one.image.space, one.settled.step_m, one.image.middle
    rows, cols = one.image.height.shape
    beside = np.array([[middle - step / 2], [middle + step / 2]], np.float32)
    low, high = (space.ground(rows // 2, hypothesis[None], cols // 2)[0, 0, 2] for hypothesis in beside)
    pixel_m = ground_sample_distance(space.reference, z)
    return PixelHeights(one.image, one.surface, before.surface, step, abs(float(high - low)), pixel_m)


def grid_tile(matched: GridImages, scene: MatchScene, core: CellWindow, config: RunConfig, fill: str) -> TileResult:
    """A tile of the ground grid from the pixels that fall on it. scene : its lattice of cells and heights."""
    if not (core.rows and core.cols):
        return TileResult(Surface.nothing(core))
    halo = config.pyramid.halo
    window = core.at_level(0, halo)
    z_range = (scene.origin_m, scene.origin_m + scene.n_steps * scene.step_m)
    cells = Cells((window.rows, window.cols), scene.transform(window, 0), z_range)
    surface = gridded(matched.images, cells, matched.matched).precise(config.checks.most_sigma_m)
    if fill == "interpolate":
        surface = filled(surface, halo // 2)
    return TileResult(surface.part(core, window))
