"""Seams of a mosaic: which image shows each cell, so that neighbouring images meet where they differ least."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from zlocus.matching.kernels.seams import OPEN, flood

# Differences are averaged over so many cells, so that a seam keeps away from edges.
SMOOTHED_CELLS = 3
# Differences of this many contrasts and more are all the same.
LARGEST_DIFFERENCE = 2.0
# Cells that no image shows.
NOTHING = OPEN - 1


def preferred_images(score: NDArray[np.floating], may_show: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The image with the highest score of those that show each cell, (r, c) int32; `NOTHING` where none does.

    score, may_show : (k, r, c).
    """
    masked = np.where(may_show, score, -np.inf)
    best = masked.argmax(axis=0).astype(np.int32)
    return np.where(may_show.any(axis=0), best, np.int32(NOTHING)).astype(np.int32)


def seamed_images(
    preferred: NDArray[np.int32],
    grey: NDArray[np.float32],
    may_show: NDArray[np.bool_],
    band_cells: float,
    contrast: float,
) -> NDArray[np.int32]:
    """The image that shows each cell, (r, c) int32: the preferred one, but for a band along the border of two.

    preferred : (r, c), see `preferred_images`; grey, may_show : (k, r, c), levelled grey values, and where an image has
    them; band_cells : how far from the border of the preferred images a seam may lie; contrast : of the grey values.
    """
    shown = [int(k) for k in np.unique(preferred) if k >= 0]
    if len(shown) < 2:
        return preferred
    distance = np.full(preferred.shape, np.inf)
    other = np.full(preferred.shape, shown[0], np.int32)
    for k in shown:
        from_k = distance_transform_edt(preferred != k)
        nearer = (preferred != k) & (from_k < distance)
        distance, other = np.where(nearer, from_k, distance), np.where(nearer, np.int32(k), other)
    row, col = np.indices(preferred.shape)
    own = np.maximum(preferred, 0)
    is_open = (preferred >= 0) & (distance <= band_cells) & may_show[other, row, col]
    difference = np.where(is_open, np.abs(grey[own, row, col] - grey[other, row, col]), 0.0)
    smooth = cv2.blur(difference.astype(np.float32), (SMOOTHED_CELLS, SMOOTHED_CELLS))
    levels = np.sqrt(np.minimum(smooth / max(LARGEST_DIFFERENCE * contrast, 1e-12), 1.0))
    labels = np.where(is_open, np.int32(OPEN), preferred).astype(np.int32)
    flood(np.rint(255 * levels).astype(np.uint8), np.ascontiguousarray(may_show), labels)
    return np.where(labels == OPEN, preferred, labels).astype(np.int32)
