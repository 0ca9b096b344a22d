"""Pixels of images whose files can only be decoded as a whole, kept in memory while they are used.

To read a window of a JPEG, everything above it has to be decoded. A run reads hundreds of windows of each image, so it
would decode the same pixels hundreds of times.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from zlocus.io.stored_files import file_state, is_remote

# Formats whose decoders begin at the first row.
WHOLE_DRIVERS = frozenset(("JPEG", "PNG", "WEBP"))
# Memory of the decoded images that a process keeps. Larger images are read by window.
DECODED_BYTES = 768 << 20


class DecodedImages:
    """Decoded images of a process, as many as fit into a memory of so many bytes; the least recently used go first."""

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes
        self._images: OrderedDict[Path, tuple[list[int], NDArray[Any]]] = OrderedDict()
        self._lock = threading.Lock()
        self._decoding: dict[Path, threading.Lock] = {}

    def window(self, source: rasterio.DatasetReader, path: Path, band: int, window: Window) -> NDArray[Any]:
        """Pixels (r, c) of a band in a window of an open raster, from memory where its format is decoded as a whole."""
        if not 0 < whole_bytes(source, path) <= self.n_bytes:
            return np.asarray(source.read(band, window=window))
        pixels = self._decoded(source, path)
        row, col = int(window.row_off), int(window.col_off)
        return pixels[band - 1, row : row + int(window.height), col : col + int(window.width)]

    @property
    def held_bytes(self) -> int:
        """Memory of the images that are kept now."""
        with self._lock:
            return sum(pixels.nbytes for _, pixels in self._images.values())

    def limit(self, n_bytes: int) -> None:
        """Keep no more than so many bytes from now on."""
        with self._lock:
            self.n_bytes = n_bytes
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        while sum(pixels.nbytes for _, pixels in self._images.values()) > self.n_bytes:
            self._images.popitem(last=False)

    def _decoded(self, source: rasterio.DatasetReader, path: Path) -> NDArray[Any]:
        """All bands (b, r, c) of an image. A file that has changed is decoded again."""
        state = file_state(path)
        with self._lock:
            own_lock = self._decoding.setdefault(path, threading.Lock())
        with own_lock:
            with self._lock:
                known = self._images.get(path)
                if known is not None and known[0] == state:
                    self._images.move_to_end(path)
                    return known[1]
            pixels = np.asarray(source.read())
            with self._lock:
                self._images[path] = (state, pixels)
                self._images.move_to_end(path)
                self._forget_oldest()
        return pixels


def whole_bytes(source: rasterio.DatasetReader, path: Path) -> int:
    """Memory of all bands of a raster whose format is decoded as a whole; 0 of other formats, and on servers."""
    if source.driver not in WHOLE_DRIVERS or is_remote(path):
        return 0
    return int(source.count * source.height * source.width * np.dtype(source.dtypes[0]).itemsize)


# One for each process: its threads share the images.
DECODED = DecodedImages(DECODED_BYTES)
