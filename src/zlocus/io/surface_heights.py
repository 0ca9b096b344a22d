"""Heights of a finished surface by window, in the frame of its raster, and the greatest of them within bounds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS
from rasterio.windows import Window

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.footprints import Bounds
from zlocus.core.scene import is_local
from zlocus.io.axis_resampling import resampled
from zlocus.io.crs import checked_crs, raster_crs
from zlocus.io.grid_inputs import dem_datum
from zlocus.io.height_values import check_unit, is_fill
from zlocus.io.open_raster import cached_raster, open_raster
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum, check_heights

# Of so many cells of the raster along each side only the lowest and the greatest height are kept.
PATCH_CELLS = 256
# Cells around a window that are read too, for bilinear interpolation; of the larger grid.
MARGIN_CELLS = 2


@dataclass(frozen=True, eq=False)
class SurfaceHeights:
    """A raster of heights.

    path : of the raster; crs : its horizontal frame; transform, shape : of its cells; vertical_datum : of its
    heights; highest : (a, b) m, ellipsoidal, the greatest height of each patch of cells, -inf where there is none;
    z_range : lowest and greatest height, m; area : bounds of the patches with a height.
    """

    path: Path
    crs: CRS
    transform: rasterio.Affine
    shape: tuple[int, int]
    vertical_datum: VerticalDatum
    highest: NDArray[np.float64]
    z_range: tuple[float, float]
    median: float
    area: Bounds

    @property
    def cell_m(self) -> float:
        """Side of a cell, m."""
        return float(self.transform.a)

    def read(self, geobox: GeoBox) -> NDArray[np.float32]:
        """Ellipsoidal heights (r, c) m at the cell centres of a grid in the same frame; NaN where there are none.

        They are interpolated between cells, and averaged where the cells of the grid are larger.

        Raises
        ------
        InputError
            The file can no longer be read.
        """
        heights = np.full(tuple(geobox.shape), np.nan, np.float32)
        (west, south, east, north), t = geobox.boundingbox.bbox, self.transform
        rows, cols = self.shape
        first_col, last_col = ((at - t.c) / t.a for at in (west, east))
        first_row, last_row = ((at - t.f) / t.e for at in (north, south))
        margin = MARGIN_CELLS * max(int(np.ceil(float(geobox.transform.a) / t.a)), 1)
        left, top = max(int(first_col) - margin, 0), max(int(first_row) - margin, 0)
        right, bottom = min(int(last_col) + 1 + margin, cols), min(int(last_row) + 1 + margin, rows)
        if left >= right or top >= bottom:
            return heights
        window = Window(left, top, right - left, bottom - top)
        with cached_raster(self.path) as source:
            stored = stored_heights(source, window)
        heights = resampled(stored, t * t.translation(left, top), geobox)
        return (
            heights
            if self.vertical_datum.geoid is None
            else self.vertical_datum.ellipsoidal_from_heights(heights, geobox)
        )

    def highest_in(self, bounds: Bounds) -> float:
        """The greatest height (m) within bounds, or a little outside of them; the lowest of all where there is none."""
        (west, south, east, north), t = bounds, self.transform
        side, n = t.a * PATCH_CELLS, self.highest.shape
        left, right = (int(np.clip((at - t.c) / side, -1, n[1])) for at in (west, east))
        top, bottom = (int(np.clip((t.f - at) / side, -1, n[0])) for at in (north, south))
        found = self.highest[max(top, 0) : bottom + 1, max(left, 0) : right + 1]
        return max(float(found.max(initial=-np.inf)), self.z_range[0])


def open_surface(path: Path, vertical: str | None = None, may_be_local: bool = False) -> SurfaceHeights:
    """Open a surface, and read it once, patch by patch, for its greatest heights.

    vertical : vertical datum of its heights, see `dem_datum`; None: the one that its CRS declares. may_be_local : a
    raster in a local frame is taken too.

    Raises
    ------
    InputError
        The file is no raster of heights in metres, or has none.
    ConfigError
        Its frame is neither projected in metres nor local, its grid is not north up with square cells, or the geoid is
        not installed.
    """
    with open_raster(path, "surface") as source:
        local = may_be_local and source.crs is not None and is_local(CRS.from_user_input(source.crs))
        crs = CRS.from_user_input(source.crs) if local else raster_crs(source, path)
        transform, shape = source.transform, source.shape
        if not local:
            check_heights(crs, path)
        check_unit(source.units[0], path)
        t = transform
        if not (t.b == t.d == 0 and t.a > 0 and abs(t.a + t.e) < 1e-6 * t.a):
            raise ConfigError(f"{path} is not north up with square cells. Warp it first: gdalwarp -tr M M.")
        crs = crs if local else checked_crs(crs)
        datum = ELLIPSOIDAL if local else dem_datum(path, vertical)
        patches = -(-shape[0] // PATCH_CELLS), -(-shape[1] // PATCH_CELLS)
        highest, lowest, middles = np.full(patches, -np.inf), np.inf, []
        for i, j in np.ndindex(*patches):
            row, col = i * PATCH_CELLS, j * PATCH_CELLS
            size = min(PATCH_CELLS, shape[0] - row), min(PATCH_CELLS, shape[1] - col)
            stored = stored_heights(source, Window(col, row, size[1], size[0]))
            if datum.geoid is not None:
                geobox = GeoBox(size, t * t.translation(col, row), crs)
                stored = datum.ellipsoidal_from_heights(stored, geobox)
            known = stored[np.isfinite(stored)]
            if len(known):
                highest[i, j], lowest = float(known.max()), min(lowest, float(known.min()))
                middles.append(float(np.median(known)))
    if not middles:
        raise InputError(f"{path} has no height in any cell. Give a surface with heights.")
    row, col = np.nonzero(np.isfinite(highest))
    side = t.a * PATCH_CELLS
    area = (
        t.c + col.min() * side, max(t.f - (row.max() + 1) * side, t.f + shape[0] * t.e),
        min(t.c + (col.max() + 1) * side, t.c + shape[1] * t.a), t.f - row.min() * side,
    )  # fmt: skip
    z_range = lowest, float(highest.max())
    return SurfaceHeights(path, crs, t, shape, datum, highest, z_range, float(np.median(middles)), area)


def stored_heights(source: rasterio.DatasetReader, window: Window) -> NDArray[np.float32]:
    """The heights (r, c) m of a window of an open raster, in its own vertical datum; NaN where there are none."""
    stored = source.read(1, window=window, masked=True, out_dtype=np.float64).filled(np.nan)
    stored[is_fill(stored)] = np.nan
    return np.asarray(stored * source.scales[0] + source.offsets[0], np.float32)
