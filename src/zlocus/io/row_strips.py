"""Read finished rasters strip by strip, so that products derived from them never hold a whole raster in memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.io.band_statistics import BandStatistics
from zlocus.io.open_raster import open_raster

# A quarter of a block of a COG, which stays in GDAL's cache between strips. Working on a strip takes many times its
# memory.
STRIP_ROWS = 128


@dataclass(frozen=True)
class Strip:
    """Some rows of a raster, and rows beside them that are read along.

    row, rows : first row and number of rows of the strip; above, below : rows read beyond it on both sides.
    """

    row: int
    rows: int
    above: int
    below: int

    @property
    def own(self) -> slice:
        """The rows of the strip itself, counted from the first row that is read."""
        return slice(self.above, self.above + self.rows)


def strips_of(n_rows: int, margin_rows: int = 0, strip_rows: int = STRIP_ROWS) -> Iterator[Strip]:
    """Strips that cover a raster from its first row on, each with up to `margin_rows` rows beyond it on both sides."""
    for row in range(0, n_rows, strip_rows):
        rows = min(strip_rows, n_rows - row)
        yield Strip(row, rows, min(margin_rows, row), min(margin_rows, n_rows - row - rows))


class BandReader(AbstractContextManager["BandReader"]):
    """An open raster on a grid, read by strips. A context manager.

    Raises
    ------
    InputError
        The file is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._opening = open_raster(path, "raster")
        self._file: rasterio.DatasetReader = self._opening.__enter__()
        self._computed: dict[str, str] = {}

    @property
    def geobox(self) -> GeoBox:
        """The grid of the raster; it has no CRS where the file has none."""
        wkt = None if self._file.crs is None else self._file.crs.to_wkt()
        return GeoBox(self._file.shape, self._file.transform, wkt)

    @property
    def crs(self) -> CRS | None:
        """The CRS of the raster; None where the file has none."""
        return None if self._file.crs is None else CRS.from_wkt(self._file.crs.to_wkt())

    @property
    def horizontal_geobox(self) -> GeoBox:
        """The grid with the horizontal part of its CRS, for products that hold no heights."""
        crs = self.crs
        return self.geobox if crs is None else GeoBox(self._file.shape, self._file.transform, crs.to_2d().to_wkt())

    @property
    def description(self) -> str:
        """Description of the first band, "" for none."""
        return self._file.descriptions[0] or ""

    @property
    def cell_m(self) -> float:
        """Side of a cell, in metres of a projected CRS."""
        return float(self._file.transform.a)

    @property
    def dtype(self) -> str:
        """Type of the cells of the first band, as NumPy names it."""
        return str(self._file.dtypes[0])

    def statistic(self, name: str) -> float | None:
        """A statistic of the first band; None where no cell is valid. Computed from the cells if the file lacks it.

        name : MINIMUM, MAXIMUM, MEAN, STDDEV or VALID_PERCENT.
        """
        tags = self._file.tags(1)
        if "STATISTICS_MEAN" not in tags:
            tags = self._computed = self._computed or self._compute_statistics()
        value = tags.get(f"STATISTICS_{name}")
        return None if value is None else float(value)

    def _compute_statistics(self) -> dict[str, str]:
        statistics = BandStatistics()
        for strip in strips_of(self._file.height):
            window = self._window(strip)
            statistics.add(self._file.read(1, window=window), self._file.read_masks(1, window=window) > 0)
        return statistics.tags()

    def read(self, strip: Strip) -> NDArray[Any]:
        """Cells of the first band in a strip and in the rows read along, (r, c)."""
        return np.asarray(self._file.read(1, window=self._window(strip)))

    def read_rows(self, row: int, rows: int) -> NDArray[Any]:
        """Cells of the first band in some rows, (r, c)."""
        return self.read(Strip(row, rows, 0, 0))

    def read_bands(self, strip: Strip) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Cells of all bands, (bands, r, c), and whether they are valid, (r, c) bool."""
        window = self._window(strip)
        return np.asarray(self._file.read(window=window)), np.asarray(self._file.dataset_mask(window=window)) > 0

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opening.__exit__(kind, error, trace)

    def _window(self, strip: Strip) -> Window:
        rows = strip.above + strip.rows + strip.below
        return Window(0, strip.row - strip.above, self._file.width, rows)


def check_same_grid(readers: list[BandReader]) -> None:
    """Check that rasters of one result lie on one grid.

    Raises
    ------
    InputError
        One of them does not.
    """
    first = readers[0]
    for reader in readers[1:]:
        if reader.geobox.shape != first.geobox.shape or reader.geobox.transform != first.geobox.transform:
            raise InputError(f"{reader.path} is not on the grid of {first.path}. Make both in one run.")
