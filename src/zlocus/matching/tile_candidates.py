"""Which views may show a tile and its halo, on which pixels, and with which of many views the tile is matched."""

from __future__ import annotations

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.sensor_model import lowest_station
from zlocus.matching.level_records import level_window
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.view_pixels import PixelWindow, window_showing
from zlocus.matching.view_selection import preselected

# Points along each side of a tile with its halo for which views of close cameras are chosen: each view shows a part of
# the tile, and what two views share at the rim of a block may be narrow.
POINTS_OF_CLOSE_CAMERAS = 33


def windows_of(match_scene: MatchScene, core_window: CellWindow, config: RunConfig) -> dict[int, PixelWindow]:
    """The window (row, col, rows, cols) px of each view that may show a tile with its halo, by its number in the scene.

    core_window : finest cells of the tile; the windows are those of the coarsest level.
    """
    coarsest, window = match_scene.levels - 1, _with_halo(match_scene, core_window, config)
    ground_xy, windows = match_scene.points_of(window, coarsest), {}
    for number in match_scene.views_near(ground_xy):
        view_window = window_showing(match_scene.views[number], ground_xy, match_scene.z_range, coarsest)
        if view_window is not None:
            windows[number] = view_window
    return windows


def candidates_of_tile(
    match_scene: MatchScene, core_window: CellWindow, numbers: list[int], config: RunConfig
) -> list[int]:
    """The best candidates of the views with some numbers, ascending, see `preselected`; all where they are not many.

    Of close cameras the candidates are those of many points all over the tile, at the lowest, middle and highest of the
    heights at which the surface is expected.
    """
    views = [match_scene.views[n] for n in numbers]
    coarsest, window = match_scene.levels - 1, _with_halo(match_scene, core_window, config)
    if lowest_station(view.sensor for view in views) is None:
        if len(views) <= config.selection.max_candidates + 1:
            return numbers
        ground_xy = match_scene.points_of(window, coarsest)
        rows = preselected(views, ground_xy, match_scene.ground_height, config.selection)
    else:
        if len(views) <= config.selection.max_images_of_point + 1:
            return numbers
        ground_xy = match_scene.points_of(window, coarsest, POINTS_OF_CLOSE_CAMERAS)
        is_core, ends = match_scene.are_in(core_window, ground_xy), match_scene.expected_range or ()
        rows = preselected(views, ground_xy, match_scene.ground_height, config.selection, is_core, ends)
    return [numbers[row] for row in rows]


def _with_halo(match_scene: MatchScene, core_window: CellWindow, config: RunConfig) -> CellWindow:
    """Cells of the coarsest level of a tile with its halo."""
    coarsest, options = match_scene.levels - 1, config.pyramid
    limit_window = match_scene.overlap_window.at_level(coarsest, 0)
    return level_window(core_window, coarsest, options.halo, options.block, limit_window)
