"""Tiles: which cells are matched together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from zlocus.matching.cells import CellWindow
from zlocus.matching.setup import MatchScene
from zlocus.options import PyramidOptions

# Matching of 4.2 M cells with three views took 17.9 s of a core (benchmarks/README.md, "The whole program").
VIEW_CELLS_PER_S = 4.2e6 * 3 / 17.9
STEPS_PER_CELL = 48
BYTES_PER_CELL = 160


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


def tile_memory_bytes(scene: MatchScene, options: PyramidOptions) -> int:
    """About what one tile needs at its largest: cost volume, path sums, pixels of all views, planes and results."""
    height, width = core_size(scene.seen, options)
    wide, everything = 2 * options.halo * 2 ** (scene.levels - 1), scene.seen.rows * scene.seen.cols
    fine = min((height + 2 * options.halo) * (width + 2 * options.halo), everything)
    pixels = min((height + wide) * (width + wide), everything) * len(scene.views) * 16
    return int(fine * (min(STEPS_PER_CELL, scene.n_steps + 16) * 3 + BYTES_PER_CELL) + pixels)


def matching_seconds(scene: MatchScene, tiles: Sequence[Tile]) -> float:
    """About how long one worker matches tiles, as if all views saw all of their cells, s."""
    cells = sum(tile.core.rows * tile.core.cols for tile in tiles)
    return cells * len(scene.views) / VIEW_CELLS_PER_S
