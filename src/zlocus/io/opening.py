"""One way to open a raster for reading: small caches, no noise, and errors as sentences."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.enums import Interleaving
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from zlocus.errors import InputError

BLOCK_CACHE_MB = 64
# `warnings.catch_warnings` swaps a global list, so two threads must not be inside it at once.
_quiet = threading.Lock()


def existing_file(path: Path, what: str) -> Path:
    """`path` if it is a file. `what` names its role in the message ("image", "DEM").

    Raises
    ------
    InputError
        When there is no such file, or it is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"The {what} {path} is a folder. Give the files in it one by one.")
    if not path.exists():
        raise InputError(f"There is no {what} {path}. Check the path.")
    return path


@contextmanager
def open_raster(path: Path, what: str = "image") -> Iterator[rasterio.DatasetReader]:
    """An open rasterio dataset; what rasterio or GDAL cannot do inside the block becomes an `InputError`.

    GDAL's block cache is held to `BLOCK_CACHE_MB`, siblings of the file are probed by name instead of listing the
    folder, and the warning that an image lacks a georeference (true of every unrectified one) is not shown.
    """
    path = existing_file(path, what)
    with rasterio.Env(GDAL_CACHEMAX=BLOCK_CACHE_MB, GDAL_DISABLE_READDIR_ON_OPEN="TRUE"):
        try:
            with _quiet, warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                dataset = rasterio.open(path)
        except (RasterioError, CPLE_BaseError, OSError) as error:
            raise InputError(
                f"{path} cannot be opened as a raster: {reason(error)}. Check that it is a complete "
                "GeoTIFF (or another format of GDAL)."
            ) from error
        with dataset:
            try:
                yield dataset
            except (RasterioError, CPLE_BaseError) as error:
                raise InputError(
                    f"{path} cannot be read: {reason(error)}. It is damaged or truncated; copy it again from its "
                    "source."
                ) from error


def check_complete(source: rasterio.DatasetReader, path: Path) -> None:
    """Compare the offsets and sizes of all TIFF blocks with the length of the file, decoding nothing.

    Other formats pass.

    Raises
    ------
    InputError
        When pixels lie behind the end of the file.
    """
    if source.driver not in ("GTiff", "COG"):
        return
    length = os.path.getsize(path)
    block_rows, block_cols = source.block_shapes[0]
    n_down, n_across = -(-source.height // block_rows), -(-source.width // block_cols)
    for band in source.indexes if source.interleaving == Interleaving.band else (1,):
        for y in range(n_down):
            for x in range(n_across):
                offset = source.get_tag_item(f"BLOCK_OFFSET_{x}_{y}", "TIFF", bidx=band)
                size = source.get_tag_item(f"BLOCK_SIZE_{x}_{y}", "TIFF", bidx=band)
                if offset is not None and int(offset) + int(size or 0) > length:
                    raise InputError(
                        f"{path} is truncated: it has {length} bytes, and pixels of row {y * block_rows} on lie behind "
                        "its end. Copy it again from its source."
                    )


def reason(error: BaseException) -> str:
    """GDAL's own words: those of the first error of the chain, without a full stop."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).strip().rstrip(".") or type(error).__name__
