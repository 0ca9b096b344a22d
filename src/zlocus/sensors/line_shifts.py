"""Displacements of the lines of an image that its camera model does not know, and the image without them.

A satellite takes an image line by line while its attitude oscillates a little. The camera model is smoother than that,
so that the lines lie a few tenths of a pixel from where it says, in slow waves. An image is put right by reading each
of its lines from where it really lies; the camera model stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import ColourSource, HeldPixels, ImageSource, ImageWindow, held_pixels, masked_pixels
from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.straighten_kernel import straighten

# Half the number of pixels that Lanczos' interpolation takes from, in each direction.
LANCZOS_PX = 3


@dataclass(frozen=True)
class LineShifts:
    """Displacements of the lines of an image, linear between nodes.

    spacing : lines from a node to the next, the first is line 0; shift_px : (k, 2) column and row by which a line lies
    from where the camera model says.
    """

    spacing: float
    shift_px: FloatArray

    def at(self, row: FloatArray) -> FloatArray:
        """Displacements (n, 2) px of lines (n,)."""
        nodes = self.spacing * np.arange(len(self.shift_px))
        return np.column_stack([np.interp(row, nodes, of_axis) for of_axis in self.shift_px.T])

    @property
    def rms_px(self) -> tuple[float, float]:
        """Root mean squares of the displacements along columns and rows."""
        column, row = np.sqrt(np.mean(self.shift_px**2, axis=0))
        return float(column), float(row)

    def as_dict(self) -> dict[str, float]:
        """The sizes of the displacements for run.json."""
        column, row = self.rms_px
        return {"column_rms": round(column, 4), "row_rms": round(row, 4), "largest": round(self.max_px, 4)}

    @property
    def max_px(self) -> float:
        """Largest displacement in either direction."""
        return float(np.abs(self.shift_px).max(initial=0.0))


@dataclass(frozen=True)
class StraightenedImage:
    """An image whose lines lie where the camera model says. Colours and grey values are interpolated by Lanczos' kernel
    of six by six pixels; a pixel is valid where all of these are."""

    displaced_image: ImageSource
    line_shifts: LineShifts

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.displaced_image.shape

    @property
    def dtype(self) -> str:
        """See `ImageSource`."""
        return self.displaced_image.dtype

    @property
    def held(self) -> HeldPixels | None:
        """See `SparseSource`."""
        return held_pixels(self.displaced_image)

    @property
    def has_colours(self) -> bool:
        """See `ColourSource`."""
        return isinstance(self.displaced_image, ColourSource) and self.displaced_image.has_colours

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """See `ImageSource`."""
        window = _Window.around((row, col, rows, cols), self.shape, self._margin)
        read = self.displaced_image.read(*window.inside)
        pixels, valid = self._straightened(read.pixels, window), window.padded(read.valid)
        side = 2 * LANCZOS_PX + 1
        if not valid.all():
            valid = cv2.erode(valid.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        valid = valid[self._margin : self._margin + rows, self._margin : self._margin + cols]
        return ImageWindow(np.where(valid, pixels, np.float32(0.0)), valid)

    def masked(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
        """See `MaskedSource`; a pixel is masked where one of those is from which it is interpolated."""
        window = _Window.around((row, col, rows, cols), self.shape, self._margin)
        masked = masked_pixels(self.displaced_image, *window.inside)
        if masked is None:
            return None
        side = 2 * LANCZOS_PX + 1
        wider = cv2.dilate(window.padded(masked).astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        return np.asarray(wider[self._margin : self._margin + rows, self._margin : self._margin + cols])

    def colours(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """See `ColourSource`."""
        assert isinstance(self.displaced_image, ColourSource), "callers ask whether it has colours"
        window = _Window.around((row, col, rows, cols), self.shape, self._margin)
        bands = self.displaced_image.colours(*window.inside)
        return np.stack([self._straightened(band, window) for band in bands])

    @property
    def _margin(self) -> int:
        """Pixels around a window that it is interpolated from."""
        return LANCZOS_PX + int(np.ceil(self.line_shifts.max_px))

    def _straightened(self, pixels: NDArray[np.float32], window: _Window) -> NDArray[np.float32]:
        """The pixels (r, c) of a window from those read for it."""
        rows, cols = window.shape
        shift = self.line_shifts.at(window.row + np.arange(rows, dtype=float))
        whole = np.floor(shift).astype(np.int64)
        col_weights, row_weights = (lanczos_weights(fraction) for fraction in (shift - whole).T)
        first = self._margin - LANCZOS_PX + 1 + whole
        out = np.empty((rows, cols), np.float32)
        straighten(
            window.padded(np.asarray(pixels, np.float32)), np.arange(rows) + first[:, 1], row_weights,
            np.ascontiguousarray(first[:, 0]), col_weights, out,
        )  # fmt: skip
        return out


@dataclass(frozen=True)
class _Window:
    """A window of an image, and what is read for it.

    row : its first row; shape : its rows and columns; inside : the window with its margin as far as the image reaches,
    (row, col, rows, cols); padding : rows above and below, columns left and right, that the image does not have.
    """

    row: int
    shape: tuple[int, int]
    inside: tuple[int, int, int, int]
    padding: tuple[tuple[int, int], tuple[int, int]]

    @classmethod
    def around(cls, window: tuple[int, int, int, int], image_shape: tuple[int, int], margin: int) -> _Window:
        row, col, rows, cols = window
        top, left = max(row - margin, 0), max(col - margin, 0)
        bottom, right = min(row + rows + margin, image_shape[0]), min(col + cols + margin, image_shape[1])
        above, below = top - row + margin, row + rows + margin - bottom
        beside, beyond = left - col + margin, col + cols + margin - right
        inside = (top, left, bottom - top, right - left)
        return cls(row, (rows, cols), inside, ((above, below), (beside, beyond)))

    def padded(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values that were read, repeated beyond the borders of the image."""
        return np.ascontiguousarray(np.pad(values, self.padding, mode="edge"))


def lanczos_weights(fraction: FloatArray) -> NDArray[np.float32]:
    """Weights (n, 6) of the pixels around positions that lie so far (n,) beyond the third of them; their sum is 1."""
    distance = fraction[:, None] - np.arange(1 - LANCZOS_PX, LANCZOS_PX + 1)
    weights = np.sinc(distance) * np.sinc(distance / LANCZOS_PX)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)
