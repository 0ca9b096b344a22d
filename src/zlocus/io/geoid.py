"""Geoid rasters: undulations, interpolated at points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import crs_label, raster_crs
from zlocus.io.open_raster import check_complete, open_raster
from zlocus.sensors.earth_frame import between

# Between the lowest undulation of the Earth, -107 m, and the highest, 86 m, with room for local geoids.
MAX_UNDULATION_M = 120.0
METRE_UNITS = ("", "m", "metre", "metres", "meter", "meters")
# A point this close to the outermost posts, as a share of their spacing, counts as lying on them.
ON_POST_TOLERANCE = 1e-6


@dataclass(frozen=True)
class GeoidRaster:
    """Undulations, m above the ellipsoid, on a grid of posts: the centres of the cells of a raster.

    crs : horizontal CRS; transform, shape : of the raster; period : number of columns around the whole Earth, None for
    a projected CRS or where longitude does not run along the rows.
    """

    path: Path
    crs: CRS
    transform: Affine
    shape: tuple[int, int]
    period: float | None

    @classmethod
    def open(cls, path: Path) -> GeoidRaster:
        """Open the geoid raster of a file. Undulations are read when they are needed.

        Raises
        ------
        InputError
            The file is no raster, has no CRS, has fewer than two rows or columns, or its values are not in metres.
        """
        with open_raster(path, "geoid") as source:
            check_complete(source, path)
            crs = raster_crs(source, path).to_2d()
            if min(source.shape) < 2:
                raise InputError(
                    f"The geoid {path} has {source.height} x {source.width} posts, too few to lie between. Give "
                    "another raster."
                )
            if (unit := (source.units[0] or "").lower()) not in METRE_UNITS:
                raise InputError(f"The undulations of {path} are in {unit}. Convert them to metres.")
            transform, shape = source.transform, (source.height, source.width)
        turns = crs.is_geographic and transform.b == transform.d == 0
        around = 2.0 * np.pi / crs.axis_info[0].unit_conversion_factor
        return cls(Path(path), crs, transform, shape, around / abs(transform.a) if turns else None)

    def undulation(self, xy: FloatArray, crs: CRS) -> FloatArray:
        """Undulations (n,) m at points (n, 2) of a CRS, x or longitude first; bilinear between the four posts around.

        The result of a point does not depend on the other points. Memory: the posts between the outermost points.

        Raises
        ------
        InputError
            A point lies outside the posts or beside a post without a value, or the values are no undulations.
        """
        cell = self._cells(xy, crs)
        inside = self._inside(cell)
        if not inside.all():
            raise self._not_covered(xy[np.argmin(inside)], crs)
        undulation = self._interpolated(cell)
        if not np.isfinite(undulation).all():
            x, y = xy[np.argmin(np.isfinite(undulation))]
            raise InputError(
                f"The geoid {self.path} has no value (nodata) around {x:.10g}, {y:.10g} ({crs_label(crs)}). Give one "
                "that is whole where the heights are."
            )
        return undulation

    def known_undulation(self, xy: FloatArray, crs: CRS) -> FloatArray:
        """As `undulation`, but NaN where the raster has no value.

        Raises
        ------
        InputError
            The values are no undulations.
        """
        cell = self._cells(xy, crs)
        inside, undulation = self._inside(cell), np.full(len(xy), np.nan)
        undulation[inside] = self._interpolated(cell[inside])
        return undulation

    def spacing_m(self, xy: FloatArray, crs: CRS) -> float:
        """Approximate spacing of the posts around a point (2,), in the units of a projected CRS."""
        x, y = between(crs.to_2d(), self.crs).transform(xy[0], xy[1])
        a, b, _, d, e = self.transform[:5]
        around = np.array([[x, y], [x + a, y + d], [x + b, y + e]])
        ground_xy = np.column_stack(
            between(crs.to_2d(), self.crs).transform(around[:, 0], around[:, 1], direction="INVERSE")
        )
        return float(np.hypot(*(ground_xy[1:] - ground_xy[0]).T).min())

    @property
    def _is_around(self) -> bool:
        """Whether the raster spans the whole Earth, so that its first column follows its last."""
        return self.period is not None and abs(self.shape[1] - self.period) < 0.5

    def _cells(self, xy: FloatArray, crs: CRS) -> FloatArray:
        """(row, col) (n, 2) of points, whole numbers at the posts. Longitudes are shifted into the raster's range."""
        x, y = between(crs.to_2d(), self.crs).transform(xy[:, 0], xy[:, 1])
        a, b, c, d, e, f = (~self.transform)[:6]
        row, col = d * x + e * y + f - 0.5, a * x + b * y + c - 0.5
        if self.period is not None:
            with np.errstate(invalid="ignore"):  # points that the CRS cannot express are infinite
                col = np.mod(col + ON_POST_TOLERANCE, self.period) - ON_POST_TOLERANCE
        return np.column_stack([row, col])

    def _inside(self, cell: FloatArray) -> NDArray[np.bool_]:
        """Whether (row, col) (n, 2) lie between posts; (n,) bool."""
        last = np.array(self.shape) - 1
        if self._is_around:  # any column lies between posts
            return np.asarray((cell[:, 0] >= -ON_POST_TOLERANCE) & (cell[:, 0] <= last[0] + ON_POST_TOLERANCE))
        return np.asarray(((cell >= -ON_POST_TOLERANCE) & (cell <= last + ON_POST_TOLERANCE)).all(axis=1))

    def _interpolated(self, cell: FloatArray) -> FloatArray:
        """Undulations (n,) m at (row, col) (n, 2) inside the raster; NaN beside posts without a value."""
        if not len(cell):
            return np.empty(0)
        last, cell = np.array(self.shape) - 1, cell.copy()
        cell[:, 0] = np.clip(cell[:, 0], 0, last[0])
        cell[:, 1] = np.maximum(cell[:, 1], 0) if self._is_around else np.clip(cell[:, 1], 0, last[1])
        first = np.minimum(np.floor(cell).astype(int), last - (1, 0 if self._is_around else 1))
        down, right = (cell - first).T
        row, col = first.T
        beside = (col + 1) % self.shape[1]
        at_row, at_col = int(row.min()), int(min(col.min(), beside.min()))
        posts = self._posts(at_row, at_col, int(row.max()) + 2, int(max(col.max(), beside.max())) + 1)
        row, col, beside = row - at_row, col - at_col, beside - at_col
        upper = posts[row, col] * (1.0 - right) + posts[row, beside] * right
        lower = posts[row + 1, col] * (1.0 - right) + posts[row + 1, beside] * right
        undulation = np.asarray(upper * (1.0 - down) + lower * down)
        self._check_plausible(undulation)
        return undulation

    def _posts(self, top: int, left: int, bottom: int, right: int) -> FloatArray:
        """Undulations (r, c) m of the posts of a window; NaN where there is no value."""
        with open_raster(self.path, "geoid") as source:
            window = Window(left, top, right - left, bottom - top)
            posts = source.read(1, window=window, masked=True, out_dtype=np.float64).filled(np.nan)
            return np.asarray(posts * source.scales[0] + source.offsets[0])

    def _check_plausible(self, undulation: FloatArray) -> None:
        largest = undulation[np.argmax(np.abs(np.nan_to_num(undulation)))]
        if abs(largest) > MAX_UNDULATION_M:
            raise InputError(
                f"{self.path} is no geoid: it holds {largest:.1f} m, and undulations lie between -107 and 86 m "
                "everywhere on the Earth. Give a raster of geoid heights above the ellipsoid."
            )

    def _not_covered(self, xy: FloatArray, crs: CRS) -> InputError:
        corners = self.transform * (0.5, 0.5), self.transform * (self.shape[1] - 0.5, self.shape[0] - 0.5)
        (west, east), (south, north) = (sorted(pair) for pair in zip(*corners, strict=True))
        return InputError(
            f"The geoid {self.path} does not cover {xy[0]:.10g}, {xy[1]:.10g} ({crs_label(crs)}): its posts lie "
            f"between {west:.10g} and {east:.10g}, {south:.10g} and {north:.10g} ({crs_label(self.crs)}). "
            "Give one that covers the area."
        )
