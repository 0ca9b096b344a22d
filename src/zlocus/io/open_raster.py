"""Open rasters for reading, the same way everywhere: small caches, no warnings, and errors as sentences."""

from __future__ import annotations

import functools
import math
import os
import re
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.enums import Interleaving
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.core.scene import HeldPixels
from zlocus.io.archives import archive_name, is_archived, is_folder_in_archive, stored_file
from zlocus.io.stored_files import byte_length, file_exists, first_bytes, is_remote
from zlocus.io.tiff_blocks import held_in_blocks
from zlocus.io.tiled_products import TileHeader, is_tile_index, tile_layout
from zlocus.io.virtual_rasters import ARCHIVES, REMOTE, check_served, check_virtual, is_virtual

BLOCK_CACHE_BYTES = 128 << 20
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Bytes that each block takes in the list of blocks of a TIFF.
MIN_BLOCK_ENTRY_BYTES = 4
# Blocks up to this size are always read. Larger ones are refused if they exceed the size of the file by this factor.
LARGE_BLOCK_BYTES, MAX_COMPRESSION_RATIO = 256 << 20, 10_000
# Bytes of pixel types that NumPy does not have.
PIXEL_BYTES = {"complex_int16": 4}
MAX_OPEN_RASTERS = 32  # per thread
# Beside a compressed archive GDAL would write its unpacked size, into a folder that is not ours.
_GDAL = {
    "GDAL_CACHEMAX": BLOCK_CACHE_BYTES, "GDAL_DISABLE_READDIR_ON_OPEN": "TRUE", "CPL_VSIL_GZIP_WRITE_PROPERTIES": "NO",
}  # fmt: skip
# Drivers of rasters that refer to other files or to services. They are not used, whatever a file is called; VRT is used
# for files whose name ends in .vrt.
INDIRECT_DRIVERS = frozenset((
    "DERIVED", "ECRGTOC", "EEDA", "EEDAI", "ESRIC", "GTI", "HTTP", "KMLSUPEROVERLAY", "MRF", "PLMOSAIC", "RPFTOC",
    "STACIT", "STACTA", "VRT", "WCS", "WMS", "WMTS",
))  # fmt: skip
# Formats that store pixels without compression.
UNCOMPRESSED_DRIVERS = frozenset(
    ("BT", "EHdr", "ENVI", "ERS", "GTX", "ISCE", "KRO", "LAN", "PAux", "PNM", "ROI_PAC", "SAGA")
)
# `warnings.catch_warnings` replaces a global list, so only one thread may be inside it.
_warnings_lock = threading.Lock()


def gdal_name(path: Path) -> str:
    """A path in GDAL's spelling: restores the second slash of an address or of an archive, which `Path` removes."""
    if is_archived(path):
        return archive_name(path)
    return re.sub(r"^(/vsi\w+/(?:\w+=[^/]*/)?https?:)/(?!/)", r"\1//", str(path))


def existing_file(path: Path, what: str) -> Path:
    """The path, if it is a file, in a folder or in an archive. A path on a server is not looked up.

    what : role of the file in messages ("image", "DEM").

    Raises
    ------
    InputError
        There is no such file, it is a folder, or it lies in a virtual file system that is not read.
    """
    path = Path(path)
    if is_remote(path):
        if path.parts[1] not in REMOTE:
            raise InputError(
                f"{quoted(str(path))} names a stream or an archive of a kind that is not followed. Unpack it, and give "
                f"the {what} itself, or one on a server ({', '.join(f'/{name}/' for name in REMOTE[:3])}...)."
            )
        return path
    try:
        if is_archived(path):
            is_folder = is_folder_in_archive(path)
            is_there = is_folder or file_exists(path)
        else:
            is_there, is_folder = path.exists(), path.is_dir()
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise InputError(f"There can be no {what} {quoted(str(path))}: {why.lower()}. Check the path.") from error
    if is_folder:
        raise InputError(f"The {what} {path} is a folder. Give the files in it one by one.")
    if not is_there:
        raise InputError(f"There is no {what} {path}. Check the path.")
    return path


@contextmanager
def open_raster(path: Path, what: str = "image") -> Iterator[rasterio.DatasetReader]:
    """Open a raster for the block; errors of rasterio or GDAL inside the block become `InputError`.

    GDAL's block cache is limited to `BLOCK_CACHE_BYTES`. Files beside the raster are looked up by name, without listing
    the folder. The warning that an image has no georeference, true of every unrectified image, is suppressed.
    """
    path = existing_file(path, what)
    with rasterio.Env(**_GDAL), _opened(path) as dataset, _read_errors(path):
        if dataset.driver in UNCOMPRESSED_DRIVERS and not is_remote(path):
            _check_plain(dataset, path)
        yield dataset


