"""SIFT features of images, detected part by part so that an image of any size fits in memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import OrientationOptions
from zlocus.core.parallel import run_all
from zlocus.core.scene import ImageSource, ImageWindow, held_pixels, held_window
from zlocus.core.sensor_model import FloatArray
from zlocus.core.unnamed_files import on_disk
from zlocus.orientation.kernels.descriptors import DESCRIPTOR_LENGTH_UNITS

PART_PX = 1024
# Pixels of the reduced image that are read around each part.
HALO_PX = 16
STRETCH_PERCENT = (0.5, 99.5)
CONTRAST_THRESHOLD = 0.02
N_DESCRIPTOR_VALUES = 128
# Descriptors of all images together that are kept in memory; further ones are written to files.
HELD_BYTES = 500e6
MIN_VALID_SHARE = 0.999  # of the area of a reduced pixel


@dataclass(frozen=True)
class Features:
    """SIFT features of one image. xy : (n, 2) px; descriptors : (n, 128) int16, RootSIFT descriptors, all of the length
    `DESCRIPTOR_LENGTH_UNITS`."""

    xy: FloatArray
    descriptors: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.xy)

    def only(self, rows: NDArray[np.int64]) -> Features:
        """Some of the features, rows (k,)."""
        return Features(self.xy[rows], self.descriptors[rows])


NOTHING = Features(np.empty((0, 2)), np.empty((0, N_DESCRIPTOR_VALUES), np.int16))


def detect(image: ImageSource, wanted: NDArray[np.bool_], options: OrientationOptions) -> Features:
    """SIFT features of some parts of an image, the strongest of each part.

    wanted : (r, c) bool, the parts, as `part_grid` numbers them. Large images are reduced first, see `reduction`.
    """
    return detect_all([image], [wanted], options)[0]


def detect_all(
    images: Sequence[ImageSource],
    wanted: Sequence[NDArray[np.bool_]],
    options: OrientationOptions,
    threads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Features]:
    """Features of several images, see `detect`. Threads share the parts of all images.

    progress : is called with the share that is done.
    """
    work = [(i, core) for i, image in enumerate(images) for part, core in parts(image) if wanted[i][part]]
    left = np.bincount([i for i, _ in work], minlength=len(images))
    part_features: list[dict[int, Features]] = [{} for _ in images]
    found, held_bytes = [NOTHING for _ in images], 0

    def detect_one(number: int) -> Features:
        i, core = work[number]
        return detect_part(images[i], core, options)

    for done, (number, part) in enumerate(run_all(detect_one, range(len(work)), threads)):
        i = work[number][0]
        part_features[i][number] = part
        left[i] -= 1
        if not left[i]:
            found[i] = joined([part_features[i][number] for number in sorted(part_features[i])], held_bytes)
            held_bytes += found[i].descriptors.nbytes
            part_features[i] = {}
        if progress is not None:
            progress((done + 1) / len(work))
    return found


def joined(features_of_parts: Sequence[Features], held_bytes: int) -> Features:
    """The features of several parts as those of one image.

    held_bytes : size of the descriptors that are in memory already. Beyond `HELD_BYTES` descriptors are written to
    unnamed files, from which the system reads them as they are needed.
    """
    xy = np.concatenate([features.xy for features in features_of_parts])
    descriptors = np.concatenate([features.descriptors for features in features_of_parts])
    if held_bytes + descriptors.nbytes > HELD_BYTES and descriptors.size:
        descriptors = on_disk(descriptors, "Features of the images")
    return Features(xy, descriptors)


def detect_part(image: ImageSource, core: tuple[int, int, int, int], options: OrientationOptions) -> Features:
    """Features of a part of an image. core : first row, first column, end row and end column of the part."""
    (rows, cols), held_shape = image.shape, held_window(image)[2:]
    area_mpx = math.prod(held_shape) / 1e6
    factor = reduction(held_shape, options)
    halo = math.ceil(HALO_PX * factor)
    per_mpx = min(options.features_per_mpx * math.sqrt(area_mpx), options.features_per_image) / area_mpx
    row, col = max(core[0] - halo, 0), max(core[1] - halo, 0)
    image_window = image.read(row, col, min(core[2] + halo, rows) - row, min(core[3] + halo, cols) - col)
    limit = int(np.ceil(per_mpx * image_window.valid.size / 1e6))
    xy, descriptors = detect_window(image_window, limit, factor)
    xy = xy + np.array([col, row])
    inside = (xy >= np.array([core[1], core[0]]) - 0.5) & (xy < np.array([core[3], core[2]]) - 0.5)
    kept = np.flatnonzero(inside.all(axis=1))
    kept = kept[: math.ceil(per_mpx * (core[2] - core[0]) * (core[3] - core[1]) / 1e6)]
    return Features(xy[kept], descriptors[kept])


def reduction(shape: tuple[int, int], options: OrientationOptions) -> float:
    """Number of pixels along each axis that become one pixel for SIFT.

    It is 1 up to `full_detail_mpx`, 2 just above it, 3.3 at 4.4 Mpx and 10 at 400 Mpx, so that the work grows with the
    square root of the image. The precision lost by the reduction comes back in `tie_refinement`.
    """
    ratio = shape[0] * shape[1] / 1e6 / options.full_detail_mpx
    return 1.0 if ratio <= 1.0 else 2.0 * ratio**0.25


def part_grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Numbers of rows and columns of parts into which an image of that shape is divided."""
    return max(round(shape[0] / PART_PX), 1), max(round(shape[1] / PART_PX), 1)


