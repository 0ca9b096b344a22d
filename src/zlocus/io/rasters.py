"""Write rasters as Cloud Optimized GeoTIFF (COG), whole or by blocks. A file appears only when it is complete."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.windows import Window

from zlocus.core.errors import InputError, OutputError
from zlocus.io.band_statistics import BandStatistics, is_data
from zlocus.io.block_buffer import BlockBuffer
from zlocus.io.open_raster import BLOCK_CACHE_BYTES, check_complete, gdal_message, open_raster

BLOCK_SIZE = 512
# Every reader knows Deflate. Level 6 makes heights, sigmas and grey values 1 % smaller and takes nearly twice as long.
COG_OPTIONS = {"BLOCKSIZE": BLOCK_SIZE, "COMPRESS": "DEFLATE", "LEVEL": 1, "BIGTIFF": "IF_SAFER"}
_threads = ContextVar("_threads", default=1)
FLOAT_PREDICTOR, INTEGER_PREDICTOR = "FLOATING_POINT", "STANDARD"


@contextmanager
def compression_threads(threads: int) -> Iterator[None]:
    """Compress the rasters that this thread closes inside the block with this number of threads.

    Blocks are still written in their order, so the bytes of a file do not depend on the number.
    """
    token = _threads.set(threads)
    try:
        yield
    finally:
        _threads.reset(token)


@dataclass(frozen=True)
class RasterBands:
    """The bands of a raster to be written.

    dtype : type of the cells. nodata : value that means no data; None where every value is valid.
    descriptions : one name per band, so they also give the number of bands. units : unit of all bands, "" for none.
    has_colours : the bands are red, green and blue. meanings : what each band shows; empty: as `has_colours` says.
    has_mask : an internal mask is written with the blocks (for images, in which every value is a valid grey value).
    average_overviews : overviews hold averages. None: averages for float cells and for rasters with a mask, the nearest
    cell for all others (flags and counts). tags : of each band, for other programs.
    """

    dtype: np.typing.DTypeLike
    nodata: float | None = None
    descriptions: tuple[str, ...] = ("",)
    units: str = ""
    has_colours: bool = False
    has_mask: bool = False
    meanings: tuple[ColorInterp, ...] = ()
    average_overviews: bool | None = None
    tags: Mapping[str, str] = field(default_factory=dict)

    @property
    def overview_resampling(self) -> str:
        """GDAL's name of the resampling of overviews."""
        average = self.average_overviews
        if average is None:
            average = np.dtype(self.dtype).kind == "f" or self.has_mask
        return "AVERAGE" if average else "NEAREST"


