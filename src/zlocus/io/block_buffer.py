"""Keep the cells of a raster on disk while its blocks come in any order."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Slices = tuple[slice, slice]


class BlockBuffer:
    """A plain file of square blocks, in the order in which each block got its first cell. Memory: one block.

    A GDAL dataset cannot do this. If a block is changed a second time while another thread reads any raster, GDAL's
    shared cache sometimes loses the first change (3.10: one raster in a hundred with a cache of 2 MB).

    shape : (bands, r, c) of the raster; dtype : type of the cells; nodata : value of cells that were never written;
    side : rows and columns of a block.
    """

    def __init__(self, path: Path, shape: tuple[int, int, int], dtype: np.dtype[Any], nodata: float, side: int) -> None:
        self._shape, self._side, self._nodata = shape, side, nodata
        self._block = np.empty((shape[0], side, side), dtype)
        # Number of each block within the file; -1 for a block without any cell yet.
        self._place = np.full((-(-shape[1] // side), -(-shape[2] // side)), -1)
        self._n_begun = 0
        self._file = path.open("w+b")

    def put(self, row: int, col: int, cells: NDArray[Any]) -> None:
        """Store cells (bands, r, c), the first of them at (row, col) of the raster."""
        for r, c in product(self._blocks(row, cells.shape[1]), self._blocks(col, cells.shape[2])):
            block = self._read(r, c)
            to, of = self._common(r, row, cells.shape[1]), self._common(c, col, cells.shape[2])
            block[:, to[0], of[0]] = cells[:, to[1], of[1]]
            if self._place[r, c] < 0:
                self._place[r, c], self._n_begun = self._n_begun, self._n_begun + 1
            self._file.seek(int(self._place[r, c]) * block.nbytes)
            self._file.write(block.data.cast("B"))
        self._file.flush()

    def get(self, row: int, col: int, shape: tuple[int, int]) -> NDArray[Any]:
        """Cells (bands, r, c) of a part of the raster, whose first cell is (row, col). shape : its rows and columns."""
        cells = np.empty((self._shape[0], *shape), self._block.dtype)
        for r, c in product(self._blocks(row, shape[0]), self._blocks(col, shape[1])):
            to, of = self._common(r, row, shape[0]), self._common(c, col, shape[1])
            cells[:, to[1], of[1]] = self._read(r, c)[:, to[0], of[0]]
        return cells

    def __iter__(self) -> Iterator[tuple[Slices, NDArray[Any]]]:
        """Yield rows and columns, and cells (bands, r, c), of each block that has cells. The array is reused."""
        for r, c in np.argwhere(self._place >= 0):
            rows, cols = (
                slice(n * self._side, min((n + 1) * self._side, size))
                for n, size in ((int(r), self._shape[1]), (int(c), self._shape[2]))
            )
            yield (rows, cols), self._read(r, c)[:, : rows.stop - rows.start, : cols.stop - cols.start]

    def close(self) -> None:
        """Close the file. The cells can no longer be read."""
        self._file.close()

    def _read(self, r: int, c: int) -> NDArray[Any]:
        if self._place[r, c] < 0:
            self._block[:] = self._nodata
        else:
            self._file.seek(int(self._place[r, c]) * self._block.nbytes)
            self._file.readinto(self._block.data.cast("B"))
        return self._block

    def _blocks(self, first: int, n: int) -> range:
        return range(first // self._side, math.ceil((first + n) / self._side))

    def _common(self, number: int, first: int, n: int) -> Slices:
        """The overlap of a range of cells with a block, counted from the block's first cell and from the range's."""
        low, high = max(number * self._side, first), min((number + 1) * self._side, first + n)
        return slice(low - number * self._side, high - number * self._side), slice(low - first, high - first)
