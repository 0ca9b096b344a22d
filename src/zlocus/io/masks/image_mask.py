"""The mask of an image: which pixels of a window show no ground, read when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import ImageSource, has_mask, masked_pixels

# The share of a larger image that is masked is that of so many rows spread over it.
MAX_PX_COUNTED_WHOLE, SAMPLED_ROWS = 1 << 24, 32
ROWS_AT_A_TIME = 1024


class MaskPart(Protocol):
    """The mask of one file. Parts are plain values: threads and processes share them."""

    @property
    def path(self) -> Path:
        """Its file."""
        ...

    def covers(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_]:
        """The masked pixels (r, c) of a window of the image."""
        ...


@dataclass(frozen=True, eq=False)
class ImageMask:
    """All masks of an image; a pixel is masked where one of them covers it.

    parts : the masks, at least one; files : all files that they are read from.
    """

    parts: tuple[MaskPart, ...]
    files: tuple[Path, ...]

    def covers(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_]:
        """The masked pixels (r, c) bool of a window.

        Raises
        ------
        InputError
            A file can no longer be read, or has changed its size.
        """
        first, *others = self.parts
        masked = first.covers(row, col, rows, cols)
        for part in others:
            masked = masked | part.covers(row, col, rows, cols)
        return masked


def masked_share(image: ImageSource) -> float | None:
    """Share of the pixels of an image that its mask covers, None without a mask; of a large image, that of rows spread
    over it.

    Raises
    ------
    InputError
        See `ImageMask.covers`.
    """
    if not has_mask(image):
        return None
    rows, cols = image.shape
    if rows * cols <= MAX_PX_COUNTED_WHOLE:
        parts = [(row, min(ROWS_AT_A_TIME, rows - row)) for row in range(0, rows, ROWS_AT_A_TIME)]
    else:
        parts = [(int(row), 1) for row in np.linspace(0, rows - 1, SAMPLED_ROWS)]
    masked = [masked_pixels(image, row, 0, count, cols) for row, count in parts]
    n_masked = sum(int(part.sum()) for part in masked if part is not None)
    return n_masked / (cols * sum(count for _, count in parts))
