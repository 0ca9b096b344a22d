"""Find pixels without a grey value that no nodata value declares: plateaus at the border, and too large values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.scene import ImageSource, ImageWindow

# Largest grey value of any sensor, that of 32-bit integers. Larger numbers, squared and summed over an image, would
# exceed the range of float32.
MAX_GREY_VALUE = 2.0**32
# A plateau is searched for at this number of places along each side of an image. It is at least this wide at one of
# them.
PLACES_PER_SIDE, MIN_PLATEAU_WIDTH_PX = 24, 8
# A plateau fills at least this share of the image; a smaller one may be a dark corner or a bright roof. It also holds
# at least this share of all pixels of its value; otherwise the value is an ordinary one, such as that of saturated
# pixels.
MIN_PLATEAU_SHARE, MIN_SHARE_OF_VALUE = 1e-3, 0.5
BAND_ROWS = 256  # rows read at a time
# Images of so many pixels or fewer are read once, which takes less time than many small windows.
MAX_PX_READ_WHOLE = 1_000_000


@dataclass(frozen=True, eq=False)
class BorderPlateau:
    """Pixels of one constant value that are connected to the border of an image.

    value : their grey value; left, right : (r,) int64, how many pixels of each row belong to it at its begin and its
    end; top, bottom : (c,) int64, the same for columns.
    """

    value: float
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    top: NDArray[np.int64]
    bottom: NDArray[np.int64]

    def covers(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_]:
        """The pixels (r, c) of a window that belong to the plateau."""
        r, c = np.arange(row, row + rows)[:, None], np.arange(col, col + cols)
        n_rows, n_cols = len(self.left), len(self.top)
        left, right = self.left[row : row + rows, None], n_cols - self.right[row : row + rows, None]
        top, bottom = self.top[col : col + cols], n_rows - self.bottom[col : col + cols]
        return np.asarray((c < left) | (c >= right) | (r < top) | (r >= bottom))

    @property
    def n_pixels(self) -> int:
        """Number of pixels of the plateau."""
        n_cols = len(self.top)
        return sum(int(self.covers(row, 0, rows, n_cols).sum()) for row, rows in row_bands(len(self.left)))


def border_plateau(image: ImageSource) -> BorderPlateau | None:
    """The plateau at the border of an image; None where there is none, or too small a one.

    The whole image is read only if a few windows along its border suggest a plateau.

    Raises
    ------
    InputError
        The image cannot be read.
    """
    rows, cols = image.shape
    value = _value_at_border(image)
    if value is None:
        return None
    left, right = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
    first_other, last_other = np.full(cols, rows), np.full(cols, -1)
    n_of_value = 0
    for row, count in row_bands(rows):
        window = image.read(row, 0, count, cols)
        n_of_value += int((window.valid & (window.pixels == value)).sum())
        is_other = window.valid & (window.pixels != value)
        has_other = is_other.any(axis=1)
        left[row : row + count] = np.where(has_other, is_other.argmax(axis=1), cols)
        right[row : row + count] = np.where(has_other, is_other[:, ::-1].argmax(axis=1), cols)
        here = is_other.any(axis=0)
        first_other[here] = np.minimum(first_other[here], row + is_other[:, here].argmax(axis=0))
        last_other[here] = row + count - 1 - is_other[::-1, here].argmax(axis=0)
    plateau = BorderPlateau(value, left, right, first_other.astype(np.int64), (rows - 1 - last_other).astype(np.int64))
    is_large = plateau.n_pixels >= MIN_PLATEAU_SHARE * rows * cols
    return plateau if is_large and plateau.n_pixels >= MIN_SHARE_OF_VALUE * n_of_value else None


def _value_at_border(image: ImageSource) -> float | None:
    """The value of a possible plateau: that of most of the checked places that are constant; None where none is."""
    rows, cols = image.shape
    depth = MIN_PLATEAU_WIDTH_PX
    if min(rows, cols) < 4 * depth:
        return None
    votes: dict[float, int] = {}
    across = [
        (int(row), col, 1, depth) for row in np.linspace(0, rows - 1, PLACES_PER_SIDE) for col in (0, cols - depth)
    ]
    down = [(row, int(col), depth, 1) for col in np.linspace(0, cols - 1, PLACES_PER_SIDE) for row in (0, rows - depth)]
    whole = image.read(0, 0, rows, cols) if rows * cols <= MAX_PX_READ_WHOLE else None
    for place in (*across, *down):
        window = image.read(*place) if whole is None else part_of(whole, *place)
        first = float(window.pixels.flat[0])
        if window.valid.all() and (window.pixels == first).all():
            votes[first] = votes.get(first, 0) + 1
    return max(votes, key=lambda value: votes[value]) if votes else None


def part_of(image_window: ImageWindow, row: int, col: int, rows: int, cols: int) -> ImageWindow:
    """The window of rows x cols pixels that starts at (row, col) of another window."""
    at = slice(row, row + rows), slice(col, col + cols)
    return ImageWindow(image_window.pixels[at], image_window.valid[at])


@dataclass(frozen=True)
class TooLargeValues:
    """How many pixels have a value that is too large for a grey value.

    n_pixels : their number; n_known : number of pixels with a finite value; largest : the largest magnitude of all.
    """

    n_pixels: int
    n_known: int
    largest: float


def count_too_large_values(shape: tuple[int, int], read: Callable[[int, int], NDArray[np.floating]]) -> TooLargeValues:
    """Count the values of an image beyond `MAX_GREY_VALUE`.

    read : returns rows of the image, (r, c) float, for the first row and the number of rows.
    """
    n_pixels, n_known, largest = 0, 0, 0.0
    for row, count in row_bands(shape[0]):
        magnitude = np.abs(read(row, count))
        magnitude = magnitude[np.isfinite(magnitude)]
        n_known += magnitude.size
        n_pixels += int((magnitude > MAX_GREY_VALUE).sum())
        largest = max(largest, float(magnitude.max(initial=0.0)))
    return TooLargeValues(n_pixels, n_known, largest)


def row_bands(n_rows: int) -> Iterator[tuple[int, int]]:
    """First row and number of rows of the bands in which a whole image is read."""
    for row in range(0, n_rows, BAND_ROWS):
        yield row, min(BAND_ROWS, n_rows - row)


def drop_pixels(image_window: ImageWindow, dropped: NDArray[np.bool_]) -> ImageWindow:
    """The window with some more pixels, (r, c) bool, made invalid."""
    if not dropped.any():
        return image_window
    return ImageWindow(np.where(dropped, np.float32(0.0), image_window.pixels), image_window.valid & ~dropped)
