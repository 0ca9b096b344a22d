"""Finished rasters read again by strips, for what is made of them: never whole in memory."""

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

# A quarter of a block of a COG, which stays in GDAL's cache meanwhile; work on a strip takes many times its cells.
STRIP_ROWS = 128


@dataclass(frozen=True)
class Strip:
    """Rows of a raster. row, rows : its own; above, below : rows beyond them that were asked for and are there."""

    row: int
    rows: int
    above: int
    below: int

    @property
    def own(self) -> slice:
        """Its own rows, of those read."""
        return slice(self.above, self.above + self.rows)


def strips_of(n_rows: int, aside: int = 0, strip_rows: int = STRIP_ROWS) -> Iterator[Strip]:
    """Strips of a raster, from the north, with up to `aside` rows beyond each."""
    for row in range(0, n_rows, strip_rows):
        rows = min(strip_rows, n_rows - row)
        yield Strip(row, rows, min(aside, row), min(aside, n_rows - row - rows))


class BandReader(AbstractContextManager["BandReader"]):
    """The first band of a raster on a grid, open to be read by strips.

    Raises
    ------
    InputError
        Where the file is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._opening = open_raster(path, "raster")
        self._file: rasterio.DatasetReader = self._opening.__enter__()
        self._counted: dict[str, str] = {}

    @property
    def geobox(self) -> GeoBox:
        """Its grid; without CRS where it has none."""
        wkt = None if self._file.crs is None else self._file.crs.to_wkt()
        return GeoBox(self._file.shape, self._file.transform, wkt)

    @property
    def crs(self) -> CRS | None:
        """Its CRS, None where it has none."""
        return None if self._file.crs is None else CRS.from_wkt(self._file.crs.to_wkt())

    @property
    def horizontal_geobox(self) -> GeoBox:
        """Its grid for what holds no heights: the CRS is that of x and y."""
        crs = self.crs
        return self.geobox if crs is None else GeoBox(self._file.shape, self._file.transform, crs.to_2d().to_wkt())

    @property
    def description(self) -> str:
        """Of its band, "" for none."""
        return self._file.descriptions[0] or ""

    @property
    def cell_m(self) -> float:
        """Side of a cell, m."""
        return float(self._file.transform.a)

    @property
    def dtype(self) -> str:
        """Of its cells, as NumPy names it."""
        return str(self._file.dtypes[0])

    def statistic(self, name: str) -> float | None:
        """MINIMUM, MAXIMUM, MEAN, STDDEV, VALID_PERCENT of the band, None where no cell is valid; read from the cells
        where the file does not say."""
        tags = self._file.tags(1)
        if "STATISTICS_MEAN" not in tags:
            tags = self._counted = self._counted or self._count()
        value = tags.get(f"STATISTICS_{name}")
        return None if value is None else float(value)

    def _count(self) -> dict[str, str]:
        statistics = BandStatistics()
        for strip in strips_of(self._file.height):
            window = self._window(strip)
            statistics.add(self._file.read(1, window=window), self._file.read_masks(1, window=window) > 0)
        return statistics.tags()

    def read(self, strip: Strip) -> NDArray[Any]:
        """Cells of a strip with what is beside it, (r, c)."""
        return np.asarray(self._file.read(1, window=self._window(strip)))

    def read_rows(self, row: int, rows: int) -> NDArray[Any]:
        """Cells of some rows, (r, c)."""
        return self.read(Strip(row, rows, 0, 0))

    def read_bands(self, strip: Strip) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Cells of all bands, (bands, r, c), and whether they are valid, (r, c)."""
        window = self._window(strip)
        return np.asarray(self._file.read(window=window)), np.asarray(self._file.dataset_mask(window=window)) > 0

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opening.__exit__(kind, error, trace)

    def _window(self, strip: Strip) -> Window:
        rows = strip.above + strip.rows + strip.below
        return Window(0, strip.row - strip.above, self._file.width, rows)


def check_same_grid(bands: list[BandReader]) -> None:
    """Make sure that rasters of one result lie on one grid.

    Raises
    ------
    InputError
        Where one does not.
    """
    first = bands[0]
    for band in bands[1:]:
        if band.geobox.shape != first.geobox.shape or band.geobox.transform != first.geobox.transform:
            raise InputError(f"{band.path} is not on the grid of {first.path}. Make both in one run.")
