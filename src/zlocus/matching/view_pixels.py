"""Pixels of the images of a tile: for each level the part of an image that the level needs, on one grey scale.

Level 0 has the pixels of the image, every further level the means of 2 x 2 pixels of the level before. A coarse level
shows much more ground than the finest one, because halos double from level to level. So each level reads a window of
its own, and the pixels of coarse levels are kept for the next tiles, see `Pyramids`.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import ImageSource, View
from zlocus.core.sensor_model import SensorModel
from zlocus.matching.radiometry import GreyScale

FloatImage = NDArray[np.float32]
# Margin of a window of pixels around the points of the ground that it shows, in pixels of the level and as a share of
# its larger side: between the points rows of cells are bent.
MARGIN_PX, MARGIN_SHARE = 8, 1 / 64
# Margin beside points beyond which the camera cannot map the ground, in distances between two points.
MARGIN_OF_STEPS = 1.5
# Grey values as the image has them.
AS_STORED = GreyScale(0.0, 1.0)
# Side of the parts in which an image is reduced, in pixels of the image.
PART_PX = 1024
# The finest level that is kept: to make the levels before it again takes about as long as to find them in memory, and
# they take most of the memory. And the memory of the reduced parts that a process keeps.
FIRST_KEPT_LEVEL, PYRAMID_BYTES = 2, 256 << 20


class PixelWindow(NamedTuple):
    """A window of an image: its first row and column, and its size in pixels of a level."""

    row: int
    col: int
    rows: int
    cols: int

    def at_finest(self, level: int) -> PixelWindow:
        """A window of pixels of a level in pixels of the image."""
        return PixelWindow(*(number << level for number in self))


class LevelPixels(NamedTuple):
    """Grey values of a level on the scale of the scene, 0 where invalid, (r, c) float32; and validity, (r, c) bool."""

    pixels: FloatImage
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class ViewPixels:
    """A window of one view at one level.

    origin : (row, col) of its first pixel, in pixels of the level; pixels, valid : see `LevelPixels`; scale : grey
    scale of the image.
    """

    sensor: SensorModel
    origin: tuple[int, int]
    pixels: FloatImage
    valid: NDArray[np.bool_]
    scale: GreyScale = AS_STORED
    level: int = 0

    @property
    def window(self) -> PixelWindow:
        """The window, in pixels of the level."""
        rows, cols = self.pixels.shape
        return PixelWindow(*self.origin, rows, cols)

    @property
    def trend(self) -> FloatImage | None:
        """Grey values (r, c) of the image that were subtracted, see `GreyTrend`; None where nothing was."""
        assert self.level == 0, "callers ask for the pixels of the image"
        return None if self.scale.trend is None else self.scale.trend.window(*self.window)


def window_showing(
    view: View, ground: NDArray[np.float64], z_range: tuple[float, float], level: int = 0
) -> PixelWindow | None:
    """The window of a level of an image that shows a patch of ground; None where the image does not show it.

    ground : (n, 2) m, a square grid of points all over the patch, row by row; z_range : m, heights of the ground.
    """
    heights, side = (z_range[0], sum(z_range) / 2, z_range[1]), math.isqrt(len(ground))
    xyz = np.concatenate([np.column_stack([ground, np.full(len(ground), z)]) for z in heights])
    # The middle of the first pixel of a level lies half of its size, less half a pixel, from that of the image.
    xy = (view.sensor.image_from_ground(xyz) + 0.5) / 2**level - 0.5
    known = np.isfinite(xy).all(axis=1)
    if not known.any():
        return None
    rows, cols = (size >> level for size in view.image.shape)
    margin = MARGIN_PX + np.ceil(MARGIN_SHARE * np.ptp(xy[known], axis=0).max())
    if not known.all():
        # A camera cannot map what lies far beside its image. The ground between a point that it can map and one that it
        # cannot is no farther away than the next point on the other side, about.
        grid = xy.reshape(len(heights), side, side, 2)
        apart = [np.abs(np.diff(grid, axis=axis)).ravel() for axis in (1, 2)]
        margin += MARGIN_OF_STEPS * np.nanmax(np.concatenate(apart), initial=0.0)
    xy = xy[known]
    (left, top), (right, bottom) = np.floor(xy.min(axis=0)) - margin, np.ceil(xy.max(axis=0)) + margin + 1
    row, col, end, stop = max(int(top), 0), max(int(left), 0), min(int(bottom), rows), min(int(right), cols)
    return PixelWindow(row, col, end - row, stop - col) if min(end - row, stop - col) >= 2 else None


def read_pixels(view: View, pixel_window: PixelWindow, scale: GreyScale, level: int = 0) -> ViewPixels:
    """Read a window of a level of an image. scale : of the whole image, the same for every window of it."""
    if level >= FIRST_KEPT_LEVEL:
        found = PYRAMIDS.read(view.image, pixel_window, scale, level)
    else:
        found = _scaled(view.image, pixel_window.at_finest(level), scale)
        for _ in range(level):
            found = halved(*found)
    return ViewPixels(view.sensor, (pixel_window.row, pixel_window.col), *found, scale, level)


def unseen(view: View, scale: GreyScale, level: int) -> ViewPixels:
    """The window of an image that shows nothing of the ground of a level: the smallest, without a valid pixel."""
    pixels, valid = np.zeros((2, 2), np.float32), np.zeros((2, 2), np.bool_)
    return ViewPixels(view.sensor, (0, 0), pixels, valid, scale, level)


def _scaled(image: ImageSource, pixel_window: PixelWindow, scale: GreyScale) -> LevelPixels:
    """Pixels of an image on the grey scale of the scene."""
    read = image.read(*pixel_window)
    grey = read.pixels if scale.trend is None else read.pixels - scale.trend.window(*pixel_window)
    return LevelPixels((grey - np.float32(scale.mean)) * np.float32(1.0 / scale.contrast), read.valid)


def halved(pixels: FloatImage, valid: NDArray[np.bool_]) -> LevelPixels:
    """Pixels and validity at half the size: means over 2 x 2 valid pixels, valid where at least three of the four are.

    An odd last row or column is dropped.
    """
    rows, cols = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    blocks = pixels[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2)
    if valid.all():
        mean = (blocks[:, 0, :, 0] + blocks[:, 0, :, 1] + blocks[:, 1, :, 0] + blocks[:, 1, :, 1]) * np.float32(0.25)
        return LevelPixels(np.ascontiguousarray(mean, np.float32), np.ones(mean.shape, bool))
    kept = valid[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2)
    count = kept.sum(axis=(1, 3))
    total = np.where(kept, blocks, np.float32(0.0)).sum(axis=(1, 3))
    return LevelPixels((total / np.maximum(count, 1)).astype(np.float32), np.asarray(count >= 3))


class PartKey(NamedTuple):
    """What the reduced parts of images are found by: the image, its grey scale, and the first row and column (px)."""

    image_id: int
    scale: GreyScale
    row: int
    col: int


@dataclass(frozen=True)
class ReducedPart:
    """A part of an image at the levels from `FIRST_KEPT_LEVEL` on. image : is kept, so that its identity stays its."""

    image: ImageSource
    level_pixels: list[LevelPixels]

    @property
    def n_bytes(self) -> int:
        """Memory of its pixels."""
        return sum(one.pixels.nbytes + one.valid.nbytes for one in self.level_pixels)


class Pyramids:
    """Reduced parts of images, kept from tile to tile as long as they fit into a memory of so many bytes.

    Parts lie at the same places whatever is read, so that a pixel of a level does not depend on the window. The parts
    that were not used for longest go first.
    """

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes
        self._parts: OrderedDict[PartKey, ReducedPart] = OrderedDict()
        self.held_bytes = 0
        self._lock = threading.Lock()

    def limit(self, n_bytes: int) -> None:
        """Keep no more than so many bytes from now on."""
        with self._lock:
            self.n_bytes = n_bytes
            self._forget_oldest()

    def read(self, image: ImageSource, pixel_window: PixelWindow, scale: GreyScale, level: int) -> LevelPixels:
        """A window of a level, `FIRST_KEPT_LEVEL` or coarser."""
        pixels, valid = np.empty(pixel_window[2:], np.float32), np.empty(pixel_window[2:], np.bool_)
        side = max(PART_PX >> level, 1)
        first, end = pixel_window[:2], (pixel_window.row + pixel_window.rows, pixel_window.col + pixel_window.cols)
        for place in product(*(range(a // side, -(-b // side)) for a, b in zip(first, end, strict=True))):
            part = self._part(image, scale, place, level)
            corner = [number * side for number in place]
            low = [max(a, c) for a, c in zip(first, corner, strict=True)]
            high = [min(b, c + n) for b, c, n in zip(end, corner, part.pixels.shape, strict=True)]
            of_part = tuple(slice(a - c, b - c) for a, b, c in zip(low, high, corner, strict=True))
            of_window = tuple(slice(a - f, b - f) for a, b, f in zip(low, high, first, strict=True))
            pixels[of_window], valid[of_window] = part.pixels[of_part], part.valid[of_part]
        return LevelPixels(pixels, valid)

    def _part(self, image: ImageSource, scale: GreyScale, place: tuple[int, ...], level: int) -> LevelPixels:
        """A level of the part of an image at a row and column of parts."""
        # Levels that are coarser than a part have one pixel for several parts, and parts of their own.
        side = max(PART_PX, 1 << level)
        part_key = PartKey(id(image), scale, place[0] * side, place[1] * side)
        with self._lock:
            known = self._parts.get(part_key)
            if known is not None and len(known.level_pixels) > level - FIRST_KEPT_LEVEL:
                self._parts.move_to_end(part_key)
                return known.level_pixels[level - FIRST_KEPT_LEVEL]
        rows, cols = (min(side, n - first) for n, first in zip(image.shape, part_key[2:], strict=True))
        reduced, level_pixels = _scaled(image, PixelWindow(part_key.row, part_key.col, rows, cols), scale), []
        for number in range(1, max(level, PART_PX.bit_length() - 1) + 1):
            reduced = halved(*reduced)
            if number >= FIRST_KEPT_LEVEL:
                level_pixels.append(reduced)
        with self._lock:
            self._forget(part_key)
            self._parts[part_key] = made = ReducedPart(image, level_pixels)
            self.held_bytes += made.n_bytes
            self._forget_oldest()
        return level_pixels[level - FIRST_KEPT_LEVEL]

    def _forget(self, part_key: PartKey) -> None:
        part = self._parts.pop(part_key, None)
        self.held_bytes -= 0 if part is None else part.n_bytes

    def _forget_oldest(self) -> None:
        while self.held_bytes > self.n_bytes and self._parts:
            self._forget(next(iter(self._parts)))


# One for each process: its threads share the parts.
PYRAMIDS = Pyramids(PYRAMID_BYTES)
