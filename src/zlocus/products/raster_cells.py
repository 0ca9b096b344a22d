"""The cells of a written surface: read from its rasters, and blended with cells that were matched again.

Heights are those of dsm.tif, in its vertical datum; grey values are those of ortho.tif.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio.windows import Window

from zlocus.io.open_raster import open_raster
from zlocus.io.run_folder import SURFACE_RASTERS
from zlocus.matching.quality import EMPTY, Quality, is_water

# Heights of two surfaces are blended that differ by no more than so many standard deviations of their difference.
AGREEING_SIGMAS = 3.0


@dataclass(frozen=True)
class RasterCells:
    """Cells of the rasters of a surface, (r, c).

    height, sigma : float32 m, NaN for none; quality : uint16; views : uint8; ortho : (bands, r, c) of the type of the
    image; has_grey : bool, whether the ortho-image has a value; water : uint8, see `WaterKind`.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    quality: NDArray[np.uint16]
    views: NDArray[np.uint8]
    ortho: NDArray[Any]
    has_grey: NDArray[np.bool_]
    water: NDArray[np.uint8]

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """All arrays, in the order of the fields."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def differs_from(self, other: RasterCells) -> NDArray[np.bool_]:
        """Cells (r, c) bool in which any raster has another value."""
        differs = np.zeros(self.height.shape, np.bool_)
        for one, two in zip(self.arrays, other.arrays, strict=True):
            is_same = (one == two) | ((one != one) & (two != two))  # NaN is the same as NaN
            differs |= ~is_same if is_same.ndim == 2 else ~is_same.all(axis=0)
        return differs


class SurfaceReader:
    """The six rasters of a finished surface, read by windows. A context manager.

    Raises
    ------
    InputError
        A raster is missing or damaged.
    """

    def __init__(self, folder: Path) -> None:
        self._stack = ExitStack()
        with ExitStack() as undo:
            undo.push(self._stack)
            self._files: list[rasterio.DatasetReader] = [
                self._stack.enter_context(open_raster(folder / name, "raster")) for name in SURFACE_RASTERS
            ]
            undo.pop_all()

    @property
    def geobox(self) -> GeoBox:
        """The grid, with the horizontal part of its CRS."""
        file = self._files[1]
        return GeoBox(file.shape, file.transform, None if file.crs is None else file.crs.to_wkt())

    @property
    def ortho_dtype(self) -> str:
        """Type of the grey values, as NumPy names it."""
        return str(self._files[4].dtypes[0])

    @property
    def has_colours(self) -> bool:
        """Whether the ortho-image has colours."""
        return int(self._files[4].count) > 1

    def read(self, row: int, col: int, shape: tuple[int, int]) -> RasterCells:
        """Cells from (row, col) on. shape : rows and columns."""
        window = Window(col, row, shape[1], shape[0])
        dsm, sigma, quality, views, ortho, water = self._files
        height, spread, flags, n_views, kind = (
            file.read(1, window=window) for file in (dsm, sigma, quality, views, water)
        )
        return RasterCells(
            height, spread, flags, n_views, ortho.read(window=window), ortho.dataset_mask(window=window) > 0, kind
        )

    def __enter__(self) -> SurfaceReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


def blended(old_cells: RasterCells, new_cells: RasterCells, weight: NDArray[np.float32]) -> RasterCells:
    """Cells of a surface, replaced by new ones as far as a weight says.

    weight : (r, c) from 0 to 1, 0 outside the area that is redone. Heights that agree (`AGREEING_SIGMAS`) pass from the
    old to the new ones with the weight. Of heights that do not agree, and of everything else, one is taken: the new one
    where the weight is one half or more, or only the new one is there. Cells that were not asked for, and those of
    levelled water, stay.
    """
    stays = ((old_cells.quality & np.uint16(Quality.OUTSIDE)) != 0) | is_water(old_cells.quality) | (weight == 0)
    old_has, new_has = np.isfinite(old_cells.height), np.isfinite(new_cells.height)
    is_new = ~stays & ((weight >= 0.5) | (new_has & ~old_has))
    sigma = np.hypot(np.nan_to_num(old_cells.sigma), np.nan_to_num(new_cells.sigma))
    apart = new_cells.height - old_cells.height
    with np.errstate(invalid="ignore"):
        is_blended = ~stays & old_has & new_has & (np.abs(apart) <= np.float32(AGREEING_SIGMAS) * sigma)
    height, spread, flags, views, ortho, has_grey, water = (
        np.where(is_new, new, old) for old, new in zip(old_cells.arrays, new_cells.arrays, strict=True)
    )
    between = (weight > 0) & (weight < 1) & is_blended
    # Written like this, equal heights stay what they are.
    height = np.where(between, old_cells.height + weight * apart, height)
    both = between & np.isfinite(old_cells.sigma) & np.isfinite(new_cells.sigma)
    spread = np.where(both, old_cells.sigma + weight * (new_cells.sigma - old_cells.sigma), spread)
    # Possible water stays marked where there is no height again.
    water = np.where(is_new & ~new_has, old_cells.water, water)
    return RasterCells(height, spread, flags, views, ortho, has_grey, water)


def with_fixed(cells: RasterCells, heights: NDArray[np.float64]) -> RasterCells:
    """Cells of which some have a height that was given. heights : (r, c) m, NaN in the others.

    Such a cell counts as filled: no image has told its height, and it has no standard deviation. Cells that were not
    asked for have none.
    """
    is_fixed = np.isfinite(heights) & ((cells.quality & np.uint16(Quality.OUTSIDE)) == 0)
    flags = (cells.quality & np.uint16(EMPTY)) | np.uint16(Quality.FILLED)
    flags = np.where(is_water(cells.quality), flags | np.uint16(Quality.WATER), flags)
    none = np.float32(np.nan)
    return RasterCells(
        np.where(is_fixed, heights.astype(np.float32), cells.height), np.where(is_fixed, none, cells.sigma),
        np.where(is_fixed, flags, cells.quality), np.where(is_fixed, np.uint8(0), cells.views),
        cells.ortho, cells.has_grey, cells.water,
    )  # fmt: skip
