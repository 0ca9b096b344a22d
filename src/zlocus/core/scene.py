"""What is matched, where, in which frame: views and the CRS they share."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date as Date
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import GeometryError, ZlocusWarning
from zlocus.core.sensor_model import FloatArray, SensorModel

# Views that a scene names at a prompt.
MOST_NAMED = 8
# Along each side of an image, for the box around its footprint; and by how much of it that is widened, for sides are
# curved in between.
BOX_POINTS, BOX_ASIDE = 8, 0.02


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


def footprint(view: View, z: float, per_side: int = 8, margin_px: float = 0.0) -> FloatArray:
    """The image's outline on the ground at height z (m, ellipsoidal), counter-clockwise or clockwise, not closed; of an
    image in a sparse file, the outline of the part that the file holds.

    Runs along the outer edges of the border pixels, or `margin_px` outside of them, `per_side` points a side, because
    the sides of a line scanner's image are curves. Returns (4 * per_side, 2) m; points the sensor cannot map are left
    out.
    """
    top, left, rows, cols = held_window(view.image)
    t = np.arange(per_side) / per_side
    zero, one = np.zeros(per_side), np.ones(per_side)
    column = np.concatenate([t, one, 1 - t, zero]) * (cols + 2 * margin_px) - 0.5 - margin_px + left
    row = np.concatenate([zero, t, one, 1 - t]) * (rows + 2 * margin_px) - 0.5 - margin_px + top
    xyz = view.sensor.ground_from_image(np.column_stack([column, row]), np.full(len(column), float(z)))
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1), :2])


def ground_box(view: View, z_range: tuple[float, float], margin_px: float = 0.0) -> FloatArray:
    """Least and greatest east and north (2, 2) m that an image may see between two heights (m), if it may lie
    `margin_px` away from where its sensor model puts it; infinite where some ray at its border meets no ground.

    Rays are straight: at heights in between they stay in the box of both ends.
    """
    outlines = [footprint(view, z, BOX_POINTS, margin_px) for z in z_range]
    if any(len(outline) < 4 * BOX_POINTS for outline in outlines):
        return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    xy = np.concatenate(outlines)
    aside = BOX_ASIDE * np.ptp(xy, axis=0)
    return np.stack([xy.min(axis=0) - aside, xy.max(axis=0) + aside])


def is_shared(scene: Scene, z: float) -> bool:
    """Whether two views or more see the same ground at a height (m, ellipsoidal)."""
    from shapely import MultiPoint, STRtree

    hulls = [MultiPoint(footprint(view, z)).convex_hull for view in scene.views]
    tree = STRtree(hulls)
    first, second = tree.query(hulls, predicate="intersects")
    return any(hulls[i].intersection(hulls[j]).area > 0 for i, j in zip(first, second, strict=True) if i < j)


def ground_sample_distance(view: View, z: float) -> float:
    """Metres on the ground at height z per pixel at the image's centre: geometric mean of both directions.

    NaN where the sensor cannot map the centre.
    """
    top, left, rows, cols = held_window(view.image)
    column, row = left + (cols - 1) / 2, top + (rows - 1) / 2
    xy = np.array([[column - 0.5, row], [column + 0.5, row], [column, row - 0.5], [column, row + 0.5]])
    left, right, up, down = view.sensor.ground_from_image(xy, np.full(4, float(z)))[:, :2]
    (ax, ay), (bx, by) = right - left, down - up
    return float(np.sqrt(abs(ax * by - ay * bx)))


def check_overlap(scene: Scene, heights: float | Sequence[float]) -> None:
    """Refuse a scene without two views of the same ground; warn of views that share none.

    heights : m, ellipsoidal; views overlap when their footprints do at any of them (a footprint moves with the height,
    so give several where the height of the ground is not known).

    Raises
    ------
    GeometryError
        When no two footprints overlap; names the views and where they lie.
    """
    # shapely costs 0.1 s to import, and only this check needs it.
    from shapely import MultiPoint, STRtree

    levels = np.atleast_1d(np.asarray(heights, float))
    n_views = len(scene.views)
    overlap = np.zeros(n_views, bool)
    for z in levels:
        hulls = [MultiPoint(footprint(view, z)).convex_hull for view in scene.views]
        for i, j in zip(*STRtree(hulls).query(hulls, predicate="intersects"), strict=True):
            if i < j and hulls[i].intersection(hulls[j]).area > 0:
                overlap[[i, j]] = True
    at = f"at heights of {levels.min():g} to {levels.max():g} m" if len(levels) > 1 else f"at {levels[0]:g} m"
    if not overlap.any():
        where = "; ".join(f"{view.name} {_extent(hull.bounds)}" for view, hull in zip(scene.views, hulls, strict=True))
        raise GeometryError(
            f"No two images see the same ground {at} ({scene.crs.to_string()}): {where}. "
            "Check that they show the same place and that each RPC belongs to its image."
        )
    for view, overlaps in zip(scene.views, overlap, strict=True):
        if not overlaps:
            warnings.warn(
                f"{view.name} ({view.path}) overlaps no other image {at}. Leave it out, or check its RPC.",
                ZlocusWarning,
                stacklevel=2,
            )


def _extent(bounds: tuple[float, ...]) -> str:
    """Bounds for a message."""
    if not bounds or not np.isfinite(bounds).all():
        return "nowhere"
    xmin, ymin, xmax, ymax = bounds
    return f"E {xmin:.0f} to {xmax:.0f} m, N {ymin:.0f} to {ymax:.0f} m"
