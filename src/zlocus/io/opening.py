"""One way to open a raster for reading: small caches, no noise, and errors as sentences."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rasterio
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
        except (RasterioError, OSError) as error:
            raise InputError(
                f"{path} cannot be opened as a raster: {_reason(error)}. Check that it is a complete GeoTIFF (or another format "
                "of GDAL)."
            ) from error
        with dataset:
            try:
                yield dataset
            except RasterioError as error:
                raise InputError(
                    f"{path} cannot be read: {_reason(error)}. It is damaged or truncated; copy it again from its "
                    "source."
                ) from error


def _reason(error: BaseException) -> str:
    """GDAL's own words: those of the first error of the chain, without a full stop."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).strip().rstrip(".") or type(error).__name__
