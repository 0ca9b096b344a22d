"""Between which heights the surface is expected around a place, as the tie points there suggest.

Images that look alike at many heights agree by chance somewhere in a wide search range. Tie points tell in advance
where the surface lies: most of them are right, and features of wide windows found them. So the coarsest level, where
nothing else is known yet, charges a cost for heights far from all nearby tie points. Images that clearly agree at such
a height pay it, as at a tower that carries no tie point; chance does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.core.nearest_points import nearest_points
from zlocus.core.sensor_model import limited_margin, lowest_station
from zlocus.matching.level_records import PyramidLevel, SearchPrior
from zlocus.matching.match_scene import MatchScene

FloatGrid = NDArray[np.float32]

# Expected heights are the same for squares of so many coarsest cells.
SQUARE_CELLS = 8
# Tie points nearest to a square whose heights count, how many of the lowest and of the highest are left out as
# possibly false, and how many must be near enough to count at all.
NEIGHBOURS, LEFT_OUT, MIN_NEAR = 16, 1, 8
# Expected below the lowest and above the highest of them, m: single trees and roofs carry no tie points.
BELOW_M, ABOVE_M = 2.0, 25.0
# The ground may rise or fall by so much between a place and the nearest tie point, m per m. Ties so far away that they
# could lie anywhere in the expected range are left out.
MAX_SLOPE = 0.5


def expected_heights(
    match_scene: MatchScene, level: PyramidLevel, has_margins: bool = True
) -> tuple[FloatGrid, FloatGrid] | None:
    """Lowest and highest expected height of each cell, (r, c) float32 level indices; None where no ties tell.

    Around each place they are those of the nearest tie points, within the range of all of them. has_margins : whether
    objects without tie points are expected too, below and above them.
    """
    ties, in_scene = match_scene.trusted_ties, match_scene.expected_range
    if in_scene is None or not len(ties):
        return None
    places = _middles_of_squares(match_scene, level)
    margins = (BELOW_M, _above_m(match_scene, in_scene)) if has_margins else (0.0, 0.0)
    low, high = _of_nearest(places.reshape(-1, 2), ties, in_scene, margins)
    rows, cols = level.shape
    bounds = []
    for z in (low, high):
        of_squares = ((z - level.height_origin) / level.height_step).astype(np.float32).reshape(places.shape[:2])
        cells = of_squares.repeat(SQUARE_CELLS, axis=0).repeat(SQUARE_CELLS, axis=1)
        offset_row, offset_col = level.window.row % SQUARE_CELLS, level.window.col % SQUARE_CELLS
        bounds.append(np.ascontiguousarray(cells[offset_row : offset_row + rows, offset_col : offset_col + cols]))
    return bounds[0], bounds[1]


def expected_of_searched(
    match_scene: MatchScene, level: PyramidLevel, prior: SearchPrior
) -> tuple[FloatGrid, FloatGrid]:
    """Lowest and highest expected height of each cell among those searched, (r, c) float32 level indices."""
    expected = expected_heights(match_scene, level)
    if expected is None:
        return prior.low, prior.high
    return np.maximum(prior.low, expected[0]), np.minimum(prior.high, expected[1])


def _middles_of_squares(match_scene: MatchScene, level: PyramidLevel) -> NDArray[np.float64]:
    """Middles (p, q, 2) m of the squares of cells that a level's window meets; squares are those of the whole lattice,
    so that they do not depend on the tile."""
    window, transform = level.window, match_scene.transform(level.window, level.number)
    row, col = (
        (np.arange(first // SQUARE_CELLS, (first + count - 1) // SQUARE_CELLS + 1) + 0.5) * SQUARE_CELLS - first
        for first, count in ((window.row, window.rows), (window.col, window.cols))
    )
    cols, rows = np.meshgrid(col, row)
    return np.stack(transform * (cols, rows), axis=-1)


def _above_m(match_scene: MatchScene, in_scene: tuple[float, float]) -> float:
    """How far above tie points the surface is expected, m."""
    station = lowest_station(view.sensor for view in match_scene.views)
    return limited_margin(ABOVE_M, in_scene[0], station)


def _of_nearest(
    places: NDArray[np.float64], ties: NDArray[np.float64], in_scene: tuple[float, float], margins: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest height (m) that the ties (n, 3) around each of some places (m, 2) suggest.

    margins : below the lowest and above the highest of them, m.
    """
    far = (in_scene[1] - in_scene[0]) / MAX_SLOPE
    low, high = np.full(len(places), in_scene[0]), np.full(len(places), in_scene[1])
    lowest, highest = places.min(axis=0) - far, places.max(axis=0) + far
    ties = ties[((ties[:, :2] >= lowest) & (ties[:, :2] <= highest)).all(axis=1)]
    if len(ties) < NEIGHBOURS:
        return low, high
    distance, near = nearest_points(ties[:, :2], NEIGHBOURS, places)
    is_near = distance <= far
    enough = is_near.sum(axis=1) >= MIN_NEAR
    z = ties[near, 2]
    z_low = np.sort(np.where(is_near, z, np.inf), axis=1)[:, LEFT_OUT]
    z_high = -np.sort(np.where(is_near, -z, np.inf), axis=1)[:, LEFT_OUT]
    rise = MAX_SLOPE * distance[:, 0]
    low[enough] = np.maximum(low, z_low - margins[0] - rise)[enough]
    high[enough] = np.minimum(high, z_high + margins[1] + rise)[enough]
    return low, high
