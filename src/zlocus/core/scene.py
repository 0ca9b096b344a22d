"""Scene: views in a common frame, and the images they read their pixels from."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from datetime import date as Date
from datetime import datetime as DateTime
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.sensor_model import SensorModel

# The representation of a scene names at most this many views.
MAX_NAMED_VIEWS = 8


@dataclass(frozen=True)
class ImageWindow:
    """Pixels of a window. pixels : (r, c) float32, 0 where not valid; valid : (r, c) bool."""

    pixels: NDArray[np.float32]
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class HeldPixels:
    """The cells of an image of which its file holds pixels. A sparse file leaves out the other cells, which are empty.

    cell_px : rows and columns of a cell; shape : rows and columns of the image; cells : (r, c) bool, whether the file
    holds a pixel of a cell.
    """

    cell_px: tuple[int, int]
    shape: tuple[int, int]
    cells: NDArray[np.bool_]

    @property
    def regions(self) -> NDArray[np.int64]:
        """The cells that are held, (n, 4) px: first row and column, and the first row and column after the cell."""
        first = np.argwhere(self.cells) * self.cell_px
        return np.column_stack([first, np.minimum(first + self.cell_px, self.shape)])

    @cached_property
    def window(self) -> tuple[int, int, int, int]:
        """The smallest window that contains all cells that are held: first row, first column, rows and columns, px."""
        (top, left), (bottom, right) = self.regions[:, :2].min(axis=0), self.regions[:, 2:].max(axis=0)
        return int(top), int(left), int(bottom - top), int(right - left)

    def inside(self, windows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which windows contain a pixel that is held, (n,) bool. windows : (n, 4) px, as `regions`."""
        # Sums over all cells above and to the left; four of them give the number of cells inside a window.
        sums = np.pad(self.cells.cumsum(axis=0, dtype=np.int64).cumsum(axis=1), ((1, 0), (1, 0)))
        first = windows[:, :2] // self.cell_px
        end = np.minimum(-(-windows[:, 2:] // self.cell_px), self.cells.shape)
        (top, left), (bottom, right) = first.T, end.T
        return np.asarray(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0)

    def missing(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
        """The pixels (r, c) bool of a window that are not held; None where all are held."""
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
        """NumPy's name of the data type of the file's pixels."""
        ...

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        """The window that starts at (row, col); it lies inside the image."""
        ...


@runtime_checkable
class SparseSource(Protocol):
    """An image whose file may hold only some of its pixels."""

    @property
    def held(self) -> HeldPixels | None:
        """The cells that it holds; None where it holds all of them, or does not say."""
        ...


@runtime_checkable
class DecodedSource(Protocol):
    """An image whose file may have to be decoded as a whole."""

    @property
    def decoded_bytes(self) -> int:
        """Memory of its decoded pixels; 0 where windows of it can be read alone."""
        ...


@runtime_checkable
class MaskedSource(Protocol):
    """An image of which a mask may cover pixels. They are not valid in the windows that are read."""

    def masked(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
        """The pixels (r, c) of a window that its mask covers; None for an image without a mask."""
        ...


def masked_pixels(image: ImageSource, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_] | None:
    """The pixels (r, c) of a window of an image that its mask covers; None for an image without a mask."""
    return image.masked(row, col, rows, cols) if isinstance(image, MaskedSource) else None


def has_mask(image: ImageSource) -> bool:
    """Whether an image has a mask, whatever it covers."""
    return masked_pixels(image, 0, 0, 1, 1) is not None


def held_pixels(image: ImageSource) -> HeldPixels | None:
    """The cells of an image of which its file holds pixels; None where it holds all of them, as far as is known."""
    return image.held if isinstance(image, SparseSource) else None


def held_window(image: ImageSource) -> tuple[int, int, int, int]:
    """First row, first column, rows and columns of the part of an image that its file holds; most files hold all."""
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
        """Red, green and blue of a window, (3, r, c), in the numbers of the file; only where the image has colours."""
        ...


@dataclass(frozen=True)
class SunDirection:
    """Where the sun stood. azimuth_deg : clockwise from north, 0 to 360; altitude_deg : above the horizon."""

    azimuth_deg: float
    altitude_deg: float

    def angle_deg(self, other: SunDirection) -> float:
        """Angle between this direction and another one, 0 to 180 degrees."""
        low, high = math.radians(self.altitude_deg), math.radians(other.altitude_deg)
        turned = math.radians(self.azimuth_deg - other.azimuth_deg)
        cosine = math.sin(low) * math.sin(high) + math.cos(low) * math.cos(high) * math.cos(turned)
        return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))


@dataclass(frozen=True)
class Acquisition:
    """When and how an image was taken, as far as it is known.

    date : day of the exposure; time : of its first line, UTC; satellite : and sensor, as the vendor names them;
    sun_direction : at the exposure; view_azimuth_deg : direction from the ground to the sensor, clockwise from north;
    incidence_deg : angle between that direction and the vertical on the ground; off_nadir_deg : the same angle at the
    sensor; cloud_cover : share of the image, 0 to 1, as the vendor estimates it.
    """

    date: Date | None = None
    time: DateTime | None = None
    satellite: str | None = None
    sun_direction: SunDirection | None = None
    view_azimuth_deg: float | None = None
    incidence_deg: float | None = None
    off_nadir_deg: float | None = None
    cloud_cover: float | None = None

    def completed_by(self, other: Acquisition) -> Acquisition:
        """This acquisition, with what it does not know taken from another source. A day of one source and the time of
        another day of the other do not go together: the time is left out then."""
        known = {field.name: getattr(self, field.name) for field in fields(self)}
        whole = Acquisition(**{name: getattr(other, name) if at is None else at for name, at in known.items()})
        is_of_day = whole.time is None or whole.date is None or whole.time.date() == whole.date
        return whole if is_of_day else replace(whole, time=None)


NOT_KNOWN = Acquisition()


@dataclass(frozen=True)
class View:
    """One image with its sensor model in the frame of the scene.

    camera_files : files beside the image from which the sensor model was read, and what is known of the exposure.
    """

    name: str
    path: Path
    image: ImageSource
    sensor: SensorModel
    camera_files: tuple[Path, ...] = ()
    acquisition: Acquisition = NOT_KNOWN

    @property
    def date(self) -> Date | None:
        """Day of the exposure, where it is known."""
        return self.acquisition.date

    @property
    def sun_direction(self) -> SunDirection | None:
        """Where the sun stood at the exposure, where it is known."""
        return self.acquisition.sun_direction

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file from which the view is read."""
        return (self.path, *getattr(self.image, "sources", ()), *self.camera_files)

    def __repr__(self) -> str:
        rows, cols = self.image.shape
        return f"View({self.name}, {rows} x {cols} px, {type(self.sensor).__name__})"


@dataclass(frozen=True)
class Scene:
    """Views in a common frame: projected easting, northing and ellipsoidal height in metres, or local x, y, z (up).

    bounds : (xmin, ymin, xmax, ymax) of the requested area, in `crs`; None: the ground that two views or more see.
    heights : (zmin, zmax) m, ellipsoidal, height range to search; None: found from the tie points.
    """

    views: tuple[View, ...]
    crs: CRS
    bounds: tuple[float, float, float, float] | None = None
    heights: tuple[float, float] | None = None

    def __repr__(self) -> str:
        """One line, without the hundreds of numbers of the sensor models."""
        names = [view.name for view in self.views[:MAX_NAMED_VIEWS]] + ["..."] * (len(self.views) > MAX_NAMED_VIEWS)
        frame = "a local frame" if is_local(self.crs) else self.crs.name
        requested = [f"{name} {value}" for name in ("bounds", "heights") if (value := getattr(self, name)) is not None]
        return f"Scene({len(self.views)} views: {', '.join(names)}; {'; '.join([frame, *requested])})"


def is_local(crs: CRS) -> bool:
    """Whether a frame is local: Cartesian axes whose place on the Earth is not known."""
    return bool(crs.is_engineering)
