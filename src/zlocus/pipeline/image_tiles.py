"""Matching in image space: every pixel of a reference image gets a height, for clouds and for surfaces.

`zlocus.pipeline.image_scenes` makes a match scene for each reference image. Then the steps are, in order:
`matched_tiles` (all tiles of all images), and for a surface `match_images`, `cross_checked_images` (heights that other
images contradict are removed), `heights_for_grid` and `grid_tile` (the heights on the ground grid). A cloud takes each
tile from `zlocus.pipeline.checked_tiles` as soon as its heights are checked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import TileError, ZlocusError
from zlocus.core.footprints import ground_sample_distance
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.matching.fill import filled
from zlocus.matching.fusion import GridCells, PixelHeights, gridded
from zlocus.matching.image_space import (
    ROWS_AT_ONCE,
    MatchedImage,
    beyond_range,
    check_cross_consistency,
    depth_options,
    is_by_depth,
)
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.matching.tile import TileResult
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.execution.plan import Tile, plan_tiles
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.image_scenes import (
    GroundArea,
    ImageScene,
    ImageSetup,
    build_image_scenes,
    pixels_of,
    searched_range,
)
from zlocus.pipeline.tile_run import MatchMethod, TileProduct

# Two images agree on a height where it moves the pixel by at most this much.
MAX_DISAGREEMENT_PX = 1.0
# A limit that no spread of heights reaches.
NO_SPREAD_LIMIT_STEPS = 1e4


class ImageTile(NamedTuple):
    """A tile of a reference image. number : of the image among the reference images, from 0."""

    number: int
    tile: Tile

    @property
    def name(self) -> str:
        """Name under which it is kept."""
        return f"image{self.number}_{self.tile.core_window.row}_{self.tile.core_window.col}"


class MatchedTile(NamedTuple):
    """A tile of a reference image with its product."""

    image_tile: ImageTile
    tile_product: TileProduct


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

    @classmethod
    def of(cls, image_scene: ImageScene, surface: Surface) -> MatchedPixels:
        """The pixels of a reference image. surface : of them."""
        match_scene = image_scene.match_scene
        middle = match_scene.height_origin + match_scene.n_steps * match_scene.height_step / 2
        return cls(MatchedImage(image_scene.image_space, surface.height, middle), match_scene, surface)

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


def tiles_of_images(
    image_scenes: Sequence[ImageScene], config: RunConfig, ground_area: GroundArea | None
) -> list[ImageTile]:
    """The tiles of every reference image that may show an area, image by image. ground_area : None takes all."""
    return [
        ImageTile(number, tile)
        for number, one in enumerate(image_scenes)
        for tile in plan_tiles(pixels_of(one), one.match_scene.overlap_window, config.pyramid)
        if ground_area is None
        or ground_area.may_show(one.image_space, tile.kept_window, searched_range(one.match_scene))
    ]


def matched_tiles(
    image_scenes: Sequence[ImageScene], image_tiles: Sequence[ImageTile], matching: ImageMatching, progress: Progress
) -> Iterator[MatchedTile]:
    """Match tiles of the reference images; yields each with its product, in the order in which they end.

    Heights of any precision are kept: in image space they are not in metres, and the ground grid judges them later.
    """
    checks = replace(matching.config.checks, max_sigma_m=None, max_overlap_edge_sigma_steps=NO_SPREAD_LIMIT_STEPS)
    config = replace(matching.config, checks=checks)

    def work(image_tile: ImageTile) -> tuple[TileProduct, bool]:
        """The product of a tile, and whether it was matched now instead of loaded."""
        arrays = None if matching.checkpoint is None else matching.checkpoint.load(image_tile.name)
        if arrays is not None:
            return TileProduct.of(arrays), False
        return matched_tile(image_scenes[image_tile.number], image_tile.tile, config, matching.method), True

    with progress.stage("Matching", len(image_tiles)) as stage:
        if matching.checkpoint is not None:
            n_there = sum(image_tile.name in matching.checkpoint.finished for image_tile in image_tiles)
            if n_there:
                progress.note(f"{n_there} of {len(image_tiles)} tiles of images are there already.")
        for image_tile, (tile_product, is_new) in run_all(work, image_tiles, matching.workers):
            if matching.checkpoint is not None and is_new:
                matching.checkpoint.keep(image_tile.name, tile_product.arrays())
            yield MatchedTile(image_tile, tile_product)
            matching.spill_arrays.rest()
            stage.advance()


def match_images(
    image_scenes: Sequence[ImageScene], matching: ImageMatching, progress: Progress
) -> list[MatchedPixels]:
    """Match the tiles of every reference image, and return the heights of all pixels."""
    surfaces = [Surface.nothing(pixels_of(one), full=matching.spill_arrays.full) for one in image_scenes]
    tallies = np.zeros((len(image_scenes), 2), np.int64)
    image_tiles = tiles_of_images(image_scenes, matching.config, matching.ground_area)
    with interruption(matching.checkpoint, image_tiles, progress):
        for image_tile, tile_product in matched_tiles(image_scenes, image_tiles, matching, progress):
            put_tile(surfaces[image_tile.number], image_tile.tile.kept_window, tile_product.surface)
            tallies[image_tile.number] += tile_product.evaluations, tile_product.all_images
    matched = [matched_pixels(one, surface) for one, surface in zip(image_scenes, surfaces, strict=True)]
    return [replace(m, evaluations=int(t[0]), all_images=int(t[1])) for m, t in zip(matched, tallies, strict=True)]


def put_tile(surface: Surface, pixel_window: CellWindow, tile_surface: Surface) -> None:
    """Copy the surface of a tile into that of its image. pixel_window : the kept pixels of the tile."""
    row, col = pixel_window.row, pixel_window.col
    for to, since in zip(surface.arrays, tile_surface.arrays, strict=True):
        to[row : row + pixel_window.rows, col : col + pixel_window.cols] = since


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
def interruption(
    checkpoint: TileCheckpoint | None, image_tiles: Sequence[ImageTile], progress: Progress
) -> Iterator[None]:
    """Say which finished tiles are kept after an interrupt."""
    try:
        yield
    except KeyboardInterrupt:
        if checkpoint is not None:
            checkpoint.count_from_disk()
            done = sum(image_tile.name in checkpoint.finished for image_tile in image_tiles)
            if done:
                kept = f"{done} of {len(image_tiles)} tiles of images are finished and kept"
                progress.note(f"{kept}: {checkpoint.how_to_resume}.")
        raise


def matched_pixels(image_scene: ImageScene, surface: Surface) -> MatchedPixels:
    """The surface of a reference image without the heights that lie beyond the requested range."""
    matched, match_scene = MatchedPixels.of(image_scene, surface), image_scene.match_scene
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
    assert matching.ground_area.z_range is not None, "between two heights"
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