@contextmanager
def cached_raster(path: Path) -> Iterator[rasterio.DatasetReader]:
    """As `open_raster`, but the image stays open, with its cached blocks, for the next call of the same thread.

    A file that has changed is opened again. Handles of GDAL must not be shared between threads, nor between a process
    and its fork.
    """
    path = existing_file(path, "image")
    with rasterio.Env(**_GDAL):
        dataset = _open_rasters.dataset(path)
        try:
            with _read_errors(path):
                yield dataset
        except BaseException:
            _open_rasters.close(path)
            raise


def _opened(path: Path) -> rasterio.DatasetReader:
    if is_tile_index(path):
        layout = tile_layout(path, _tile_header)
        return _dataset(path, layout.as_vrt(gdal_name), is_list=True)
    is_list = path.suffix.lower() == ".vrt"
    if is_list and not is_remote(path) and is_virtual(first_bytes(path)):
        if is_archived(path):
            raise InputError(f"{path} is a list of files in an archive, which is not followed. Unpack the archive.")
        check_virtual(path)
    dataset = _dataset(path, gdal_name(path), is_list)
    if not is_remote(path):
        _check_block(dataset, path)
    elif dataset.driver == "VRT":
        try:
            check_served(path, dataset.tags(ns="xml:VRT")["xml:VRT"])
        except BaseException:
            dataset.close()
            raise
    return dataset


def _dataset(path: Path, name: str, is_list: bool) -> rasterio.DatasetReader:
    """The raster that GDAL opens by a name. path : in messages; is_list : the driver of virtual rasters may open it."""
    try:
        with _warnings_lock, warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # `rasterio.open` accepts only one driver.
            return rasterio.DatasetReader(name, driver=_drivers(is_list))
    except (RasterioError, CPLE_BaseError, OSError, UnicodeDecodeError) as error:
        if not is_list and not is_remote(path) and is_virtual(first_bytes(path)):
            raise InputError(f"{path} is a list of other files. Call it .vrt, if that is meant.") from error
        reason = _without_name(gdal_message(error), name)
        raise InputError(
            f"{path} cannot be opened as a raster: {reason}. Check that it is a complete GeoTIFF (or another format of "
            "GDAL)."
        ) from error


def _tile_header(path: Path) -> TileHeader:
    """The size and the bands of a tile of a product, which is checked to be complete."""
    first = first_bytes(path).lstrip()
    if not first or is_virtual(first) or first.startswith((b"<", b"{", *ARCHIVES)):
        raise InputError(f"The tile {path} is empty or holds no pixels itself. Copy the product again.")
    with open_raster(path, "tile") as source:
        check_complete(source, path)
        return TileHeader(
            source.shape,
            source.dtypes[0],
            tuple(meaning.name for meaning in source.colorinterp),
            source.nodata,
        )


def _check_block(source: rasterio.DatasetReader, path: Path) -> None:
    """Refuse a TIFF whose blocks would need far more memory than the file is large: a block is decoded as a whole."""
    if source.driver not in ("GTiff", "COG") or not source.count:
        return
    bands = source.count if source.interleaving == Interleaving.pixel else 1
    kind = source.dtypes[0]
    pixel = PIXEL_BYTES[kind] if kind in PIXEL_BYTES else np.dtype(kind).itemsize
    n_bytes, length = math.prod(source.block_shapes[0]) * bands * pixel, byte_length(path)
    if n_bytes > max(LARGE_BLOCK_BYTES, MAX_COMPRESSION_RATIO * length):
        source.close()
        raise InputError(
            f"{path} is damaged: it says that it has blocks of {n_bytes / 1e9:.1f} GB of pixels, in {length} bytes. "
            "Copy it again from its source."
        )


@functools.cache
def _drivers(virtual: bool) -> list[str]:
    """The drivers of GDAL that may open a file. virtual : include VRT."""
    with rasterio.Env() as gdal:
        return [name for name in gdal.drivers() if name not in INDIRECT_DRIVERS or (virtual and name == "VRT")]


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (RasterioError, CPLE_BaseError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read: {gdal_message(error)}. It, or a file beside it that belongs to it, is damaged or "
            "truncated; copy both again from their source."
        ) from error


