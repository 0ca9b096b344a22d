"""The rasters of a surface, written tile by tile."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from odc.geo.geobox import GeoBox

from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum
from zlocus.matching.quality import EMPTY, Quality
from zlocus.matching.surface import Surface
from zlocus.products.raster_cells import RasterCells

GREY, COLOURS = ("grey value",), ("red", "green", "blue")


class WaterKind(IntEnum):
    """Values of `water.tif`."""

    LAND = 0  # no water is known here
    LEVELLED = 1  # water inside a polygon, with the level of its surface
    POSSIBLE_LEVELLED = 2  # possible water, with the level of its surface
    POSSIBLE = 3  # possible water, or a polygon whose level is not known; the heights are the matched ones


WATER_MEANINGS = {
    WaterKind.LAND: "no water is known",
    WaterKind.LEVELLED: "water inside a polygon, with the level of its surface",
    WaterKind.POSSIBLE_LEVELLED: "possible water, with the level of its surface",
    WaterKind.POSSIBLE: "possible water, or a polygon whose level is not known; the heights are the matched ones",
}


@dataclass(frozen=True)
class WrittenHeights:
    """height, sigma : (r, c) float32 m, in the vertical datum of the result; quality : (r, c) uint16, see `Quality`;
    views : (r, c) uint8, number of images."""

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    quality: NDArray[np.uint16]
    views: NDArray[np.uint8]


class SurfaceRasters:
    """Writer of the rasters of a `Surface` on one grid. The files appear when the context ends without an error.

    dsm.tif, sigma.tif, quality.tif, views.tif, ortho.tif and water.tif. vertical : what the heights of dsm.tif are
    above; its CRS says so, and those of the others, which hold no heights, are horizontal.
    """

    def __init__(
        self,
        folder: Path,
        geobox: GeoBox,
        ortho_dtype: DTypeLike,
        vertical: VerticalDatum = ELLIPSOIDAL,
        has_colours: bool = False,
    ) -> None:
        self._vertical, self._geobox = vertical, geobox
        self._stack = ExitStack()
        self._ortho_dtype, self._bands = np.dtype(ortho_dtype), COLOURS if has_colours else GREY
        self._paths: list[Path] = []

        def sink(name: str, dtype: DTypeLike, *bands: str, box: GeoBox = geobox, **options: Any) -> RasterSink:
            self._paths.append(folder / name)
            raster = RasterSink(folder / name, box, RasterBands(dtype, descriptions=bands, **options))
            return self._stack.enter_context(raster)

        with ExitStack() as undo:
            undo.push(self._stack)
            above = f"height above {vertical.surface_name}"
            box = vertical.compound_geobox(geobox)
            self._dsm = sink("dsm.tif", "float32", above, box=box, nodata=float("nan"), units="m")
            self._sigma = sink("sigma.tif", "float32", "standard deviation of height", nodata=float("nan"), units="m")
            self._quality = sink("quality.tif", "uint16", "quality bit flags", tags=flag_tags())
            self._views = sink("views.tif", "uint8", "images used", nodata=0)
            self._ortho = sink("ortho.tif", self._ortho_dtype, *self._bands, has_colours=has_colours, has_mask=True)
            self._water = sink("water.tif", "uint8", "water surface")
            undo.pop_all()

    def write(self, row: int, col: int, surface: Surface) -> None:
        """Write a block of cells whose first cell is (row, col) of the grid."""
        cells = self.cells_of(row, col, surface)
        self._dsm.write(row, col, cells.height)
        self._sigma.write(row, col, cells.sigma)
        self._quality.write(row, col, cells.quality)
        self._views.write(row, col, cells.views)
        self._ortho.write(row, col, cells.ortho, cells.has_grey)

    def cells_of(self, row: int, col: int, surface: Surface) -> RasterCells:
        """What `write` writes of a block of cells whose first cell is (row, col) of the grid; no water is known."""
        height = self._vertical.heights_from_ellipsoidal(surface.height, self._geobox, row, col)
        bands = np.moveaxis(np.atleast_3d(surface.ortho), -1, 0)
        if len(bands) > len(self._bands):
            bands = bands.mean(axis=0, keepdims=True)
        valid = np.asarray(np.isfinite(bands).all(axis=0))
        shape = (len(self._bands), *valid.shape)
        ortho = as_source(np.broadcast_to(np.where(valid, bands, 0), shape), self._ortho_dtype)
        none = np.full(valid.shape, WaterKind.LAND, np.uint8)
        return RasterCells(height, surface.sigma, surface.quality, surface.views, ortho, valid, none)

    def write_cells(self, row: int, col: int, cells: RasterCells) -> None:
        """Write cells as they are, with their water, from (row, col) of the grid on."""
        self._dsm.write(row, col, cells.height)
        self._sigma.write(row, col, cells.sigma)
        self._quality.write(row, col, cells.quality)
        self._views.write(row, col, cells.views)
        self._ortho.write(row, col, cells.ortho, cells.has_grey)
        self._water.write(row, col, cells.water)

    def heights(self, row: int, col: int, shape: tuple[int, int]) -> WrittenHeights:
        """Heights of cells that are written, whose first is (row, col) of the grid. shape : rows and columns."""
        return WrittenHeights(
            *(sink.read(row, col, shape) for sink in (self._dsm, self._sigma, self._quality, self._views))
        )

    def grey(self, row: int, col: int, shape: tuple[int, int]) -> NDArray[Any]:
        """Grey values, or values of the first colour, of the ortho-image as it is written, (r, c); see `heights`."""
        return self._ortho.read(row, col, shape)

    def level(self, row: int, col: int, is_levelled: NDArray[np.bool_], height_m: float, sigma_m: float) -> None:
        """Give cells that are written the level of their water surface, and the flags that say so.

        row, col : the first cell; is_levelled : (r, c) bool, those that get it; height_m : in the vertical datum of
        dsm.tif; sigma_m : its standard deviation, NaN where it is not known.
        """
        shape = is_levelled.shape
        why_empty = self._quality.read(row, col, shape) & np.uint16(EMPTY)
        for sink, value in (
            (self._dsm, np.float32(height_m)), (self._sigma, np.float32(sigma_m)), (self._views, np.uint8(0)),
            (self._quality, why_empty | np.uint16(Quality.WATER)),
        ):  # fmt: skip
            sink.write(row, col, np.where(is_levelled, value, sink.read(row, col, shape)))

    def mark_water(self, row: int, col: int, is_water: NDArray[np.bool_], water_kind: WaterKind) -> None:
        """Say in water.tif what kind of water cells are. row, col : the first cell; is_water : (r, c) bool."""
        self._water.write(
            row, col, np.where(is_water, np.uint8(water_kind), self._water.read(row, col, is_water.shape))
        )

    def __enter__(self) -> SurfaceRasters:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._stack.__exit__(kind, error, trace)
        except BaseException:
            # Some files may be complete already, but a set of rasters that do not belong together is of no use.
            for path in self._paths:
                with suppress(OSError):
                    path.unlink()
            raise


def as_source(values: NDArray[np.float32], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Grey values in the data type of the images, rounded and clipped to its range."""
    if dtype.kind == "f":
        return values.astype(dtype)
    info = np.iinfo(dtype.name)
    return np.clip(np.rint(values), info.min, info.max).astype(dtype)


def flag_tags() -> dict[str, str]:
    """The flags of quality.tif as tags of its band, by the conventions of CF: their values and their names."""
    flags = [flag for flag in Quality if flag.name]
    return {
        "flag_masks": ", ".join(str(int(flag)) for flag in flags),
        "flag_meanings": " ".join(str(flag.name) for flag in flags),
    }
