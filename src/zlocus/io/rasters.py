"""Products as Cloud Optimized GeoTIFF: written whole or by blocks, there complete or not at all."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio._err import CPLE_BaseError
from rasterio.errors import RasterioError
from rasterio.windows import Window

from zlocus.core.errors import InputError, OutputError
from zlocus.io.band_statistics import BandStatistics, is_data
from zlocus.io.block_buffer import BlockBuffer
from zlocus.io.open_raster import BLOCK_CACHE_BYTES, check_complete, gdal_message, open_raster

BLOCK_SIZE = 512
# Deflate is read everywhere. Heights, sigmas and grey values shrink by 1 % more at level 6, in nearly twice the time.
COG_OPTIONS = {"BLOCKSIZE": BLOCK_SIZE, "COMPRESS": "DEFLATE", "LEVEL": 1, "BIGTIFF": "IF_SAFER"}
_threads = ContextVar("_threads", default=1)
FLOAT_PREDICTOR, INTEGER_PREDICTOR = "FLOATING_POINT", "STANDARD"


@contextmanager
def compression_threads(threads: int) -> Iterator[None]:
    """Rasters that this thread closes meanwhile are compressed by so many; blocks are written in their order all the
    same, and so the same bytes."""
    token = _threads.set(threads)
    try:
        yield
    finally:
        _threads.reset(token)


class RasterSink:
    """A raster of a grid that is written block by block; `close` makes it a COG under its own name.

    Until then the cells wait in a file beside it (never in memory), so blocks may come in any order, of any size, from
    any thread; `close` is for when no other thread reads rasters. Cells never written have the nodata value, or 0 where
    there is none. Each band carries its statistics. As a context it closes at the end and aborts on an exception.

    path : of the COG. geobox : its grid. dtype : of the cells.
    nodata : value that means no data; None where all cells mean something.
    descriptions : name of each band, as many as there are bands. units : of all bands, "" for none.
    has_colours : whether the bands are red, green and blue.
    has_mask : whether an internal mask is written with the blocks (for images, where no value can be spared).
    average : whether overviews are averages; None: those of heights and images are, those of flags and counts are not.

    Raises
    ------
    OutputError
        From any method, when the file cannot be written (folder, permission, full disk); what was begun is removed.
    """

    def __init__(
        self,
        path: Path,
        geobox: GeoBox,
        dtype: np.typing.DTypeLike,
        *,
        nodata: float | None = None,
        descriptions: tuple[str, ...] = ("",),
        units: str = "",
        has_colours: bool = False,
        has_mask: bool = False,
        average: bool | None = None,
    ) -> None:
        self.path, self.dtype, self.has_mask = Path(path), np.dtype(dtype), has_mask
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part.tif")
        self._cog = self.path.with_name(f".{self.path.name}.{os.getpid()}.cog.tif")
        # Of the cells and of the mask.
        names = ("cells", "mask") if has_mask else ("cells",)
        self._paths = [self.path.with_name(f".{self.path.name}.{os.getpid()}.{name}") for name in names]
        self._waiting: list[BlockBuffer] = []
        self._lock = threading.Lock()
        rows, cols = geobox.shape
        self._descriptions, self._units = descriptions, units
        self._average = (self.dtype.kind == "f" or has_mask) if average is None else average
        self._profile = {
            "driver": "GTiff", "width": cols, "height": rows, "count": len(descriptions), "dtype": self.dtype.name,
            "crs": None if geobox.crs is None else geobox.crs.to_wkt(), "transform": geobox.transform, "nodata": nodata,
            "tiled": True, "blockxsize": BLOCK_SIZE, "blockysize": BLOCK_SIZE, "BIGTIFF": "IF_SAFER", "SPARSE_OK": True,
            "photometric": "RGB" if has_colours else "MINISBLACK",
        }  # fmt: skip
        kinds = ((len(descriptions), self.dtype, nodata or 0), (1, np.dtype(bool), 0))
        try:
            with self._guard():
                for path, (count, kind, empty) in zip(self._paths, kinds, strict=False):
                    self._waiting.append(BlockBuffer(path, (count, rows, cols), kind, empty, BLOCK_SIZE))
        except BaseException:
            self._remove()
            raise

    def write(self, row: int, col: int, array: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> None:
        """Put a block with its first cell at (row, col).

        array : (r, c) or (bands, r, c). mask : (r, c) bool, True is valid; None is all valid.
        """
        bands = array if array.ndim == 3 else array[np.newaxis]
        with self._lock, self._guard():
            valid = np.ones(bands.shape[1:], bool) if mask is None else mask
            for waiting, cells in zip(self._waiting, (bands, valid[np.newaxis]), strict=False):
                waiting.put(row, col, cells)

    def close(self) -> None:
        """Convert to COG and rename to `path`; nothing else stays, after an exception either."""
        options = COG_OPTIONS | {
            "PREDICTOR": FLOAT_PREDICTOR if self.dtype.kind == "f" else INTEGER_PREDICTOR,
            "OVERVIEW_RESAMPLING": "AVERAGE" if self._average else "NEAREST",
            "NUM_THREADS": _threads.get(),
        }
        try:
            with self._guard():
                self._gather()
                _check_written(self._part)
                rasterio.shutil.copy(self._part, self._cog, driver="COG", **options)
                _check_written(self._cog)
                os.replace(self._cog, self.path)
        finally:
            self._remove()

    def abort(self) -> None:
        """Remove everything that was begun; harmless after `close`."""
        self._remove()

    def _gather(self) -> None:
        """The cells as a GeoTIFF, block by block, each once and whole."""
        with rasterio.open(self._part, "w", **self._profile) as dataset:
            for band, description in enumerate(self._descriptions, 1):
                dataset.set_band_description(band, description)
            dataset.units = (self._units,) * len(self._descriptions)
            statistics = [BandStatistics() for _ in self._descriptions]
            masks = iter(self._waiting[1]) if self.has_mask else None
            for slices, cells in self._waiting[0]:
                window = Window.from_slices(*slices)
                dataset.write(cells, window=window)
                valid = None
                if masks is not None:
                    # Both came in the same blocks.
                    valid = next(masks)[1][0]
                    dataset.write_mask(valid, window=window)
                for one, band in zip(statistics, cells, strict=True):
                    one.add(band, is_data(band, dataset.nodata) if valid is None else valid)
            for number, one in enumerate(statistics, 1):
                n_left = dataset.width * dataset.height - one.n
                if self.has_mask or dataset.nodata is not None:
                    one.add_nothing(n_left)
                else:
                    one.add_zeros(n_left)
                # GDAL copies them into the COG; computed by a reader they would go to a file beside it.
                dataset.update_tags(number, **one.tags())

    def _remove(self) -> None:
        for waiting in self._waiting:
            with suppress(OSError):  # of a full disk
                waiting.close()
        for path in (*self._paths, self._part, self._cog):
            with suppress(OSError):  # where it could not be made
                path.unlink()

    @contextmanager
    def _guard(self) -> Iterator[None]:
        """GDAL's settings for writing, and its errors (of several unrelated kinds) as one."""
        try:
            with rasterio.Env(GDAL_CACHEMAX=BLOCK_CACHE_BYTES, GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED=False):
                yield
        except (RasterioError, CPLE_BaseError, InputError, OSError, SystemError) as error:
            self._remove()
            raise OutputError(
                f"{self.path} cannot be written: {gdal_message(error)}. Check the folder, its permissions and the space left."
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
    """Write a whole raster as COG. array : (r, c) or (bands, r, c); mask : (r, c), True is valid. See `RasterSink`."""
    if descriptions is None:
        descriptions = ("",) * (1 if array.ndim == 2 else len(array))
    with RasterSink(
        path, geobox, array.dtype, nodata=nodata, descriptions=descriptions, units=units, has_mask=mask is not None
    ) as sink:
        sink.write(0, 0, array, mask)


def _check_written(path: Path) -> None:
    """GDAL does not report every failed write of a full disk: see that all blocks are there."""
    with open_raster(path) as dataset:
        check_complete(dataset, path)
