"""Where water is possible: dark areas in which the images agree at no height, among flat ground that is not lower.

The areas are looked for on blocks of cells, so that memory is bounded on large grids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import WaterOptions
from zlocus.matching.quality import Quality
from zlocus.matching.water_level import is_confident

FloatGrid = NDArray[np.float32]
BoolGrid = NDArray[np.bool_]
# A window of this side holds enough independent correlations, which are those of windows of 7 or 9 cells.
WINDOW_CELLS = 15
# Least share of a window that two images see.
MIN_SEEN_SHARE = 0.3
# An area grows back from the middles of windows to its shore over blocks of which this share of the cells is unmatched.
MIN_SHARE_AT_SHORE = 0.5
# Heights around an area are taken from blocks at this distance from it; whether they lie lower, up to the second one.
NEAR_CELLS, FAR_CELLS = 8, 32
MIN_RIM_BLOCKS = 8
# Water lies lowest: of the surroundings at most this share is lower than the rim by more than `max_rim_m`.
MAX_SHARE_LOWER = 0.25
# Of what is as bright as the brightest tenth of the other ground, the images say nothing because it saturates the
# sensor: snow and white roofs.
MAX_BRIGHTNESS_PERCENTILE = 90.0


@dataclass
class WaterBlocks:
    """Counts and heights of square blocks of cells.

    side : cells; seen : (r, c) float32, number of cells that two images see; unmatched : those on which they do not
    agree; height : m, mean of the confident heights, NaN without any; matched : m, mean of all heights; grey : mean of
    the grey values of cells with a height.
    """

    side: int
    seen: FloatGrid
    unmatched: FloatGrid
    height: FloatGrid
    matched: FloatGrid
    grey: FloatGrid

    @classmethod
    def empty(cls, shape: tuple[int, int], side: int) -> WaterBlocks:
        """Blocks without any cell. shape : rows and columns of the grid."""
        rows, cols = (-(-n // side) for n in shape)
        counts = (np.zeros((rows, cols), np.float32) for _ in range(2))
        return cls(side, *counts, *(np.full((rows, cols), np.nan, np.float32) for _ in range(3)))

    def add(
        self, row: int, height: FloatGrid, quality: NDArray[np.uint16], grey: NDArray[Any], is_known: BoolGrid
    ) -> None:
        """Add whole rows of blocks.

        row : first row of cells; height : (r, c) m; quality : (r, c) uint16; grey : (r, c), of the ortho-image;
        is_known : (r, c) bool, cells of water surfaces that are known already and do not count.
        """
        seen = ((quality & np.uint16(Quality.OUTSIDE | Quality.UNSEEN)) == 0) & ~is_known
        unmatched = seen & ((quality & np.uint16(Quality.WEAK | Quality.NO_MATCH)) != 0)
        is_matched, is_sure = np.isfinite(height) & ~is_known, is_confident(height, quality) & ~is_known
        first, z = row // self.side, np.where(is_matched, height, np.float32(0.0))
        n = -(-height.shape[0] // self.side)
        rows = slice(first, first + n)
        self.seen[rows], self.unmatched[rows] = self._sums(seen), self._sums(unmatched)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.height[rows] = self._sums(np.where(is_sure, z, np.float32(0.0))) / self._sums(is_sure)
            self.matched[rows] = self._sums(z) / self._sums(is_matched)
            self.grey[rows] = self._sums(np.where(is_matched, grey, 0.0)) / self._sums(is_matched)

    def _sums(self, values: NDArray[np.generic]) -> FloatGrid:
        """Sums over the blocks of some rows of cells."""
        side, (rows, cols) = self.side, values.shape
        whole = np.pad(values, ((0, -rows % side), (0, -cols % side)))
        return np.asarray(whole.reshape(-(-rows // side), side, -1, side).sum(axis=(1, 3), dtype=np.float32))


@dataclass(frozen=True)
class WaterArea:
    """An area of possible water. row, col : of its first block; is_water : (r, c) bool, its blocks from there on."""

    row: int
    col: int
    is_water: BoolGrid


def possible_water(blocks: WaterBlocks, cell_m: float, options: WaterOptions) -> list[WaterArea]:
    """Areas of possible water, from north to south. cell_m : side of a cell."""
    candidate = _unmatched_areas(blocks, options.min_unmatched_share)
    n, labels, boxes, _ = cv2.connectedComponentsWithStats(candidate, connectivity=4)
    block_m2 = (blocks.side * cell_m) ** 2
    found = []
    for number in range(1, n):
        col, row, cols, rows, n_blocks = (int(value) for value in boxes[number])
        if n_blocks * block_m2 < options.min_area_m2:
            continue
        reach = _reach(FAR_CELLS, blocks.side, 4)
        near = slice(max(row - reach, 0), row + rows + reach), slice(max(col - reach, 0), col + cols + reach)
        if _lies_flat(blocks, near, labels[near] == number, options.max_rim_m) and _is_dark(
            blocks.grey, labels == number
        ):
            found.append(WaterArea(row, col, labels[row : row + rows, col : col + cols] == number))
    return found


def _unmatched_areas(blocks: WaterBlocks, min_share: float) -> NDArray[np.uint8]:
    """(r, c) uint8: 1 in blocks of areas in which the images agree at no height."""
    width = max(1, round(WINDOW_CELLS / blocks.side)) | 1
    window = (width, width)
    seen, unmatched = (
        cv2.blur(counts, window, borderType=cv2.BORDER_CONSTANT) for counts in (blocks.seen, blocks.unmatched)
    )
    share = np.where(seen > MIN_SEEN_SHARE * blocks.side**2, unmatched / np.maximum(seen, np.float32(1e-6)), 0.0)
    middle = ((share >= min_share) & (blocks.seen > 0)).astype(np.uint8)
    grown = cv2.dilate(middle, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, window)) > 0
    return np.asarray(grown & (share >= MIN_SHARE_AT_SHORE) & (blocks.seen > 0), np.uint8)


def _lies_flat(blocks: WaterBlocks, part: tuple[slice, slice], is_area: BoolGrid, max_rim_m: float) -> bool:
    """Whether the rim of an area is flat and lies lowest, and the area does not stand above it.

    part : rows and columns of the blocks around the area; is_area : (r, c) bool, its blocks among these. Of the rim the
    lowest quarter counts, because banks and trees rise from a shore.
    """
    inside = is_area.astype(np.uint8)
    touching, near, far = (
        cv2.dilate(inside, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        for reach in (1, _reach(NEAR_CELLS, blocks.side, 2), _reach(FAR_CELLS, blocks.side, 4))
    )
    height = blocks.height[part]
    rim, around = (height[ring & ~touching & np.isfinite(height)] for ring in (near, far))
    if len(rim) < MIN_RIM_BLOCKS:
        return False
    lowest, level = np.percentile(rim, (10.0, 25.0))
    matched = blocks.matched[part][is_area]
    stands_above = np.nanpercentile(matched, 25.0) > level + max_rim_m if np.isfinite(matched).any() else False
    is_lower = float((around < lowest - max_rim_m).mean()) > MAX_SHARE_LOWER
    return bool(level - lowest <= max_rim_m / 2.0 and not is_lower and not stands_above)


def _is_dark(grey: FloatGrid, is_area: BoolGrid) -> bool:
    """Whether an area is darker than the brightest other ground. grey : (r, c), NaN where unknown; is_area : (r, c)."""
    area, others = (grey[part & np.isfinite(grey)] for part in (is_area, ~is_area))
    if not (len(area) and len(others)):
        return True
    return bool(np.median(area) < np.percentile(others, MAX_BRIGHTNESS_PERCENTILE))


def _reach(cells: int, side: int, least: int) -> int:
    """A distance in cells as a number of blocks, at least so many."""
    return max(least, round(cells / side))