def parts(image: ImageSource) -> Iterator[tuple[tuple[int, int], tuple[int, int, int, int]]]:
    """Each part's (row, column) in the grid of parts and its (first row, first column, end row, end column) in px.

    The grid covers the window of the image that its file holds (`held_window`). Of a sparse file, only the parts with
    pixels are given.
    """
    top, left, rows, cols = held_window(image)
    grid = part_grid((rows, cols))
    row_edges = top + np.linspace(0, rows, grid[0] + 1).round().astype(int)
    col_edges = left + np.linspace(0, cols, grid[1] + 1).round().astype(int)
    place = np.moveaxis(np.indices(grid), 0, -1).reshape(-1, 2)
    i, j = place.T
    edges = np.column_stack([row_edges[i], col_edges[j], row_edges[i + 1], col_edges[j + 1]])
    held = held_pixels(image)
    if held is not None:
        some = held.inside(edges)
        place, edges = place[some], edges[some]
    for part, core in zip(place.tolist(), edges.tolist(), strict=True):
        yield (part[0], part[1]), (core[0], core[1], core[2], core[3])


def detect_window(image_window: ImageWindow, limit: int, factor: float) -> tuple[FloatArray, NDArray[np.int16]]:
    """SIFT positions (n, 2) px in a window and RootSIFT descriptors (n, 128), at most `limit`, the strongest first.

    factor : by which the window is reduced first, see `reduction`.

    `enable_precise_upscale` is needed: without it OpenCV's positions are 0.25 px too large in both axes, because of the
    way in which it doubles the image. Descriptors are compared as square roots (Arandjelovic and Zisserman 2012,
    section 2).
    """
    full = np.array(image_window.pixels.shape[::-1])
    size = np.maximum(np.round(full / factor).astype(int), 1)
    image_window = image_window if factor == 1.0 else reduced(image_window, size)
    pixels, valid = stretched(image_window), image_window.valid
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=CONTRAST_THRESHOLD, enable_precise_upscale=True)
    keypoints, found = sift.detectAndCompute(pixels, None)
    if not keypoints:
        return np.empty((0, 2)), np.empty((0, N_DESCRIPTOR_VALUES), np.int16)
    strongest = np.argsort([-k.response for k in keypoints], kind="stable")
    keypoints, found = [keypoints[k] for k in strongest], found[strongest]
    xy = np.array([k.pt for k in keypoints])
    size_px = np.array([k.size for k in keypoints])
    keep = far_from_nodata(xy, size_px, valid)
    descriptors = np.sqrt(found[keep] / np.maximum(found[keep].sum(axis=1, keepdims=True), 1e-12))
    whole = np.rint(descriptors * DESCRIPTOR_LENGTH_UNITS).astype(np.int16)
    return (xy[keep] + 0.5) * (full / size) - 0.5, whole


def reduced(image_window: ImageWindow, size: NDArray[np.int64]) -> ImageWindow:
    """The window reduced to a size (columns, rows), each pixel the mean over its area, valid where all of the area
    is."""
    pixels = np.asarray(cv2.resize(image_window.pixels, size.tolist(), interpolation=cv2.INTER_AREA))
    if image_window.valid.all():
        return ImageWindow(pixels, np.ones(pixels.shape, bool))
    valid = cv2.resize(image_window.valid.astype(np.float32), size.tolist(), interpolation=cv2.INTER_AREA)
    return ImageWindow(pixels, valid > MIN_VALID_SHARE)


def stretched(image_window: ImageWindow) -> NDArray[np.uint8]:
    """The window in 8 bit, stretched between percentiles of its valid pixels; invalid pixels get their median."""
    sample = image_window.pixels[::3, ::3][image_window.valid[::3, ::3]]
    if not len(sample):
        return np.zeros(image_window.pixels.shape, np.uint8)
    low, middle, high = np.percentile(sample, (STRETCH_PERCENT[0], 50.0, STRETCH_PERCENT[1]))
    pixels = (
        image_window.pixels
        if image_window.valid.all()
        else np.where(image_window.valid, image_window.pixels, np.float32(middle))
    )
    return np.asarray(cv2.convertScaleAbs(np.maximum(pixels - low, 0.0), alpha=255.0 / max(high - low, 1e-12)))


def far_from_nodata(xy: FloatArray, size_px: FloatArray, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Features (n,) without an invalid pixel within three times their size."""
    if valid.all():
        return np.ones(len(xy), bool)
    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 3)
    cell = np.clip(xy.round().astype(int), 0, np.array(valid.shape[::-1]) - 1)
    return np.asarray(distance[cell[:, 1], cell[:, 0]] > 3.0 * size_px)
