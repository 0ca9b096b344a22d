"""Search range: between which heights each cell of a level is searched, before the heights are grouped by blocks.

The coarsest level searches the whole height range of the scene, or what a terrain model leaves of it. Each finer level
searches around what the coarser level found: the best height, a second height of nearly the same cost, the height that
neighbouring cells agree on without the semi-global constraint, and the tie points. All heights here are level indices
(see `zlocus.matching.height_lattice`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import on_cells
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.matching.height_lattice import LANES, shared_heights, without_spikes
from zlocus.matching.level_records import LevelResult, PyramidLevel, SearchPrior, TileInputs
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.occlusion import PAIR, covers
from zlocus.matching.view_selection import curve_reach_steps

# Path cost units: a second minimum whose cost is larger by less than this is searched again one level down.
MAX_COST_MARGIN_OF_SECOND_HEIGHT = 128
# Projection tables extend this many steps below and above the height range, for margins, windows and vector lanes.
TABLE_STEPS_BELOW, TABLE_STEPS_ABOVE = 2, 18

FloatGrid = NDArray[np.float32]


def coarsest_prior(match_scene: MatchScene, level: PyramidLevel, surface: FloatGrid | None) -> SearchPrior:
    """Search prior of the coarsest level: the height range of the scene, or what a terrain model leaves of it.

    surface : (r, c) heights of a first pass over this level, None before it.
    """
    low = np.zeros(level.shape, np.float32)
    high = np.full(level.shape, level.n_steps - 1, np.float32)
    if match_scene.dem_limits is not None:
        limits_window = match_scene.overlap_window.at_level(level.number, 0)
        limits = np.stack([on_cells(bound, limits_window, level.window, 0) for bound in match_scene.dem_limits])
        from_dem = (limits - np.float32(level.height_origin)) / np.float32(level.height_step)
        low, high = (
            np.where(np.isnan(from_dem[0]), low, from_dem[0]),
            np.where(np.isnan(from_dem[1]), high, from_dem[1]),
        )
    return SearchPrior(surface, low, high)


def prior_from_coarser(tile: TileInputs, level: PyramidLevel, coarser_result: LevelResult) -> SearchPrior:
    """Search prior of a level from the result of the next coarser one."""
    surface = 2 * on_cells(coarser_result.heights.vertex, coarser_result.level.window, level.window)
    low, high = range_from_coarser(tile.match_scene, coarser_result, level, tile.config.pyramid)
    return SearchPrior(surface, low, high, coarser_result)


def range_from_coarser(
    match_scene: MatchScene, coarser_result: LevelResult, level: PyramidLevel, options: PyramidOptions
) -> tuple[FloatGrid, FloatGrid]:
    """Lowest and highest height to search in each cell, two (r, c) float32 arrays; NaN where fewer than two views."""
    is_seen = covers(coarser_result.visible).sum(axis=0) >= PAIR
    found = candidates(coarser_result, options)
    low, high = without_spikes(found.min(axis=0).astype(np.float32), found.max(axis=0).astype(np.float32), is_seen)
    low, high = (2 * on_cells(bound, coarser_result.level.window, level.window) for bound in (low, high))
    _widen_to_ties(match_scene, level, low, high)
    return low, high


def candidates(coarser_result: LevelResult, options: PyramidOptions) -> NDArray[np.int32]:
    """Heights of a level between which the next finer one searches, (3, r, c) int32 level indices of the coarser level.

    The best height; a second one of nearly the same cost; and the winner-takes-all height where neighbours agree on it.
    The last is there because the semi-global constraint removes a tower or a tree of few coarse cells: its cells agree
    with each other, but are too few to pay for the jump at its edges (see `shared_heights`).
    """
    heights, winner_takes_all = coarser_result.heights, coarser_result.winner_takes_all
    assert winner_takes_all is not None, "of every level but the finest"
    second = np.where(heights.uniqueness < MAX_COST_MARGIN_OF_SECOND_HEIGHT, heights.second, heights.best)
    shared = shared_heights(winner_takes_all, heights.best, coarser_result.slope_surface.cells, options)
    return np.stack([heights.best, second, shared])


def _widen_to_ties(match_scene: MatchScene, level: PyramidLevel, low: FloatGrid, high: FloatGrid) -> None:
    """Widen the search ranges of cells to the tie points and break lines in them; changes `low` and `high`."""
    ties, window = match_scene.ties, level.window
    if match_scene.break_lines is not None:
        ties = np.concatenate([ties, match_scene.break_lines.held])
    if not len(ties):
        return
    side = match_scene.cell_size * 2**level.number
    col = np.floor((ties[:, 0] - match_scene.anchor[0]) / side).astype(int) - window.col
    row = np.floor((match_scene.anchor[1] - ties[:, 1]) / side).astype(int) - window.row
    inside = (row >= 0) & (row < window.rows) & (col >= 0) & (col < window.cols)
    level_index = ((ties[inside, 2] - level.height_origin) / level.height_step).astype(np.float32)
    np.fmin.at(low, (row[inside], col[inside]), level_index)
    np.fmax.at(high, (row[inside], col[inside]), level_index)


def table_range(level: PyramidLevel) -> tuple[float, float]:
    """Lowest and highest height (m) of a level's projection tables: its height range, extended by a few steps."""
    return (
        level.height_origin - TABLE_STEPS_BELOW * level.height_step,
        level.height_origin + (level.n_steps + TABLE_STEPS_ABOVE) * level.height_step,
    )


def reachable_range(level: PyramidLevel, prior: SearchPrior, config: RunConfig) -> tuple[float, float]:
    """The part of `table_range` (m) that the search ranges of a prior, their margins and match curves can reach."""
    z_range = table_range(level)
    is_known = np.isfinite(prior.low) & np.isfinite(prior.high)
    if not is_known.any():
        return z_range
    margin = config.pyramid.margin_steps + LANES + curve_reach_steps(level.number, config.selection)
    low, high = float(prior.low[is_known].min()) - margin, float(prior.high[is_known].max()) + margin
    return max(z_range[0], level.height_origin + low * level.height_step), min(
        z_range[1], level.height_origin + high * level.height_step
    )
