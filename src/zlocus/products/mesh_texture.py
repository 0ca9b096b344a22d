"""The texture of a tile of a mesh: for each patch and wall the image that shows it best, among those that see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.io.image_bands import ImageBands
from zlocus.products.mesh_geometry import CellPatches, Walls
from zlocus.products.mesh_sight import SurfaceWindow, is_seen
from zlocus.products.ortho_images import stored
from zlocus.sensors.ground_sampling import sampled

# Largest height of a texture; walls get coarser until they fit.
MAX_TEXTURE_ROWS = 8192
# Texels around each wall, so that interpolation at its edges takes from the wall itself.
GUTTER = 1
# Parts of a wall, one above the other, of which each gets an image that sees its middle: what stands before a wall
# hides its foot.
WALL_PARTS = 4
# An image is preferred to one that shows more of the tile where it shows a face on so many times its pixels. Walls that
# run askew are stairs, whose steps face two sides and should still show one image.
MIN_GAIN, MIN_GAIN_OF_WALL = 1.5, 3.0
# Points whose values are looked up side by side.
ROW_OF_POINTS = 256
# Value of faces that no image shows.
GREY = 128


@dataclass(frozen=True)
class TextureImage:
    """An image as a source of textures. sensor : corrected; bands : that a picture shows; limits : values of black and
    white."""

    sensor: SensorModel
    bands: ImageBands
    limits: tuple[float, float]


@dataclass(frozen=True)
class TextureLayout:
    """Where the faces of a tile lie in its texture.

    shape : rows and columns, texels; per_cell : texels along the side of a cell; wall_rows : (k,) texels along the
    height of each wall; first : (k, 2) column and row of each wall's first texel, without its gutter.
    """

    shape: tuple[int, int]
    per_cell: int
    wall_rows: NDArray[np.int64]
    first: NDArray[np.int64]

    @classmethod
    def of(cls, tile_shape: tuple[int, int], walls: Walls, per_cell: int, cell_m: float) -> TextureLayout:
        """Patches lie as on the map; below them the walls stand in rows, the tallest first."""
        rows, cols = tile_shape[0] * per_cell, tile_shape[1] * per_cell
        width, texel_m = per_cell + 2 * GUTTER, cell_m / per_cell
        per_row = max(cols // width, 1)
        height = walls.outlines[:, 2:, 2].max(axis=1) - walls.outlines[:, :2, 2].min(axis=1)
        order = np.argsort(-height, kind="stable")
        while True:
            wall_rows = np.maximum(np.ceil(height / texel_m - 1e-9), 1).astype(np.int64)
            shelves = wall_rows[order][::per_row] + 2 * GUTTER
            total = rows + GUTTER + int(shelves.sum())
            if total <= MAX_TEXTURE_ROWS or (wall_rows == 1).all():
                break
            texel_m *= 2
        top = rows + GUTTER + np.concatenate([[0], np.cumsum(shelves)])
        first = np.empty((len(walls), 2), np.int64)
        at = np.arange(len(walls))
        first[order, 0] = at % per_row * width + GUTTER
        first[order, 1] = top[at // per_row] + GUTTER
        return cls((total, max(cols, width)), per_cell, wall_rows, first)

    def patch_corners(self, patches: CellPatches) -> FloatArray:
        """Texture coordinates (k, 4, 2) of the corners of patches, from 0 to 1."""
        return np.asarray(patches.outlines[..., :2] * self.per_cell / self.shape[::-1])

    def wall_corners(self) -> FloatArray:
        """Texture coordinates (k, 4, 2) of lower left, lower right, upper right, upper left ends of the rectangles of
        walls."""
        left, top = self.first.T
        right, bottom = left + self.per_cell, top + self.wall_rows
        at = np.stack([left, bottom, right, bottom, right, top, left, top], axis=-1).reshape(-1, 4, 2)
        return np.asarray(at / self.shape[::-1])


@dataclass(frozen=True)
class MeshTexture:
    """A texture. values : (r, c, 3) uint8; n_unseen_patches, n_unseen_walls : faces that no image shows, which are
    grey."""

    values: NDArray[np.uint8]
    n_unseen_patches: int
    n_unseen_walls: int


def mesh_texture(
    images: Sequence[TextureImage], patches: CellPatches, walls: Walls, layout: TextureLayout, window: SurfaceWindow
) -> MeshTexture:
    """Resample the texture of a tile from the images.

    window : of the surface around the tile, in whose cells patches and walls are counted from its tile's first one.

    Raises
    ------
    InputError
        An image can no longer be read.
    """
    best_patch = best_image(images, patches.outlines, _patch_samples(patches), None, window)
    of_parts = (np.repeat(each, WALL_PARTS, axis=0) for each in (walls.outlines, walls.outwards))
    outlines, outwards = of_parts
    best_wall = best_image(images, outlines, _wall_samples(walls), outwards, window).reshape(-1, WALL_PARTS)
    points, owner = _texels(patches, best_patch, walls, best_wall, layout)
    values = np.full((*layout.shape, 3), GREY, np.uint8)
    for number, image in enumerate(images):
        mine = owner == number
        if not mine.any():
            continue
        places = np.full((*layout.shape, 2), np.nan)
        places[mine] = image.sensor.image_from_ground(window.ground(points[mine]))
        found = sampled(image.bands.read, image.bands.shape, image.bands.displaced(places))
        if found is None:
            continue
        low, high = image.limits
        scaled = stored((found.values - low) * (255.0 / (high - low)), np.dtype(np.uint8))
        shown = mine & found.valid
        values[shown] = np.broadcast_to(np.moveaxis(scaled, 0, -1), (*layout.shape, scaled.shape[0]))[shown]
    return MeshTexture(values, int((best_patch < 0).sum()), int((best_wall < 0).all(axis=1).sum()))


def best_image(
    images: Sequence[TextureImage],
    outlines: FloatArray,
    samples: FloatArray,
    outwards: FloatArray | None,
    window: SurfaceWindow,
) -> NDArray[np.int64]:
    """The image (k,) that shows each face best among those that see it from outside; -1 where none does.

    That is the one that shows most of the tile, unless another one shows the face on clearly more pixels.

    outlines : (k, 4, 3), samples : (k, s, 3) points of the face that must be seen, both in cells and m; outwards :
    (k, 2) of walls.
    """
    best, area = np.full(len(outlines), -1), np.zeros(len(outlines))
    if not (len(outlines) and images):
        return best
    shown = np.stack([_pixels(image, outlines, window) for image in images])
    # Neighbouring faces should show the same image: those that show most of the tile come first.
    gain = MIN_GAIN if outwards is None else MIN_GAIN_OF_WALL
    for number in np.argsort(-shown.sum(axis=1), kind="stable"):
        wanted = np.flatnonzero(shown[number] > gain * area)
        chosen = None if outwards is None else outwards[wanted]
        wanted = wanted[is_seen(images[number].sensor, samples[wanted], chosen, window)]
        middle = window.ground(samples[wanted].mean(axis=1))
        wanted = wanted[has_value(images[number], images[number].sensor.image_from_ground(middle))]
        best[wanted], area[wanted] = number, shown[number, wanted]
    return best


def _pixels(image: TextureImage, outlines: FloatArray, window: SurfaceWindow) -> FloatArray:
    """Pixels (k,) on which an image shows each face from outside; 0 where it does not show all of it."""
    xy = image.sensor.image_from_ground(window.ground(outlines.reshape(-1, 3))).reshape(-1, 4, 2)
    with np.errstate(invalid="ignore"):
        limits = np.array(image.bands.shape[::-1]) - 0.5
        inside = ((xy >= -0.5) & (xy <= limits)).all(axis=(1, 2))
    following = np.roll(xy, -1, axis=1)
    # Outlines are counter-clockwise from outside, and rows of images grow downwards.
    shown = -0.5 * (xy[..., 0] * following[..., 1] - following[..., 0] * xy[..., 1]).sum(axis=1)
    return np.where(inside, np.maximum(shown, 0.0), 0.0)


def has_value(image: TextureImage, xy: FloatArray) -> NDArray[np.bool_]:
    """Whether an image has a value at pixels (k, 2), as column and row: none lies beyond its edge or below its mask."""
    if not len(xy):
        return np.zeros(0, bool)
    # In rows, because a picture may not be as wide as there are points.
    places = np.full((-(-len(xy) // ROW_OF_POINTS) * ROW_OF_POINTS, 2), np.nan)
    places[: len(xy)] = xy
    rows = image.bands.displaced(places.reshape(-1, ROW_OF_POINTS, 2))
    found = sampled(image.bands.read, image.bands.shape, rows)
    return np.zeros(len(xy), bool) if found is None else found.valid.ravel()[: len(xy)]


def _patch_samples(patches: CellPatches) -> FloatArray:
    """The middle (k, 1, 3) of each patch."""
    return np.asarray(patches.outlines.mean(axis=1, keepdims=True))


def _wall_samples(walls: Walls) -> FloatArray:
    """The middle of each part of each wall, (k * parts, 1, 3), the lowest part of a wall first."""
    low, high = walls.outlines[:, :2].mean(axis=1), walls.outlines[:, 2:].mean(axis=1)
    shares = (np.arange(WALL_PARTS) + 0.5) / WALL_PARTS
    return np.asarray((low[:, None] + shares[:, None] * (high - low)[:, None]).reshape(-1, 1, 3))


def _texels(
    patches: CellPatches, best_patch: NDArray[np.int64], walls: Walls, best_wall: NDArray[np.int64],
    layout: TextureLayout,
) -> tuple[FloatArray, NDArray[np.int64]]:  # fmt: skip
    """The point (r, c, 3) of the surface that each texel shows, in cells and m, and the image (r, c) that it is taken
    from; -1 where there is none. best_patch : (k,), best_wall : (k, parts) images."""
    n = layout.per_cell
    points, owner = np.zeros((*layout.shape, 3)), np.full(layout.shape, -1)
    share = (np.arange(n) + 0.5) / n
    down, across = (a.ravel() for a in np.meshgrid(share, share, indexing="ij"))
    weights = np.stack([(1 - down) * (1 - across), down * (1 - across), down * across, (1 - down) * across])
    rows, cols = patches.rows[:, None] + down, patches.cols[:, None] + across
    at = (rows * n).astype(np.int64), (cols * n).astype(np.int64)
    points[at] = np.stack([cols, rows, patches.z @ weights], axis=-1)
    owner[at] = best_patch[:, None]
    for wall_rows in np.unique(layout.wall_rows):
        mine = np.flatnonzero(layout.wall_rows == wall_rows)
        along = (np.arange(-GUTTER, n + GUTTER) + 0.5) / n
        up = 1.0 - (np.arange(-GUTTER, wall_rows + GUTTER) + 0.5) / wall_rows
        low, high = walls.outlines[mine, :2, 2].min(axis=1), walls.outlines[mine, 2:, 2].max(axis=1)
        z = low[:, None] + up * (high - low)[:, None]
        start, end = walls.outlines[mine, 0, :2], walls.outlines[mine, 1, :2]
        flat = start[:, None] + along[:, None] * (end - start)[:, None]
        grid = np.empty((len(mine), len(up), len(along), 3))
        grid[..., :2], grid[..., 2] = flat[:, None], z[:, :, None]
        to_row = (layout.first[mine, 1, None] + np.arange(-GUTTER, wall_rows + GUTTER))[:, :, None]
        to_col = (layout.first[mine, 0, None] + np.arange(-GUTTER, n + GUTTER))[:, None, :]
        points[to_row, to_col] = grid
        part = np.clip(np.floor(up * WALL_PARTS), 0, WALL_PARTS - 1).astype(np.int64)
        owner[to_row, to_col] = best_wall[mine][:, part][:, :, None]
    return points, owner
