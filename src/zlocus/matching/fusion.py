"""A surface on a ground grid from images that were matched in their own image spaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.matching.image_space import MatchedImage, hypothesis_differences
from zlocus.matching.kernels.rasterise import SurfaceLimits, agreed_heights, draw_image
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface

# Neighbouring pixels show one surface where they are at most this far apart on the ground (in ground pixels), and
# differ in height by at most so many steps of the matching, or so many metres per metre.
MAX_PIXEL_DISTANCE_PX, MAX_HEIGHT_DIFFERENCE_STEPS, MAX_STEEPNESS = 3.0, 3.0, 3.0
# Heights of two images agree within so many steps.
MAX_DISAGREEMENT_STEPS = 2.0
# Pixels around the part of an image that may show the cells.
MARGIN_PX = 3
# Places along a side of the cells, and heights, at which that part is searched, because its outline may be bent.
SAMPLES_PER_SIDE, HEIGHT_SAMPLES = 9, 3
Numbers = NDArray[np.floating[Any]]
# Flags of pixels that explain why a cell has no height.
FLAGS_OF_EMPTY_PIXELS = Quality.OCCLUDED | Quality.RANGE_END | Quality.NO_MATCH | Quality.INCONSISTENT


@dataclass(frozen=True)
class PixelHeights:
    """A matched reference image, as a ground grid takes it.

    matched_image : its heights, in hypotheses; pixel_surface : heights, flags and grey values of its pixels, likewise;
    unchecked_surface : the same before the cross-consistency check; step : of the matching, in hypotheses; step_m : the
    same in metres of height; pixel_m : side of a pixel on the ground.
    """

    matched_image: MatchedImage
    pixel_surface: Surface
    unchecked_surface: Surface
    step: float
    step_m: float
    pixel_m: float


@dataclass(frozen=True)
class GridCells:
    """Cells of a ground grid. shape : rows and columns; transform : from cell corners to the ground; z_range : m, range
    of the heights of the ground."""

    shape: tuple[int, int]
    transform: Affine
    z_range: tuple[float, float]

    def ground(self, where: NDArray[np.bool_], z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ground points (n, 3) m: centres of the n cells marked in `where`, (r, c), at the heights z, (n,) m."""
        row, col = np.nonzero(where)
        return np.column_stack([*on_ground(self.transform, col + 0.5, row + 0.5), z])


class PixelPlaces(NamedTuple):
    """Nearest pixels of ground points, (n,) each; row and column are 0 where a point is not inside the image."""

    row: NDArray[np.int64]
    col: NDArray[np.int64]
    is_inside: NDArray[np.bool_]


def gridded(
    pixel_heights: Sequence[PixelHeights], grid_cells: GridCells, all_pixel_heights: Sequence[PixelHeights]
) -> Surface:
    """The surface on which most images agree in each cell; of equal numbers of images the higher one, because a roof
    may occlude what lies lower, never what lies higher.

    Where no image has a height that passed the cross-consistency check, two images that agree on the ground are enough:
    they support each other, although others see something farther away there. Such cells are marked as DISPUTED.

    pixel_heights : of the images that give heights, in the order in which they give grey values to the ortho-image;
    all_pixel_heights : of all images that were matched, whose flags tell why a cell is empty.
    """
    tolerance_m = MAX_DISAGREEMENT_STEPS * min(one.step_m for one in pixel_heights)
    surface = agreed([drawn(one, one.pixel_surface, grid_cells) for one in pixel_heights], 1, tolerance_m)
    gaps = np.isnan(surface.height)
    if len(pixel_heights) > 1 and gaps.any():
        unchecked = agreed([drawn(one, one.unchecked_surface, grid_cells) for one in pixel_heights], 2, tolerance_m)
        unchecked = replace(unchecked, quality=unchecked.quality | np.uint16(Quality.DISPUTED))
        for target, source in zip(surface.arrays, unchecked.arrays, strict=True):
            target[gaps] = source[gaps]
    surface.quality[np.isnan(surface.height)] = why_empty(all_pixel_heights, grid_cells, surface.height)
    return surface


