"""Plan of tiles: which cells are matched together, and what memory and time they need."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zlocus.core.footprints import ground_sample_distance
from zlocus.core.grid import CellWindow
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.scene import DecodedSource, View
from zlocus.io.decoded_images import DECODED, DECODED_BYTES
from zlocus.matching.level_records import READ_POINTS_PER_SIDE, level_window
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.tile_candidates import candidates_of_tile, windows_of
from zlocus.matching.view_pixels import FIRST_KEPT_LEVEL, PYRAMID_BYTES, PYRAMIDS, window_showing

# Time to match a cell of a core, and in addition for each view that may show it
# (docs/development/experiments/growth.md, docs/development/experiments/close_cameras.md).
CELL_S, VIEW_CELL_S = 2e-6, 3e-6
# Peak memory of a tile: for each cell; for each cell and height step; for each cell and view that shows it; for each
# cell and view of the tile that does not show it; for each pixel that the views show of the cells
# (docs/development/experiments/growth.md).
CELL_BYTES, STEP_BYTES, VIEW_CELL_BYTES, OTHER_VIEW_CELL_BYTES, PIXEL_BYTES = 65, 3, 23, 10, 12
STEPS_PER_CELL = 48
# Memory of the reduced parts of an image for each of its pixels: five bytes for each pixel of a level.
REDUCED_BYTES = 5 / 4**FIRST_KEPT_LEVEL * 4 / 3
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
    of the views that take part; among equal views the height of a cell does not depend on the requested area. Cells
    outside the overlap belong to tiles of the same size without a core.
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
    steps = match_scene.n_steps + 16
    if match_scene.levels > 1:  # the finest cells search near the next coarser surface only
        steps = min(steps, STEPS_PER_CELL)
    for tile in looked:
        fine = level_window(
            tile.core_window, 0, config.pyramid.halo, config.pyramid.block, match_scene.overlap_window
        )  # fmt: skip
        cells, shown = fine.rows * fine.cols, _shown_pixels(match_scene, tile.core_window, fine, config)
        n_other = len(shown.pixels) - shown.views_of_cell
        per_cell = (
            CELL_BYTES + STEP_BYTES * steps + VIEW_CELL_BYTES * shown.views_of_cell + OTHER_VIEW_CELL_BYTES * n_other
        )
        most = max(most, int(cells * per_cell + sum(shown.pixels) * PIXEL_BYTES))
        seconds += tile.core_window.rows * tile.core_window.cols * (CELL_S + VIEW_CELL_S * shown.views_of_cell)
    return TileNeeds(most, seconds * len(worked) / max(len(looked), 1))


def kept_bytes(match_scene: MatchScene) -> int:
    """Memory of the images that a process keeps from tile to tile: decoded ones, and reduced parts of all of them."""
    return kept_bytes_of(match_scene.views)


def kept_bytes_of(views: Sequence[View], n_scenes: int = 1) -> int:
    """Memory of the images of some views that a process keeps from tile to tile, see `kept_bytes`.

    n_scenes : number of match scenes with these views; each has grey values, and so reduced parts, of its own.
    """
    return sum(_needed_bytes(views, n_scenes))


def keep_at_most(n_bytes: int = DECODED_BYTES + PYRAMID_BYTES, views: Sequence[View] = ()) -> None:
    """Limit the memory of the images that this process keeps from tile to tile, see `kept_bytes`.

    n_bytes : by default as much as any scene may take. It is divided as the images of the views need it.
    """
    decoded, reduced = _needed_bytes(views)
    share = reduced / (decoded + reduced) if views else PYRAMID_BYTES / (DECODED_BYTES + PYRAMID_BYTES)
    of_reduced = min(math.ceil(n_bytes * share), PYRAMID_BYTES)
    PYRAMIDS.limit(of_reduced)
    DECODED.limit(min(n_bytes - of_reduced, DECODED_BYTES))


def _needed_bytes(views: Sequence[View], n_scenes: int = 1) -> tuple[int, int]:
    """Memory that a process may use for decoded images, and for reduced parts, see `kept_bytes_of`."""
    decoded = sum(view.image.decoded_bytes for view in views if isinstance(view.image, DecodedSource))
    n_pixels = n_scenes * sum(math.prod(view.image.shape) for view in views)
    return min(decoded, DECODED_BYTES), min(int(n_pixels * REDUCED_BYTES), PYRAMID_BYTES)


class ShownPixels(NamedTuple):
    """What views show of a tile. pixels : number for each view; views_of_cell : number of views that show a cell."""

    pixels: list[int]
    views_of_cell: float


def _shown_pixels(
    match_scene: MatchScene, core_window: CellWindow, fine_window: CellWindow, config: RunConfig
) -> ShownPixels:
    """Pixels of the finest level that the views of a tile show of it."""
    ground, z_range = match_scene.points_of(fine_window, 0, READ_POINTS_PER_SIDE), match_scene.expected_range
    pixels, cells = [], []
    numbers = list(windows_of(match_scene, core_window, config))
    for number in candidates_of_tile(match_scene, core_window, numbers, config):
        view = match_scene.views[number]
        part = window_showing(view, ground, z_range or match_scene.z_range)
        if part is not None:
            pixel_cells = ground_sample_distance(view, match_scene.ground_height) / match_scene.cell_size
            pixels.append(part.rows * part.cols)
            cells.append(pixels[-1] * pixel_cells**2)
    shares = np.minimum(np.array(cells) / (fine_window.rows * fine_window.cols), 1.0)
    return ShownPixels(pixels, float(np.nansum(shares)))
