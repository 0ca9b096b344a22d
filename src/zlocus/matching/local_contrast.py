"""How much the ground's grey values differ: the units of what counts as an edge, and as plain."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.median import median
from zlocus.matching.tile_views import TileViews
from zlocus.matching.true_ortho import ortho_image

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


# Agreement with the other views, as a share of the best one's, that a view needs to lead: noise, clouds and the shadows
# of another hour have edges where nothing stands.
AGREES = 0.8
# Cells that two views must share for their agreement to mean anything.
FEWEST_SHARED = 64


def agreement(
    views: TileViews, surface: NDArray[np.float32], covering: NDArray[np.bool_], core: Part
) -> NDArray[np.float64]:
    """How alike each view is to the others: the median of its correlations with them over the core, (i,).

    surface : (r, c) height indices on which they are compared; covering : (i, r, c) bool, which views cover which cells
    at some of the heights searched. NaN for a view that shares too little with any.
    """
    shown = covering[:, *core].reshape(len(covering), -1)
    grey = np.stack([ortho_image(views, surface, view)[core].ravel() for view in range(len(covering))])
    grey, count = np.where(shown, grey, np.float32(0.0)).astype(np.float64), shown.astype(np.float64)
    n = np.maximum(count @ count.T, 1.0)
    mean = (grey @ count.T) / n
    variance = (grey**2 @ count.T) / n - mean**2
    covariance = (grey @ grey.T) / n - mean * mean.T
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = covariance / np.sqrt(variance * variance.T)
    alike[n < FEWEST_SHARED] = np.nan
    np.fill_diagonal(alike, np.nan)
    found, known = np.full(len(alike), np.nan), np.isfinite(alike).any(axis=1)
    found[known] = np.nanmedian(alike[known], axis=1)
    return found


def edge_image(
    views: TileViews,
    surface: NDArray[np.float32],
    covering: NDArray[np.bool_],
    core: Part,
    agrees: NDArray[np.float64],
) -> NDArray[np.float32]:
    """The leading view of a tile on a surface (r, c), NaN where it covers nothing.

    That is the first that agrees with the others and covers half as much of the core, or more, as any that does.
    covering : (i, r, c) bool, as for `agreement`, which gives `agrees` (i,).
    """
    best = np.nanmax(agrees, initial=0.0)
    trusted = ~(agrees < AGREES * best) if best > 0 else np.ones(len(agrees), np.bool_)
    shown = covering[:, *core].sum(axis=(1, 2))
    view = int(np.flatnonzero(trusted & (shown >= shown[trusted].max() / 2))[0])
    return np.where(covering[view], ortho_image(views, surface, view), np.float32(np.nan))
