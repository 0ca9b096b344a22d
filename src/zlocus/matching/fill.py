"""Heights for gaps, for those who want none: interpolated, and marked as such."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.fill import interpolate_gaps
from zlocus.matching.quality import Quality
from zlocus.matching.surface import Surface


def filled(surface: Surface, reach: int) -> Surface:
    """The surface, (r, c), with gaps interpolated from the nearest heights in eight directions, at most `reach` cells
    away.

    Cells that no two images cover, or that were not asked for, stay empty. Filled cells carry `Quality.FILLED` beside
    the reason why they were empty, use 0 images, and have no sigma.
    """
    beyond = (surface.quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
    height = np.empty_like(surface.height)
    interpolate_gaps(surface.height, beyond, reach, height)
    gained = np.isnan(surface.height) & np.isfinite(height)
    return _with_heights(surface, gained, height)


def filled_from(surface: Surface, terrain: NDArray[np.float32]) -> Surface:
    """The surface with other heights, (r, c) ellipsoidal m, NaN where there are none, in all its empty cells that were
    asked for; they carry `Quality.FILLED` as those of `filled` do."""
    outside = (surface.quality & np.uint16(Quality.OUTSIDE)) != 0
    gained = np.isnan(surface.height) & np.isfinite(terrain) & ~outside
    return _with_heights(surface, gained, np.where(gained, terrain, surface.height))


def _with_heights(surface: Surface, gained: NDArray[np.bool_], height: NDArray[np.float32]) -> Surface:
    quality = np.where(gained, surface.quality | np.uint16(Quality.FILLED), surface.quality)
    return Surface(height, surface.sigma, quality, surface.views, surface.ortho)


FloatGrid = NDArray[np.float32]
DIRECTIONS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))


def filled_from_behind(height: FloatGrid, beyond: NDArray[np.bool_]) -> FloatGrid:
    """Gaps with the second lowest of the nearest heights in eight directions: what is hidden lies behind what hides it.

    height : (r, c) float32, the higher the nearer, NaN in gaps; beyond : (r, c) bool, gaps to be left.
    Source: Hirschmueller (2008), section 2.6, for occlusions. He gives other gaps the median of the eight; here they
    are filled alike, for most are beside a jump too, where the median is the nearer side's.
    """
    gaps = np.isnan(height) & ~beyond
    if not gaps.any():
        return height
    around = np.stack([nearest(height, *step)[gaps] for step in DIRECTIONS])
    lowest = np.sort(around, axis=0)  # NaN last
    out = height.copy()
    out[gaps] = np.where(np.isnan(lowest[1]), lowest[0], lowest[1])
    return out


def nearest(height: FloatGrid, by_row: int, by_col: int) -> FloatGrid:
    """The first height met from each cell in one direction; NaN where there is none. (r, c) -> (r, c)"""
    if by_row == 0:
        return nearest(height.T, by_col, 0).T
    out = height.copy()
    rows, cols = height.shape
    to, since = slice(max(-by_col, 0), cols - max(by_col, 0)), slice(max(by_col, 0), cols - max(-by_col, 0))
    for row in range(1, rows) if by_row < 0 else range(rows - 2, -1, -1):
        line, before = out[row, to], out[row + by_row, since]
        np.copyto(line, before, where=np.isnan(line))
    return out
