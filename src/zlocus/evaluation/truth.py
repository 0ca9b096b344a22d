"""A reference surface as blocks of about half a metre, each with the heights that count as true."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import unit_m
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.slopes import block_gradient, slope_deg
from zlocus.io.open_raster import open_raster

BLOCK_M = 0.5
# A block holds an edge where its heights differ by more than this.
MAX_FLAT_SPREAD_M = 0.5
CLASS_NAMES = {"ground": (0, 1), "building": (2,), "tree": (3,)}


@dataclass(frozen=True)
class TruthBlocks:
    """Blocks of a reference surface.

    xy : (n, 2) float64, centres in the reference's CRS. heights : (n, k) float64, m, of the block's cells.
    classes : (n,) uint8, class of the block's first cell, or None. gradient : (n, 2) float64, metres per metre to the
    east and north of the frame, NaN where a neighbour has no height. cells : (n, 2) row and column of the block on the
    grid of all blocks, whose shape and transform follow. size : cells of the reference along a side of a block.
    """

    xy: FloatArray
    heights: FloatArray
    classes: NDArray[np.uint8] | None
    gradient: FloatArray
    cells: NDArray[np.int64]
    shape: tuple[int, int]
    transform: Affine
    size: int = 1

    @property
    def mean(self) -> FloatArray:
        """Mean height, (n,) m."""
        return np.asarray(self.heights.mean(axis=1))

    @property
    def is_edge(self) -> NDArray[np.bool_]:
        """Whether a block holds an edge, either side of which counts as true, (n,)."""
        return np.asarray(np.ptp(self.heights, axis=1) > MAX_FLAT_SPREAD_M)

    @property
    def slope_deg(self) -> FloatArray:
        """Slope of the ground, (n,) degrees; NaN where a neighbour has no height."""
        return slope_deg(self.gradient)

    def errors(self, z: FloatArray) -> FloatArray:
        """Errors (n,) m of heights z (n,) m at the centres: against the mean, at an edge against the nearest cell."""
        nearest = np.abs(self.heights - np.nan_to_num(z)[:, None]).argmin(axis=1)
        member = np.take_along_axis(self.heights, nearest[:, None], axis=1)[:, 0]
        return z - np.where(self.is_edge, member, self.mean)

    def members(self, name: str) -> NDArray[np.bool_]:
        """Whether a block belongs to a class of `CLASS_NAMES`, (n,)."""
        if self.classes is None:
            raise ValueError("these blocks were read without classes")
        return np.isin(self.classes, CLASS_NAMES[name])


def truth_blocks(
    reference: HeightRaster, margin_m: float, classes: NDArray[np.uint8] | None, frame: CRS | None = None
) -> TruthBlocks:
    """Blocks of a reference whose cells all have a height, without a margin along the reference's edge.

    classes : (r, c) on the reference's grid, or None. frame : map in metres for slopes and
    sizes; None: the reference's CRS.

    Raises
    ------
    InputError
        The reference is geographic and has no frame, has no height, or is narrower than its margins.
    """
    if frame is None and reference.horizontal is not None and reference.horizontal.is_geographic:
        raise InputError(f"{reference.path} is in degrees ({reference.crs}). Reproject it to a CRS in metres first.")
    transform, unit = reference.transform, unit_m(reference, frame)
    size = max(1, round(BLOCK_M / (abs(transform.a) * unit[0])))
    rows, cols = reference.z.shape[0] // size, reference.z.shape[1] // size
    cells = reference.z[: rows * size, : cols * size]
    heights = cells.reshape(rows, size, cols, size).transpose(0, 2, 1, 3).reshape(rows * cols, size * size)
    row, col = (index.ravel() * size for index in np.mgrid[:rows, :cols])
    xy = places(transform, row + size / 2, col + size / 2)
    keep = inside_margin(reference, margin_m, unit, xy)
    if not keep.any():
        raise InputError(f"A margin of {margin_m:g} m leaves nothing of {reference.path}. Give a smaller --margin.")
    keep &= np.isfinite(heights).all(axis=1)
    if not keep.any():
        raise InputError(f"{reference.path} has no height inside its margin of {margin_m:g} m. Check its nodata value.")
    gradient = block_gradient(reference, size, frame, keep.reshape(rows, cols))
    chosen = None if classes is None else classes[row[keep], col[keep]]
    block = np.column_stack([row[keep], col[keep]]) // size
    grid = transform * Affine.scale(size)
    return TruthBlocks(xy[keep], heights[keep], chosen, gradient, block, (rows, cols), grid, size)


def places(transform: Affine, row: FloatArray, col: FloatArray) -> FloatArray:
    """Coordinates (n, 2) of places on a grid, whose (0, 0) is the outer corner of its first cell."""
    x = transform.a * col + transform.b * row + transform.c
    y = transform.d * col + transform.e * row + transform.f
    return np.column_stack([x, y])


def inside_margin(
    reference: HeightRaster, margin_m: float, unit: tuple[float, float], xy: FloatArray
) -> NDArray[np.bool_]:
    """Whether points (n, 2) lie farther inside a reference than a margin. unit : metres per unit of x and y."""
    transform, x, y = reference.transform, xy[:, 0], xy[:, 1]
    left, top = transform.c, transform.f
    right, bottom = transform * (reference.z.shape[1], reference.z.shape[0])
    width, height = margin_m / unit[0], margin_m / unit[1]
    return np.asarray((x > left + width) & (x < right - width) & (y > bottom + height) & (y < top - height))


def read_classes(path: Path, reference: HeightRaster) -> NDArray[np.uint8]:
    """Classes (r, c) on the reference's grid.

    Raises
    ------
    InputError
        The file is missing or cannot be read.
    ConfigError
        The file is on another grid.
    """
    with open_raster(path, "raster of classes") as source:
        classes, transform = source.read(1), source.transform
    if classes.shape != reference.z.shape or not transform.almost_equals(reference.transform):
        raise ConfigError(f"{path} is not on the grid of {reference.path}. Resample it to that grid first.")
    return np.asarray(classes)
