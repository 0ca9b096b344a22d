"""What a tile sees of every view: pixels of one level, where they are valid, and how its cells project into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.scene import View
from zlocus.core.sensor_model import Scanning, SensorModel, bare, capped, lowest_station
from zlocus.matching.kernels.shared_records import ViewArrays
from zlocus.matching.radiometry import GreyScale
from zlocus.sensors.projection_table import (
    DEGREE,
    HIGHER_DEGREE,
    HIGHEST_DEGREE,
    UNSTEADY_DEGREE,
    ProjectionTable,
    TableRequest,
    projection_table,
    projection_table_where_shown,
)

FloatImage = NDArray[np.float32]
FAR = 2**29  # no height index is as large
MARGIN_PX = 4
# Table against exact model, in pixels of the level. Coarser levels only guide, and a block of theirs spans so much
# ground that an aircraft's unsteady flight bends it (0.011 px over the 102 m of the demo's).
FINEST_TABLE_PX, COARSER_TABLE_PX = 0.01, 0.05
# Where even the smallest blocks are too bent for that: a wide lens close to high things.
FINEST_BENT_PX, COARSER_BENT_PX = 0.05, 0.25
# A view may be left out of this share of what it shows (blocks by heights); and at last of this.
LITTLE_LOST, MOST_LOST = 0.01, 0.5
# The windows' borders make small blocks slow: these are twice as slow per cell as those of eight cells.
SMALL_BLOCK, SMALLEST_BLOCK = 4, 2
# Tables end at this share of the depth below the lowest camera: nothing is projected from beside it.
CLEARANCE = 0.1


@dataclass(frozen=True)
class ViewPixels:
    """A window of one view at every level.

    origin : (row, col) of the window's first pixel in the image, a multiple of 2^(levels - 1), so that the pyramid
    does not depend on the window. mean, contrast : grey value of the image that is 0, and that are 1 here, so that
    views taken with other exposures compare. pixels, valid : per level,
    (r, c) float32 and bool; level l has half the pixels of level l - 1 each way. trend : (r, c) float32 grey values
    taken off at the finest level, None is nothing (see `GreyTrend`).
    """

    sensor: SensorModel
    origin: tuple[int, int]
    mean: float
    contrast: float
    pixels: tuple[FloatImage, ...]
    valid: tuple[NDArray[np.bool_], ...]
    trend: FloatImage | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns at the finest level."""
        rows, cols = self.pixels[0].shape
        return rows, cols


@dataclass(frozen=True)
class TileViews:
    """All views of a tile at one level, as the kernels take them.

    pixels : (p,) float32, one view after the other; blocked : (p,) bool, pixels no window may touch; layout : (i, 3)
    int64, offset, rows, columns; nodes : (i, b + 1, d + 1, 2, n) float64, see `ProjectionTable`, in pixels of the
    window; holds : (i, b, d) bool, blocks that a view can show; lost : (i, b, d) bool, others that it may show, where
    it takes no part all the same because its table does not hold; heights : (2,) float64, t of the tables at height
    index 0 and per index; ends : (i, b, d, 2) float64, lowest and highest height index, counted from what the nodes
    follow, over which a block's polynomials hold; block : cells between the nodes.
    """

    pixels: FloatImage
    blocked: NDArray[np.bool_]
    has_blocked: NDArray[np.bool_]
    layout: NDArray[np.int64]
    nodes: NDArray[np.float64]
    holds: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    heights: NDArray[np.float64]
    ends: NDArray[np.float64]
    block: int

    @property
    def arrays(self) -> ViewArrays:
        """What the kernels read of them."""
        return ViewArrays(self.pixels, self.layout, self.nodes, self.heights, self.block)

    @property
    def limits(self) -> NDArray[np.int64]:
        """(2, i, b, d), lowest and highest height index at which a block may be seen; the first is the higher one where
        there is none."""
        low = np.where(self.holds, np.ceil(self.ends[..., 0]), FAR)
        high = np.where(self.holds, np.floor(self.ends[..., 1]), -FAR)
        return np.stack([low, high]).clip(-FAR, FAR).astype(np.int64)


