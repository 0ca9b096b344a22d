"""How much the ground's grey values differ: the units of what counts as an edge, and as plain."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.median import median

AROUND = (5, 5)  # cells of a window whose texture is looked at
# Units are powers of two of so many to a doubling: what differs a little in two tiles makes no difference.
TO_A_DOUBLING = 8
Part = tuple[slice, slice]
ALL: Part = (slice(None), slice(None))


def edge_unit(ortho: NDArray[np.float32], core: Part = ALL) -> float:
    """Median difference of neighbours along the rows of an image (r, c), in its core; 0 where none are known."""
    away = np.abs(np.diff(ortho[core], axis=1))
    known = away[np.isfinite(away)]
    return rounded(float(median(known))) if known.size else 0.0


def texture_unit(ortho: NDArray[np.float32], core: Part = ALL) -> float:
    """Median standard deviation of grey values (r, c) in small windows of the core; 0 where nothing is shown."""
    grey = ortho[core]
    shown = np.isfinite(grey)
    if not shown.any():
        return 0.0
    return rounded(float(median(deviation(np.where(shown, grey, np.float32(0.0)), AROUND)[shown])))


def rounded(unit: float) -> float:
    """The power of two nearest by, of `TO_A_DOUBLING` to a doubling; 0 of 0."""
    return float(2.0 ** (np.rint(TO_A_DOUBLING * np.log2(unit)) / TO_A_DOUBLING)) if unit > 0 else 0.0


def deviation(grey: NDArray[np.float32], window: tuple[int, int]) -> NDArray[np.float32]:
    """Standard deviation of grey values in a window around each cell, (r, c)."""
    mean, squares = cv2.blur(grey, window), cv2.blur(grey * grey, window)
    return np.asarray(np.sqrt(np.maximum(squares - mean * mean, 0)), np.float32)