@dataclass
class _OpenRasters(threading.local):
    """The open rasters of one thread, the last used at the end, each with the state of its file when it was opened."""

    datasets: OrderedDict[Path, tuple[tuple[int, ...], rasterio.DatasetReader]] = field(default_factory=OrderedDict)

    def dataset(self, path: Path) -> rasterio.DatasetReader:
        """The open raster of a file; it is opened if it is not open, or if the file has changed."""
        state: tuple[int, ...] = (os.getpid(),)
        if not is_remote(path):
            file = os.stat(stored_file(path))
            state += (file.st_dev, file.st_ino, file.st_size, file.st_mtime_ns)
        known, dataset = self.datasets.get(path, (None, None))
        if known != state or dataset is None:
            self.close(path)
            dataset = _opened(path)
            self.datasets[path] = state, dataset
            if len(self.datasets) > MAX_OPEN_RASTERS:
                self.close(next(iter(self.datasets)))
        self.datasets.move_to_end(path)
        return dataset

    def close(self, path: Path) -> None:
        """Close a raster, unless another process opened it."""
        state, dataset = self.datasets.pop(path, (None, None))
        if state and dataset and state[0] == os.getpid():
            dataset.close()


_open_rasters = _OpenRasters()


def check_complete(source: rasterio.DatasetReader, path: Path) -> HeldPixels | None:
    """Check that a TIFF or PNG is not truncated, and return the parts that a sparse TIFF stores (None: everything).

    Offsets and sizes of all blocks or chunks are compared with the length of the file; nothing is decoded. Other
    formats are not checked, because GDAL or `open_raster` detects truncation; neither are files on servers and files
    that are compressed in an archive, whose checksum tells.

    Raises
    ------
    InputError
        Pixels lie behind the end of the file, or there are too many blocks.
    """
    if is_remote(path) or is_archived(path) or is_tile_index(path):
        return None
    if source.driver == "PNG":
        _check_png(path)
    if source.driver not in ("GTiff", "COG"):
        return None
    length = os.path.getsize(path)
    block_rows, block_cols = source.block_shapes[0]
    n_down, n_across = -(-source.height // block_rows), -(-source.width // block_cols)
    if n_down * n_across * MIN_BLOCK_ENTRY_BYTES > length:
        raise InputError(
            f"{path} is damaged: it says that it has {n_down * n_across} blocks of pixels, which its {length} bytes "
            "cannot list. Copy it again from its source."
        )
    return held_in_blocks(source, path)


def _check_plain(source: rasterio.DatasetReader, path: Path) -> None:
    """Refuse a truncated file of pixels without compression: GDAL would read the missing pixels as 0."""
    sizes = {name: os.path.getsize(name) for name in source.files if os.path.isfile(name)}
    largest = max(sizes, key=lambda name: sizes[name], default=None)
    if largest is None or first_bytes(Path(largest)).startswith(tuple(ARCHIVES)):
        return
    item_bits = int(source.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", 8 * np.dtype(source.dtypes[0]).itemsize))
    needed = source.count * source.height * source.width * item_bits // 8
    if sizes[largest] < needed:
        raise InputError(
            f"{path} is truncated: {Path(largest).name} has {sizes[largest]} bytes, and its pixels take {needed}. Copy "
            "it again from its source."
        )


def _check_png(path: Path) -> None:
    """Refuse a PNG that ends before its last chunk. Source: PNG specification (ISO/IEC 15948), 5.2 and 5.3."""
    length, at, kind = os.path.getsize(path), len(PNG_SIGNATURE), b""
    with path.open("rb") as file:
        while kind != b"IEND":
            file.seek(at)
            head = file.read(8)
            # A chunk has its length and name before its content, and a checksum behind it.
            at += 12 + int.from_bytes(head[:4], "big")
            kind = head[4:]
            if len(head) < 8 or at > length:
                raise InputError(
                    f"{path} is truncated: it has {length} bytes, and ends before its last chunk. Copy it again from "
                    "its source."
                )


def _without_name(message: str, name: str) -> str:
    """A message of GDAL without the name of the file at its begin, which the sentence names already."""
    for start in (f"'{name}' ", f"`{name}' ", f"{name}: ", f"{name} "):
        message = message.removeprefix(start)
    return message.replace("not recognized as being in a supported file format", "its format is not known")


def gdal_message(error: BaseException) -> str:
    """GDAL's own message: that of the first error of the chain, without a full stop."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).strip().rstrip(".") or type(error).__name__