def agreed(surfaces: Sequence[Surface], min_images: int, tolerance_m: float) -> Surface:
    """The surface on which most of the surfaces of images agree in each cell, where at least `min_images` agree; empty
    elsewhere, without flags yet."""
    heights = np.stack([surface.height for surface in surfaces])
    height, agrees = np.empty(heights.shape[1:], np.float32), np.empty(heights.shape, bool)
    agreed_heights(heights, np.float32(tolerance_m), height, agrees)
    agrees &= agrees.sum(axis=0) >= min_images
    known, nothing = agrees.any(axis=0), np.float32(np.nan)
    views = np.max([np.where(a, s.views, np.uint8(0)) for a, s in zip(agrees, surfaces, strict=True)], axis=0)
    ortho = np.full_like(surfaces[0].ortho, nothing)
    for a, surface in zip(agrees, surfaces, strict=True):
        np.copyto(ortho, surface.ortho, where=_of_bands(a, ortho) & np.isnan(ortho))
    sigma = _sigma(heights, np.stack([surface.sigma for surface in surfaces]), agrees)
    return Surface(
        height=np.where(known, height, nothing),
        sigma=np.where(known, sigma, nothing),
        quality=np.where(known, _warnings([surface.quality for surface in surfaces], agrees), np.uint16(0)),
        views=views,
        ortho=ortho,
    )


def drawn(pixel_heights: PixelHeights, pixel_surface: Surface, grid_cells: GridCells) -> Surface:
    """The surface of one image on the cells: heights of its pixels at the cells' centres, and everything else from the
    pixel nearest to each; NaN where there is none.

    pixel_surface : of the image's pixels, in hypotheses.
    """
    height, pixel = np.full(grid_cells.shape, np.nan, np.float32), np.full(grid_cells.shape, -1, np.int32)
    matched_image, step_m = pixel_heights.matched_image, pixel_heights.step_m
    block = _pixels_of(matched_image, grid_cells)
    hypotheses = np.ascontiguousarray(pixel_surface.height[block])
    if not hypotheses.size:
        ortho = np.full(grid_cells.shape + pixel_surface.ortho.shape[2:], np.nan, np.float32)
        return Surface(
            height, height, np.zeros(grid_cells.shape, np.uint16), np.zeros(grid_cells.shape, np.uint8), ortho
        )
    ground = matched_image.image_space.ground(block[0].start, hypotheses, block[1].start)
    sigma = pixel_surface.sigma[block] * np.float32(step_m / pixel_heights.step)
    ground[..., 0], ground[..., 1] = on_ground(~grid_cells.transform, ground[..., 0], ground[..., 1])
    cell_m = grid_cells.transform.a
    limits = SurfaceLimits(
        MAX_PIXEL_DISTANCE_PX * (pixel_heights.pixel_m / cell_m), MAX_HEIGHT_DIFFERENCE_STEPS * step_m,
        MAX_STEEPNESS * cell_m,
    )  # fmt: skip
    draw_image(ground, limits, height, pixel)
    shown, nothing = pixel >= 0, np.float32(np.nan)
    at = np.unravel_index(np.maximum(pixel, 0), hypotheses.shape)
    quality, views, ortho = (values[block][at] for values in pixel_surface.arrays[2:])
    return Surface(
        height,
        np.where(shown, sigma[at], nothing),
        np.where(shown, quality, np.uint16(0)),
        np.where(shown, views, np.uint8(0)),
        np.where(_of_bands(shown, ortho), ortho, nothing),
    )


def _of_bands(cells: NDArray[np.bool_], ortho: NDArray[np.float32]) -> NDArray[np.bool_]:
    """A mask of cells (r, c) with as many dimensions as the ortho-image."""
    return cells if ortho.ndim == 2 else cells[..., None]


def why_empty(
    pixel_heights: Sequence[PixelHeights], grid_cells: GridCells, height: NDArray[np.float32]
) -> NDArray[np.uint16]:
    """Quality flags of the cells without a height, in their order, (n,) uint16; each has at least one.

    A cell is judged at the height of the nearest cell that has one. It is UNSEEN where fewer than two images show that
    place. Otherwise it has the flags of the pixels there, and is OCCLUDED where in fewer than two images nothing nearer
    stands in front of it, or where all pixels there show another place. IMAGE_EXCLUDED of any pixel is kept beside
    them.
    """
    empty = np.isnan(height)
    if empty.all():
        z = np.full(int(empty.sum()), sum(grid_cells.z_range) / 2)
    else:
        # Imported here, because it takes half a second, which runs in object space do not need.
        from scipy.ndimage import distance_transform_edt

        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        z = height[tuple(nearest)][empty].astype(float)
    ground = grid_cells.ground(empty, z)
    n_showing, n_not_occluded, flags, is_excluded = (np.zeros(len(ground), np.uint16) for _ in range(4))
    for one in pixel_heights:
        row, col, inside = _pixels_at(one.matched_image, ground)
        quality = np.where(inside, one.pixel_surface.quality[row, col], np.uint16(0))
        shows = inside & ((quality & np.uint16(Quality.UNSEEN)) == 0)
        nearer_by = np.nan_to_num(hypothesis_differences(one.matched_image, ground))
        occludes = nearer_by > MAX_DISAGREEMENT_STEPS * one.step
        n_showing += shows
        n_not_occluded += shows & ~occludes
        flags |= np.where(shows & ~occludes, quality & np.uint16(FLAGS_OF_EMPTY_PIXELS), np.uint16(0))
        is_excluded |= quality & np.uint16(Quality.IMAGE_EXCLUDED)
    flags[(n_not_occluded < 2) | (flags == 0)] |= np.uint16(Quality.OCCLUDED)
    return np.where(n_showing < 2, np.uint16(Quality.UNSEEN), flags) | is_excluded


