"""Rasters of a surface moved by a shift and a tilt: all of a folder together, so that they stay on one grid."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio import DatasetReader
from rasterio.enums import MaskFlags
from rasterio.windows import Window

from zlocus.core.progress import Progress
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.heights import HeightRaster, read_window
from zlocus.evaluation.surface_fit import SurfaceFit
from zlocus.evaluation.truth import places
from zlocus.io.open_raster import open_raster
from zlocus.io.rasters import BLOCK_SIZE, RasterBands, RasterSink
from zlocus.matching.quality import Quality

HEIGHTS, FLAGS = "dsm.tif", "quality.tif"
STATISTICS = "STATISTICS_"


@dataclass(frozen=True)
class Move:
    """How the rasters of a surface are moved. fit : what is removed.

    keeps_grid : the result has the cells of the surface, whose heights are interpolated; otherwise the cells move, and
    nothing is interpolated.
    """

    fit: SurfaceFit
    keeps_grid: bool

    def transform(self, before: Affine) -> Affine:
        """The transform of a raster after the move."""
        if self.keeps_grid:
            return before
        east, north, _ = self.fit.shift_m
        return Affine.translation(-east, -north) * before

    def cells(self, transform: Affine) -> tuple[float, float]:
        """Rows and columns from a cell of the result to the place in the surface that belongs there."""
        if not self.keeps_grid:
            return 0.0, 0.0
        east, north, _ = self.fit.shift_m
        inverse = ~transform
        return float(inverse.d * east + inverse.e * north), float(inverse.a * east + inverse.b * north)


def write_moved(sources: dict[str, Path], out: Path, move: Move, progress: Progress) -> list[str]:
    """Write moved rasters into a folder, and return their names. sources : raster by the name of the result.

    Heights change by the offset and the tilt at their new places. All others keep their values: where the grid is kept,
    each cell takes those of the nearest one, so that flags and numbers of images stay what they are.

    Raises
    ------
    InputError
        A raster is damaged.
    OutputError
        A file cannot be written; those that were are removed.
    """
    written = []
    try:
        with progress.stage("Moving rasters", len(sources)) as stage:
            for name, path in sources.items():
                with open_raster(path, "raster of a surface") as source:
                    _write_one(source, path, out / name, move)
                written.append(name)
                stage.advance()
    except BaseException:
        for name in written:
            with suppress(OSError):
                (out / name).unlink()
        raise
    return written


def _write_one(source: DatasetReader, path: Path, to: Path, move: Move) -> None:
    """Write a raster, block by block."""
    transform = move.transform(source.transform)
    shape = (source.height, source.width)
    geobox = GeoBox(shape, transform, None if source.crs is None else source.crs.to_wkt())
    is_height = to.name == HEIGHTS
    bands = RasterBands(np.float32, math.nan, (source.descriptions[0] or "",), "m") if is_height else _bands(source)
    with RasterSink(to, geobox, bands) as sink:
        for row, col, rows, cols in _blocks(shape):
            if is_height:
                z = _heights(source, path, move, (row, col, rows, cols))
                row_at, col_at = np.mgrid[row : row + rows, col : col + cols].reshape(2, -1) + 0.5
                offset = move.fit.offset(places(transform, row_at, col_at)).reshape(rows, cols)
                sink.write(row, col, (z - offset).astype(np.float32))
            else:
                values, mask = _values(source, to.name, move, (row, col, rows, cols))
                sink.write(row, col, values, mask if bands.has_mask else None)


def _bands(source: DatasetReader) -> RasterBands:
    """The bands of a raster as it has them."""
    names = [meaning.name for meaning in source.colorinterp]
    tags = {key: value for key, value in source.tags(1).items() if not key.startswith(STATISTICS)}
    return RasterBands(
        source.dtypes[0], source.nodata, tuple(text or "" for text in source.descriptions), source.units[0] or "",
        has_colours=names[:3] == ["red", "green", "blue"], has_mask=MaskFlags.per_dataset in source.mask_flag_enums[0],
        tags=tags,
    )  # fmt: skip


def _blocks(shape: tuple[int, int]) -> Iterator[tuple[int, int, int, int]]:
    """First row and column, rows and columns of the blocks of a raster."""
    for row in range(0, shape[0], BLOCK_SIZE):
        for col in range(0, shape[1], BLOCK_SIZE):
            yield row, col, min(BLOCK_SIZE, shape[0] - row), min(BLOCK_SIZE, shape[1] - col)


def _heights(source: DatasetReader, path: Path, move: Move, block: tuple[int, int, int, int]) -> FloatArray:
    """Heights (r, c) m of a block of the result, before the offset is removed."""
    row, col, rows, cols = block
    down, across = move.cells(source.transform)
    if down == across == 0.0:
        return read_window(source, path, Window(col, row, cols, rows))
    top, left = row + math.floor(down) - 1, col + math.floor(across) - 1
    window = _inside(source, top, left, rows + 3, cols + 3)
    if window is None:
        return np.full((rows, cols), np.nan)
    z = read_window(source, path, window)
    # In cells: the window's own grid, so that no large coordinates are rounded.
    raster = HeightRaster(path, z, Affine.identity(), None)
    at = np.mgrid[row : row + rows, col : col + cols].reshape(2, -1) + 0.5
    x, y = at[1] + across - window.col_off, at[0] + down - window.row_off
    return raster.bilinear(np.column_stack([x, y])).reshape(rows, cols)


def _values(
    source: DatasetReader, name: str, move: Move, block: tuple[int, int, int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Values (bands, r, c) of the nearest cells of a block, and which of them are valid (r, c)."""
    row, col, rows, cols = block
    down, across = (math.floor(cells + 0.5) for cells in move.cells(source.transform))
    empty = Quality.OUTSIDE if name == FLAGS else source.nodata or 0
    values = np.full((source.count, rows, cols), empty, source.dtypes[0])
    mask = np.zeros((rows, cols), bool)
    window = _inside(source, row + down, col + across, rows, cols)
    if window is not None:
        first = int(window.row_off) - row - down, int(window.col_off) - col - across
        part = slice(first[0], first[0] + int(window.height)), slice(first[1], first[1] + int(window.width))
        values[(slice(None), *part)] = source.read(window=window)
        mask[part] = source.dataset_mask(window=window) > 0
    return values, mask


def _inside(source: DatasetReader, row: int, col: int, rows: int, cols: int) -> Window | None:
    """The part of a window that lies in a raster; None where none does."""
    top, left = max(row, 0), max(col, 0)
    bottom, right = min(row + rows, source.height), min(col + cols, source.width)
    return None if bottom <= top or right <= left else Window(left, top, right - left, bottom - top)
