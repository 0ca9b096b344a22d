"""Surface of a tile by stereo selection (Ji et al. 2014), each cell by itself: `zlocus dsm --selection paper`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig, SelectionOptions
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_curve import FAIR, POOR
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.stereo_selection import (
    CELLS_AT_ONCE,
    REFERENCE,
    SelectedMatch,
    all_cells,
    match_cells,
    selection_area,
)
from zlocus.matching.surface import Surface
from zlocus.matching.tile import TileResult


def match_tile_of_paper(
    match_scene: MatchScene, core_window: CellWindow, kept_window: CellWindow, config: RunConfig
) -> TileResult:
    """Match the kept cells of a tile, each with the search images that the feature points around it choose.

    The tie points of the match scene are the feature points. Those within the radius around the core count, so that the
    height of a cell does not depend on the cells that are kept; the other cells of the core stay empty. The surface has
    no standard deviations, because the paper gives no precision; its ortho-image is that of the reference image.
    """
    halo = math.ceil(config.selection.radius_px)
    window = core_window.at_level(0, halo).within(match_scene.overlap_window)
    surface = Surface.nothing(core_window)
    area = selection_area(match_scene, window, config) if core_window.rows and core_window.cols else None
    if area is None:
        return TileResult(surface)
    matched = kept_window.within(core_window).within(window)
    cells = all_cells(matched) + np.array([matched.row - window.row, matched.col - window.col])
    done = all_images = 0
    for first in range(0, len(cells), CELLS_AT_ONCE):
        part = cells[first : first + CELLS_AT_ONCE]
        match = match_cells(area, part, config)
        row, col = (part + np.array([window.row - core_window.row, window.col - core_window.col])).T
        quality = quality_of(match, config.selection)
        index = np.where(is_empty(quality), np.nan, match.lattice_index(config.selection.reach_steps))
        surface.height[row, col] = match_scene.height_origin + index * match_scene.height_step
        surface.quality[row, col] = quality
        surface.views[row, col] = np.where(np.isnan(index), 0, match.progressive_match.n_images + 1)
        done, all_images = (
            done + match.progressive_match.evaluations,
            all_images + match.progressive_match.evaluations_all,
        )
    _add_grey_values(surface, core_window, match_scene)
    return TileResult(surface, done, all_images)


def quality_of(match: SelectedMatch, options: SelectionOptions) -> NDArray[np.uint16]:
    """Flags of matched cells, (n,) uint16, see `Quality`.

    A curve without any correlation is UNSEEN. A peak without a visible neighbour on both sides lies at an end of the
    search range: RANGE_END. A poor curve is NO_MATCH. A fair one is AMBIGUOUS where its rho1 would do for a good one,
    else WEAK.
    """
    curves, peaks, label = match.progressive_match.mean_ncc, match.peaks, match.progressive_match.label
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


def _add_grey_values(surface: Surface, core_window: CellWindow, match_scene: MatchScene) -> None:
    """Write the grey values of the reference image where the surface has heights; changes `surface.ortho`."""
    row, col = np.nonzero(np.isfinite(surface.height))
    if not len(row):
        return
    cells = np.column_stack([col + core_window.col + 0.5, -(row + core_window.row + 0.5)])
    xy = match_scene.anchor + cells * match_scene.cell_size
    xyz = np.column_stack([xy, surface.height[row, col].astype(np.float64)])
    surface.ortho[row, col] = grey_values(match_scene.views[REFERENCE], xyz)


def grey_values(view: View, xyz: FloatArray) -> NDArray[np.float32]:
    """Grey values that a view shows at ground points, (n,) float32, bilinear. xyz : (n, 3) m, inside the image."""
    rows, cols = view.image.shape
    xy = np.clip(view.sensor.image_from_ground(xyz), 0.0, (cols - 1.0, rows - 1.0))
    left, top = np.minimum(np.floor(xy).astype(np.int64), (max(cols - 2, 0), max(rows - 2, 0))).T
    first_row, first_col = int(top.min()), int(left.min())
    n_rows, n_cols = min(int(top.max()) + 2, rows) - first_row, min(int(left.max()) + 2, cols) - first_col
    pixels = view.image.read(first_row, first_col, n_rows, n_cols).pixels
    x, y = (xy - np.column_stack([left, top])).astype(np.float32).T
    r, c = top - first_row, left - first_col
    high = pixels[r, c] + x * (pixels[r, c + 1] - pixels[r, c])
    low = pixels[r + 1, c] + x * (pixels[r + 1, c + 1] - pixels[r + 1, c])
    return np.asarray(high + y * (low - high), np.float32)
