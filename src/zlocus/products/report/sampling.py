"""What the rasters of a run hold: counts over all cells, and cells at regular distances."""

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
from zlocus.matching.quality import Quality

RASTERS = ("dsm", "sigma", "quality", "views")
MOST_SIDE = 1500
N_CODES = 1 << 16
NOT_SEEN = Quality.OUTSIDE | Quality.UNSEEN


@dataclass(frozen=True)
class Survey:
    """Counts of cells, and every `stride`-th row and column of the rasters.

    shape : rows and columns of the grid; transform : cell corners to ground; above : what band 1 of dsm.tif says its
    heights are; codes : (65536,) int64, how many cells have a value of quality.tif; n_heights : cells with a height;
    n_used : (256,) int64, how many cells rest on so many images; lowest_m, highest_m : of all heights, NaN without any.
    height, sigma : (r, c) float32 m, NaN where there is none; quality : (r, c) uint16; views : (r, c) uint8; cell
    [i, j] of these is [first + i * stride, first + j * stride] of the grid.
    """

    shape: tuple[int, int]
    transform: Affine
    above: str
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
        """First row and column of those kept."""
        return self.stride // 2

    @property
    def n_asked(self) -> int:
        """Cells inside the area asked for."""
        return self.count_without(Quality.OUTSIDE)

    @property
    def n_seen(self) -> int:
        """Cells inside the area that two images or more cover."""
        return self.count_without(NOT_SEEN)

    @property
    def n_matched(self) -> int:
        """Cells with a height that was not filled in."""
        return self.n_heights - self.count(Quality.FILLED)

    def count(self, flag: Quality) -> int:
        """Cells with a reason, inside the area asked for, or of those outside where that is the reason."""
        which = np.arange(N_CODES)
        has = (which & int(flag)) != 0
        return int(self.codes[has if flag is Quality.OUTSIDE else has & ((which & int(Quality.OUTSIDE)) == 0)].sum())

    def count_without(self, flags: Quality) -> int:
        """Cells that have none of some reasons."""
        return int(self.codes[(np.arange(N_CODES) & int(flags)) == 0].sum())

    def grid_cell(self, i: int, j: int) -> tuple[int, int]:
        """Row and column of the grid of a cell that was kept."""
        return self.first + i * self.stride, self.first + j * self.stride


def survey(folder: Path) -> Survey:
    """Look at every cell of the rasters in a folder once, block by block.

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
        return _looked_at(files)


def _looked_at(files: dict[str, rasterio.DatasetReader]) -> Survey:
    dsm = files["dsm"]
    rows, cols = dsm.shape
    stride = -(-max(rows, cols) // MOST_SIDE)
    kept_rows, kept_cols = (len(range(stride // 2, n, stride)) for n in (rows, cols))
    kept = {name: np.zeros((kept_rows, kept_cols), file.dtypes[0]) for name, file in files.items()}
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
        _keep(kept, cells, window, stride)
    is_any = n_heights > 0
    return Survey(
        shape=(rows, cols), transform=dsm.transform, above=dsm.descriptions[0] or "height", codes=codes,
        n_heights=n_heights, n_used=n_used, lowest_m=lowest if is_any else np.nan,
        highest_m=highest if is_any else np.nan, stride=stride, height=kept["dsm"], sigma=kept["sigma"],
        quality=kept["quality"], views=kept["views"],
    )  # fmt: skip


def _keep(
    kept: dict[str, NDArray[np.generic]], cells: dict[str, NDArray[np.generic]], window: Window, stride: int
) -> None:
    """Put those cells of a block that are kept into their place."""
    # The first row and column at or behind the block's that is kept.
    i, j = (-(-(start - stride // 2) // stride) for start in (window.row_off, window.col_off))
    down, across = stride // 2 + i * stride - window.row_off, stride // 2 + j * stride - window.col_off
    for name, block in cells.items():
        part = block[down::stride, across::stride]
        kept[name][i : i + part.shape[0], j : j + part.shape[1]] = part