def pixel_window(
    view: View, corners: NDArray[np.float64], z_range: tuple[float, float], step: int
) -> tuple[int, int, int, int] | None:
    """Window (row, col, rows, cols) of an image that sees a patch of ground; None where it sees none of it.

    corners : (n, 2) m, outline of the patch; z_range : m; step : the origin is a multiple of it.
    """
    xyz = np.concatenate([np.column_stack([corners, np.full(len(corners), z)]) for z in z_range])
    xy = view.sensor.image_from_ground(xyz)
    known = np.isfinite(xy).all(axis=1)
    rows, cols = view.image.shape
    if not known.any():
        return None
    if not known.all():
        # What lies between a point that is seen and one that is not may be anywhere in the image.
        xy = np.concatenate([xy[known], [(0.0, 0.0), (cols - 1.0, rows - 1.0)]])
    margin = MARGIN_PX * step
    col0, row0 = np.floor(xy.min(axis=0)).astype(int) - margin
    col1, row1 = np.ceil(xy.max(axis=0)).astype(int) + margin + 1
    row0, col0 = max(row0 // step * step, 0), max(col0 // step * step, 0)
    row1, col1 = min(row1, rows), min(col1, cols)
    if row1 - row0 < 2 * step or col1 - col0 < 2 * step:
        return None
    return row0, col0, row1 - row0, col1 - col0


def read_pixels(view: View, window: tuple[int, int, int, int], levels: int, scale: GreyScale) -> ViewPixels:
    """Read a window and build its pyramid by means of 2 x 2 valid pixels.

    scale : of the whole image, the same for every window of it.
    """
    row, col, rows, cols = window
    read = view.image.read(row, col, rows, cols)
    trend = None if scale.trend is None else scale.trend.window(row, col, rows, cols)
    grey = read.pixels if trend is None else read.pixels - trend
    pixels, valid = [(grey - np.float32(scale.mean)) * np.float32(1.0 / scale.contrast)], [read.valid]
    for _ in range(levels - 1):
        coarse, kept = halved(pixels[-1], valid[-1])
        pixels.append(coarse)
        valid.append(kept)
    return ViewPixels(view.sensor, (row, col), scale.mean, scale.contrast, tuple(pixels), tuple(valid), trend)


def halved(pixels: FloatImage, valid: NDArray[np.bool_]) -> tuple[FloatImage, NDArray[np.bool_]]:
    """Means over 2 x 2 valid pixels; valid where three of the four are. A last odd row or column is dropped."""
    rows, cols = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    blocks = pixels[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2)
    if valid.all():
        mean = (blocks[:, 0, :, 0] + blocks[:, 0, :, 1] + blocks[:, 1, :, 0] + blocks[:, 1, :, 1]) * np.float32(0.25)
        return np.ascontiguousarray(mean, np.float32), np.ones(mean.shape, bool)
    kept = valid[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2)
    count = kept.sum(axis=(1, 3))
    total = np.where(kept, blocks, np.float32(0.0)).sum(axis=(1, 3))
    return (total / np.maximum(count, 1)).astype(np.float32), np.asarray(count >= 3)


def tile_views(
    views: Sequence[ViewPixels],
    level: int,
    transform: Affine,
    shape: tuple[int, int],
    block: int,
    lattice: tuple[float, float],
    z_range: tuple[float, float],
    half: int,
    z_needed: tuple[float, float] | None = None,
) -> TileViews:
    """Gather one level of all views for a grid of cells.

    transform, shape : of the grid at this level; block : cells between nodes, fewer where projections are too bent for
    that; lattice : height of index 0 and step (m); z_range : m, heights that may be asked for; half : half width of the
    largest window, by which blocked pixels grow; z_needed : m, the part of them that will be, where that is known.

    Raises
    ------
    GeometryError
        Where projections are too bent even for the smallest block.
    """
    layout, nodes, blocked, offset = [], [], [], 0
    scale = 2.0**level
    station = lowest_station(view.sensor for view in views)
    z_ranges = capped(z_range, station, CLEARANCE), capped(z_needed or z_range, station, CLEARANCE)
    tables, block = _fitting_tables(views, level, transform, shape, block, z_ranges)
    for view, table in zip(views, tables, strict=True):
        shape_px = view.pixels[level].shape
        layout.append((offset, *shape_px))
        offset += view.pixels[level].size
        scaled = table.nodes / scale
        scaled[..., 0, 0] += 0.5 / scale - 0.5 - view.origin[1] / scale
        scaled[..., 1, 0] += 0.5 / scale - 0.5 - view.origin[0] / scale
        nodes.append(scaled)
        unusable = ~view.valid[level]
        if unusable.any():
            side = 2 * (half + 2) + 1
            unusable = cv2.dilate(unusable.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool)
        blocked.append(unusable)
    heights = np.array([(lattice[0] - tables[0].z_mid) / tables[0].z_half, lattice[1] / tables[0].z_half])
    return TileViews(
        pixels=np.concatenate([view.pixels[level].ravel() for view in views]),
        blocked=np.concatenate([mask.ravel() for mask in blocked]),
        has_blocked=np.array([bool(mask.any()) for mask in blocked]),
        layout=np.array(layout, np.int64),
        nodes=np.ascontiguousarray(np.stack(nodes)),
        holds=np.stack([table.holds for table in tables]),
        lost=np.stack([table.lost for table in tables]),
        heights=heights,
        ends=(np.stack([table.ends for table in tables]) - heights[0]) / heights[1],
        block=block,
    )


def _fitting_tables(
    views: Sequence[ViewPixels],
    level: int,
    transform: Affine,
    shape: tuple[int, int],
    block: int,
    z_ranges: tuple[tuple[float, float], tuple[float, float]],
) -> tuple[list[ProjectionTable], int]:
    """A table per view that holds to a tolerance, and its block: as asked for, where need be over the second, shorter
    range of heights only and of a higher degree, where need be halved; where that is not enough, of the highest degree,
    each block over the heights at which it is shown; and then to the wider tolerance. A view is left out of more than a
    few blocks (see `TileViews.lost`) only after all that.

    Perspective bends projections along heights and across blocks: images taken from close by, and tilted ones. So does
    an unsteady flight in raw images of line scanners, far more than any perspective, which get a still higher degree.
    """
    near, far = (COARSER_TABLE_PX, COARSER_BENT_PX) if level else (FINEST_TABLE_PX, FINEST_BENT_PX)
    blocks = [block]
    while blocks[-1] >= 2 * SMALL_BLOCK:
        blocks.append(blocks[-1] // 2)
    large = [b for b in blocks if b > SMALL_BLOCK]
    for cells, z_range, degree in ((block, z_ranges[0], DEGREE), *((b, z_ranges[1], HIGHER_DEGREE) for b in large)):
        tables = _tables_over_all_heights(
            views, TableRequest(transform, shape, cells, z_range, near * 2.0**level, degree)
        )
        if tables is not None:
            return tables, cells
    is_scanning = any(isinstance(bare(view.sensor), Scanning) for view in views)
    attempts = [(b, near, HIGHEST_DEGREE, 0.0) for b in large]
    attempts += [(b, far, HIGHEST_DEGREE, 0.0) for b in large[-1:]]
    attempts += [(SMALL_BLOCK, px, HIGHEST_DEGREE, 0.0) for px in (near, far)]
    attempts += [(SMALL_BLOCK, far, UNSTEADY_DEGREE, 0.0)] * is_scanning
    attempts += [(SMALL_BLOCK, far, HIGHEST_DEGREE, LITTLE_LOST), (SMALLEST_BLOCK, far, HIGHEST_DEGREE, 0.0)]
    attempts += [(SMALLEST_BLOCK, far, HIGHEST_DEGREE, MOST_LOST)]
    for cells, px, degree, lost in attempts:
        request = TableRequest(transform, shape, cells, z_ranges[1], px * 2.0**level, degree)
        try:
            return [
                projection_table_where_shown(
                    view.sensor, request, (*view.origin, *view.shape), max(lost, LITTLE_LOST), lost > 0.0
                )
                for view in views
            ], cells
        except GeometryError as error:
            bent = error
    if not is_scanning:
        raise bent
    raise GeometryError(
        f"The flight is too unsteady for its raw images: {bent} Or give images resampled to a plane (level 1)."
    )


def _tables_over_all_heights(views: Sequence[ViewPixels], request: TableRequest) -> list[ProjectionTable] | None:
    """A table per view; None where one of them does not hold, or not wherever its window shows something."""
    tables = []
    for view in views:
        window = (*view.origin, *view.shape)
        try:
            table = projection_table(view.sensor, request, window)
        except GeometryError:
            return None
        if table.lost.any():
            return None
        tables.append(table)
    return tables
