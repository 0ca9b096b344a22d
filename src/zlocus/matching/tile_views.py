"""The views of a tile at one level: their pixels, where these are valid, and how the cells project into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import Scanning, bare, capped, lowest_station
from zlocus.matching.kernels.shared_records import ViewArrays
from zlocus.matching.view_pixels import FloatImage, ViewPixels
from zlocus.sensors.projection_table import (
    DEGREE,
    HIGHER_DEGREE,
    HIGHEST_DEGREE,
    UNSTEADY_DEGREE,
    ProjectionTable,
    TableRequest,
    may_show,
    projection_table,
    projection_table_where_shown,
)

NO_INDEX = 2**29  # every height index is smaller
# Largest error of the projection table, in pixels of the level. It may be larger at coarser levels, which only give the
# search range of the next, and whose blocks span so much ground that the unsteady flight of an aircraft bends them
# (0.011 px over the 102 m of the demo).
FINEST_TABLE_PX, COARSER_TABLE_PX = 0.01, 0.05
# The same where even the smallest blocks do not allow it: a wide lens close to tall objects.
FINEST_BENT_PX, COARSER_BENT_PX = 0.05, 0.25
# Largest share of what a view shows (blocks by heights) from which it may be excluded; and the share in the last
# attempt.
MAX_EXCLUDED_SHARE, MAX_EXCLUDED_SHARE_AT_LAST = 0.01, 0.5
# Cells along the side of the smallest blocks. The cells around a block make small ones slow: those of four cells are
# twice as slow per cell as those of eight.
SMALL_BLOCK, SMALLEST_BLOCK = 4, 2
# Blocks whose positions are bent are at most so large: over more cells the speed with which points move with height
# changes too much for one relief (see `pixel_positions`).
LARGEST_BENT_BLOCK = 16
# Pixels around the window of a cell that must be usable too, for its interpolation.
GROWN_PX = 2
# A view shows no block whose box of corners and middles lies so far beside it, pixels of the level and cells, beyond
# the windows of the cells at its border: what lies between the places and heights looked at is not farther away.
BESIDE_PX, BESIDE_CELLS = 16.0, 4
# Tables end at this share of the depth below the lowest camera: nothing is projected from beside it.
CLEARANCE = 0.1


@dataclass(frozen=True)
class TileViews:
    """All views of a tile at one level, as the kernels take them.

    pixels : (p,) float32, one view after the other; blocked : (p,) bool, pixels that no window may touch;
    has_blocked : (i,) bool, whether a view has any; layout : (i, 3) int64, offset, rows and columns of each view in
    `pixels`; nodes : (i, b + 1, d + 1, 2, n) float64, polynomials at the corners of the blocks, in pixels of the
    window, and bends : (i, b, d, 2, 2, n) float64, see `ProjectionTable`; is_projected : (i, b, d) bool, blocks
    that a view can show; is_excluded : (i, b, d) bool, other blocks that it may show, from which it is excluded
    because its projection table is not accurate there; t_of_index : (2,) float64, parameter t of the polynomials at
    height index 0, and its change per index; index_range : (i, b, d, 2) float64, lowest and highest height index
    over which the polynomials of a block hold; block : cells along the side of a block. Height indices are level
    indices, or slope indices where the nodes follow a slanted support surface (see `height_lattice`). view_pixels : of
    the views, whose pixels are parts of `pixels`.
    """

    pixels: FloatImage
    blocked: NDArray[np.bool_]
    has_blocked: NDArray[np.bool_]
    layout: NDArray[np.int64]
    nodes: NDArray[np.float64]
    bends: NDArray[np.float64]
    is_projected: NDArray[np.bool_]
    is_excluded: NDArray[np.bool_]
    t_of_index: NDArray[np.float64]
    index_range: NDArray[np.float64]
    block: int
    view_pixels: tuple[ViewPixels, ...] = ()

    @property
    def arrays(self) -> ViewArrays:
        """The arrays that the kernels read."""
        return ViewArrays(self.pixels, self.layout, self.nodes, self.bends, self.t_of_index, self.block)

    @property
    def index_limits(self) -> NDArray[np.int64]:
        """Lowest and highest whole height index at which a view may show a block, (2, i, b, d).

        The lowest is larger than the highest where the view may not show it.
        """
        low = np.where(self.is_projected, np.ceil(self.index_range[..., 0]), NO_INDEX)
        high = np.where(self.is_projected, np.floor(self.index_range[..., 1]), -NO_INDEX)
        return np.stack([low, high]).clip(-NO_INDEX, NO_INDEX).astype(np.int64)


@dataclass(frozen=True)
class TileGrid:
    """The cells of a tile at one level, and what their height indices mean.

    transform : from cell corners to the ground; shape : rows and columns; block : cells along the side of a block,
    fewer where projections are too curved for that; height_origin, height_step : height of index 0, and of a step.
    """

    level: int
    transform: Affine
    shape: tuple[int, int]
    block: int
    height_origin: float
    height_step: float


def tile_views(
    view_pixels: Sequence[ViewPixels],
    tile_grid: TileGrid,
    z_range: tuple[float, float],
    half: int,
    z_needed: tuple[float, float] | None = None,
) -> TileViews:
    """Pixels and projections of all views for the cells of a tile at one level.

    z_range : m, heights that may be projected; half : half width of the largest window, by which the unusable pixels
    grow; z_needed : m, the part of these heights that will be projected, None where it is not known.

    Raises
    ------
    GeometryError
        Projections are too curved even for the smallest block.
    """
    layout, nodes, bends, unusable, offset, level = [], [], [], [], 0, tile_grid.level
    scale = 2.0**level
    station = lowest_station(view.sensor for view in view_pixels)
    z_ranges = capped(z_range, station, CLEARANCE), capped(z_needed or z_range, station, CLEARANCE)
    tables, block = _fitting_tables(view_pixels, tile_grid, z_ranges)
    is_projected = []
    for view, table in zip(view_pixels, tables, strict=True):
        assert view.level == level, "the pixels are those of the level"
        layout.append((offset, *view.pixels.shape))
        offset += view.pixels.size
        scaled = table.nodes / scale
        scaled[..., 0, 0] += 0.5 / scale - 0.5 - view.origin[1]
        scaled[..., 1, 0] += 0.5 / scale - 0.5 - view.origin[0]
        nodes.append(scaled)
        bends.append(table.bends / scale)
        shown_part = view.window.at_finest(level)
        is_projected.append(table.holds & may_show(table, shown_part, block, BESIDE_PX * scale, half + BESIDE_CELLS))
        unusable.append(None if view.valid.all() else grown(~view.valid, half))
    t_of_index = np.array(
        [(tile_grid.height_origin - tables[0].z_mid) / tables[0].z_half, tile_grid.height_step / tables[0].z_half]
    )
    pixels = np.concatenate([view.pixels.ravel() for view in view_pixels])
    parts = [pixels[first : first + rows * cols].reshape(rows, cols) for first, rows, cols in layout]
    blocked = np.zeros(offset, np.bool_)
    for (first, rows, cols), mask in zip(layout, unusable, strict=True):
        if mask is not None:
            blocked[first : first + rows * cols] = mask.ravel()
    return TileViews(
        pixels=pixels,
        blocked=blocked,
        has_blocked=np.array([mask is not None for mask in unusable]),
        layout=np.array(layout, np.int64),
        nodes=np.ascontiguousarray(np.stack(nodes)),
        bends=np.ascontiguousarray(np.stack(bends)),
        is_projected=np.stack(is_projected),
        is_excluded=np.stack([table.lost for table in tables]),
        t_of_index=t_of_index,
        index_range=(np.stack([table.ends for table in tables]) - t_of_index[0]) / t_of_index[1],
        block=block,
        view_pixels=tuple(replace(view, pixels=part) for view, part in zip(view_pixels, parts, strict=True)),
    )


def grown(unusable: NDArray[np.bool_], half: int) -> NDArray[np.bool_]:
    """Pixels (r, c) that no middle of a window of half width `half` may be on."""
    side = 2 * (half + GROWN_PX) + 1
    wider = cv2.dilate(unusable.astype(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(wider, np.bool_)


@dataclass(frozen=True)
class TableAttempt:
    """How projection tables are made.

    block : cells along the side of a block; tolerance_px : largest error, pixels of the level; degree : of the
    polynomials in height; is_bent : see `TableRequest`; max_excluded : share of what a view shows from which it may be
    excluded.
    """

    block: int
    tolerance_px: float
    degree: int
    is_bent: bool = False
    max_excluded: float = 0.0

    def request(self, tile_grid: TileGrid, z_range: tuple[float, float]) -> TableRequest:
        """The table of a view over some heights (m)."""
        tolerance_px = self.tolerance_px * 2.0**tile_grid.level
        return TableRequest(
            tile_grid.transform, tile_grid.shape, self.block, z_range, tolerance_px, self.degree, self.is_bent
        )


def _attempts(block: int, level: int, is_scanning: bool) -> tuple[list[TableAttempt], list[TableAttempt]]:
    """Attempts to make projection tables that hold at all heights that are needed, and, after these, attempts in which
    each block holds at the heights at which a view shows it."""
    near, far = (COARSER_TABLE_PX, COARSER_BENT_PX) if level else (FINEST_TABLE_PX, FINEST_BENT_PX)
    blocks = [block]
    while blocks[-1] >= 2 * SMALL_BLOCK:
        blocks.append(blocks[-1] // 2)
    large = [b for b in blocks if b > SMALL_BLOCK]
    bent = [b for b in large if b <= LARGEST_BENT_BLOCK]
    everywhere = [TableAttempt(b, near, HIGHER_DEGREE) for b in large if b not in bent]
    everywhere += [TableAttempt(b, near, HIGHER_DEGREE, is_bent=True) for b in bent]
    shown = [TableAttempt(b, px, HIGHEST_DEGREE, is_bent=True) for px in (near, far) for b in bent]
    shown += [TableAttempt(SMALL_BLOCK, px, HIGHEST_DEGREE, is_bent=True) for px in (near, far)]
    shown += [TableAttempt(SMALL_BLOCK, far, UNSTEADY_DEGREE)] * is_scanning
    shown += [
        TableAttempt(SMALL_BLOCK, far, HIGHEST_DEGREE, max_excluded=MAX_EXCLUDED_SHARE),
        TableAttempt(SMALLEST_BLOCK, far, HIGHEST_DEGREE),
        TableAttempt(SMALLEST_BLOCK, far, HIGHEST_DEGREE, max_excluded=MAX_EXCLUDED_SHARE_AT_LAST),
    ]
    return everywhere, shown


def _fitting_tables(
    view_pixels: Sequence[ViewPixels], tile_grid: TileGrid, z_ranges: tuple[tuple[float, float], tuple[float, float]]
) -> tuple[list[ProjectionTable], int]:
    """Projection tables of all views that are accurate enough, and the cells along the side of their blocks.

    The first attempt takes the blocks of the grid over the first, wider range of heights. The next ones take the
    second, shorter range and polynomials of a higher degree, then smaller blocks; then each block over the heights at
    which it is shown, with the highest degree; then a larger tolerance. Only after all these is a view excluded from
    more than a few blocks (see `TileViews.is_excluded`).

    Perspective bends projections along heights and across blocks: images taken from close by, and oblique ones. So does
    an unsteady flight in raw images of line scanners, far more than any perspective; they get a still higher degree.
    """
    level = tile_grid.level
    is_scanning = any(isinstance(bare(view.sensor), Scanning) for view in view_pixels)
    everywhere, shown = _attempts(tile_grid.block, level, is_scanning)
    first = TableAttempt(tile_grid.block, COARSER_TABLE_PX if level else FINEST_TABLE_PX, DEGREE)
    for attempt, z_range in ((first, z_ranges[0]), *((attempt, z_ranges[1]) for attempt in everywhere)):
        tables = _tables_over_all_heights(view_pixels, attempt.request(tile_grid, z_range))
        if tables is not None:
            return tables, attempt.block
    for attempt in shown:
        request, share = attempt.request(tile_grid, z_ranges[1]), max(attempt.max_excluded, MAX_EXCLUDED_SHARE)
        try:
            return [
                projection_table_where_shown(
                    view.sensor, request, view.window.at_finest(view.level), share, attempt.max_excluded > 0.0
                )
                for view in view_pixels
            ], attempt.block
        except GeometryError as error:
            # Its traceback would keep this frame, and the arrays of the tile, until the next garbage collection.
            bent = error.with_traceback(None)
    if not is_scanning:
        raise bent
    raise GeometryError(
        f"The flight is too unsteady for its raw images: {bent} Or give images resampled to a plane (level 1)."
    )


def _tables_over_all_heights(view_pixels: Sequence[ViewPixels], request: TableRequest) -> list[ProjectionTable] | None:
    """A projection table per view; None where one is not accurate enough, or not wherever its window shows the tile."""
    tables = []
    for view in view_pixels:
        try:
            table = projection_table(view.sensor, request, view.window.at_finest(view.level))
        except GeometryError:
            return None
        if table.lost.any():
            return None
        tables.append(table)
    return tables
