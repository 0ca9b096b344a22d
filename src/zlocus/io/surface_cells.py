"""Read surfaces block by block on a common grid: as they are where their cells lie on it, else resampled.

A jump between cells is never interpolated: where the four cells around a place differ by more than a steep slope
explains, the nearest one is taken, so that no height appears that neither roof nor ground has.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from rasterio.windows import Window

from zlocus.core.grid import CellWindow
from zlocus.core.sensor_model import FloatArray
from zlocus.io.height_values import is_fill
from zlocus.io.open_raster import open_raster
from zlocus.io.surface_inputs import ORTHO, SIGMA, SurfaceInput, has_same_cells
from zlocus.io.vertical import VerticalDatum

# Largest difference of the four cells around a place that is interpolated, in sides of a cell: a slope of 63 degrees.
MAX_SLOPE_CELLS = 2.0
# From this ratio of cells on, heights are averaged over each cell of the grid; at most so many places a side.
MIN_COARSER_RATIO, MAX_PLACES = 1.99, 4
# Cells read beyond those that are needed, for interpolation and rounding.
MARGIN_CELLS = 2
# Heights outside these limits are none, whatever they mean, m.
MIN_HEIGHT_M, MAX_HEIGHT_M = -1e4, 1e5


@dataclass(frozen=True)
class PlacedSurface:
    """A surface and how it comes onto a grid.

    geobox : of the grid; grid_crs : its horizontal CRS; vertical_datums : of the surface and of the result, None where
    heights stay as they are; offset_m : subtracted from the heights.
    """

    source: SurfaceInput
    geobox: GeoBox
    grid_crs: CRS | None
    vertical_datums: tuple[VerticalDatum, VerticalDatum] | None = None
    offset_m: float = 0.0

    @property
    def is_on_grid(self) -> bool:
        """Whether no cell has to be resampled."""
        return has_same_cells(self.source, self.geobox, self.grid_crs)

    @property
    def window(self) -> CellWindow:
        """Cells of the grid that the surface may reach."""
        rows, cols = self.source.shape
        side = np.linspace(0.0, 1.0, 17)
        none, all_of = np.zeros_like(side), np.ones_like(side)
        x, y = _moved(
            self.source.transform,
            cols * np.concatenate([side, side, none, all_of]),
            rows * np.concatenate([none, all_of, side, side]),
        )
        if self.source.crs != self.grid_crs:
            x, y = _transformer(self.source.crs, self.grid_crs).transform(x, y)
        col, row = _moved(~self.geobox.transform, np.asarray(x), np.asarray(y))
        known = np.isfinite(col) & np.isfinite(row)
        if not known.any():
            return CellWindow(0, 0, 0, 0)
        places = np.array([row[known], col[known]])
        if self.is_on_grid:
            first, last = np.rint(places.min(axis=1)), np.rint(places.max(axis=1))
        else:
            first, last = np.floor(places.min(axis=1)) - 1, np.ceil(places.max(axis=1)) + 1
        return CellWindow(*(int(n) for n in (*first, *(last - first))))


@dataclass(frozen=True)
class SurfaceCells:
    """Cells of a surface on a part of a grid.

    height : (r, c) float32 m, NaN where there is none; sigma : (r, c) float32 m, NaN where it is not known; is_inside :
    (r, c) bool, cells that the raster covers; flags : (r, c) of quality.tif, views.tif and water.tif, by name; ortho :
    (bands, r, c) and ortho_mask : (r, c) bool, None without an ortho-image.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    is_inside: NDArray[np.bool_]
    flags: Mapping[str, NDArray[Any]]
    ortho: NDArray[Any] | None = None
    ortho_mask: NDArray[np.bool_] | None = None


