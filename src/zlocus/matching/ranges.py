"""Which heights each block of cells searches: all at the coarsest level, then what the coarser level found nearby."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.lattice import HeightLattice
from zlocus.options import PyramidOptions

LANES = 16
UNKNOWN = np.float32(1e9)


def whole_range(origin_m: float, step_m: float, n_steps: int, shape: tuple[int, int], block: int) -> HeightLattice:
    """Every block searches indices 0 to n_steps - 1 (rounded up to whole vector lanes)."""
    n_b, n_d = -(-shape[0] // block), -(-shape[1] // block)
    count = -(-n_steps // LANES) * LANES
    return HeightLattice(
        origin_m, step_m, shape, block, np.zeros((n_b, n_d), np.int64), np.full((n_b, n_d), count, np.int64)
    )


def ranges_nearby(
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    origin_m: float,
    step_m: float,
    shape: tuple[int, int],
    n_steps: int,
    options: PyramidOptions,
) -> HeightLattice:
    """The span of the heights found in and around each block, with a margin.

    low, high : (r, c) float32, lowest and highest candidate of every cell, in height indices of this level; NaN where
    there is none. A block with no candidate at all, which no two views saw at the coarser level, searches the least.
    """
    block = options.block
    grow = np.ones((4 * options.reach + 1,) * 2, np.uint8)
    lowest = _by_block(cv2.erode(np.where(np.isnan(low), UNKNOWN, low), grow), block, np.minimum)
    highest = _by_block(cv2.dilate(np.where(np.isnan(high), -UNKNOWN, high), grow), block, np.maximum)
    known = lowest <= highest
    last = -(-n_steps // LANES) * LANES - 1
    first = np.where(known, np.floor(np.where(known, lowest, 0)) - options.margin_steps, 0)
    end = np.where(known, np.ceil(np.where(known, highest, 0)) + options.margin_steps, 0)
    first, end = np.clip(first, 0, last), np.clip(end, 0, last)
    count = np.minimum(-(-(end - first + 1) // LANES) * LANES, last + 1).astype(np.int64)
    first = np.minimum(first, last + 1 - count).astype(np.int64)
    return HeightLattice(origin_m, step_m, shape, block, first, count)


def _by_block(values: NDArray[np.float32], block: int, reduce: np.ufunc) -> NDArray[np.float32]:
    """Reduce (r, c) to blocks (b, d)."""
    rows = np.arange(0, values.shape[0], block)
    cols = np.arange(0, values.shape[1], block)
    return np.asarray(reduce.reduceat(reduce.reduceat(values, rows, axis=0), cols, axis=1))
