"""Arrays that spill to disk where memory has no room for them."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from zlocus.core.errors import OutputError

# Bytes written to a file at a time; and the smallest file, because file descriptors are few.
PART_BYTES, FILE_BYTES = 64_000_000, 1 << 30
ALIGNED = 64


class SpillArrays:
    """Makes arrays in memory while there is room, and then in unnamed files that disappear with the process.

    Files are mapped: what is read and written of them counts as memory of the process until `rest` is called.
    """

    def __init__(self, beside: Path, room_bytes: float, least_file_bytes: int = FILE_BYTES) -> None:
        """beside : folder on whose disk files are made; room_bytes : memory that all arrays together may take;
        least_file_bytes : size of the smallest file, where less than `FILE_BYTES` is known to be enough."""
        self.folder = next(path for path in (beside, *beside.absolute().parents) if path.is_dir())
        self.room_bytes = room_bytes
        self.least_file_bytes = min(least_file_bytes, FILE_BYTES)
        self.file_bytes = 0
        self._maps: list[mmap.mmap] = []
        self._used = 0

    def full(self, shape: tuple[int, ...], value: Any, dtype: DTypeLike) -> NDArray[Any]:
        """A new array filled with a value, as `numpy.full` makes it.

        Raises
        ------
        OutputError
            Neither memory nor the disk has room for it.
        """
        return self._filled(np.broadcast_to(np.asarray(value, dtype), shape))

    def copied(self, values: NDArray[Any]) -> NDArray[Any]:
        """A copy of an array. Errors as of `full`."""
        return self._filled(values)

    def rest(self) -> None:
        """Release the memory that mapped files take; their content stays."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for held in self._maps:
                held.madvise(mmap.MADV_DONTNEED)

    def _filled(self, values: NDArray[Any]) -> NDArray[Any]:
        n_bytes = math.prod(values.shape) * values.dtype.itemsize
        if n_bytes <= self.room_bytes or not n_bytes:
            self.room_bytes -= n_bytes
            return np.array(values)
        held, first = self._mapped(n_bytes)
        out = np.frombuffer(held, values.dtype, values.size, first).reshape(values.shape)
        rows = max(PART_BYTES * len(out) // n_bytes, 1)
        for row in range(0, len(out), rows):
            out[row : row + rows] = values[row : row + rows]
            self.rest()
        return out

    def _mapped(self, n_bytes: int) -> tuple[mmap.mmap, int]:
        """A mapped file with room for n_bytes, and the offset of the first one.

        The space is allocated now: writing to a mapped file for which the disk has no room would kill the process.
        """
        self.file_bytes += n_bytes
        first = -(-self._used // ALIGNED) * ALIGNED
        if self._maps and first + n_bytes <= len(self._maps[-1]):
            self._used = first + n_bytes
            return self._maps[-1], first
        size = max(n_bytes, self.least_file_bytes)
        try:
            with tempfile.TemporaryFile(dir=self.folder) as file:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, size)
                else:
                    file.truncate(size)
                held = mmap.mmap(file.fileno(), size)
        except OSError as error:
            raise OutputError(
                f"{self.folder} cannot hold the {size / 1e9:.2g} GB that memory has no room for: "
                f"{error.strerror or error}. Choose a folder on a larger disk with -o, or a machine with more memory."
            ) from error
        self._maps.append(held)
        self._used = n_bytes
        return held, 0
