"""Ortho-images of any image on a finished surface: all its bands, at its own pixel, without what the surface hides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio.enums import ColorInterp

from zlocus.core.footprints import Bounds, ground_box, ground_sample_distance
from zlocus.core.grid import cell_centres, grid_from_bounds
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.core.scene import View
from zlocus.core.sensor_model import SensorModel
from zlocus.io.image_bands import ImageBands
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.surface_heights import SurfaceHeights
from zlocus.matching.sight import hidden_cells
from zlocus.sensors.ground_sampling import sampled

# Side of the blocks that are worked on at a time, px; smaller where a pixel is the mean of many of the image.
BLOCK_PX, MIN_BLOCK_PX = 512, 16
# Colours that make a picture of three bands.
COLOURS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)


@dataclass(frozen=True)
class OrthoSource:
    """An image from which ortho-images are made.

    name : of the view; path : of its file; sensor : its corrected camera; bands : of its file; pixel_m : size of a
    pixel on the ground.
    """

    name: str
    path: Path
    sensor: SensorModel
    bands: ImageBands
    pixel_m: float

    @classmethod
    def of(cls, view: View, z: float) -> OrthoSource:
        """The source of a view. z : height (m) of the ground."""
        return cls(view.name, view.path, view.sensor, ImageBands.of(view.image), ground_sample_distance(view, z))

    @property
    def cell_m(self) -> float:
        """Its own pixel on the ground, rounded to two digits, m."""
        return float(f"{self.pixel_m:.2g}")


@dataclass
class OrthoCounts:
    """Pixels of an ortho-image, counted: with a value, hidden by the surface, and without a height of it."""

    shown: int = 0
    hidden: int = 0
    without_height: int = 0

    def add(self, other: OrthoCounts) -> None:
        """Add those of a block."""
        self.shown += other.shown
        self.hidden += other.hidden
        self.without_height += other.without_height


@dataclass(frozen=True, eq=False)
class OrthoBlock:
    """A block of an ortho-image. values : (b, r, c) in the numbers of the file; valid : (r, c) bool."""

    values: NDArray[np.floating]
    valid: NDArray[np.bool_]
    counts: OrthoCounts = field(default_factory=OrthoCounts)


def ortho_area(view: View, surface: SurfaceHeights, bounds: Bounds | None) -> Bounds | None:
    """Bounds (m) of the ground that an image shows of a surface; None where it shows none of it."""
    low, high = ground_box(view, surface.z_range)
    limits = [surface.area] if bounds is None else [surface.area, bounds]
    for west, south, east, north in limits:
        low, high = np.maximum(low, (west, south)), np.minimum(high, (east, north))
    if not (high > low).all():
        return None
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def ortho_block(source: OrthoSource, surface: SurfaceHeights, geobox: GeoBox) -> OrthoBlock | None:
    """A block of the ortho-image of an image; None where it shows nothing of the block.

    A pixel is left out where the surface has no height, where it hides the pixel from the sensor, and where the image
    has no value.
    """
    z = surface.read(geobox)
    is_known = np.isfinite(z)
    if not is_known.any():
        return None
    known = np.where(is_known, z, np.float32(np.nanmedian(z)))
    xyz = np.dstack([cell_centres(geobox), known]).reshape(-1, 3)
    xy = source.sensor.image_from_ground(xyz).reshape(*z.shape, 2)
    rows, cols = source.bands.shape
    with np.errstate(invalid="ignore"):
        inside = ((xy >= -0.5) & (xy <= np.array([cols, rows]) - 0.5)).all(axis=-1)
    if not inside.any():
        return None
    hidden = hidden_cells(source.sensor, surface.read, surface.highest_in, geobox, z, surface.cell_m)
    wanted = inside & is_known & ~hidden
    counts = OrthoCounts(0, int((hidden & inside).sum()), int((inside & ~is_known).sum()))
    places = np.where(wanted[..., None], source.bands.displaced(xy), np.nan)
    pixels_per_cell = float(geobox.transform.a) / source.pixel_m
    window = sampled(source.bands.read, (rows, cols), places, pixels_per_cell)
    if window is None:
        empty = np.zeros((len(source.bands.bands), *z.shape), np.float32)
        return OrthoBlock(empty, np.zeros(z.shape, bool), counts)
    counts.shown = int(window.valid.sum())
    return OrthoBlock(window.values, window.valid, counts)


def blocks_of(geobox: GeoBox, pixels_per_cell: float) -> Iterator[tuple[int, int, GeoBox]]:
    """First row and column of each block of a grid, with its part of the grid."""
    side = max(int(BLOCK_PX / max(pixels_per_cell, 1.0)), MIN_BLOCK_PX)
    rows, cols = geobox.shape
    for row in range(0, rows, side):
        for col in range(0, cols, side):
            yield row, col, geobox[row : min(row + side, rows), col : min(col + side, cols)]


def stored(values: NDArray[np.floating], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values in the type of a file: rounded, and cut off where it ends."""
    if dtype.kind not in "iu":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max).astype(dtype))


def raster_bands(source: OrthoSource) -> RasterBands:
    """The bands of the ortho-image of an image, as in its file."""
    meanings = source.bands.meanings
    return RasterBands(
        source.bands.dtype, None, source.bands.names, has_colours=meanings == COLOURS, has_mask=True,
        meanings=() if meanings == COLOURS else meanings,
    )  # fmt: skip


def write_ortho(
    path: Path, source: OrthoSource, surface: SurfaceHeights, area: Bounds, cell_m: float, progress: Progress,
    workers: int,
) -> OrthoCounts:  # fmt: skip
    """Write the ortho-image of an image block by block. area : see `ortho_area`.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    geobox, counts = grid_from_bounds(area, cell_m, surface.crs).geobox, OrthoCounts()
    blocks = list(blocks_of(geobox, cell_m / source.pixel_m))

    def make(block: tuple[int, int, GeoBox]) -> OrthoBlock | None:
        return ortho_block(source, surface, block[2])

    with (
        RasterSink(path, geobox, raster_bands(source)) as sink,
        progress.stage(f"Ortho-image of {source.name}", len(blocks)) as stage,
    ):
        for (row, col, _), made in run_all(make, blocks, workers):
            if made is not None:
                counts.add(made.counts)
                sink.write(row, col, stored(made.values, source.bands.dtype), made.valid)
            stage.advance()
    return counts
