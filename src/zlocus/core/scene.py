"""What is matched, where, in which frame: views and the CRS they share."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date as Date
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.sensor_model import SensorModel

# Views that a scene names at a prompt.
MOST_NAMED = 8


@dataclass(frozen=True)
class ImageWindow:
    """Pixels of a window. pixels : (r, c) float32, 0 where not valid; valid : (r, c) bool."""

    pixels: NDArray[np.float32]
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class HeldPixels:
    """The parts of an image whose pixels its file holds. A sparse file leaves out the others, which are empty.

    cell_px : rows and columns of the parts that are told apart; shape : of the image, px; cells : (r, c) bool, whether
    the file holds a pixel of the part.
    """

    cell_px: tuple[int, int]
    shape: tuple[int, int]
    cells: NDArray[np.bool_]

    @property
    def regions(self) -> NDArray[np.int64]:
        """The parts that it holds, (n, 4) first row, first column, and the first row and column beyond, px."""
        first = np.argwhere(self.cells) * self.cell_px
        return np.column_stack([first, np.minimum(first + self.cell_px, self.shape)])

    @cached_property
    def window(self) -> tuple[int, int, int, int]:
        """First row, first column, rows and columns of the smallest window that holds all of them, px."""
        (top, left), (bottom, right) = self.regions[:, :2].min(axis=0), self.regions[:, 2:].max(axis=0)
        return int(top), int(left), int(bottom - top), int(right - left)

    def inside(self, windows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which windows hold a pixel, (n,) bool. windows : (n, 4) first row, first column, and the first row and column
        beyond, px."""
        # Sums over all cells above and to the left, of which four tell how many lie inside a window.
        sums = np.pad(self.cells.cumsum(axis=0, dtype=np.int64).cumsum(axis=1), ((1, 0), (1, 0)))
        first = windows[:, :2] // self.cell_px
        end = np.minimum(-(-windows[:, 2:] // self.cell_px), self.cells.shape)
        (top, left), (bottom, right) = first.T, end.T
        return np.asarray(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0)

    def missing(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
        """The pixels (r, c) of a window that are not held; None where all are."""
        (top, bottom), (left, right) = (
            (first // side, -(-(first + count) // side))
            for first, count, side in zip((row, col), (rows, cols), self.cell_px, strict=True)
        )
        cells = self.cells[top:bottom, left:right]
        if cells.all():
            return None
        down, across = (
            np.arange(first, first + count) // side - first // side
            for first, count, side in zip((row, col), (rows, cols), self.cell_px, strict=True)
        )
        return ~cells[down[:, None], across]


class ImageSource(Protocol):
    """An image that is read by window, never whole (implemented in `zlocus.io.images`)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ...

    @property
    def dtype(self) -> str:
        """Data type of the file's pixels, as NumPy names it."""
        ...

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """The window that starts at (row, col); it lies inside the image."""
        ...


@runtime_checkable
class SparseSource(Protocol):
    """An image whose file may hold only some of its pixels."""

    @property
    def held(self) -> HeldPixels | None:
        """Those that it holds; None where it holds all, or does not say."""
        ...


def held_pixels(image: ImageSource) -> HeldPixels | None:
    """The parts of an image whose pixels its file holds; None where that is all of it, as far as is known."""
    return image.held if isinstance(image, SparseSource) else None


def held_window(image: ImageSource) -> tuple[int, int, int, int]:
    """First row, first column, rows and columns of the part of an image that its file holds: of most, all of it."""
    held = held_pixels(image)
    return (0, 0, *image.shape) if held is None else held.window


@runtime_checkable
class ColourSource(ImageSource, Protocol):
    """An image that may have colours."""

    @property
    def has_colours(self) -> bool:
        """Whether its file declares red, green and blue."""
        ...

    def colours(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.float32]:
        """Red, green and blue (3, r, c) of the same window, in the file's own numbers, of an image that has them."""
        ...


@dataclass(frozen=True)
class View:
    """One image with its sensor model in the scene's frame. camera_files : what the model was read from, besides it;
    date : of its exposure, where it is known."""

    name: str
    path: Path
    image: ImageSource
    sensor: SensorModel
    camera_files: tuple[Path, ...] = ()
    date: Date | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that it is read from."""
        return (self.path, *getattr(self.image, "sources", ()), *self.camera_files)

    def __repr__(self) -> str:
        rows, cols = self.image.shape
        return f"View({self.name}, {rows} x {cols} px, {type(self.sensor).__name__})"


@dataclass(frozen=True)
class Scene:
    """Views that share a frame: projected easting, northing and ellipsoidal height in metres, or local x, y, z (up).

    bounds : (xmin, ymin, xmax, ymax) of the area asked for, in `crs`; None is the ground seen by two views or more.
    heights : (zmin, zmax) m, ellipsoidal, searched; None is found from the tie points.
    """

    views: tuple[View, ...]
    crs: CRS
    bounds: tuple[float, float, float, float] | None = None
    heights: tuple[float, float] | None = None

    def __repr__(self) -> str:
        """In a line: a sensor alone has hundreds of numbers."""
        names = [view.name for view in self.views[:MOST_NAMED]] + ["..."] * (len(self.views) > MOST_NAMED)
        frame = "a local frame" if is_local(self.crs) else self.crs.name
        asked = [f"{name} {value}" for name in ("bounds", "heights") if (value := getattr(self, name)) is not None]
        return f"Scene({len(self.views)} views: {', '.join(names)}; {'; '.join([frame, *asked])})"


def is_local(crs: CRS) -> bool:
    """Whether a frame is local Cartesian axes at no known place of the Earth."""
    return bool(crs.is_engineering)
