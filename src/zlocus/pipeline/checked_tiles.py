"""Tiles of reference images whose heights are final: matched, checked across images and cut to the area.

A height is compared with heights of other images, so a tile is final only when the tiles that show the same ground in
the other images are matched too. Tiles are matched strip by strip on the ground, so that few of them wait, and become
final in a fixed order, whatever the order in which they were matched. The heights of all pixels lie on disk.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.image_space import (
    ROWS_AT_ONCE,
    OverlappingImage,
    beyond_range,
    cross_consistency,
    images_that_overlap,
)
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.image_scenes import MARGIN_PX, GroundArea, ImageScene, pixels_of, rays_on_ground, searched_range
from zlocus.pipeline.image_tiles import MAX_DISAGREEMENT_PX, ImageTile, MatchedPixels, MatchedTile, put_tile
from zlocus.pipeline.tile_run import TileProduct

T = TypeVar("T", bound=np.generic)


def strip_by_strip(image_scenes: Sequence[ImageScene], image_tiles: Sequence[ImageTile]) -> list[ImageTile]:
    """The tiles in strips of ground across its longest extent, and image by image within a strip.

    So tiles of different images that show the same ground are near each other in the order, and the tiles of one image
    still follow each other, for which its reduced parts stay in memory.
    """
    middles, extents = np.empty((len(image_tiles), 3)), np.empty((len(image_tiles), 3))
    for k, image_tile in enumerate(image_tiles):
        image_scene, window = image_scenes[image_tile.number], image_tile.tile.kept_window
        middle = sum(searched_range(image_scene.match_scene)) / 2
        ground = rays_on_ground(image_scene.image_space, window, (middle, middle))
        ground = ground[np.isfinite(ground).all(axis=1)]
        middles[k] = np.median(ground, axis=0) if len(ground) else np.nan
        side = max(window.rows, window.cols)
        extents[k] = np.ptp(ground, axis=0) * (side / (side + 2 * MARGIN_PX)) if len(ground) else np.nan
    known = np.isfinite(middles).all(axis=1)
    if not known.any():
        return list(image_tiles)
    axis = int(np.argmax(np.ptp(middles[known], axis=0)))
    width = max(float(np.median(extents[known, axis])), 1e-6)
    strips = np.where(known, np.rint((middles[:, axis] - middles[known, axis].min()) / width), np.inf)
    return [image_tiles[k] for k in np.lexsort((np.array([tile.number for tile in image_tiles]), strips))]


class CheckedTiles:
    """The pixels of all reference images, while their tiles are matched and become final.

    pixels : of each reference image, in their order; of tiles that are final, with the heights that other images
    confirm and that lie in the area.
    """

    def __init__(
        self,
        image_scenes: Sequence[ImageScene],
        image_tiles: Sequence[ImageTile],
        spill_arrays: SpillArrays,
        ground_area: GroundArea | None = None,
    ) -> None:
        """image_tiles : all that will be matched; spill_arrays : makes the arrays of all pixels; ground_area : heights
        outside of it are removed, None keeps all."""
        self._scenes, self._area, self._tiles = image_scenes, ground_area, list(image_tiles)
        surfaces = [Surface.nothing(pixels_of(one), full=spill_arrays.full) for one in image_scenes]
        self._matched = [MatchedPixels.of(one, each) for one, each in zip(image_scenes, surfaces, strict=True)]
        if ground_area is not None:  # tiles that cannot show the area are not matched
            for surface in surfaces:
                for row in range(0, len(surface.quality), ROWS_AT_ONCE):
                    surface.quality[row : row + ROWS_AT_ONCE] = Quality.OUTSIDE
                spill_arrays.rest()
        # With one image there is no other one to check it, and all its heights are final as they are matched.
        self.pixels = [each.copied(spill_arrays) for each in self._matched] if len(image_scenes) > 1 else self._matched
        self._tallies = np.zeros((len(image_scenes), 2), np.int64)
        self._matched_image_tiles: set[ImageTile] = set()
        self._overlapping = cache(self._find_overlapping)
        self._of_image = [[tile for tile in self._tiles if tile.number == k] for k in range(len(image_scenes))]

    def final_tiles(self, matched_tiles: Iterable[MatchedTile]) -> Iterator[ImageTile]:
        """Take matched tiles with their products, and yield each tile as soon as its heights in `pixels` are final.

        They are yielded in the order of all tiles.
        """
        waiting, needed = deque(self._tiles), None
        for image_tile, tile_product in matched_tiles:
            self._put(image_tile, tile_product)
            while waiting and waiting[0] in self._matched_image_tiles:
                if needed is None:
                    needed = self._compared_tiles(waiting[0])
                if not needed <= self._matched_image_tiles:
                    break
                self._finish(waiting[0])
                yield waiting.popleft()
                needed = None
        assert not waiting, "every tile was matched"

    def result(self) -> list[MatchedPixels]:
        """The pixels of all reference images with the counts of their tiles."""
        return [
            replace(each, evaluations=int(done), all_images=int(every))
            for each, (done, every) in zip(self.pixels, self._tallies, strict=True)
        ]

    def _put(self, image_tile: ImageTile, tile_product: TileProduct) -> None:
        """Take the product of a tile, without the heights that lie beyond the requested range."""
        window, matched = image_tile.tile.kept_window, self._matched[image_tile.number]
        put_tile(matched.surface, window, tile_product.surface)
        height, quality = _part(matched.image.height, window), _part(matched.quality, window)
        _remove(height, quality, beyond_range(matched.match_scene, height), Quality.RANGE_END)
        self._tallies[image_tile.number] += tile_product.evaluations, tile_product.all_images
        self._matched_image_tiles.add(image_tile)

    def _finish(self, image_tile: ImageTile) -> None:
        """Check the heights of a tile across images, and cut them to the area."""
        window, matched = image_tile.tile.kept_window, self._matched[image_tile.number]
        final = self.pixels[image_tile.number]
        height, quality = _part(final.image.height, window), _part(final.quality, window)
        if final is not matched:
            height[:], quality[:] = _part(matched.image.height, window), _part(matched.quality, window)
            result = cross_consistency(
                matched.image, window, self._overlapping(image_tile.number), MAX_DISAGREEMENT_PX
            )  # fmt: skip
            _remove(height, quality, np.isfinite(height) & ~result.is_consistent, Quality.INCONSISTENT)
        if self._area is not None:
            outside = ~self._area.holds(self._places(image_tile, height)).reshape(height.shape)
            _remove(height, quality, outside, Quality.OUTSIDE)

    def _places(self, image_tile: ImageTile, height: NDArray[np.float32]) -> FloatArray:
        """Ground (n, 2) m of the pixels of a tile, (r, c); a pixel without a height is taken to have the median one."""
        match_scene = self._scenes[image_tile.number].match_scene
        known = np.isfinite(height)
        middle = np.median(height[known]) if known.any() else sum(searched_range(match_scene)) / 2
        window = image_tile.tile.kept_window
        at = np.where(known, height, np.float32(middle))
        return self._scenes[image_tile.number].image_space.ground(window.row, at, window.col).reshape(-1, 3)[:, :2]

    def _compared_tiles(self, image_tile: ImageTile) -> set[ImageTile]:
        """The tiles of other images that show the ground of the heights of a tile."""
        if len(self._scenes) < 2:
            return set()
        window = image_tile.tile.kept_window
        height = _part(self._matched[image_tile.number].image.height, window)
        known = height[np.isfinite(height)]
        if not len(known):
            return set()
        ends = (float(known.min()), float(known.max()))
        ground = rays_on_ground(self._scenes[image_tile.number].image_space, window, ends)
        needed_image_tiles: set[ImageTile] = set()
        for other, _ in self._overlapping(image_tile.number):
            name = other.image_space.reference_view.name
            number = next(k for k, one in enumerate(self._scenes) if one.image_space.reference_view.name == name)
            needed_image_tiles |= _showing(
                self._of_image[number], other.image_space.reference_view.sensor.image_from_ground(ground)
            )
        return needed_image_tiles

    def _find_overlapping(self, number: int) -> list[OverlappingImage]:
        images = [each.image for each in self._matched]
        return images_that_overlap(images[number], images[:number] + images[number + 1 :])


def _showing(image_tiles: Sequence[ImageTile], xy: FloatArray) -> set[ImageTile]:
    """The tiles of an image that may show what lies between ground points at these pixels (n, 2); all of them where
    the camera does not see one of the points."""
    if not np.isfinite(xy).all():
        return set(image_tiles)
    (left, top), (right, bottom) = xy.min(axis=0) - MARGIN_PX, xy.max(axis=0) + MARGIN_PX
    return {
        each
        for each in image_tiles
        if (w := each.tile.kept_window).col <= right
        and w.col + w.cols >= left
        and w.row <= bottom
        and w.row + w.rows >= top
    }


def _part(values: NDArray[T], window: CellWindow) -> NDArray[T]:
    """The pixels of a window of an image, as a view."""
    return values[window.row : window.row + window.rows, window.col : window.col + window.cols]


def _remove(
    height: NDArray[np.float32], quality: NDArray[np.uint16], pixels: NDArray[np.bool_], reason: Quality
) -> None:
    """Remove the heights of some pixels (r, c) and set the reason; changes the arrays."""
    height[pixels] = np.float32(np.nan)
    quality[pixels] |= np.uint16(reason)
