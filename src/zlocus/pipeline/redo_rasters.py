"""The rasters of a surface written anew, with a part blended in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED
from zlocus.io.grid_inputs import cells_of_each
from zlocus.io.row_strips import strips_of
from zlocus.io.run_record import Stopwatch
from zlocus.matching.break_lines import held_heights
from zlocus.pipeline.execution.plan import Tile
from zlocus.pipeline.finished_record import ITEM
from zlocus.pipeline.redo_folder import RedoFolder
from zlocus.pipeline.redo_part import RedonePart
from zlocus.pipeline.setup import RunSetup
from zlocus.pipeline.tile_run import TileProduct
from zlocus.products.derived import FILES
from zlocus.products.metadata import METADATA
from zlocus.products.raster_cells import RasterCells, SurfaceReader, blended, with_fixed
from zlocus.products.rasters import SurfaceRasters
from zlocus.products.report.file_names import RECORD, REPORT

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")


@dataclass
class ChangedCells:
    """Cells of a surface that was written anew. n_inside : of the area; n_changed : with another value."""

    n_inside: int = 0
    n_changed: int = 0


def write_part(
    part: RedonePart,
    folder: RedoFolder,
    tiles: Sequence[Tile],
    product: Callable[[Tile], TileProduct | None],
    stopwatch: Stopwatch,
    progress: Progress,
    setup: RunSetup | None = None,
) -> ChangedCells:
    """Write all rasters of the new folder: the old cells, and those of the part."""
    derived = {name for name in FILES.values() if (part.dsm_request.out / name).is_file()}
    folder.begin_surface({*RASTERS, *derived, RECORD, FINISHED, ITEM, METADATA, REPORT})
    changed_cells = ChangedCells()
    with stopwatch.stage("write"), SurfaceReader(part.dsm_request.out) as reader:
        rasters = SurfaceRasters(
            folder.surface, part.geobox, reader.ortho_dtype, part.vertical_datum, reader.has_colours
        )
        rows, cols = part.geobox.shape
        strips = list(strips_of(rows))
        with rasters, progress.stage("Writing", len(strips) + len(tiles)) as stage:
            for strip in strips:
                shape = (strip.rows, cols)
                cells = reader.read(strip.row, 0, shape)
                if part.levels_m is not None:
                    cells = _levelled(part, strip.row, shape, cells, changed_cells)
                rasters.write_cells(strip.row, 0, cells)
                stage.advance()
            for tile in tiles:
                tile_product = product(tile)
                if tile_product is not None:
                    assert setup is not None, "tiles are those of a setup"
                    _blend(part, setup, tile, tile_product, reader, rasters, changed_cells)
                stage.advance()
    return changed_cells


def _levelled(
    part: RedonePart, row: int, shape: tuple[int, int], old_cells: RasterCells, changed_cells: ChangedCells
) -> RasterCells:
    """Cells of a strip, with the level of their polygon."""
    assert part.level_polygons is not None, "callers make sure"
    assert part.levels_m is not None, "polygons have levels"
    numbers = np.arange(1, len(part.level_polygons) + 1)
    of_polygon = cells_of_each(part.level_polygons, numbers, part.geobox[row : row + shape[0], : shape[1]])
    heights = np.concatenate([[np.nan], part.levels_m])[of_polygon]
    cells = with_fixed(old_cells, heights)
    changed_cells.n_inside += int((of_polygon > 0).sum())
    changed_cells.n_changed += int(cells.differs_from(old_cells).sum())
    return cells


def _blend(
    part: RedonePart,
    setup: RunSetup,
    tile: Tile,
    tile_product: TileProduct,
    reader: SurfaceReader,
    rasters: SurfaceRasters,
    changed_cells: ChangedCells,
) -> None:
    """Blend a tile into the rasters."""
    window, grid = tile.kept_window, setup.grid
    row, col, shape = window.row - grid.window.row, window.col - grid.window.col, (window.rows, window.cols)
    weight = part.redone_area.weights(row, col, shape)
    old_cells = reader.read(row, col, shape)
    cells = blended(old_cells, rasters.cells_of(row, col, tile_product.surface), weight)
    if part.given_lines is not None and len(part.given_lines.held):
        box = part.geobox[row : row + shape[0], col : col + shape[1]]
        heights = held_heights(part.given_lines.held, ~box.transform, shape)
        cells = with_fixed(cells, np.where(weight > 0, heights, np.nan))
    changed_cells.n_inside += int((weight > 0).sum())
    changed_cells.n_changed += int(cells.differs_from(old_cells).sum())
    rasters.write_cells(row, col, cells)
