"""SIFT features of an image, found part by part so that any image size fits in memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.options import OrientationOptions
from zlocus.scene import ImageSource, ImageWindow
from zlocus.sensors.model import FloatArray

PART_PX = 1024
HALO_PX = 16  # of the reduced image
STRETCH_PERCENT = (0.5, 99.5)
CONTRAST_THRESHOLD = 0.02
DESCRIPTOR_LENGTH = 128
WHOLLY = 0.999  # valid share of what a reduced pixel covers


@dataclass(frozen=True)
class Features:
    """Distinctive points of one image. xy : (n, 2) px; descriptors : (n, 128) float32 of unit length."""

    xy: FloatArray
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.xy)

    def only(self, rows: NDArray[np.int64]) -> Features:
        """Some of the features."""
        return Features(self.xy[rows], self.descriptors[rows])


def detect(image: ImageSource, wanted: NDArray[np.bool_], options: OrientationOptions) -> Features:
    """SIFT features of the wanted parts of an image, the strongest of each part.

    wanted : (r, c) bool, one entry per part, as `part_grid` numbers them. Large images are reduced first, see
    `reduction`.
    """
    rows, cols = image.shape
    area_mpx = rows * cols / 1e6
    factor = reduction(image.shape, options)
    halo = math.ceil(HALO_PX * factor)
    per_mpx = min(options.features_per_mpx * math.sqrt(area_mpx), options.features_per_image) / area_mpx
    xys, descriptors = [np.empty((0, 2))], [np.empty((0, DESCRIPTOR_LENGTH), np.float32)]
    for part, core in parts(image.shape):
        if not wanted[part]:
            continue
        row, col = max(core[0] - halo, 0), max(core[1] - halo, 0)
        window = image.read(row, col, min(core[2] + halo, rows) - row, min(core[3] + halo, cols) - col)
        limit = int(np.ceil(per_mpx * window.valid.size / 1e6))
        xy, descriptor = detect_window(window, limit, factor)
        xy = xy + np.array([col, row])
        inside = (xy >= np.array([core[1], core[0]]) - 0.5) & (xy < np.array([core[3], core[2]]) - 0.5)
        kept = np.flatnonzero(inside.all(axis=1))
        kept = kept[: math.ceil(per_mpx * (core[2] - core[0]) * (core[3] - core[1]) / 1e6)]
        xys.append(xy[kept])
        descriptors.append(descriptor[kept])
    return Features(np.concatenate(xys), np.concatenate(descriptors))


def reduction(shape: tuple[int, int], options: OrientationOptions) -> float:
    """How many pixels along an image become one for SIFT.

    1 up to `full_detail_mpx`, 2 just above it, 3.3 at 4.4 Mpx, 10 at 400: work grows with the square root of the image.
    What the reduced image cannot tell comes back when ties are measured again, see `sharpen`.
    """
    ratio = shape[0] * shape[1] / 1e6 / options.full_detail_mpx
    return 1.0 if ratio <= 1.0 else 2.0 * ratio**0.25


def part_grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of parts of an image."""
    return max(round(shape[0] / PART_PX), 1), max(round(shape[1] / PART_PX), 1)


def parts(shape: tuple[int, int]) -> Iterator[tuple[tuple[int, int], tuple[int, int, int, int]]]:
    """Each part's (row, column) in the grid of parts and its (first row, first column, end row, end column) in px."""
    grid = part_grid(shape)
    row_edges = np.linspace(0, shape[0], grid[0] + 1).round().astype(int)
    col_edges = np.linspace(0, shape[1], grid[1] + 1).round().astype(int)
    for i in range(grid[0]):
        for j in range(grid[1]):
            yield (i, j), (int(row_edges[i]), int(col_edges[j]), int(row_edges[i + 1]), int(col_edges[j + 1]))


def detect_window(window: ImageWindow, limit: int, factor: float) -> tuple[FloatArray, NDArray[np.float32]]:
    """SIFT positions (n, 2) px in the window and RootSIFT descriptors (n, 128), the strongest first, at most `limit`.

    factor : by which the window is reduced first, see `reduction`.

    `enable_precise_upscale` matters: without it OpenCV's positions are 0.25 px too large in both axes, because of how
    it doubles the image. Descriptors are compared as square roots (Arandjelovic and Zisserman 2012, section 2).
    """
    full = np.array(window.pixels.shape[::-1])
    size = np.maximum(np.round(full / factor).astype(int), 1)
    window = window if factor == 1.0 else reduced(window, size)
    pixels, valid = stretched(window), window.valid
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=CONTRAST_THRESHOLD, enable_precise_upscale=True)
    keypoints, found = sift.detectAndCompute(pixels, None)
    if not keypoints:
        return np.empty((0, 2)), np.empty((0, DESCRIPTOR_LENGTH), np.float32)
    strongest = np.argsort([-k.response for k in keypoints], kind="stable")
    keypoints, found = [keypoints[k] for k in strongest], found[strongest]
    xy = np.array([k.pt for k in keypoints])
    size_px = np.array([k.size for k in keypoints])
    keep = far_from_nodata(xy, size_px, valid)
    descriptors = np.sqrt(found[keep] / np.maximum(found[keep].sum(axis=1, keepdims=True), 1e-12))
    return (xy[keep] + 0.5) * (full / size) - 0.5, descriptors.astype(np.float32)


def reduced(window: ImageWindow, size: NDArray[np.int64]) -> ImageWindow:
    """The window with fewer pixels, (columns, rows), each the mean over its area, valid where all of that is."""
    pixels = np.asarray(cv2.resize(window.pixels, size.tolist(), interpolation=cv2.INTER_AREA))
    if window.valid.all():
        return ImageWindow(pixels, np.ones(pixels.shape, bool))
    valid = cv2.resize(window.valid.astype(np.float32), size.tolist(), interpolation=cv2.INTER_AREA)
    return ImageWindow(pixels, valid > WHOLLY)


def stretched(window: ImageWindow) -> NDArray[np.uint8]:
    """The window as 8 bit, stretched between percentiles of its valid pixels; invalid pixels take their median."""
    sample = window.pixels[::3, ::3][window.valid[::3, ::3]]
    if not len(sample):
        return np.zeros(window.pixels.shape, np.uint8)
    low, middle, high = np.percentile(sample, (STRETCH_PERCENT[0], 50.0, STRETCH_PERCENT[1]))
    pixels = window.pixels if window.valid.all() else np.where(window.valid, window.pixels, np.float32(middle))
    return np.asarray(cv2.convertScaleAbs(np.maximum(pixels - low, 0.0), alpha=255.0 / max(high - low, 1e-12)))


def far_from_nodata(xy: FloatArray, size_px: FloatArray, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Features whose surroundings, three times their size, hold no invalid pixel."""
    if valid.all():
        return np.ones(len(xy), bool)
    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 3)
    cell = np.clip(xy.round().astype(int), 0, np.array(valid.shape[::-1]) - 1)
    return np.asarray(distance[cell[:, 1], cell[:, 0]] > 3.0 * size_px)
