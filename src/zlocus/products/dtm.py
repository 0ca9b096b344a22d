"""dtm.tif: the terrain without buildings and trees."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import ProductOptions
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.row_strips import STRIP_ROWS, BandReader, Strip, check_same_grid, strips_of
from zlocus.matching.quality import Quality, is_water
from zlocus.products.smrf import between_blocks, block_mean, block_min, membrane, outside_of, terrain

FloatImage = NDArray[np.float32]
# Ground is searched on at most this many blocks, of which some ten float32 arrays are in memory at a time.
MAX_BLOCKS = 20_000_000
# Ground is searched on blocks of about this side. A cell is ground within the tolerance of the option, plus this many
# metres times the slope of the ground.
GROUND_BLOCK_M, TOLERANCE_PER_SLOPE_M = 1.0, 1.25
# Heights with these flags lie beside walls and trees, anywhere between roof and ground.
DOUBTFUL = np.uint16(Quality.JUMP | Quality.DISPUTED | Quality.FILLED)


def write_dtm(dsm: Path, quality: Path, path: Path, options: ProductOptions, strip_rows: int = STRIP_ROWS) -> None:
    """Write the terrain, float32 m: the surface where it is ground, else heights interpolated between ground.

    A cell is ground where its height is close to the provisional terrain of `smrf.terrain` and it is not flagged JUMP,
    DISPUTED or FILLED; levelled water is ground. Other cells stay empty where fewer than two images cover them, outside
    the requested area, and farther than `ground_window_m` from all ground. strip_rows : rows that are processed at a
    time, about; they change no byte.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    OutputError
        The terrain cannot be written.
    """
    with BandReader(dsm) as height_reader, BandReader(quality) as flag_reader:
        check_same_grid([height_reader, flag_reader])
        side = _cells_of_a_block(height_reader, options)
        # Every block must lie in one strip.
        strip_rows = max(1, strip_rows // side) * side
        lowest = _by_blocks(height_reader, side, strip_rows)
        first = terrain(lowest, side * height_reader.cell_m, options)
        slope = _slope(first, side * height_reader.cell_m)
        shape = height_reader.geobox.shape

        def grounds() -> Iterator[tuple[Strip, FloatImage]]:
            """Each strip with its heights that are ground, NaN elsewhere."""
            for strip in strips_of(shape[0], 0, strip_rows):
                z = height_reader.read(strip)
                allowed = options.ground_tolerance_m + TOLERANCE_PER_SLOPE_M * between_blocks(
                    slope, side, strip.row, z.shape
                )
                off = np.abs(z - between_blocks(first, side, strip.row, z.shape))
                quality = flag_reader.read(strip)
                is_ground = (off <= allowed) & ((quality & DOUBTFUL) == 0) | is_water(quality)
                yield strip, np.where(is_ground, z, np.float32(np.nan))

        mean = np.concatenate([block_mean(ground, side) for _, ground in grounds()])
        filled, reach = membrane(mean), options.ground_window_m / (side * height_reader.cell_m)
        is_filled = _is_near(mean, reach) & ~outside_of(lowest)
        above = height_reader.description.partition(" above ")[2]
        what = f"height of the ground above {above}" if above else "height of the ground"
        with RasterSink(path, height_reader.geobox, RasterBands("float32", float("nan"), (what,), "m")) as sink:
            for strip, ground in grounds():
                rows, cols = np.arange(strip.row, strip.row + strip.rows) // side, np.arange(shape[1]) // side
                beyond = (flag_reader.read(strip) & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) != 0
                gap = np.isnan(ground) & ~beyond & is_filled[np.ix_(rows, cols)]
                sink.write(strip.row, 0, np.where(gap, between_blocks(filled, side, strip.row, ground.shape), ground))


def _cells_of_a_block(height_reader: BandReader, options: ProductOptions) -> int:
    """Cells along the side of a block on which ground is searched."""
    rows, cols = height_reader.geobox.shape
    return max(1, round(GROUND_BLOCK_M / height_reader.cell_m), int(np.ceil(np.sqrt(rows * cols / MAX_BLOCKS))))


def _by_blocks(height_reader: BandReader, side: int, strip_rows: int) -> FloatImage:
    """Lowest height of each block, (r, c), NaN where it has none."""
    strips = strips_of(height_reader.geobox.shape[0], 0, strip_rows)
    return np.concatenate([block_min(height_reader.read(strip), side) for strip in strips])


def _slope(z: FloatImage, cell_m: float) -> FloatImage:
    """Slope of a terrain (r, c) without gaps, as a ratio; across a single row or column it is 0."""
    south, east = (np.gradient(z, cell_m, axis=axis) if z.shape[axis] > 1 else np.zeros_like(z) for axis in (0, 1))
    return np.hypot(south, east).astype(np.float32)


def _is_near(mean: FloatImage, reach: float) -> NDArray[np.bool_]:
    """Whether a block has ground, or lies at most `reach` blocks from one that has. (r, c)."""
    unknown = np.isnan(mean)
    if unknown.all():
        return ~unknown
    from scipy.ndimage import distance_transform_edt  # a tenth of a second

    return np.asarray(distance_transform_edt(unknown) <= reach)