def read_cells(placed: PlacedSurface, window: CellWindow, with_images: bool = False) -> SurfaceCells:
    """Cells of a surface in a window of the grid. with_images : the ortho-image too.

    Raises
    ------
    InputError
        A raster cannot be read.
    """
    source = placed.source
    names = [name for name in source.layers if name not in (SIGMA, ORTHO)]
    lookup = _lookup(placed, window)
    with open_raster(source.dsm, "surface") as file:
        stored, is_inside = lookup.read(file, np.float64)
        heights = _heights(stored[0], file)
    sigmas = np.full(heights.shape, np.nan) if source.sigma_m is None else np.full(heights.shape, source.sigma_m)
    if SIGMA in source.layers:
        with open_raster(source.layers[SIGMA], "raster of standard deviations") as file:
            sigmas = lookup.read(file, np.float64)[0][0]
            sigmas[~(sigmas > 0) | is_fill(sigmas)] = np.nan
    height, sigma = lookup.heights(heights, sigmas)
    sigma[~np.isfinite(height)] = np.nan
    if placed.vertical_datums is not None:
        given, wanted = placed.vertical_datums
        box = _part(placed.geobox, window)
        height = wanted.heights_from_ellipsoidal(given.ellipsoidal_from_heights(height, box), box)
    if placed.offset_m:
        height = (height - placed.offset_m).astype(np.float32)
    flags = {}
    for name in names:
        with open_raster(source.layers[name], "raster") as file:
            flags[name] = lookup.nearest(lookup.read(file)[0])[0]
    ortho, ortho_mask = _ortho(source, lookup) if with_images and ORTHO in source.layers else (None, None)
    return SurfaceCells(height, sigma, lookup.nearest(is_inside[None])[0], flags, ortho, ortho_mask)


def _ortho(source: SurfaceInput, lookup: _Lookup) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    with open_raster(source.layers[ORTHO], "ortho-image") as file:
        values = lookup.nearest(lookup.read(file, n_bands=file.count)[0])
        return values, lookup.nearest(lookup.read_mask(file)[None])[0]


def _heights(stored: FloatArray, file: rasterio.DatasetReader) -> FloatArray:
    """Heights, m, as numbers of a file mean them; NaN where there is none."""
    stored[is_fill(stored)] = np.nan
    if file.nodata is not None:
        stored[stored == file.nodata] = np.nan
    heights = stored * file.scales[0] + file.offsets[0]
    heights[(heights < MIN_HEIGHT_M) | (heights > MAX_HEIGHT_M)] = np.nan
    return np.asarray(heights)


