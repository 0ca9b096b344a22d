"""Filled gaps of a surface: interpolated or taken from a terrain model, and marked as such."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.kernels.fill import interpolate_gaps
from zlocus.matching.quality import Quality, with_filled
from zlocus.matching.surface import Surface


def filled(surface: Surface, max_distance_cells: int) -> Surface:
    """The surface with gaps interpolated from the nearest heights in eight directions, up to a distance in cells.

    Cells that fewer than two images cover, or outside the requested area, stay empty. Filled cells get `Quality.FILLED`
    beside the flag that says why they were empty, 0 images, and no sigma.
    """
    is_excluded = (surface.quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
    height = np.empty_like(surface.height)
    interpolate_gaps(surface.height, is_excluded, max_distance_cells, height)
    is_filled = np.isnan(surface.height) & np.isfinite(height)
    return _with_heights(surface, is_filled, height)


def filled_from(surface: Surface, terrain: NDArray[np.float32]) -> Surface:
    """The surface with heights of a terrain model in its empty cells inside the requested area.

    terrain : (r, c) ellipsoidal m, NaN where it has no height. Filled cells are marked as in `filled`.
    """
    outside = (surface.quality & np.uint16(Quality.OUTSIDE)) != 0
    is_filled = np.isnan(surface.height) & np.isfinite(terrain) & ~outside
    return _with_heights(surface, is_filled, np.where(is_filled, terrain, surface.height))


def _with_heights(surface: Surface, is_filled: NDArray[np.bool_], height: NDArray[np.float32]) -> Surface:
    """The surface with the given heights and the flag FILLED in filled cells."""
    quality = with_filled(surface.quality, is_filled)
    return Surface(height, surface.sigma, quality, surface.views, surface.ortho)


FloatGrid = NDArray[np.float32]
DIRECTIONS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))


def filled_from_behind(height: FloatGrid, is_excluded: NDArray[np.bool_]) -> FloatGrid:
    """Heights with gaps filled by the second lowest of the nearest heights in eight directions.

    An occluded place lies behind its occluder, so the gap gets a low height, not the mean.

    height : (r, c) float32, larger is nearer, NaN in gaps; is_excluded : (r, c) bool, gaps that stay.
    Source: Hirschmueller (2008), section 2.6, for occlusions. There other gaps get the median of the eight heights.
    Here all gaps are filled alike, because most are beside a jump, where the median belongs to the nearer side.
    """
    gaps = np.isnan(height) & ~is_excluded
    if not gaps.any():
        return height
    around = np.stack([nearest(height, *step)[gaps] for step in DIRECTIONS])
    lowest = np.sort(around, axis=0)  # NaN last
    out = height.copy()
    out[gaps] = np.where(np.isnan(lowest[1]), lowest[0], lowest[1])
    return out


def nearest(height: FloatGrid, by_row: int, by_col: int) -> FloatGrid:
    """The nearest height (r, c) of each cell in a direction; NaN where there is none. by_row, by_col : -1, 0 or 1."""
    if by_row == 0:
        return nearest(height.T, by_col, 0).T
    out = height.copy()
    rows, cols = height.shape
    to, since = slice(max(-by_col, 0), cols - max(by_col, 0)), slice(max(by_col, 0), cols - max(-by_col, 0))
    for row in range(1, rows) if by_row < 0 else range(rows - 2, -1, -1):
        line, before = out[row, to], out[row + by_row, since]
        np.copyto(line, before, where=np.isnan(line))
    return out