def on_ground(transform: Affine, col: Numbers, row: Numbers) -> tuple[Numbers, Numbers]:
    """Ground coordinates (x, y) of columns and rows, arrays of one shape, by an affine transform."""
    t = transform
    return t.a * col + t.b * row + t.c, t.d * col + t.e * row + t.f


def _pixels_of(matched_image: MatchedImage, grid_cells: GridCells) -> tuple[slice, slice]:
    """Rows and columns of an image that may show the cells."""
    rows, cols = grid_cells.shape
    spans = (
        (0.0, cols, SAMPLES_PER_SIDE), (0.0, rows, SAMPLES_PER_SIDE), (*grid_cells.z_range, HEIGHT_SAMPLES)
    )  # fmt: skip
    across, down, z = (v.ravel() for v in np.meshgrid(*(np.linspace(*span) for span in spans)))
    ground = np.column_stack([*on_ground(grid_cells.transform, across, down), z])
    at = matched_image.image_space.frame_from_ground(ground)
    shape = matched_image.height.shape
    if not np.isfinite(at).all():
        return slice(0, shape[0]), slice(0, shape[1])
    low, high = np.floor(at.min(axis=0)) - MARGIN_PX, np.ceil(at.max(axis=0)) + MARGIN_PX
    row = np.clip([-high[1], -low[1] + 1], 0, shape[0]).astype(int)
    col = np.clip([low[0], high[0] + 1], 0, shape[1]).astype(int)
    return slice(int(row[0]), int(row[1])), slice(int(col[0]), int(col[1]))


def _pixels_at(matched_image: MatchedImage, ground: NDArray[np.float64]) -> PixelPlaces:
    """The nearest pixels of an image to ground points (n, 3) m."""
    at = matched_image.image_space.frame_from_ground(ground)
    rows, cols = matched_image.height.shape
    with np.errstate(invalid="ignore"):
        col, row = np.rint(at[:, 0]), np.rint(-at[:, 1])
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    return PixelPlaces(
        np.where(inside, row, 0).astype(np.int64), np.where(inside, col, 0).astype(np.int64), inside
    )  # fmt: skip


def _warnings(qualities: Sequence[NDArray[np.uint16]], agrees: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Flags (r, c) that all agreeing images have, and JUMP where any of them has it. All (i, r, c)."""
    everything = np.uint16(0xFFFF)
    of_all, of_any = np.full(agrees.shape[1:], everything), np.zeros(agrees.shape[1:], np.uint16)
    for a, quality in zip(agrees, qualities, strict=True):
        of_all &= np.where(a, quality, everything)
        of_any |= np.where(a, quality, np.uint16(0))
    return np.asarray(of_all | (of_any & np.uint16(Quality.JUMP)))


def _sigma(heights: NDArray[np.float32], sigmas: NDArray[np.float32], agrees: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Standard deviation of the heights of the cells, (r, c) m.

    Its square is the sum of the mean variance of the images and the variance of their heights. It is not divided by the
    number of images, because they were matched with the same pixels. heights, sigmas, agrees : (i, r, c).
    """
    n = np.maximum(agrees.sum(axis=0), 1).astype(np.float32)
    own = np.where(agrees, sigmas, np.float32(0)) ** 2
    mean = np.where(agrees, heights, np.float32(0)).sum(axis=0) / n
    apart = np.where(agrees, heights - mean, np.float32(0)) ** 2
    sigma = np.sqrt((own + apart).sum(axis=0) / n)
    return np.where(agrees.any(axis=0), sigma, np.float32(np.nan)).astype(np.float32)