@dataclass(frozen=True)
class _Lookup:
    """Where cells of a window lie in a raster.

    read_window : rows and columns of the raster that are read, possibly beyond it; step : cells of the raster for each
    one that is read; row, col : (r, c) places in what is read, in its cells from the centre of the first; None: cell by
    cell. cell_m : side of a cell that is read; places : (k, r, c) rows and columns of several places in each cell,
    which are averaged.
    """

    read_window: CellWindow
    shape: tuple[int, int]
    step: int = 1
    row: FloatArray | None = None
    col: FloatArray | None = None
    cell_m: float = 1.0
    places: tuple[FloatArray, FloatArray] | None = None

    def read(
        self, file: rasterio.DatasetReader, dtype: Any = None, n_bands: int = 1
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Cells (bands, r, c) of the window that is read, 0 (NaN for floats) beyond the raster, and (r, c) whether
        they lie in it."""
        kind = np.dtype(dtype or file.dtypes[0])
        out = np.full((n_bands, *self._read_shape), np.nan if kind.kind == "f" else 0, kind)
        is_inside = np.zeros(self._read_shape, bool)
        inner, here = self._inner(file)
        if inner is not None:
            averaged = self.step > 1 and kind.kind == "f"
            out[(slice(None), *here)] = file.read(
                list(range(1, n_bands + 1)), window=inner, out_shape=(n_bands, *out[(0, *here)].shape), out_dtype=kind,
                resampling=Resampling.average if averaged else Resampling.nearest,
            )  # fmt: skip
            is_inside[here] = True
        return out, is_inside

    def read_mask(self, file: rasterio.DatasetReader) -> NDArray[np.bool_]:
        """Whether the cells that are read are valid (r, c)."""
        out = np.zeros(self._read_shape, bool)
        inner, here = self._inner(file)
        if inner is not None:
            out[here] = np.asarray(file.dataset_mask(window=inner, out_shape=out[here].shape)) > 0
        return out

    @property
    def _read_shape(self) -> tuple[int, int]:
        return self.read_window.rows // self.step, self.read_window.cols // self.step

    def _inner(self, file: rasterio.DatasetReader) -> tuple[Window | None, tuple[slice, slice]]:
        """The part of the raster that is read, in whole steps, and its place among the cells; None without one."""
        inner = self.read_window.within(CellWindow(0, 0, *file.shape))
        rows, cols = inner.rows // self.step, inner.cols // self.step
        if rows <= 0 or cols <= 0:
            return None, (slice(0), slice(0))
        top, left = (inner.row - self.read_window.row) // self.step, (inner.col - self.read_window.col) // self.step
        window = Window(inner.col, inner.row, cols * self.step, rows * self.step)
        return window, (slice(top, top + rows), slice(left, left + cols))

    def nearest(self, read: NDArray[Any]) -> NDArray[Any]:
        """Cells (bands, r, c) of the window, each that of the raster which holds its centre; 0 beyond it."""
        if self.row is None or self.col is None:
            return read
        row, col, is_there = self._rounded(self.row, self.col, read.shape[1:])
        return np.where(is_there, read[:, row, col], np.zeros((), read.dtype))

    def heights(self, heights: FloatArray, sigmas: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Heights and standard deviations (r, c) float32 of the window, see the module."""
        if self.row is None or self.col is None:
            return heights.astype(np.float32), sigmas.astype(np.float32)
        if self.places is not None:
            return self._means(heights, sigmas)
        z, at = self._between(self.row, self.col, heights)
        sigma = np.where(at, self._bilinear(self.row, self.col, sigmas), self._at(self.row, self.col, sigmas))
        return z.astype(np.float32), sigma.astype(np.float32)

    def _means(self, heights: FloatArray, sigmas: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Means over several places of each cell; NaN where fewer than half of them have a height."""
        assert self.places is not None, "there are places to average over"
        total, squares, n = np.zeros(self.shape), np.zeros(self.shape), np.zeros(self.shape)
        for row, col in zip(*self.places, strict=True):
            z, sigma = self._at(row, col, heights), self._at(row, col, sigmas)
            known = np.isfinite(z)
            total += np.where(known, z, 0.0)
            squares += np.where(known, sigma**2, 0.0)
            n += known
        enough = 2 * n >= len(self.places[0])
        with np.errstate(invalid="ignore", divide="ignore"):
            mean, sigma = total / n, np.sqrt(squares / n)
        return np.where(enough, mean, np.nan).astype(np.float32), np.where(enough, sigma, np.nan).astype(np.float32)

    def _between(self, row: FloatArray, col: FloatArray, heights: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Heights between four cells where they differ by no more than a slope, else of the nearest; and where."""
        corners = self._corners(row, col, heights)
        with np.errstate(invalid="ignore"):
            is_smooth = corners.max(axis=0) - corners.min(axis=0) <= MAX_SLOPE_CELLS * self.cell_m
        return np.where(is_smooth, self._bilinear(row, col, heights), self._at(row, col, heights)), is_smooth

    def _corners(self, row: FloatArray, col: FloatArray, values: FloatArray) -> FloatArray:
        top, left = np.floor(row), np.floor(col)
        return np.stack([self._at(top + i, left + j, values) for i in (0, 1) for j in (0, 1)])

    def _bilinear(self, row: FloatArray, col: FloatArray, values: FloatArray) -> FloatArray:
        down, right = row - np.floor(row), col - np.floor(col)
        a, b, c, d = self._corners(row, col, values)
        return np.asarray((a * (1 - right) + b * right) * (1 - down) + (c * (1 - right) + d * right) * down)

    def _at(self, row: FloatArray, col: FloatArray, values: FloatArray) -> FloatArray:
        rows, cols, is_there = self._rounded(row, col, values.shape)
        return np.asarray(np.where(is_there, values[rows, cols], np.nan))

    def _rounded(
        self, row: FloatArray, col: FloatArray, shape: tuple[int, ...]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        with np.errstate(invalid="ignore"):
            rows, cols = np.floor(row + 0.5), np.floor(col + 0.5)
            is_there = (rows >= 0) & (rows < shape[0]) & (cols >= 0) & (cols < shape[1])
        return np.where(is_there, rows, 0).astype(np.int64), np.where(is_there, cols, 0).astype(np.int64), is_there


def _lookup(placed: PlacedSurface, window: CellWindow) -> _Lookup:
    source, shape = placed.source, (window.rows, window.cols)
    if placed.is_on_grid:
        col, row = ~source.transform * (placed.geobox.transform * (window.col, window.row))
        return _Lookup(CellWindow(round(row), round(col), *shape), shape)
    row, col = np.mgrid[: window.rows, : window.cols] + 0.5
    at = _places_in(placed, window, row, col)
    ratio = _ratio(placed, window)
    step = max(1, int(ratio // MAX_PLACES))
    low, high = (np.floor(np.nanmin(at, axis=(1, 2))), np.ceil(np.nanmax(at, axis=(1, 2))))
    reach = MARGIN_CELLS * step + math.ceil(ratio)
    first, last = (
        np.clip(low - reach, -reach, (source.shape[0], source.shape[1])),
        np.clip(high + reach, 0, (source.shape[0] + reach, source.shape[1] + reach)),
    )
    first, last = np.floor(first / step) * step, np.ceil(last / step) * step
    read = CellWindow(*(int(n) for n in (*first, *np.maximum(last - first, 0))))

    def counted(places: FloatArray) -> tuple[FloatArray, FloatArray]:
        in_read = (places - first[:, None, None]) / step - 0.5
        return in_read[0], in_read[1]

    places = None
    if ratio >= MIN_COARSER_RATIO:
        side = min(MAX_PLACES, math.ceil(ratio - 0.01))
        steps = (np.arange(side) + 0.5) / side - 0.5
        found = [counted(_places_in(placed, window, row + i, col + j)) for i in steps for j in steps]
        places = np.stack([each[0] for each in found]), np.stack([each[1] for each in found])
    rows, cols = counted(at)
    return _Lookup(read, shape, step, rows, cols, placed.source.cell * step, places)


def _places_in(placed: PlacedSurface, window: CellWindow, row: FloatArray, col: FloatArray) -> FloatArray:
    """Rows and columns (2, r, c) of the source, from the corner of its first cell, of places of a window.

    row, col : (r, c) from the corner of the window's first cell; NaN where the CRS has no place.
    """
    x, y = _moved(placed.geobox.transform, col + window.col, row + window.row)
    if placed.source.crs != placed.grid_crs:
        x, y = _transformer(placed.grid_crs, placed.source.crs).transform(x, y)
        x, y = np.where(np.isfinite(x), x, np.nan), np.where(np.isfinite(y), y, np.nan)
    cols, rows = _moved(~placed.source.transform, x, y)
    return np.stack([rows, cols])


def _ratio(placed: PlacedSurface, window: CellWindow) -> float:
    """Side of a cell of the grid in cells of the source, at the middle of the window."""
    middle = np.array([[window.rows / 2]]), np.array([[window.cols / 2]])
    at = _places_in(placed, window, *middle)
    down = _places_in(placed, window, middle[0] + 1, middle[1]) - at
    across = _places_in(placed, window, middle[0], middle[1] + 1) - at
    ratio = math.sqrt(abs(float(down[0, 0, 0] * across[1, 0, 0] - down[1, 0, 0] * across[0, 0, 0])))
    return ratio if math.isfinite(ratio) and ratio > 0 else 1.0


def _moved(transform: Affine, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places after an affine transform, of the shape of x and y."""
    a, b, c, d, e, f = transform[:6]
    return a * x + b * y + c, d * x + e * y + f


def _part(geobox: GeoBox, window: CellWindow) -> GeoBox:
    """The grid of a window."""
    moved = geobox.transform * Affine.translation(window.col, window.row)
    return GeoBox((window.rows, window.cols), moved, geobox.crs)


@lru_cache(maxsize=64)
def _transformer(given: CRS | None, wanted: CRS | None) -> Transformer:
    assert given is not None, "both CRS are known where they differ"
    assert wanted is not None, "both CRS are known where they differ"
    return Transformer.from_crs(given, wanted, always_xy=True)
