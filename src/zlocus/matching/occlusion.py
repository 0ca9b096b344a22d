"""The visible height range of every view in every cell: inside the image, on valid pixels, not occluded by a surface.

Height indices are slope indices while a level is matched, and level indices in its result: see `height_lattice`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.coverage import BlockLimits, ViewMasks, tile_coverage
from zlocus.matching.kernels.occlusion import (
    count_seeing,
    forget_most_occlusions,
    lowest_visible,
    write_lowest_unoccluded,
)
from zlocus.matching.kernels.shared_records import NEVER_COVERED, NEVER_OCCLUDED, CellBox, VisibleHeights
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_directions import (
    cells_along_rays,
    cells_per_step,
    directions_of_blocks,
    parts_of_one_direction,
)

# Pixels along the edge of every image that are not used.
EDGE_PX = 3.0
# A height takes two views.
PAIR = 2
# Views whose base-to-height is smaller tell no height: a match off by a third of a pixel would put it off by more than
# thirty pixels.
MIN_BASE_TO_HEIGHT = 0.01
# Where so many views cover the cells of a tile, none is excluded where a surface occludes it: a tower that is too wide
# would exclude just those that see the ground beside it. There the best of the pairs count, which are those without
# occluded views anyway.
MANY_VIEWS = 13


def covered_heights(
    slope_views: TileViews, slope_surface: SlopeSurface, lattice: HeightLattice, edge_px: float = EDGE_PX
) -> VisibleHeights:
    """Height range over which each view covers each cell, in slope indices; nothing is occluded yet.

    A view takes part over the longest run of heights whose windows lie inside the image and on valid pixels; at other
    heights it counts like an occluded one. (If the whole search range had to be covered, every image would lose its
    edges by as much as the range is wide in parallax.) slope_views : projections of slope indices; edge_px : pixels
    along the edge of the image that are not used.
    """
    shape = (len(slope_views.layout), *lattice.shape)
    visible = VisibleHeights(np.empty(shape, np.int32), np.empty(shape, np.int32), np.full(shape, NEVER_OCCLUDED))
    tile_coverage(
        slope_views.arrays, ViewMasks(slope_views.blocked, slope_views.has_blocked), lattice.layout,
        BlockLimits(*slope_views.index_limits), edge_px, slope_surface.relief, visible.lowest_covered,
        visible.highest_covered,
    )  # fmt: skip
    return visible


def exclude_views_of_one_direction(visible: VisibleHeights, tile_views: TileViews, steps_per_cell: float) -> None:
    """Let no view cover the cells whose views all look along nearly the same line; changes `visible`.

    Such views are alike at every height, so that any height would do: a copy of an image, or a second image from the
    same point of the orbit. steps_per_cell : side of a cell in height steps.
    """
    n_views = len(visible.lowest_covered)
    middle = np.array([cells_per_step(tile_views, view) for view in range(n_views)]) * steps_per_cell
    # Directions turn a little within a tile.
    is_near = np.hypot(*np.moveaxis(middle[:, None] - middle[None], -1, 0)) < 2 * MIN_BASE_TO_HEIGHT
    most_alike = int(is_near.sum(axis=1).max(initial=0))
    if most_alike < PAIR:
        return
    covered = covers(visible)
    count = covered.sum(axis=0)
    row, col = np.nonzero((count >= PAIR) & (count <= most_alike))
    direction = directions_of_blocks(tile_views)[:, row // tile_views.block, col // tile_views.block] * steps_per_cell
    is_covering = covered[:, row, col, None]
    low, high = (np.where(is_covering, direction, beyond) for beyond in (np.inf, -np.inf))
    is_alike = np.hypot(*(high.max(axis=0) - low.min(axis=0)).T) < MIN_BASE_TO_HEIGHT
    excluded = np.zeros_like(covered)
    excluded[:, row[is_alike], col[is_alike]] = True
    exclude(visible, excluded)


def excluded_view_mask(tile_views: TileViews, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Mark the cells (r, c) for which a view that may show them was excluded: see `TileViews.is_excluded`."""
    return _cells_of(np.asarray(tile_views.is_excluded.any(axis=0)), tile_views.block, shape)


