"""Survey of a run's rasters: counts over all cells, and a sample of cells at regular distances."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.io.open_raster import open_raster
from zlocus.matching.quality import EMPTY, Quality, is_empty, is_water

RASTERS = ("dsm", "sigma", "quality", "views")
MAX_SAMPLED_SIDE = 1500
N_CODES = 1 << 16
NOT_COVERED = Quality.OUTSIDE | Quality.UNSEEN


@dataclass(frozen=True)
class Survey:
    """Counts over all cells, and every `stride`-th row and column of the rasters.

    shape : rows and columns of the grid; transform : cell corners to ground; height_name : description of the heights
    in dsm.tif; codes : (65536,) int64, number of cells per value of quality.tif; n_heights : number of cells with a
    height; n_used : (256,) int64, number of cells that were matched with each number of images; lowest_m, highest_m :
    of all heights, NaN without any. height, sigma : (r, c) float32 m, NaN where there is none; quality : (r, c) uint16;
    views : (r, c) uint8, number of images. Cell [i, j] of these is cell [first + i * stride, first + j * stride] of the
    grid.
    """

    shape: tuple[int, int]
    transform: Affine
    height_name: str
    codes: NDArray[np.int64]
    n_heights: int
    n_used: NDArray[np.int64]
    lowest_m: float
    highest_m: float
    stride: int
    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    quality: NDArray[np.uint16]
    views: NDArray[np.uint8]

    @property
    def cell_m(self) -> float:
        """Side of a cell."""
        return float(self.transform.a)

    @property
    def first(self) -> int:
        """First row and column of the grid that are sampled."""
        return self.stride // 2

    @property
    def n_requested(self) -> int:
        """Number of cells inside the requested area."""
        return self.count_without(Quality.OUTSIDE)

    @property
    def n_covered(self) -> int:
        """Number of cells inside the area that two images or more cover, without levelled water."""
        codes = np.arange(N_CODES)
        return self.count_without(NOT_COVERED) - int(
            self.codes[is_water(codes.astype(np.uint16)) & ((codes & int(NOT_COVERED)) == 0)].sum()
        )

    @property
    def n_matched(self) -> int:
        """Number of cells whose height was matched, not filled."""
        return self.n_heights - self.count(Quality.FILLED) - self.count(Quality.WATER)

    @property
    def n_masked(self) -> int:
        """Number of cells of the requested area for which masks leave fewer than two images; none of levelled water."""
        codes = np.arange(N_CODES, dtype=np.uint16)
        is_masked = (codes & int(Quality.MASKED | Quality.OUTSIDE)) == int(Quality.MASKED)
        return int(self.codes[is_masked & ~is_water(codes)].sum())

    def count(self, flag: Quality) -> int:
        """Number of cells of the requested area that have a flag; for OUTSIDE, of the whole grid.

        A flag that only warns is counted where there is a height of which it could warn. Levelled water counts as
        WATER, and neither as FILLED nor as PLANE.
        """
        which = np.arange(N_CODES, dtype=np.uint16)
        is_levelled = is_water(which)
        has = is_levelled if flag is Quality.WATER else (which & int(flag)) != 0
        if flag in (Quality.FILLED, Quality.PLANE):
            has = has & ~is_levelled
        if flag is not Quality.OUTSIDE:
            has = has & ((which & int(Quality.OUTSIDE)) == 0)
        if flag not in EMPTY and flag is not Quality.IMAGE_EXCLUDED:
            has = has & ~is_empty(which)
        return int(self.codes[has].sum())

    def count_without(self, quality: Quality) -> int:
        """Number of cells that have none of some flags. quality : the flags, combined."""
        return int(self.codes[(np.arange(N_CODES) & int(quality)) == 0].sum())

    def grid_cell(self, i: int, j: int) -> tuple[int, int]:
        """Row and column in the grid of a sampled cell."""
        return self.first + i * self.stride, self.first + j * self.stride


def survey_rasters(folder: Path) -> Survey:
    """Read every cell of the rasters in a folder once, block by block.

    Raises
    ------
    InputError
        One of them is missing, cannot be read, or is on another grid.
    """
    with ExitStack() as stack:
        files = {name: stack.enter_context(open_raster(folder / f"{name}.tif", "raster")) for name in RASTERS}
        dsm = files["dsm"]
        for name, file in files.items():
            if (file.shape, file.transform) != (dsm.shape, dsm.transform):
                raise InputError(f"{folder / name}.tif is not on the grid of dsm.tif. Make the surface again.")
        return _survey_of(files)


def _survey_of(files: dict[str, rasterio.DatasetReader]) -> Survey:
    dsm = files["dsm"]
    rows, cols = dsm.shape
    stride = -(-max(rows, cols) // MAX_SAMPLED_SIDE)
    n_rows, n_cols = (len(range(stride // 2, n, stride)) for n in (rows, cols))
    sampled = {name: np.zeros((n_rows, n_cols), file.dtypes[0]) for name, file in files.items()}
    codes, n_used = np.zeros(N_CODES, np.int64), np.zeros(256, np.int64)
    n_heights, lowest, highest = 0, np.inf, -np.inf
    for _, window in dsm.block_windows(1):
        cells = {name: file.read(1, window=window) for name, file in files.items()}
        codes += np.bincount(cells["quality"].ravel(), minlength=N_CODES)
        n_used += np.bincount(cells["views"].ravel(), minlength=256)
        known = cells["dsm"][np.isfinite(cells["dsm"])]
        if known.size:
            n_heights += known.size
            lowest, highest = min(lowest, float(known.min())), max(highest, float(known.max()))
        _sample(sampled, cells, window, stride)
    is_any = n_heights > 0
    return Survey(
        shape=(rows, cols), transform=dsm.transform, height_name=dsm.descriptions[0] or "height", codes=codes,
        n_heights=n_heights, n_used=n_used, lowest_m=lowest if is_any else np.nan,
        highest_m=highest if is_any else np.nan, stride=stride, height=sampled["dsm"], sigma=sampled["sigma"],
        quality=sampled["quality"], views=sampled["views"],
    )  # fmt: skip


def _sample(
    sampled: dict[str, NDArray[np.generic]], cells: dict[str, NDArray[np.generic]], window: Window, stride: int
) -> None:
    """Copy the sampled cells of a block to their place."""
    # The first sampled row and column at or after the start of the block.
    i, j = (-(-(start - stride // 2) // stride) for start in (window.row_off, window.col_off))
    down, across = stride // 2 + i * stride - window.row_off, stride // 2 + j * stride - window.col_off
    for name, block in cells.items():
        part = block[down::stride, across::stride]
        sampled[name][i : i + part.shape[0], j : j + part.shape[1]] = part
