"""dtm.tif: the ground without buildings and trees."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import ProductOptions
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.row_strips import STRIP_ROWS, BandReader, Strip, check_same_grid, strips_of
from zlocus.matching.quality import Quality
from zlocus.products.smrf import between_blocks, block_least, block_mean, membrane, outside_of, terrain

FloatImage = NDArray[np.float32]
# Cells in which ground is looked for; held in memory, some ten arrays of float32 at a time.
MOST_CELLS = 20_000_000
# Beside walls and trees matched heights lie anywhere between roof and ground.
DOUBTFUL = np.uint16(Quality.JUMP | Quality.DISPUTED | Quality.FILLED)


def write_dtm(dsm: Path, quality: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """The terrain: float32 m, the height of the surface where that is ground, else interpolated between ground.

    A cell is ground where its height is near the terrain that `surface.terrain` finds on coarser cells, and not marked
    as JUMP, DISPUTED or FILLED. Cells that no
    two images cover or that were not asked for stay empty, as do those farther from all ground than
    `ground_window_m`. strip_rows : rows worked on at a time, about; they change no byte.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    OutputError
        The terrain cannot be written.
    """
    with BandReader(dsm) as heights, BandReader(quality) as flags:
        check_same_grid([heights, flags])
        side = _cells_of_a_block(heights, options)
        # Blocks lie within one strip.
        strip_rows = max(1, strip_rows // side) * side
        lowest = _by_blocks(heights, side, strip_rows)
        first = terrain(lowest, side * heights.cell_m, options)
        slope = _slope(first, side * heights.cell_m)
        shape = heights.geobox.shape

        def grounds() -> Iterator[tuple[Strip, FloatImage]]:
            """Heights that are ground, NaN elsewhere, of each strip."""
            for strip in strips_of(shape[0], 0, strip_rows):
                z = heights.read(strip)
                allowed = options.ground_tolerance_m + options.ground_scaling * between_blocks(
                    slope, side, strip.row, z.shape
                )
                off = np.abs(z - between_blocks(first, side, strip.row, z.shape))
                doubtful = (flags.read(strip) & DOUBTFUL) != 0
                yield strip, np.where((off <= allowed) & ~doubtful, z, np.float32(np.nan))

        mean = np.concatenate([block_mean(ground, side) for _, ground in grounds()])
        filled, reach = membrane(mean), options.ground_window_m / (side * heights.cell_m)
        is_filled = _is_near(mean, reach) & ~outside_of(lowest)
        above = heights.description.partition(" above ")[2]
        what = f"height of the ground above {above}" if above else "height of the ground"
        with RasterSink(path, heights.geobox, RasterBands("float32", float("nan"), (what,), "m")) as sink:
            for strip, ground in grounds():
                rows, cols = np.arange(strip.row, strip.row + strip.rows) // side, np.arange(shape[1]) // side
                beyond = (flags.read(strip) & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
                gap = np.isnan(ground) & ~beyond & is_filled[np.ix_(rows, cols)]
                sink.write(strip.row, 0, np.where(gap, between_blocks(filled, side, strip.row, ground.shape), ground))


def _cells_of_a_block(heights: BandReader, options: ProductOptions) -> int:
    """Cells along the side of a block in which ground is looked for."""
    rows, cols = heights.geobox.shape
    return max(1, round(options.ground_cell_m / heights.cell_m), int(np.ceil(np.sqrt(rows * cols / MOST_CELLS))))


def _by_blocks(heights: BandReader, side: int, strip_rows: int) -> FloatImage:
    """Lowest height of each block, (r, c)."""
    strips = strips_of(heights.geobox.shape[0], 0, strip_rows)
    return np.concatenate([block_least(heights.read(strip), side) for strip in strips])


def _slope(z: FloatImage, cell_m: float) -> FloatImage:
    """Steepness of a terrain, a ratio. (r, c) without gaps; a single row or column has none across it."""
    south, east = (np.gradient(z, cell_m, axis=axis) if z.shape[axis] > 1 else np.zeros_like(z) for axis in (0, 1))
    return np.hypot(south, east).astype(np.float32)


def _is_near(mean: FloatImage, reach: float) -> NDArray[np.bool_]:
    """Whether a block has ground, or lies at most `reach` blocks from one that has. (r, c)."""
    unknown = np.isnan(mean)
    if unknown.all():
        return ~unknown
    from scipy.ndimage import distance_transform_edt  # a tenth of a second

    return np.asarray(distance_transform_edt(unknown) <= reach)
