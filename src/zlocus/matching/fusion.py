"""A surface on a ground grid from images that were matched in their own spaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.matching.image_space import MatchedImage, hypothesis_differences
from zlocus.matching.kernels.rasterise import agreed_heights, draw_image
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface

# Neighbouring pixels show one surface where they are no further apart on the ground than this, and differ in height by
# no more than steps of the matching, or than so many metres per metre.
APART_PX, JUMP_STEPS, STEEPEST = 3.0, 3.0, 3.0
# Heights of images agree within so many steps.
AGREE_STEPS = 2.0
MARGIN_PX = 3
# Along a side of the cells, and of their heights, at which they are looked for in an image: outlines may be bent there.
SAMPLES, HEIGHT_SAMPLES = 9, 3
Numbers = NDArray[np.floating[Any]]
WHY_PIXELS_ARE_EMPTY = Quality.OCCLUDED | Quality.RANGE_END | Quality.NO_MATCH | Quality.INCONSISTENT


@dataclass(frozen=True)
class PixelHeights:
    """A reference image as a grid takes it.

    image : its heights, in hypotheses; surface : of its pixels, likewise; before : the same before other images had to
    confirm the heights; step, step_m : of the matching, in hypotheses and in metres of height; pixel_m : side of a
    pixel on the ground.
    """

    image: MatchedImage
    surface: Surface
    before: Surface
    step: float
    step_m: float
    pixel_m: float


@dataclass(frozen=True)
class Cells:
    """Cells of a ground grid. shape : rows and columns; transform : cell corners to ground; z_range : m, heights that
    the ground lies between."""

    shape: tuple[int, int]
    transform: Affine
    z_range: tuple[float, float]

    def ground(self, where: NDArray[np.bool_], z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Centres of some cells (r, c) at heights (n,) m. (n, 3)"""
        row, col = np.nonzero(where)
        return np.column_stack([*on_ground(self.transform, col + 0.5, row + 0.5), z])


def gridded(images: Sequence[PixelHeights], cells: Cells, seen_by: Sequence[PixelHeights]) -> Surface:
    """The surface on which most of the images agree in each cell; of equal numbers the higher, for a roof may hide what
    lies lower, never what lies higher.

    Where no image has a confirmed height, two that agree on the ground are enough: they confirm each other, though
    others see something farther away there; such cells are marked as DISPUTED. images : in the order in which they give
    grey values to the ortho-image; seen_by : all that were matched, which know why a cell is empty.
    """
    tolerance_m = AGREE_STEPS * min(one.step_m for one in images)
    surface = agreed([drawn(one, one.surface, cells) for one in images], 1, tolerance_m)
    gaps = np.isnan(surface.height)
    if len(images) > 1 and gaps.any():
        second = agreed([drawn(one, one.before, cells) for one in images], 2, tolerance_m)
        second = replace(second, quality=second.quality | np.uint16(Quality.DISPUTED))
        for mine, theirs in zip(surface.arrays, second.arrays, strict=True):
            mine[gaps] = theirs[gaps]
    surface.quality[np.isnan(surface.height)] = why_empty(seen_by, cells, surface.height)
    return surface


def agreed(layers: Sequence[Surface], least: int, tolerance_m: float) -> Surface:
    """What most surfaces say of each cell, where at least so many agree; empty elsewhere, with no reasons yet."""
    heights = np.stack([layer.height for layer in layers])
    height, agrees = np.empty(heights.shape[1:], np.float32), np.empty(heights.shape, bool)
    agreed_heights(heights, np.float32(tolerance_m), height, agrees)
    agrees &= agrees.sum(axis=0) >= least
    known, nothing = agrees.any(axis=0), np.float32(np.nan)
    views = np.max([np.where(a, layer.views, np.uint8(0)) for a, layer in zip(agrees, layers, strict=True)], axis=0)
    ortho = np.full_like(layers[0].ortho, nothing)
    for a, layer in zip(agrees, layers, strict=True):
        np.copyto(ortho, layer.ortho, where=_of_bands(a, ortho) & np.isnan(ortho))
    sigma = _sigma(heights, np.stack([layer.sigma for layer in layers]), agrees)
    return Surface(
        height=np.where(known, height, nothing),
        sigma=np.where(known, sigma, nothing),
        quality=np.where(known, _warnings([layer.quality for layer in layers], agrees), np.uint16(0)),
        views=views,
        ortho=ortho,
    )


def drawn(one: PixelHeights, pixels: Surface, cells: Cells) -> Surface:
    """Heights of one image's pixels on the cells, with what is known of the pixel nearest to each; NaN where there is
    none."""
    height, pixel = np.full(cells.shape, np.nan, np.float32), np.full(cells.shape, -1, np.int32)
    block = _pixels_of(one.image, cells)
    hypotheses = np.ascontiguousarray(pixels.height[block])
    if not hypotheses.size:
        ortho = np.full(cells.shape + pixels.ortho.shape[2:], np.nan, np.float32)
        return Surface(height, height, np.zeros(cells.shape, np.uint16), np.zeros(cells.shape, np.uint8), ortho)
    ground = one.image.image_space.ground(block[0].start, hypotheses, block[1].start)
    sigma = pixels.sigma[block] * np.float32(one.step_m / one.step)
    ground[..., 0], ground[..., 1] = on_ground(~cells.transform, ground[..., 0], ground[..., 1])
    side = one.pixel_m / cells.transform.a
    draw_image(
        ground, np.array([APART_PX * side, JUMP_STEPS * one.step_m, STEEPEST * cells.transform.a]), height, pixel
    )
    shown = pixel >= 0

    at = np.unravel_index(np.maximum(pixel, 0), hypotheses.shape)
    quality, views, ortho = (values[block][at] for values in pixels.arrays[2:])
    nothing = np.float32(np.nan)
    return Surface(
        height,
        np.where(shown, sigma[at], nothing),
        np.where(shown, quality, np.uint16(0)),
        np.where(shown, views, np.uint8(0)),
        np.where(_of_bands(shown, ortho), ortho, nothing),
    )


