"""Errors of a surface in marked cells of a rendered scene, such as those of a painted trouble."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.warp import Resampling, reproject

from workplace import CannotRun

# Side of a block of truth cells, and the spread from which on a block holds an edge; as the independent judges have it.
BLOCK_CELLS, EDGE_M = 2, 1.0


@dataclass(frozen=True)
class MarkedErrors:
    """Errors in marked blocks. errors_m : (n,) m, absolute, NaN without a height."""

    errors_m: np.ndarray

    @property
    def with_height(self) -> float:
        """Share of the blocks that have a height."""
        return float(np.isfinite(self.errors_m).mean())

    def off_by_more(self, limit_m: float) -> float:
        """Share of the heights that are off by more than a limit; NaN where there is no height."""
        known = self.errors_m[np.isfinite(self.errors_m)]
        return float((known > limit_m).mean()) if len(known) else float("nan")


def marked_errors(dsm: Path, scene: Path, marks: str = "trouble.tif") -> MarkedErrors:
    """Errors of a surface in the blocks of 2 x 2 truth cells that are marked as a whole.

    The surface is looked up at the centre of each block. Where a block holds an edge, both sides and what lies between
    are right. scene : folder with truth_dsm.tif and the raster of marks.

    Raises
    ------
    CannotRun
        No block is marked.
    """
    with rasterio.open(scene / "truth_dsm.tif") as file:
        blocks, transform, crs = _blocks(file.read(1)), file.transform, file.crs
    with rasterio.open(scene / marks) as file:
        is_marked = _blocks(file.read(1)).all(axis=2)
    if not is_marked.any():
        raise CannotRun(f"`{scene / marks}` marks no block, so there is nothing to judge.")
    heights = np.full(is_marked.shape, np.nan)
    with rasterio.open(dsm) as file:
        reproject(
            file.read(1).astype(float), heights, src_transform=file.transform, src_crs=file.crs, src_nodata=np.nan,
            dst_transform=transform * Affine.scale(BLOCK_CELLS), dst_crs=crs, dst_nodata=np.nan,
            resampling=Resampling.nearest,
        )  # fmt: skip
    low, high, mean = blocks.min(axis=2), blocks.max(axis=2), blocks.mean(axis=2)
    beside = np.maximum(np.maximum(low - heights, heights - high), 0.0)
    errors = np.where(high - low > EDGE_M, beside, np.abs(heights - mean))
    return MarkedErrors(errors[is_marked])


def _blocks(values: np.ndarray) -> np.ndarray:
    """Cells (r, c, n) of each whole block of a raster."""
    rows, cols = (n // BLOCK_CELLS for n in values.shape)
    whole = values[: rows * BLOCK_CELLS, : cols * BLOCK_CELLS].astype(float)
    split = whole.reshape(rows, BLOCK_CELLS, cols, BLOCK_CELLS)
    return split.swapaxes(1, 2).reshape(rows, cols, -1)
