"""How much the grey values of the ground differ: the units in which edges and missing texture are measured."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.matching.median import median
from zlocus.matching.tile_views import TileViews
from zlocus.matching.true_ortho import ortho_image

TEXTURE_CELLS = (5, 5)  # window over which texture is measured
# Units are rounded to powers of two, so many to a doubling, so that small differences between two tiles have no effect.
STEPS_PER_DOUBLING = 8
Part = tuple[slice, slice]
ALL: Part = (slice(None), slice(None))


def edge_unit(ortho: NDArray[np.float32], core: Part = ALL) -> float:
    """Median grey difference of neighbours along the rows of an ortho-image (r, c), in its core; 0 if none is known."""
    away = np.abs(np.diff(ortho[core], axis=1))
    known = away[np.isfinite(away)]
    return rounded(float(median(known))) if known.size else 0.0


def texture_unit(ortho: NDArray[np.float32], core: Part = ALL) -> float:
    """Median standard deviation of grey values (r, c) in small windows of the core; 0 where all values are NaN."""
    grey = ortho[core]
    shown = np.isfinite(grey)
    if not shown.any():
        return 0.0
    return rounded(float(median(deviation(np.where(shown, grey, np.float32(0.0)), TEXTURE_CELLS)[shown])))


def rounded(unit: float) -> float:
    """The nearest power of two, of `STEPS_PER_DOUBLING` to a doubling; 0 for 0."""
    return float(2.0 ** (np.rint(STEPS_PER_DOUBLING * np.log2(unit)) / STEPS_PER_DOUBLING)) if unit > 0 else 0.0


def deviation(grey: NDArray[np.float32], window: tuple[int, int]) -> NDArray[np.float32]:
    """Standard deviation of grey values in a window around each cell, (r, c) float32. window : cells."""
    mean, squares = cv2.blur(grey, window), cv2.blur(grey * grey, window)
    return np.asarray(np.sqrt(np.maximum(squares - mean * mean, 0)), np.float32)


# The images that give edges and plain segments must agree with the other views by at least this share of the best
# agreement: noise, clouds and the shadows of another hour have edges where no object stands, and haze hides a ridge.
MIN_AGREEMENT_SHARE = 0.8
# Cells that two views must share for their agreement to mean anything.
MIN_SHARED_CELLS = 64


def agreement(
    tile_views: TileViews, surface: NDArray[np.float32], covering: NDArray[np.bool_], core: Part
) -> NDArray[np.float64]:
    """How alike each view is to the others: the median of its correlations with them over the core, (i,) float64.

    surface : (r, c) level indices on which they are compared; covering : (i, r, c) bool, which views cover which cells
    at some of the heights searched. NaN for a view that shares too few cells with each other view.
    """
    shown = covering[:, *core].reshape(len(covering), -1)
    grey = np.stack([ortho_image(tile_views, surface, i, shows)[core].ravel() for i, shows in enumerate(covering)])
    grey, count = np.where(shown, grey, np.float32(0.0)).astype(np.float64), shown.astype(np.float64)
    n = np.maximum(count @ count.T, 1.0)
    mean = (grey @ count.T) / n
    variance = (grey**2 @ count.T) / n - mean**2
    covariance = (grey @ grey.T) / n - mean * mean.T
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = covariance / np.sqrt(variance * variance.T)
    alike[n < MIN_SHARED_CELLS] = np.nan
    np.fill_diagonal(alike, np.nan)
    of_view, known = np.full(len(alike), np.nan), np.isfinite(alike).any(axis=1)
    of_view[known] = np.nanmedian(alike[known], axis=1)
    return of_view


def agreeing_views(agrees: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Views that agree with the others well enough to show what is on the ground, (i,); all where nothing is known.

    agrees : (i,), see `agreement`.
    """
    best = np.nanmax(agrees, initial=0.0)
    return ~(agrees < MIN_AGREEMENT_SHARE * best) if best > 0 else np.ones(len(agrees), np.bool_)


def edge_image(
    tile_views: TileViews,
    surface: NDArray[np.float32],
    covering: NDArray[np.bool_],
    core: Part,
    agrees: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Ortho-image of a tile at whose edges heights may jump, (r, c) float32; NaN where the view covers nothing.

    It is that of the first view that agrees with the others and covers at least half as much of the core as any view
    that agrees. Where masked pixels or nodata hide the ground in it, it is that of the next one that agrees and covers
    the cell: without edges, roofs under a mask lose theirs. covering : see `agreement`, which gives `agrees` (i,).
    """
    trusted = agreeing_views(agrees)
    shown = covering[:, *core].sum(axis=(1, 2))
    view = int(np.flatnonzero(trusted & (shown >= shown[trusted].max() / 2))[0])
    edges = np.where(covering[view], ortho_image(tile_views, surface, view, covering[view]), np.float32(np.nan))
    if not tile_views.has_blocked[view]:
        return edges
    for other in np.flatnonzero(trusted).tolist():
        missing = np.isnan(edges) & covering[other]
        if missing.any():
            edges = np.where(missing, ortho_image(tile_views, surface, other, missing), edges)
    return edges
