"""Surface of a tile by stereo selection (Ji et al. 2014), each cell by itself: `zlocus dsm --selection paper`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions
from zlocus.matching.match_curve import FAIR, POOR
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.stereo_selection import (
    CELLS_AT_ONCE,
    REFERENCE,
    SelectedMatch,
    SelectionArea,
    all_cells,
    match_cells,
    selection_area,
)
from zlocus.matching.surface import Surface
from zlocus.matching.tile import TileResult
from zlocus.matching.true_ortho import ortho_image


def match_tile_of_paper(match_scene: MatchScene, core_window: CellWindow, config: RunConfig) -> TileResult:
    """Match the cells of a tile, each with the search images that the feature points around it choose.

    The tie points of the match scene are the feature points. Those within the radius around the tile count. The surface
    has no standard deviations, because the paper gives no precision; its ortho-image is that of the reference image.
    """
    halo = math.ceil(config.selection.radius_px)
    window = core_window.at_level(0, halo).within(match_scene.overlap_window)
    surface = Surface.nothing(core_window)
    area = selection_area(match_scene, window, config) if core_window.rows and core_window.cols else None
    if area is None:
        return TileResult(surface)
    cells = all_cells(core_window) + np.array([core_window.row - window.row, core_window.col - window.col])
    cells = cells[((cells >= 0) & (cells < (window.rows, window.cols))).all(axis=1)]
    done = all_images = 0
    for first in range(0, len(cells), CELLS_AT_ONCE):
        part = cells[first : first + CELLS_AT_ONCE]
        match = match_cells(area, part, config)
        row, col = (part + np.array([window.row - core_window.row, window.col - core_window.col])).T
        quality = quality_of(match, config.selection)
        index = np.where(is_empty(quality), np.nan, match.lattice_index(config.selection.reach_steps))
        surface.height[row, col] = match_scene.height_origin + index * match_scene.height_step
        surface.quality[row, col] = quality
        surface.views[row, col] = np.where(np.isnan(index), 0, match.progress.n_images + 1)
        done, all_images = done + match.progress.evaluations, all_images + match.progress.evaluations_all
    _add_grey_values(surface, core_window, match_scene, area)
    return TileResult(surface, done, all_images)


def quality_of(match: SelectedMatch, options: SelectionOptions) -> NDArray[np.uint16]:
    """Flags of matched cells, (n,) uint16, see `Quality`.

    A curve without any correlation is UNSEEN. A peak without a visible neighbour on both sides lies at an end of the
    search range: RANGE_END. A poor curve is NO_MATCH. A fair one is AMBIGUOUS where its rho1 would do for a good one,
    else WEAK.
    """
    curves, peaks, label = match.progress.mean_ncc, match.peaks, match.progress.label
    n, n_heights = curves.shape
    beside = np.stack([peaks.peak - 1, peaks.peak + 1], axis=1)
    is_inside = ((beside >= 0) & (beside < n_heights)).all(axis=1)
    neighbours = np.take_along_axis(curves, np.clip(beside, 0, n_heights - 1), axis=1)
    is_at_end = ~(is_inside & np.isfinite(neighbours).all(axis=1))
    is_high = peaks.rho1 > options.rho1_low
    quality = np.zeros(n, np.uint16)
    for cells, flag in (
        (np.isnan(peaks.rho1), Quality.UNSEEN),
        (is_at_end & np.isfinite(peaks.rho1), Quality.RANGE_END),
        ((label == POOR) & np.isfinite(peaks.rho1), Quality.NO_MATCH),
        ((label == FAIR) & is_high, Quality.AMBIGUOUS),
        ((label == FAIR) & ~is_high, Quality.WEAK),
    ):
        quality[cells] |= np.uint16(flag)
    return quality


def _add_grey_values(surface: Surface, core_window: CellWindow, match_scene: MatchScene, area: SelectionArea) -> None:
    """Write the grey values of the reference image where the surface has heights; changes `surface.ortho`."""
    window, index = area.window, area.initial.copy()
    shared = core_window.within(window)
    to, since = shared.slices_in(core_window), shared.slices_in(window)
    found = (surface.height[to] - match_scene.height_origin) / match_scene.height_step
    index[since] = np.where(np.isfinite(found), found, index[since])
    scale = match_scene.grey_scales[REFERENCE]
    grey = ortho_image(area.tile_views, np.ascontiguousarray(index, np.float32), REFERENCE)[since]
    grey = grey * np.float32(scale.contrast) + np.float32(scale.mean)
    surface.ortho[to] = np.where(np.isfinite(surface.height[to]), grey, np.float32(np.nan))
