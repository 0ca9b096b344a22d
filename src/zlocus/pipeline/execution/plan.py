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
    """One tile. core : matched as a whole, the same for every grid and area; kept : its requested part."""

    core: CellWindow
    kept: CellWindow


def plan_tiles(asked: CellWindow, seen: CellWindow, options: PyramidOptions) -> list[Tile]:
    """The tiles that contain the requested cells, row by row.

    asked, seen : finest cells. Cores are equal parts of the ground seen (a property of the scene), whatever the area
    asked for: so a cell's height does not depend on the area. Cells beyond that ground belong to tiles of the same size
    without a core.
    """
    height, width = core_size(seen, options)
    first_row, first_col = asked.row - (asked.row - seen.row) % height, asked.col - (asked.col - seen.col) % width
    tiles = []
    for row in range(first_row, asked.row + asked.rows, height):
        for col in range(first_col, asked.col + asked.cols, width):
            whole = CellWindow(row, col, height, width)
            tiles.append(Tile(whole.within(seen), whole.within(asked)))
    return tiles


def core_size(seen: CellWindow, options: PyramidOptions) -> tuple[int, int]:
    """Rows and columns of a core: an equal part of the overlap of views, in whole blocks, about `tile` cells a side."""
    height, width = (
        -(-side // (max(round(side / options.tile), 1) * options.block)) * options.block
        for side in (seen.rows, seen.cols)
    )
    return height, width


@dataclass(frozen=True)
class TileNeeds:
    """Estimated needs of a run. n_bytes : memory of its largest tile; seconds : time of one worker for all tiles."""

    n_bytes: int
    seconds: float


def tile_needs(scene: MatchScene, tiles: Sequence[Tile], config: RunConfig) -> TileNeeds:
    """Estimate what tiles need, from the cells, views and pixels of a sample of them."""
    worked = [tile for tile in tiles if tile.core.rows and tile.core.cols]
    most, seconds, looked = 0, 0.0, worked[:: -(-len(worked) // MAX_SAMPLED_TILES) or 1]
    for tile in looked:
        fine = tile.core.at_level(0, config.pyramid.halo).within(scene.overlap_window)
        cells, steps = fine.rows * fine.cols, min(STEPS_PER_CELL, scene.n_steps + 16)
        pixels = sorted(rows * cols for _, _, rows, cols in windows_of(scene, tile.core, config)[1].values())
        pixels = pixels[-config.selection.max_candidates - 1 :]
        per_cell = CELL_BYTES + STEP_BYTES * steps + VIEW_CELL_BYTES * len(pixels)
        most = max(most, cells * per_cell + sum(pixels) * PIXEL_BYTES)
        seconds += tile.core.rows * tile.core.cols * (CELL_S + VIEW_CELL_S * len(pixels))
    return TileNeeds(most, seconds * len(worked) / max(len(looked), 1))