def _cells_of(blocks: NDArray[np.bool_], block: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Values of the cells (..., r, c) from those of their blocks (..., b, d)."""
    rows, cols = shape
    return blocks.repeat(block, axis=-2).repeat(block, axis=-1)[..., :rows, :cols]


def mark_occlusions(
    visible: VisibleHeights,
    tile_views: TileViews,
    occluder: NDArray[np.float32],
    slope_cells: NDArray[np.float32],
    margin_steps: float,
    first: tuple[int, int] = (0, 0),
) -> None:
    """Set the lowest height index at which each view is not occluded by a surface; changes `visible`.

    tile_views : projections of level indices; occluder : float32 level indices of the surface, a lower bound of it, on
    the cells of the tile and, where some are known, of those around it; slope_cells : (r, c) float32, the surface that
    the indices of `visible` are counted from; margin_steps : a view counts as occluded this far below the lowest
    visible height; first : row and column of the tile's first cell in `occluder`.
    """
    highest, covered = float(occluder.max()), covers(visible)
    for i in range(len(tile_views.layout)):
        for part in parts_of_one_direction(tile_views, i):
            if not covered[i][part].any():
                continue
            lowest_searched = float((visible.lowest_covered[i][part] + slope_cells[part])[covered[i][part]].min())
            by_cell = cells_per_step(tile_views, i, part)
            (r0, r1), (c0, c1) = (span.indices(n)[:2] for span, n in zip(part, slope_cells.shape, strict=True))
            of_occluder = slice(first[0] + r0, first[0] + r1), slice(first[1] + c0, first[1] + c1)
            # What occludes a cell stands where its ray rises to, against the direction in which rays reach it.
            (rows, cols), _ = cells_along_rays(
                of_occluder, (-by_cell[0], -by_cell[1]), max(highest - lowest_searched, 0.0), occluder.shape
            )
            occluding = np.ascontiguousarray(occluder[rows, cols])
            lowest = np.empty(occluding.shape, np.float32)
            lowest_visible(occluding, *by_cell, lowest)
            write_lowest_unoccluded(
                lowest, np.array([first[0] - rows.start, first[1] - cols.start]), slope_cells,
                np.float32(margin_steps), np.float32(NEVER_OCCLUDED), CellBox(r0, r1, c0, c1),
                visible.lowest_unoccluded[i],
            )  # fmt: skip


def keep_enough_views(visible: VisibleHeights) -> None:
    """Remove occlusions from cells that would keep too few views; changes `visible`.

    A height that is wrong occludes as much as one that is right. Of two views neither counts as occluded, because no
    comparison would be left to correct the error. Of four or more, the three that are seen lowest do not:
    in a forest, or beside a false tower, most views would be lost, and those that are left would hold too little
    evidence. Of three views every one may be occluded: beside a wall only one may see the ground, and comparing it with
    views of the roof gives false heights.
    """
    forget_most_occlusions(visible, np.int32(NEVER_OCCLUDED))


def sees(visible: VisibleHeights, height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which views see the cells at the given height indices. visible : (..., r, c); height : (..., r, c)."""
    return np.asarray(covers_at(visible, height) & (visible.lowest_unoccluded <= height))


def covers_at(visible: VisibleHeights, height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which views cover the cells at the given height indices, occluded or not. Shapes: see `sees`."""
    return np.asarray((visible.lowest_covered <= height) & (height <= visible.highest_covered))


def n_seeing(visible: VisibleHeights, height: NDArray[np.float32]) -> NDArray[np.int32]:
    """Number of views that see each cell at its height index, (r, c). height : (r, c)."""
    count = np.empty(height.shape, np.int32)
    count_seeing(visible, height, count)
    return count


def covers(visible: VisibleHeights) -> NDArray[np.bool_]:
    """Which views cover the cells at any height, (..., r, c)."""
    return np.asarray(visible.lowest_covered <= visible.highest_covered)


def usual_number(visible: VisibleHeights, cells: tuple[slice, slice] | NDArray[np.bool_]) -> float:
    """Median number of views that cover some cells, given by their rows and columns or by a mask (r, c)."""
    return float(np.median(covers(visible).sum(axis=0)[cells]))


def in_level_indices(visible: VisibleHeights, slope_cells: NDArray[np.float32]) -> VisibleHeights:
    """Convert slope indices to level indices, to half a step; changes `visible`. slope_cells : (r, c) float32."""
    never = ~covers(visible)
    offset = np.rint(slope_cells).astype(np.int32)
    for bound in visible:
        bound += offset
    exclude(visible, never)
    return visible


def exclude(visible: VisibleHeights, excluded: NDArray[np.bool_]) -> None:
    """Let views cover some cells at no height; changes `visible`. excluded : (i, r, c) bool."""
    visible.lowest_covered[excluded], visible.highest_covered[excluded] = NEVER_COVERED, NEVER_OCCLUDED