def _of_bands(cells: NDArray[np.bool_], ortho: NDArray[np.float32]) -> NDArray[np.bool_]:
    """What holds for cells (r, c), for what an ortho-image has of them."""
    return cells if ortho.ndim == 2 else cells[..., None]


def why_empty(images: Sequence[PixelHeights], cells: Cells, height: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Reasons of the cells without a height, in their order, (n,) uint16, each at least one.

    A cell would have the height of the nearest cell that has one. It is UNSEEN where fewer than two images show that
    place; else it has the reasons of the pixels there, and is OCCLUDED where fewer than two are left that show nothing
    nearer, or where all pixels there show another place. IMAGE_EXCLUDED of any pixel there is kept beside them.
    """
    empty = np.isnan(height)
    if empty.all():
        z = np.full(int(empty.sum()), sum(cells.z_range) / 2)
    else:
        # Imported here: half a second, which runs in object space need not spend.
        from scipy.ndimage import distance_transform_edt

        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        z = height[tuple(nearest)][empty].astype(float)
    ground = cells.ground(empty, z)
    showing, open_, reasons, left_out = (np.zeros(len(ground), np.uint16) for _ in range(4))
    for one in images:
        row, col, inside = _pixels_at(one.image, ground)
        found = np.where(inside, one.surface.quality[row, col], np.uint16(0))
        shows = inside & ((found & np.uint16(Quality.UNSEEN)) == 0)
        nearer = np.nan_to_num(hypothesis_differences(one.image, ground)) > AGREE_STEPS * one.step
        showing += shows
        open_ += shows & ~nearer
        reasons |= np.where(shows & ~nearer, found & np.uint16(WHY_PIXELS_ARE_EMPTY), np.uint16(0))
        left_out |= found & np.uint16(Quality.IMAGE_EXCLUDED)
    reasons[(open_ < 2) | (reasons == 0)] |= np.uint16(Quality.OCCLUDED)
    return np.where(showing < 2, np.uint16(Quality.UNSEEN), reasons) | left_out


def on_ground(transform: Affine, col: Numbers, row: Numbers) -> tuple[Numbers, Numbers]:
    """An affine transform of arrays."""
    t = transform
    return t.a * col + t.b * row + t.c, t.d * col + t.e * row + t.f


def _pixels_of(image: MatchedImage, cells: Cells) -> tuple[slice, slice]:
    """Rows and columns of an image that may show the cells."""
    rows, cols = cells.shape
    spans = ((0.0, cols, SAMPLES), (0.0, rows, SAMPLES), (*cells.z_range, HEIGHT_SAMPLES))
    across, down, z = (v.ravel() for v in np.meshgrid(*(np.linspace(*span) for span in spans)))
    at = image.image_space.frame_from_ground(np.column_stack([*on_ground(cells.transform, across, down), z]))
    if not np.isfinite(at).all():
        return slice(0, image.height.shape[0]), slice(0, image.height.shape[1])
    low, high = np.floor(at.min(axis=0)) - MARGIN_PX, np.ceil(at.max(axis=0)) + MARGIN_PX
    row, col = (np.clip([-high[1], -low[1] + 1], 0, image.height.shape[0]).astype(int),
                np.clip([low[0], high[0] + 1], 0, image.height.shape[1]).astype(int))  # fmt: skip
    return slice(int(row[0]), int(row[1])), slice(int(col[0]), int(col[1]))


def _pixels_at(
    image: MatchedImage, ground: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Row and column of the nearest pixels to ground points (n, 3) m, and whether they are inside; 0 elsewhere."""
    at = image.image_space.frame_from_ground(ground)
    rows, cols = image.height.shape
    with np.errstate(invalid="ignore"):
        col, row = np.rint(at[:, 0]), np.rint(-at[:, 1])
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    return np.where(inside, row, 0).astype(np.int64), np.where(inside, col, 0).astype(np.int64), inside


def _warnings(qualities: Sequence[NDArray[np.uint16]], agrees: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Warnings of all images that agree; JUMP of any of them, and INCONSISTENT never, for it empties a cell."""
    everything = np.uint16(0xFFFF)
    of_all, of_any = np.full(agrees.shape[1:], everything), np.zeros(agrees.shape[1:], np.uint16)
    for a, quality in zip(agrees, qualities, strict=True):
        of_all &= np.where(a, quality, everything)
        of_any |= np.where(a, quality, np.uint16(0))
    return np.asarray(of_all | (of_any & np.uint16(Quality.JUMP)))


def _sigma(heights: NDArray[np.float32], sigmas: NDArray[np.float32], agrees: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Standard deviation of a cell's height, (r, c) m: the mean of the images' own variances and the variance of their
    heights, added. It is not divided by their number, for they were matched with the same pixels. All (i, r, c)."""
    n = np.maximum(agrees.sum(axis=0), 1).astype(np.float32)
    own = np.where(agrees, sigmas, np.float32(0)) ** 2
    mean = np.where(agrees, heights, np.float32(0)).sum(axis=0) / n
    apart = np.where(agrees, heights - mean, np.float32(0)) ** 2
    sigma = np.sqrt((own + apart).sum(axis=0) / n)
    return np.where(agrees.any(axis=0), sigma, np.float32(np.nan)).astype(np.float32)
