"""Values of an image at places between its pixels, read from the one window that holds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

# Pixels around the places that cubic interpolation takes from.
MARGIN_PX = 3
# Invalid pixels beside valid ones are filled by the mean of the valid ones within this window, for the interpolation.
FILLED_PX = 5
# A mean over several pixels is valid where more than this share of them is.
MIN_VALID_SHARE = 0.5


@dataclass(frozen=True)
class BandWindow:
    """Pixels of a window of an image. values : (b, r, c) float; valid : (r, c) bool, of all bands."""

    values: NDArray[Any]
    valid: NDArray[np.bool_]


# First row, first column, rows and columns of a window inside the image.
ReadWindow = Callable[[int, int, int, int], BandWindow]


def sampled(
    read: ReadWindow, image_shape: tuple[int, int], xy: FloatArray, pixels_per_cell: float = 1.0
) -> BandWindow | None:
    """Values of an image at given places: (b, r, c), by cubic interpolation; None where it shows none of them.

    read : reads a window of the image; image_shape : its rows and columns; xy : (r, c, 2) px, NaN where nothing is
    wanted. A value is valid where the four pixels around it are. pixels_per_cell : pixels between two places that lie
    side by side: of 2 or more, means over so many pixels are interpolated, or fine detail would be falsified.
    """
    rows, cols = image_shape
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = np.all((xy >= -0.5) & (xy <= np.array([cols, rows]) - 0.5), axis=-1)
    if not inside.any():
        return None
    factor = max(int(pixels_per_cell + 1e-6), 1)
    (left, top), (right, bottom) = (
        np.clip(np.array(end(xy[inside], axis=0)) / factor + shift, 0, np.array([cols, rows]) / factor)
        for end, shift in ((np.min, -MARGIN_PX), (np.max, MARGIN_PX + 1))
    )
    first_row, first_col = int(top) * factor, int(left) * factor
    last_row, last_col = min(int(np.ceil(bottom)) * factor, rows), min(int(np.ceil(right)) * factor, cols)
    window = reduced(read(first_row, first_col, last_row - first_row, last_col - first_col), factor)
    at = (xy - np.array([first_col, first_row]) + 0.5) / factor - 0.5
    at = np.where(inside[..., None], at, -1e6).astype(np.float32)
    values = _filled(window)
    bands = [
        cv2.remap(band, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for band in values
    ]
    share = cv2.remap(
        window.valid.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return BandWindow(np.stack(bands), inside & (share > 0.999))


def reduced(window: BandWindow, factor: int) -> BandWindow:
    """A window whose pixels are the means of the valid ones of factor x factor pixels; those at the end of fewer."""
    if factor == 1:
        return window
    _, rows, cols = window.values.shape
    padding = (0, -rows % factor), (0, -cols % factor)
    valid = np.pad(window.valid, padding)
    shape = (valid.shape[0] // factor, factor, valid.shape[1] // factor, factor)
    # Pixels beyond the end are no missing ones.
    count = np.pad(np.ones(window.valid.shape, np.float32), padding).reshape(shape).sum(axis=(1, 3))
    n_valid = valid.reshape(shape).sum(axis=(1, 3), dtype=np.float32)
    means = [
        np.where(valid, np.pad(band, padding), 0).reshape(shape).sum(axis=(1, 3)) / np.maximum(n_valid, 1.0)
        for band in window.values
    ]
    return BandWindow(np.stack(means).astype(window.values.dtype), n_valid > MIN_VALID_SHARE * count)


def _filled(window: BandWindow) -> NDArray[Any]:
    """The values with invalid ones beside valid ones replaced by means of these."""
    if window.valid.all():
        return window.values
    size = (FILLED_PX, FILLED_PX)
    weight = np.maximum(cv2.blur(window.valid.astype(np.float32), size), 1e-6)
    means = [cv2.blur(np.where(window.valid, band, 0), size) / weight for band in window.values]
    return np.where(window.valid, window.values, np.stack(means)).astype(window.values.dtype)
