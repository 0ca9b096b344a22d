"""The image at whose edges heights may jump: of the views of a tile, the first that shows what the others show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.contrast import Part
from zlocus.matching.ortho import ortho_image
from zlocus.matching.views import TileViews

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
