"""Masks from polygons, rasterised square by square when pixels are asked for."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.features import rasterize

from zlocus.core.errors import InputError

# Side of the squares in which polygons are rasterised, and the memory of the squares that a process keeps.
SQUARE_PX, KEPT_BYTES = 1024, 64 << 20
# More points than any cloud mask has.
MAX_POINTS = 4_000_000
# Polygons of fewer points are rasterised whole.
MIN_POINTS_TO_CUT = 1000


@dataclass(frozen=True, eq=False)
class MaskPolygons:
    """Polygons (n,), shapely. crs : of their coordinates, x before y; None: columns and rows of the image, with (0, 0)
    at the centre of the first pixel."""

    polygons: NDArray[np.object_]
    crs: CRS | None


@dataclass(frozen=True, eq=False)
class PolygonMask:
    """A mask from polygons: a pixel is masked where its centre lies inside one of them.

    shape : rows and columns of the image; polygons : (n,) shapely polygons, columns and rows with (0, 0) at the centre
    of the first pixel; is_outside : whether all other pixels are masked instead; key : tells masks apart.
    """

    path: Path
    shape: tuple[int, int]
    polygons: NDArray[np.object_]
    is_outside: bool
    key: bytes

    @classmethod
    def of(cls, path: Path, shape: tuple[int, int], polygons: NDArray[np.object_], is_outside: bool) -> PolygonMask:
        """The mask of polygons that may have several parts, lie beside the image or be empty.

        Raises
        ------
        InputError
            The polygons have too many points, or coordinates that are not finite.
        """
        parts = shapely.get_parts(polygons)
        n_points = int(shapely.get_num_coordinates(parts).sum()) if len(parts) else 0
        if n_points > MAX_POINTS:
            raise InputError(
                f"{path} has {n_points} points, more than the {MAX_POINTS} that are read. Simplify its "
                "polygons, or give a raster."
            )
        parts = parts[~shapely.is_empty(parts)] if len(parts) else parts
        if not np.isfinite(shapely.get_coordinates(parts)).all():
            raise InputError(f"{path} has polygons with coordinates that are not finite. Mend the file.")
        with_area = np.array(parts, object)
        digest = hashlib.sha256(repr((str(path), shape)).encode())
        for wkb in shapely.to_wkb(with_area):
            digest.update(wkb)
        return cls(path, shape, with_area, is_outside, digest.digest())

    @property
    def is_beside_image(self) -> bool:
        """Whether no polygon reaches into the image."""
        rows, cols = self.shape
        west, south, east, north = shapely.bounds(self.polygons).T if len(self.polygons) else np.empty((4, 0))
        reaches = (west <= cols - 0.5) & (east >= -0.5) & (south <= rows - 0.5) & (north >= -0.5)
        return not bool(reaches.any())

    def covers(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.bool_]:
        """See `MaskPart`."""
        masked = np.zeros((rows, cols), bool)
        for top in range(row // SQUARE_PX * SQUARE_PX, row + rows, SQUARE_PX):
            for left in range(col // SQUARE_PX * SQUARE_PX, col + cols, SQUARE_PX):
                square = SQUARES.square(self, top, left)
                if square is None:
                    continue
                r0, r1 = max(top, row), min(top + SQUARE_PX, row + rows)
                c0, c1 = max(left, col), min(left + SQUARE_PX, col + cols)
                masked[r0 - row : r1 - row, c0 - col : c1 - col] = square[r0 - top : r1 - top, c0 - left : c1 - left]
        return ~masked if self.is_outside else masked

    def inside_square(self, top: int, left: int) -> NDArray[np.bool_] | None:
        """The pixels (r, c) of a square of `SQUARE_PX` that lie inside a polygon; None where none does."""
        west, south, east, north = shapely.bounds(self.polygons).T if len(self.polygons) else np.empty((4, 0))
        box = (left - 0.5, top - 0.5, left + SQUARE_PX - 0.5, top + SQUARE_PX - 0.5)
        near = (west <= box[2]) & (east >= box[0]) & (south <= box[3]) & (north >= box[1])
        if not near.any():
            return None
        shapes = [_near_box(polygon, box) for polygon in self.polygons[near]]
        # A row or column of GDAL begins half a pixel before its centre.
        corner = Affine.translation(left - 0.5, top - 0.5)
        inside = rasterize(shapes, out_shape=(SQUARE_PX, SQUARE_PX), transform=corner, dtype="uint8")
        return np.asarray(inside, bool) if inside.any() else None


def _near_box(polygon: shapely.Polygon, box: tuple[float, float, float, float]) -> dict[str, Any]:
    """A polygon in the form of GeoJSON that is the same inside a box, with fewer points outside of it.

    box : smallest x and y, largest x and y. Of points that follow each other on one side of the box, only the first and
    the last are kept: a line from inside the box to that side then crosses the outline an even number of times more or
    less. GDAL looks at every point for each row of pixels.
    """
    rings = [polygon.exterior, *polygon.interiors]
    return {"type": "Polygon", "coordinates": [_ring_near_box(shapely.get_coordinates(ring), box) for ring in rings]}


def _ring_near_box(ring: NDArray[np.float64], box: tuple[float, float, float, float]) -> Sequence[Sequence[float]]:
    if len(ring) > MIN_POINTS_TO_CUT:
        # One side after the other: a point in a corner, on two sides, may be needed to go around that corner.
        for axis, end, sign in ((0, box[0], 1.0), (0, box[2], -1.0), (1, box[1], 1.0), (1, box[3], -1.0)):
            beside = sign * ring[:, axis] < sign * end
            keep = np.ones(len(ring), bool)
            keep[1:-1] = ~(beside[:-2] & beside[1:-1] & beside[2:])
            ring = ring[keep]
    points: list[list[float]] = ring.tolist()
    # GDAL refuses rings of fewer points; a point twice changes nothing.
    return points + [points[-1]] * (4 - len(points))


@dataclass
class RasterisedSquares:
    """Squares of masks that a process has rasterised, as many as fit into a memory of so many bytes; its threads share
    them. The least recently used go first."""

    n_bytes: int
    _squares: OrderedDict[tuple[bytes, int, int], NDArray[np.uint8] | None] = field(default_factory=OrderedDict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def square(self, polygon_mask: PolygonMask, top: int, left: int) -> NDArray[np.bool_] | None:
        """See `PolygonMask.inside_square`."""
        key = (polygon_mask.key, top, left)
        with self._lock:
            if key in self._squares:
                self._squares.move_to_end(key)
                return _unpacked(self._squares[key])
        inside = polygon_mask.inside_square(top, left)
        with self._lock:
            self._squares[key] = None if inside is None else np.packbits(inside, axis=1)
            # Each square counts as a full one, so that their number is bounded too.
            while len(self._squares) * SQUARE_PX * SQUARE_PX // 8 > self.n_bytes:
                self._squares.popitem(last=False)
        return inside


def _unpacked(bits: NDArray[np.uint8] | None) -> NDArray[np.bool_] | None:
    return None if bits is None else np.unpackbits(bits, axis=1).astype(bool)


# One for each process.
SQUARES = RasterisedSquares(KEPT_BYTES)
