"""What lies in the folder of a surface: its grid, and patches of its rasters, read from their overviews."""

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
    """A part of the grid as a picture.

    row, col, rows, cols : first cell and number of cells, which may lie outside the grid; height, width : px.
    """

    row: float
    col: float
    rows: float
    cols: float
    height: int
    width: int

    def strips(self, px: int) -> Iterator[Patch]:
        """The patch from top to bottom, so many rows of pixels at a time."""
        down = self.rows / self.height
        for top in range(0, self.height, px):
            height = min(px, self.height - top)
            yield Patch(self.row + top * down, self.col, height * down, self.cols, height, self.width)

    def widened(self, px: int) -> Patch:
        """With so many more pixels on all sides."""
        down, across = self.rows / self.height, self.cols / self.width
        return Patch(
            self.row - px * down, self.col - px * across, self.rows + 2 * px * down, self.cols + 2 * px * across,
            self.height + 2 * px, self.width + 2 * px,
        )  # fmt: skip


@dataclass(frozen=True)
class SurfaceFolder:
    """A surface that is there. run : its run.json; shape : rows and columns; above : what its heights are above."""

    out: Path
    run: Mapping[str, Any]
    shape: tuple[int, int]
    transform: Affine
    crs: CRS
    above: str

    @property
    def cell_m(self) -> float:
        """Side of a cell."""
        return float(self.transform.a)

    @property
    def is_local(self) -> bool:
        """Whether the grid has no place on the Earth."""
        return is_local(self.crs)

    def path(self, name: str) -> Path:
        """Of one of its rasters."""
        return self.out / f"{name}.tif"

    def has(self, name: str) -> bool:
        """Whether it has a raster."""
        return self.path(name).is_file()

    def cell_of(self, x: float, y: float) -> tuple[int, int] | None:
        """Row and column of the cell that holds a ground point, None outside the grid."""
        col, row = ~self.transform * (x, y)
        inside = 0 <= row < self.shape[0] and 0 <= col < self.shape[1]
        return (int(row), int(col)) if inside else None

    def middle_of(self, row: float, col: float) -> FloatArray:
        """The middle of a cell, (2,) m."""
        return np.array(self.transform * (col + 0.5, row + 0.5))

    def cell(self, row: int, col: int) -> dict[str, Any]:
        """What the rasters say of one cell, by their names."""
        found = {}
        for name in NEEDED:
            with cached_raster(self.path(name)) as file:
                found[name] = file.read(1, window=Window(col, row, 1, 1))[0, 0].item()
        return found


class _Request(BaseModel):
    out: str
    inputs: list[str]
    method: str
    views: str


class _Sun(BaseModel):
    sun_azimuth_deg: float
    sun_altitude_deg: float


class _Options(BaseModel):
    products: _Sun


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
    """What is taken from run.json without another look."""

    config: _Config
    grid: _Grid
    orientation: _Orientation
    inputs: list[_Input]


def checked_run(out: Path) -> dict[str, Any]:
    """run.json of a surface, with all that the page takes for granted.

    Raises
    ------
    InputError
        It is missing, damaged, or of something else.
    """
    run = run_record(out)
    try:
        found = _Run.model_validate(run)
        CRS.from_user_input(found.grid.crs)
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
                raise InputError(f"{out / name}.tif is not the one that run.json tells of. Make the surface again.")
    with cached_raster(out / "dsm.tif") as file:
        above = file.descriptions[0] or "height"
        crs = CRS.from_user_input(run["grid"]["crs"])
        above = "z of the local frame" if is_local(crs) else above
        return SurfaceFolder(out, run, file.shape, file.transform, crs, above)


@dataclass(frozen=True)
class Cells:
    """A patch that was read. values : (b, r, c), NaN or 0 where nothing is known; known : (r, c) bool."""

    values: NDArray[Any]
    known: NDArray[np.bool_]


def read_patch(path: Path, patch: Patch, average: bool, like: SurfaceFolder | None = None) -> Cells:
    """A patch of a raster, from its overviews.

    average : the mean of the cells of a pixel, else one of them; like : surface on whose grid it is looked up, its own
    being another.
    """
    with cached_raster(path) as file:
        if like is None:
            return _patch_of(file, patch, average)
        with on_grid(file, like) as view:
            return _patch_of(view, patch, average)


def on_grid(file: DatasetReader, like: SurfaceFolder) -> WarpedVRT:
    """A raster of heights as it lies on the grid of a surface, cell by cell."""
    return WarpedVRT(
        file, src_crs=file.crs or like.crs.to_wkt(), crs=like.crs.to_wkt(), transform=like.transform,
        height=like.shape[0], width=like.shape[1], resampling=Resampling.nearest, nodata=float("nan"),
    )  # fmt: skip


def _patch_of(file: DatasetReader, patch: Patch, average: bool) -> Cells:
    kind = np.dtype(file.dtypes[0])
    values = np.full((file.count, patch.height, patch.width), np.nan if kind.kind == "f" else 0, kind)
    known = np.zeros((patch.height, patch.width), bool)
    top, height = _inside(patch.row, patch.rows, patch.height, file.height)
    left, width = _inside(patch.col, patch.cols, patch.width, file.width)
    if not (height and width):
        return Cells(values, known)
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
    return Cells(values, known)


def _inside(start: float, size: float, pixels: int, end: int) -> tuple[int, int]:
    """First pixel and number of pixels whose middles lie on the grid, along one side of it with `end` cells."""
    middles = start + (np.arange(pixels) + 0.5) * size / pixels
    inside = np.flatnonzero((middles >= 0) & (middles < end))
    return (int(inside[0]), len(inside)) if len(inside) else (0, 0)
