"""Read the colours of an image: red, green and blue where the file declares them, otherwise grey."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.windows import Window

from zlocus.io.open_raster import open_raster

CHANNELS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)


def read_colours(path: Path, row: int, rows: int, col: int = 0, cols: int | None = None) -> NDArray[np.float32]:
    """The colours of a window of an image, (rows, cols, 3) float32, in the file's own numbers. cols : None takes all up
    to the last one.

    Raises
    ------
    InputError
        The file can no longer be read.
    """
    with open_raster(path) as source:
        index = {meaning: band for band, meaning in zip(source.indexes, source.colorinterp, strict=True)}
        bands = [index[channel] for channel in CHANNELS] if all(c in index for c in CHANNELS) else [1, 1, 1]
        values = source.read(bands, window=Window(col, row, cols or source.width - col, rows), out_dtype=np.float32)
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))
