"""Find out which blocks of a TIFF are stored, from the list of blocks in its directory, without decoding pixels.

Source: TIFF revision 6.0 (Adobe, 1992), sections 2 and 15; BigTIFF as libtiff documents it. In a sparse file,
as GDAL writes it, blocks that are not stored have offset 0 and length 0.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Interleaving

from zlocus.core.errors import InputError
from zlocus.core.scene import HeldPixels

# Tags with the offsets in the file, and with the lengths in bytes, of strips and of tiles.
OFFSETS, LENGTHS = (273, 324), (279, 325)
# NumPy's type of the values, by the number of the TIFF type: SHORT, LONG, IFD, LONG8, IFD8.
VALUE_TYPES = {3: "u2", 4: "u4", 13: "u4", 16: "u8", 18: "u8"}
# Number of values of a list in memory at a time.
VALUES_AT_ONCE = 1 << 20
# A longer list takes more than seconds to read. An image of a million pixels a side in blocks of 64 has as many.
MAX_BLOCKS = 1 << 28
# Blocks are grouped into at most this number of cells along each axis of the image.
MAX_CELLS_PER_AXIS = 1024


@dataclass(frozen=True)
class _TagValues:
    """The values of a TIFF tag in a file. at : offset of the first; n : number; dtype : with the file's byte order."""

    at: int
    n: int
    dtype: np.dtype[Any]

    def part(self, file: BinaryIO, first: int, end: int) -> NDArray[np.int64]:
        """Values from `first` to before `end`, (n,); 0 where the list or the file is too short."""
        out = np.zeros(end - first, np.int64)
        file.seek(self.at + first * self.dtype.itemsize)
        wanted = max(min(end, self.n) - first, 0)
        content = file.read(wanted * self.dtype.itemsize)
        values = np.frombuffer(content, self.dtype, len(content) // self.dtype.itemsize)
        # No file is as large as the largest signed integer.
        out[: len(values)] = np.minimum(values.astype(np.uint64), np.iinfo(np.int64).max)
        return out


def held_in_blocks(source: rasterio.DatasetReader, path: Path) -> HeldPixels | None:
    """The parts of the first image of a TIFF that are stored; None where all are, or where the file does not say.

    Where each band has its own blocks, a part counts as stored if it is stored for one band.

    Raises
    ------
    InputError
        Pixels lie behind the end of the file, or there are too many blocks.
    """
    rows, cols = source.block_shapes[0]
    n_down, n_across = -(-source.height // rows), -(-source.width // cols)
    n_of_band = n_down * n_across
    n_blocks = n_of_band * (source.count if source.interleaving == Interleaving.band else 1)
    if n_blocks > MAX_BLOCKS:
        raise InputError(
            f"{path} is cut into {n_blocks} blocks of pixels, and at most {MAX_BLOCKS} are read. Write it with larger "
            "blocks: gdal_translate -co TILED=YES."
        )
    down, across = -(-n_down // MAX_CELLS_PER_AXIS), -(-n_across // MAX_CELLS_PER_AXIS)
    held, is_sparse = np.zeros((-(-n_down // down), -(-n_across // across)), bool), False
    size = os.path.getsize(path)
    for first, offsets, lengths in _blocks(source, path, n_blocks):
        number = np.arange(first, first + len(offsets)) % n_of_band
        # The sum of both is not used, because it can overflow in a damaged file.
        behind = (offsets > size) | (lengths > size - offsets)
        if behind.any():
            row = int(number[behind.argmax()]) // n_across * rows
            raise InputError(
                f"{path} is truncated: it has {size} bytes, and pixels of row {row} on lie behind its end. Copy it "
                "again from its source."
            )
        is_stored = (offsets > 0) | (lengths > 0)
        if not is_stored.all():
            is_sparse, number = True, number[is_stored]
        held[number // n_across // down, number % n_across // across] = True
    return HeldPixels((rows * down, cols * across), source.shape, held) if is_sparse else None


def _blocks(
    source: rasterio.DatasetReader, path: Path, n_blocks: int
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
    """Yield the number of a first block, and offsets and lengths (n,) in bytes of the blocks from there on.

    Yields nothing where the directory is not found, because GDAL also opens TIFFs inside other files.
    """
    with path.open("rb") as file:
        tags = _tags(file, source.get_tag_item("IFD_OFFSET", "TIFF", bidx=1))
        offsets, lengths = (next((tags[name] for name in names if name in tags), None) for names in (OFFSETS, LENGTHS))
        if offsets is None or lengths is None:
            return
        for first in range(0, n_blocks, VALUES_AT_ONCE):
            end = min(first + VALUES_AT_ONCE, n_blocks)
            yield first, offsets.part(file, first, end), lengths.part(file, first, end)


def _tags(file: BinaryIO, directory: str | None) -> dict[int, _TagValues]:
    """The values of the tags in a directory of a TIFF. directory : its offset in the file, as GDAL gives it."""
    head = file.read(4)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None or directory is None:
        return {}
    is_big = int.from_bytes(head[2:], "little" if order == "<" else "big") == 43
    # Bytes of the number of entries, of an entry, and of a number or an offset within an entry.
    n_count, n_entry, n_field = (8, 20, 8) if is_big else (2, 12, 4)
    field = np.dtype(f"{order}u{n_field}")
    file.seek(int(directory))
    n_entries = int(np.frombuffer(file.read(n_count).ljust(n_count, b"\0"), f"{order}u{n_count}")[0])
    start, entries = file.tell(), file.read(min(n_entries, 1 << 16) * n_entry)
    tags = {}
    for at in range(0, len(entries) - n_entry + 1, n_entry):
        tag, kind = (int(value) for value in np.frombuffer(entries, f"{order}u2", 2, at))
        n, place = (int(value) for value in np.frombuffer(entries, field, 2, at + 4))
        if kind in VALUE_TYPES:
            dtype = np.dtype(order + VALUE_TYPES[kind])
            # A few values are stored in the entry itself.
            is_inside = n * dtype.itemsize <= n_field
            tags[tag] = _TagValues(start + at + 4 + n_field if is_inside else place, n, dtype)
    return tags
