"""Tiles: which cells are matched together."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.matching.cells import CellWindow
from zlocus.matching.setup import MatchScene
from zlocus.options import PyramidOptions

STEPS_PER_CELL = 48
BYTES_PER_CELL = 160


@dataclass(frozen=True)
class Tile:
    """core : matched as one, the same for every grid and extent; kept : the part of it that was asked for."""

    core: CellWindow
    kept: CellWindow


def plan_tiles(asked: CellWindow, seen: CellWindow, options: PyramidOptions) -> list[Tile]:
    """Tiles of the scene's lattice that hold the cells asked for, row by row.

    asked, seen : finest cells. Cores lie on multiples of the tile size, cut to the ground seen (a property of the
    scene), never to the area asked for: so a cell's height does not depend on the area.
    """
    size, tiles = options.tile, []
    for row in range(asked.row // size * size, asked.row + asked.rows, size):
        for col in range(asked.col // size * size, asked.col + asked.cols, size):
            whole = CellWindow(row, col, size, size)
            tiles.append(Tile(whole.within(seen), whole.within(asked)))
    return tiles


def tile_memory_bytes(scene: MatchScene, options: PyramidOptions) -> int:
    """About what one tile needs at its largest: cost volume, path sums, pixels of all views, planes and results."""
    side = options.tile + 2 * options.halo * 2 ** (scene.levels - 1)
    fine = min((options.tile + 2 * options.halo) ** 2, scene.seen.rows * scene.seen.cols)
    pixels = min(side**2, scene.seen.rows * scene.seen.cols) * len(scene.views) * 16
    return int(fine * (min(STEPS_PER_CELL, scene.n_steps + 16) * 3 + BYTES_PER_CELL) + pixels)
