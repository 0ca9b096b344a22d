"""Heights for gaps, for those who want none: interpolated, and marked as such."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.kernels.fill import interpolate_gaps
from zlocus.surface.reasons import Quality
from zlocus.surface.surface import Surface


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
