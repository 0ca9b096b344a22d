"""The folder of a surface: its grid, and patches of its rasters, which are read from overviews."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio import DatasetReader
from rasterio.enums import MaskFlags, Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.open_raster import cached_raster
from zlocus.products.report.file_names import RECORD
from zlocus.products.report.page import run_record

NEEDED = {"dsm": "float32", "sigma": "float32", "quality": "uint16", "views": "uint8"}


@dataclass(frozen=True)
class Patch:
    """A part of the grid, resampled to a picture.

    row, col, rows, cols : first cell and number of cells, which may lie outside the grid; height, width : px, of the
    picture.
    """

    row: float
    col: float
    rows: float
    cols: float
    height: int
    width: int

    def strips(self, px: int) -> Iterator[Patch]:
        """Strips of the patch from top to bottom, `px` rows of pixels each."""
        down = self.rows / self.height
        for top in range(0, self.height, px):
            height = min(px, self.height - top)
            yield Patch(self.row + top * down, self.col, height * down, self.cols, height, self.width)

    def widened(self, px: int) -> Patch:
        """The patch with `px` more pixels on all sides."""
        down, across = self.rows / self.height, self.cols / self.width
        return Patch(
            self.row - px * down, self.col - px * across, self.rows + 2 * px * down, self.cols + 2 * px * across,
            self.height + 2 * px, self.width + 2 * px,
        )  # fmt: skip


@dataclass(frozen=True)
class SurfaceFolder:
    """A finished surface.

    run : content of run.json; shape : rows and columns; height_name : description of the heights with their datum.
    """

    out: Path
    run: Mapping[str, Any]
    shape: tuple[int, int]
    transform: Affine
    crs: CRS
    height_name: str

    @property
    def cell_m(self) -> float:
        """Side of a cell."""
        return float(self.transform.a)

    @property
    def is_local(self) -> bool:
        """Whether the grid has no place on the Earth."""
        return is_local(self.crs)

    def path(self, name: str) -> Path:
        """Path of a raster."""
        return self.out / f"{name}.tif"

    def has(self, name: str) -> bool:
        """Whether the folder has a raster."""
        return self.path(name).is_file()

    def cell_of(self, x: float, y: float) -> tuple[int, int] | None:
        """Row and column of the cell that holds a ground point, None outside the grid."""
        col, row = ~self.transform * (x, y)
        inside = 0 <= row < self.shape[0] and 0 <= col < self.shape[1]
        return (int(row), int(col)) if inside else None

    def centre_of(self, row: float, col: float) -> FloatArray:
        """Centre of a cell, (2,) m."""
        return np.array(self.transform * (col + 0.5, row + 0.5))

    def cell(self, row: int, col: int) -> dict[str, Any]:
        """Values of one cell by name of the raster."""
        values = {}
        for name in NEEDED:
            with cached_raster(self.path(name)) as file:
                values[name] = file.read(1, window=Window(col, row, 1, 1))[0, 0].item()
        return values


class _Request(BaseModel):
    out: str
    inputs: list[str]
    method: str
    views: str


class _ProductsOfRun(BaseModel):
    sun_azimuth_deg: float
    sun_altitude_deg: float


class _Options(BaseModel):
    products: _ProductsOfRun


class _Config(BaseModel):
    request: _Request
    options: _Options


class _Grid(BaseModel):
    crs: str
    shape: tuple[int, int]


class _Orientation(BaseModel):
    views: dict[str, Any]


class _Input(BaseModel):
    path: str


class _Run(BaseModel):
    """The part of run.json that the page uses without further checks."""

    config: _Config
    grid: _Grid
    orientation: _Orientation
    inputs: list[_Input]


def checked_run(out: Path) -> dict[str, Any]:
    """Content of run.json of a surface, checked for everything that the page uses.

    Raises
    ------
    InputError
        The file is missing, damaged, or not of a surface.
    """
    run = run_record(out)
    try:
        checked = _Run.model_validate(run)
        CRS.from_user_input(checked.grid.crs)
    except (ValidationError, CRSError) as error:
        where = ""
        if isinstance(error, ValidationError):
            where = f" ({'.'.join(map(str, error.errors()[0]['loc']))})"
        raise InputError(f"{out / RECORD} is not what a run writes{where}. Make the surface again.") from error
    return run


def surface_folder(out: Path) -> SurfaceFolder:
    """The surface in a folder.

    Raises
    ------
    InputError
        There is no complete surface in it.
    """
    run = checked_run(out)
    for name, kind in NEEDED.items():
        with cached_raster(out / f"{name}.tif") as file:
            if file.shape != tuple(run["grid"]["shape"]) or file.dtypes != (kind,):
                raise InputError(f"{out / name}.tif is not the one that run.json describes. Make the surface again.")
    with cached_raster(out / "dsm.tif") as file:
        height_name = file.descriptions[0] or "height"
        crs = CRS.from_user_input(run["grid"]["crs"])
        height_name = "z of the local frame" if is_local(crs) else height_name
        return SurfaceFolder(out, run, file.shape, file.transform, crs, height_name)


@dataclass(frozen=True)
class PatchValues:
    """Values of a patch. values : (b, r, c), NaN or 0 where unknown; known : (r, c) bool."""

    values: NDArray[Any]
    known: NDArray[np.bool_]


def read_patch(path: Path, patch: Patch, average: bool, folder: SurfaceFolder | None = None) -> PatchValues:
    """Read a patch of a raster from its overviews.

    average : take the mean of the cells of a pixel, else one of them; folder : of the surface on whose grid the patch
    lies, where that is not the raster's own grid.
    """
    with cached_raster(path) as file:
        if folder is None:
            return _patch_of(file, patch, average)
        with on_grid(file, folder) as view:
            return _patch_of(view, patch, average)


def on_grid(file: DatasetReader, folder: SurfaceFolder) -> WarpedVRT:
    """A raster of heights, resampled to the grid of a surface (nearest cell)."""
    return WarpedVRT(
        file, src_crs=file.crs or folder.crs.to_wkt(), crs=folder.crs.to_wkt(), transform=folder.transform,
        height=folder.shape[0], width=folder.shape[1], resampling=Resampling.nearest, nodata=float("nan"),
    )  # fmt: skip


def _patch_of(file: DatasetReader, patch: Patch, average: bool) -> PatchValues:
    kind = np.dtype(file.dtypes[0])
    values = np.full((file.count, patch.height, patch.width), np.nan if kind.kind == "f" else 0, kind)
    known = np.zeros((patch.height, patch.width), bool)
    top, height = _inside(patch.row, patch.rows, patch.height, file.height)
    left, width = _inside(patch.col, patch.cols, patch.width, file.width)
    if not (height and width):
        return PatchValues(values, known)
    down, across = patch.rows / patch.height, patch.cols / patch.width
    row, col = max(patch.row + top * down, 0.0), max(patch.col + left * across, 0.0)
    window = Window(col, row, min(width * across, file.width - col), min(height * down, file.height - row))
    part, shape = (slice(top, top + height), slice(left, left + width)), (height, width)
    method = Resampling.average if average else Resampling.nearest
    values[:, *part] = file.read(window=window, out_shape=(file.count, *shape), resampling=method)
    if MaskFlags.per_dataset in file.mask_flag_enums[0]:
        known[part] = file.dataset_mask(window=window, out_shape=shape) > 0
    elif kind.kind == "f":
        known[part] = np.isfinite(values[0][part])
    else:
        known[part] = True if file.nodata is None else values[0][part] != file.nodata
    return PatchValues(values, known)


def _inside(start: float, size: float, pixels: int, end: int) -> tuple[int, int]:
    """First pixel and number of pixels whose centres lie on the grid, along a side of `end` cells."""
    centres = start + (np.arange(pixels) + 0.5) * size / pixels
    inside = np.flatnonzero((centres >= 0) & (centres < end))
    return (int(inside[0]), len(inside)) if len(inside) else (0, 0)