class RasterSink:
    """A raster that is written block by block; `close` turns it into a COG under its own name.

    Until then the cells are kept in a temporary file beside it, never in memory, so blocks may come in any order, of
    any size and from any thread. Call `close` only while no other thread reads rasters (see `BlockBuffer`). Cells that
    were never written get the nodata value, or 0 where there is none. Each band carries its statistics. Used as a
    context manager, the raster is closed at the end of the block and removed after an exception.

    path : file to write. geobox : its grid.

    Raises
    ------
    OutputError
        From any method: the file cannot be written (folder, permission, full disk). All temporary files are removed.
    """

    def __init__(self, path: Path, geobox: GeoBox, bands: RasterBands) -> None:
        self.path, self._bands, self._dtype = Path(path), bands, np.dtype(bands.dtype)
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part.tif")
        self._cog = self.path.with_name(f".{self.path.name}.{os.getpid()}.cog.tif")
        names = ("cells", "mask") if bands.has_mask else ("cells",)
        self._buffer_paths = [self.path.with_name(f".{self.path.name}.{os.getpid()}.{name}") for name in names]
        self._buffers: list[BlockBuffer] = []
        self._lock = threading.Lock()
        rows, cols = geobox.shape
        n_bands = len(bands.descriptions)
        self._profile = {
            "driver": "GTiff", "width": cols, "height": rows, "count": n_bands, "dtype": self._dtype.name,
            "crs": None if geobox.crs is None else geobox.crs.to_wkt(), "transform": geobox.transform,
            "nodata": bands.nodata, "tiled": True, "blockxsize": BLOCK_SIZE, "blockysize": BLOCK_SIZE,
            "BIGTIFF": "IF_SAFER", "SPARSE_OK": True, "photometric": "RGB" if bands.has_colours else "MINISBLACK",
        }  # fmt: skip
        contents = ((n_bands, self._dtype, bands.nodata or 0), (1, np.dtype(bool), 0))
        try:
            with self._writing():
                for path, (count, dtype, empty) in zip(self._buffer_paths, contents, strict=False):
                    self._buffers.append(BlockBuffer(path, (count, rows, cols), dtype, empty, BLOCK_SIZE))
        except BaseException:
            self._remove()
            raise

    def write(self, row: int, col: int, array: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> None:
        """Write a block whose first cell is at (row, col).

        array : (r, c) or (bands, r, c). mask : (r, c) bool, True is valid; None: all cells are valid.
        """
        cells = array if array.ndim == 3 else array[np.newaxis]
        with self._lock, self._writing():
            valid = np.ones(cells.shape[1:], bool) if mask is None else mask
            for buffer, values in zip(self._buffers, (cells, valid[np.newaxis]), strict=False):
                buffer.put(row, col, values)

    def read(self, row: int, col: int, shape: tuple[int, int]) -> NDArray[Any]:
        """Cells (r, c) of the first band as they were written so far, from (row, col) on. shape : rows and columns."""
        with self._lock, self._writing():
            return np.asarray(self._buffers[0].get(row, col, shape)[0])

    def close(self) -> None:
        """Convert the cells to a COG and give it its name. Temporary files are removed, also after an exception."""
        options = COG_OPTIONS | {
            "PREDICTOR": FLOAT_PREDICTOR if self._dtype.kind == "f" else INTEGER_PREDICTOR,
            "OVERVIEW_RESAMPLING": self._bands.overview_resampling,
            "NUM_THREADS": _threads.get(),
        }
        try:
            with self._writing():
                self._write_geotiff()
                _check_written(self._part)
                rasterio.shutil.copy(self._part, self._cog, driver="COG", **options)
                _check_written(self._cog)
                os.replace(self._cog, self.path)
        finally:
            self._remove()

    def abort(self) -> None:
        """Remove the temporary files. Does nothing after `close`."""
        self._remove()

    def _write_geotiff(self) -> None:
        """Write the buffered cells as a GeoTIFF, each block once and whole."""
        descriptions = self._bands.descriptions
        with rasterio.open(self._part, "w", **self._profile) as dataset:
            for band, description in enumerate(descriptions, 1):
                dataset.set_band_description(band, description)
                if self._bands.tags:
                    dataset.update_tags(band, **self._bands.tags)
            dataset.units = (self._bands.units,) * len(descriptions)
            if self._bands.meanings:
                dataset.colorinterp = self._bands.meanings
            statistics = [BandStatistics() for _ in descriptions]
            masks = iter(self._buffers[1]) if self._bands.has_mask else None
            for slices, cells in self._buffers[0]:
                window = Window.from_slices(*slices)
                dataset.write(cells, window=window)
                valid = None
                if masks is not None:
                    # Cells and mask were written in the same blocks.
                    valid = next(masks)[1][0]
                    dataset.write_mask(valid, window=window)
                for one, band in zip(statistics, cells, strict=True):
                    one.add(band, is_data(band, dataset.nodata) if valid is None else valid)
            for number, one in enumerate(statistics, 1):
                n_unwritten = dataset.width * dataset.height - one.n
                if self._bands.has_mask or dataset.nodata is not None:
                    one.add_invalid(n_unwritten)
                else:
                    one.add_zeros(n_unwritten)
                # GDAL copies the statistics into the COG. A reader that computes them writes a file beside the COG.
                dataset.update_tags(number, **one.tags())

    def _remove(self) -> None:
        for buffer in self._buffers:
            with suppress(OSError):  # the disk is full
                buffer.close()
        for path in (*self._buffer_paths, self._part, self._cog):
            with suppress(OSError):  # the file was never created
                path.unlink()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Apply GDAL's settings for writing, and raise its errors (of several unrelated classes) as `OutputError`."""
        try:
            with rasterio.Env(GDAL_CACHEMAX=BLOCK_CACHE_BYTES, GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED=False):
                yield
        except (RasterioError, CPLE_BaseError, InputError, OSError, SystemError) as error:
            self._remove()
            raise OutputError(
                f"{self.path} cannot be written: {gdal_message(error)}. Check the folder, its permissions and the "
                "space left."
            ) from error

    def __enter__(self) -> RasterSink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()


def write_cog(
    path: Path,
    array: NDArray[Any],
    geobox: GeoBox,
    *,
    nodata: float | None = None,
    descriptions: tuple[str, ...] | None = None,
    units: str = "",
    mask: NDArray[np.bool_] | None = None,
) -> None:
    """Write a whole raster as COG.

    array : (r, c) or (bands, r, c); mask : (r, c) bool, True is valid. For the others see `RasterBands`.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    if descriptions is None:
        descriptions = ("",) * (1 if array.ndim == 2 else len(array))
    bands = RasterBands(array.dtype, nodata, descriptions, units, has_mask=mask is not None)
    with RasterSink(path, geobox, bands) as sink:
        sink.write(0, 0, array, mask)


def _check_written(path: Path) -> None:
    """Check that all blocks of a file are there: GDAL does not report every failed write to a full disk."""
    with open_raster(path) as dataset:
        check_complete(dataset, path)
