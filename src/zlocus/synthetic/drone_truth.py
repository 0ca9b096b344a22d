"""Truth rasters of a drone block: heights and classes of all ground that two frames show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from rasterio.windows import Window

from zlocus.core.errors import ConfigError
from zlocus.core.mask_box import box_of
from zlocus.core.sensor_model import FloatArray
from zlocus.synthetic.scenes import Exposure
from zlocus.synthetic.terrain import SyntheticGround

BoolArray = NDArray[np.bool_]

ROWS_AT_ONCE = 1024
# Cells of a block whose corners tell whether a frame shows all of it, some of it, or nothing. Between the corners, lens
# and perspective bend a block by less than the margin.
BLOCK_CELLS, MARGIN_PX = 32, 3.0


def write_drone_truth(ground: SyntheticGround, exposures: Sequence[Exposure], epsg: int, folder: Path) -> None:
    """Write `truth_dsm.tif` and `truth_class.tif` at the step of the height field.

    They cover all ground that two or more frames show; heights are NaN where fewer do. Occlusion is ignored: a frame
    shows every point that lies inside it. Classes are those of `terrain`, and that of cars.

    Raises
    ------
    ConfigError
        No ground is shown by two frames.
    """
    known = n_frames_showing(ground, exposures) >= 2
    if not known.any():
        raise ConfigError("No ground is shown by two frames of the block: choose larger overlaps or more frames.")
    rows, cols = box_of(known)
    top, left, height, width = rows.start, cols.start, rows.stop - rows.start, cols.stop - cols.start
    west, north = ground.x0 + left * ground.step, ground.y0 - top * ground.step
    profile = {
        "driver": "GTiff", "height": height, "width": width, "count": 1, "compress": "deflate", "tiled": True,
        "crs": f"EPSG:{epsg}", "transform": from_origin(west, north, ground.step, ground.step),
    }  # fmt: skip
    classes_of = ground.materials["kind"].astype(np.uint8)
    layers = (
        ("truth_dsm.tif", "float32", np.nan, "height above the ellipsoid"),
        ("truth_class.tif", "uint8", None, "class"),
    )
    for name, dtype, nodata, description in layers:
        with rasterio.open(folder / name, "w", dtype=dtype, nodata=nodata, **profile) as file:
            for first in range(0, height, ROWS_AT_ONCE):
                n = min(ROWS_AT_ONCE, height - first)
                cells = slice(top + first, top + first + n), slice(left, left + width)
                if dtype == "uint8":
                    values: NDArray[np.generic] = classes_of[ground.material[cells]]
                else:
                    values = np.where(known[cells], ground.heights[cells], np.float32(np.nan))
                file.write(values, 1, window=Window(0, first, width, n))
            file.set_band_description(1, description)


def n_frames_showing(ground: SyntheticGround, exposures: Sequence[Exposure]) -> NDArray[np.uint8]:
    """Number of frames inside whose borders each cell of the ground lies, (r, c) uint8, occluded or not."""
    rows, cols = ground.heights.shape
    count = np.zeros((rows, cols), np.uint8)
    low, high = _block_heights(ground)
    for exposure in exposures:
        is_inside, is_mixed = _blocks_in_frame(ground, exposure, low, high)
        whole = np.repeat(np.repeat(is_inside, BLOCK_CELLS, axis=0), BLOCK_CELLS, axis=1)
        count += whole[:rows, :cols]
        for block_row in np.flatnonzero(is_mixed.any(axis=1)):
            part = slice(block_row * BLOCK_CELLS, min((block_row + 1) * BLOCK_CELLS, rows))
            at = np.flatnonzero(np.repeat(is_mixed[block_row], BLOCK_CELLS)[:cols])
            row, col = np.meshgrid(np.arange(part.start, part.stop), at, indexing="ij")
            xyz = np.column_stack([
                ground.x0 + (col.ravel() + 0.5) * ground.step, ground.y0 - (row.ravel() + 0.5) * ground.step,
                ground.heights[part][:, at].ravel(),
            ])  # fmt: skip
            count[row, col] += _is_in_frame(exposure.sensor.image_from_ground(xyz), exposure).reshape(row.shape)
    return count


def _is_in_frame(xy: FloatArray, exposure: Exposure) -> BoolArray:
    """Whether positions (n, 2) px lie between the centres of the outer pixels of a frame."""
    last = np.array([exposure.shape[1] - 1, exposure.shape[0] - 1])
    return np.asarray(((xy >= 0) & (xy <= last)).all(axis=1))


def _block_heights(ground: SyntheticGround) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest height of a cell in each block, (br, bc) m."""
    firsts = [np.arange(0, n, BLOCK_CELLS) for n in ground.heights.shape]
    low, high = (
        extreme.reduceat(extreme.reduceat(ground.heights, firsts[0], axis=0), firsts[1], axis=1)
        for extreme in (np.minimum, np.maximum)
    )
    return low, high


def _blocks_in_frame(
    ground: SyntheticGround, exposure: Exposure, low: NDArray[np.float32], high: NDArray[np.float32]
) -> tuple[BoolArray, BoolArray]:
    """Blocks (br, bc) of which a frame shows all cells, and blocks of which it may show some. low, high : in m."""
    north, west = (np.arange(n) * BLOCK_CELLS * ground.step for n in low.shape)
    side = BLOCK_CELLS * ground.step
    corners = np.stack([
        np.stack(np.broadcast_arrays(ground.x0 + west + i * side, (ground.y0 - north - j * side)[:, None], z), axis=-1)
        for i in (0, 1) for j in (0, 1) for z in (low, high)
    ])  # fmt: skip
    xy = exposure.sensor.image_from_ground(corners.reshape(-1, 3).astype(float)).reshape((*corners.shape[:-1], 2))
    last = np.array([exposure.shape[1] - 1, exposure.shape[0] - 1])
    is_inside = np.asarray(((xy >= MARGIN_PX) & (xy <= last - MARGIN_PX)).all(axis=(0, 3)))
    # Corners beyond the fold of the lens have no position; they are far outside.
    is_beyond_lens = np.asarray(np.isnan(xy).all(axis=(0, 3)))
    is_before = np.asarray((xy < -MARGIN_PX).all(axis=0))
    is_behind = np.asarray((xy > last + MARGIN_PX).all(axis=0))
    is_far = is_beyond_lens | (is_before | is_behind).any(axis=-1)
    return is_inside, ~(is_inside | is_far)
