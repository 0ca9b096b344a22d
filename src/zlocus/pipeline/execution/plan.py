"""Tiles: which cells are matched together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from zlocus.core.grid import CellWindow
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.tile import windows_of

# Of a core, per cell, and more for each view that is compared (docs/development/experiments/growth.md).
CELL_S, VIEW_CELL_S = 1.5e-6, 0.45e-6
# Of a tile at its largest: per cell; per cell and step of heights; per cell and view that is compared; per pixel of
# those views' windows.
CELL_BYTES, STEP_BYTES, VIEW_CELL_BYTES, PIXEL_BYTES = 170, 3, 42, 22
STEPS_PER_CELL = 48
# Tiles that are looked at for what they need, spread over all.
MOST_LOOKED_AT = 64


@dataclass(frozen=True)
class Tile:
    """core : matched as one, the same for every grid and extent; kept : the part of it that was asked for."""

    core: CellWindow
    kept: CellWindow


def plan_tiles(asked: CellWindow, seen: CellWindow, options: PyramidOptions) -> list[Tile]:
    """Tiles of the scene's lattice that hold the cells asked for, row by row.

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
    """Rows and columns of a tile's core: equal parts of the ground seen, whole blocks, about `tile` cells a side."""
    height, width = (
        -(-side // (max(round(side / options.tile), 1) * options.block)) * options.block
        for side in (seen.rows, seen.cols)
    )
    return height, width


@dataclass(frozen=True)
class TileNeeds:
    """n_bytes : about what the largest of some tiles needs; seconds : about how long one worker takes for all."""

    n_bytes: int
    seconds: float


def tile_needs(scene: MatchScene, tiles: Sequence[Tile], config: RunConfig) -> TileNeeds:
    """What tiles need, from the cells, and the views and pixels, that some of them are to be matched with."""
    worked = [tile for tile in tiles if tile.core.rows and tile.core.cols]
    most, seconds, looked = 0, 0.0, worked[:: -(-len(worked) // MOST_LOOKED_AT) or 1]
    for tile in looked:
        fine = tile.core.at_level(0, config.pyramid.halo).within(scene.seen)
        cells, steps = fine.rows * fine.cols, min(STEPS_PER_CELL, scene.n_steps + 16)
        pixels = sorted(rows * cols for _, _, rows, cols in windows_of(scene, tile.core, config)[1].values())
        pixels = pixels[-config.selection.candidates - 1 :]
        per_cell = CELL_BYTES + STEP_BYTES * steps + VIEW_CELL_BYTES * len(pixels)
        most = max(most, cells * per_cell + sum(pixels) * PIXEL_BYTES)
        seconds += tile.core.rows * tile.core.cols * (CELL_S + VIEW_CELL_S * len(pixels))
    return TileNeeds(most, seconds * len(worked) / max(len(looked), 1))
