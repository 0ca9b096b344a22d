"""Plan of tiles: which cells are matched together, and what memory and time they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from zlocus.core.grid import CellWindow
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.tile import windows_of

# Time to match a cell of a core, and in addition for each view that is compared
# (docs/development/experiments/growth.md).
CELL_S, VIEW_CELL_S = 1.5e-6, 0.45e-6
# Peak memory of a tile: for each cell; for each cell and height step; for each cell and view that is compared; for each
# pixel of the windows of those views.
CELL_BYTES, STEP_BYTES, VIEW_CELL_BYTES, PIXEL_BYTES = 170, 3, 42, 22
STEPS_PER_CELL = 48
# The needs of a run are estimated from at most this many tiles, spread over all.
MAX_SAMPLED_TILES = 64


@dataclass(frozen=True)
class Tile:
    """One tile.

    core_window : matched as a whole, the same for every grid and area; kept_window : its requested part.
    """

    core_window: CellWindow
    kept_window: CellWindow


def plan_tiles(requested_window: CellWindow, overlap_window: CellWindow, options: PyramidOptions) -> list[Tile]:
    """The tiles that contain the requested cells, row by row.

    requested_window, overlap_window : finest cells. Cores are equal parts of the overlap of views, which is a property
    of the scene; so the height of a cell does not depend on the requested area. Cells outside the overlap belong to
    tiles of the same size without a core.
    """
    height, width = core_size(overlap_window, options)
    first_row, first_col = (
        requested_window.row - (requested_window.row - overlap_window.row) % height,
        requested_window.col - (requested_window.col - overlap_window.col) % width,
    )
    tiles = []
    for row in range(first_row, requested_window.row + requested_window.rows, height):
        for col in range(first_col, requested_window.col + requested_window.cols, width):
            whole = CellWindow(row, col, height, width)
            tiles.append(Tile(whole.within(overlap_window), whole.within(requested_window)))
    return tiles


def core_size(overlap_window: CellWindow, options: PyramidOptions) -> tuple[int, int]:
    """Rows and columns of a core: an equal part of the overlap of views, in whole blocks, about `tile` cells a side."""
    height, width = (
        -(-side // (max(round(side / options.tile), 1) * options.block)) * options.block
        for side in (overlap_window.rows, overlap_window.cols)
    )
    return height, width


@dataclass(frozen=True)
class TileNeeds:
    """Estimated needs of a run. n_bytes : memory of its largest tile; seconds : time of one worker for all tiles."""

    n_bytes: int
    seconds: float


def tile_needs(match_scene: MatchScene, tiles: Sequence[Tile], config: RunConfig) -> TileNeeds:
    """Estimate what tiles need, from the cells, views and pixels of a sample of them."""
    worked = [tile for tile in tiles if tile.core_window.rows and tile.core_window.cols]
    most, seconds, looked = 0, 0.0, worked[:: -(-len(worked) // MAX_SAMPLED_TILES) or 1]
    for tile in looked:
        fine = tile.core_window.at_level(0, config.pyramid.halo).within(match_scene.overlap_window)
        cells, steps = fine.rows * fine.cols, min(STEPS_PER_CELL, match_scene.n_steps + 16)
        pixels = sorted(
            rows * cols for _, _, rows, cols in windows_of(match_scene, tile.core_window, config)[1].values()
        )
        pixels = pixels[-config.selection.max_candidates - 1 :]
        per_cell = CELL_BYTES + STEP_BYTES * steps + VIEW_CELL_BYTES * len(pixels)
        most = max(most, cells * per_cell + sum(pixels) * PIXEL_BYTES)
        seconds += tile.core_window.rows * tile.core_window.cols * (CELL_S + VIEW_CELL_S * len(pixels))
    return TileNeeds(most, seconds * len(worked) / max(len(looked), 1))
