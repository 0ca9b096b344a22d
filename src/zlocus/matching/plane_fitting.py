"""Planes through segments without texture: roofs and other even ground that cannot be matched cell by cell.

The semi-global constraint gives such cells the height of the least cost, which is level instead of sloped, and wrong by
a metre or two. The outline of a segment and what little texture it has, taken together over the whole segment, give a
better height (method section 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import PlaneOptions
from zlocus.core.options.option_fields import value_of
from zlocus.matching.kernels.plane_fitting import (
    SLOPE_SPAN_CELLS,
    FittedPlanes,
    PlaneCells,
    PlaneLimits,
    fit_segments,
    plane_heights,
)
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.local_contrast import ALL, Part, deviation, texture_unit
from zlocus.matching.occlusion import sees
from zlocus.matching.tile_views import TileViews

# Window in which the grey deviation of a cell is measured; rim around the plain cells, and what is eroded for the inner
# cells.
TEXTURE_WINDOW, RIM, INNER = (3, 3), np.ones((3, 3), np.uint8), np.ones((3, 3), np.uint8)
# The surroundings of a segment are the cells whose distance from it, in cells, is in this range. Those below its plane
# are so many steps below it. On roads and on the ground planes are worse than the matched heights: with them 1 of 25
# cells of such segments is no longer within 1 m, in towns of two to eight images, and 1 of 50 cells of roofs comes
# within it.
SURROUNDINGS, LEAST_STEPS_ABOVE = (3, 4), 3.0
# Where the views agree better on a plane than on the matched heights, this share of the cells near it is enough.
MIN_NEAR_SHARE_OF_BETTER_PLANE = 0.5


@dataclass(frozen=True)
class PlanarHeights:
    """height : (r, c) float32 height indices; is_planar : (r, c) bool, cells whose height is that of a plane."""

    height: NDArray[np.float32]
    is_planar: NDArray[np.bool_]


@dataclass(frozen=True)
class PlainSegments:
    """Cells of plain segments, one segment after the other.

    start : (s + 1,) where each begins; row, col : (n,); is_core : (n,) whether a cell is plain itself, not one of the
    rim; is_inner : (n,) whether the cells around it are plain too.
    """

    start: NDArray[np.int64]
    row: NDArray[np.int64]
    col: NDArray[np.int64]
    is_core: NDArray[np.bool_]
    is_inner: NDArray[np.bool_]

    @property
    def of_cell(self) -> NDArray[np.int64]:
        """(n,) the segment of each cell."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


class LabelledSegments(NamedTuple):
    """labels : (r, c) int32, 1 to `n_segments`, 0 where a cell belongs to no segment."""

    labels: NDArray[np.int32]
    n_segments: int


class RectangleSides(NamedTuple):
    """Sides, in cells, of the rectangle with the same covariance as the cells of each segment, (count,) each."""

    long: NDArray[np.float64]
    short: NDArray[np.float64]


def with_planes(
    tile_views: TileViews,
    ortho: NDArray[np.float32],
    known: PlanarHeights,
    visible: VisibleHeights,
    options: PlaneOptions,
    core: Part = ALL,
) -> PlanarHeights:
    """Heights with planes in place of the heights of plain segments, where the views agree on a plane.

    ortho : (r, c) grey values on the known heights, NaN where not known; known : heights so far, as lattice indices;
    cells that are planar already keep theirs; visible : see `occlusion`; core : the cells whose texture is
    the unit.

    A plane is accepted where the segment stands above its surroundings (`min_share_below`), and where most matched
    heights are near the plane, or the views agree better on it. In both cases the views have to agree on its core to
    within the noise, and not much worse than on the matched heights; the rim need not agree.
    """
    height, is_known = known.height, np.isfinite(ortho)
    grey = np.where(is_known, ortho, np.float32(0.0))
    unit = texture_unit(ortho, core)
    noise, is_plain = options.noise * unit, deviation(grey, TEXTURE_WINDOW) < options.texture * unit
    segments = plain_segments(is_plain & is_known & ~known.is_planar, options)
    if not (len(segments.start) > 1 and noise > 0):
        return known
    row, col = segments.row, segments.col
    before = height[row, col].astype(np.float64)
    is_visible = sees(visible.at(np.s_[:, row, col]), height[row, col])
    fitted = _fitted_planes(tile_views, segments, before, is_visible, PlaneLimits(float(noise), options.max_cost))
    is_near = np.abs(fitted.heights - before) < options.near_steps
    is_accepted = accepted_planes(segments, fitted, is_near, options)
    below = share_below(segments, fitted.planes, height, is_accepted)
    is_accepted[is_accepted] = below >= value_of(options, "min_share_below")
    kept = is_accepted[segments.of_cell] & (segments.is_inner | is_near) & (is_visible.sum(axis=0) >= 2)
    result = PlanarHeights(height.copy(), known.is_planar.copy())
    result.height[row[kept], col[kept]] = fitted.heights[kept]
    result.is_planar[row[kept], col[kept]] = True
    return result


def _fitted_planes(
    tile_views: TileViews,
    segments: PlainSegments,
    height: NDArray[np.float64],
    is_visible: NDArray[np.bool_],
    limits: PlaneLimits,
) -> FittedPlanes:
    """The plane of every segment. height : (n,) matched height indices; is_visible : (i, n)."""
    n_segments = len(segments.start) - 1
    fitted = FittedPlanes(
        np.zeros(n_segments, np.bool_), np.zeros((n_segments, 3)), np.zeros((n_segments, 2, 2)), height.copy()
    )
    cells = PlaneCells(segments.row, segments.col, height, segments.is_core, is_visible)
    fit_segments(segments.start, cells, tile_views.arrays, limits, fitted)
    return fitted


def accepted_planes(
    segments: PlainSegments, fitted: FittedPlanes, is_near: NDArray[np.bool_], options: PlaneOptions
) -> NDArray[np.bool_]:
    """(s,) bool: segments whose plane replaces the matched heights; see `with_planes`. is_near : (n,), matched heights
    near the plane."""
    (all_before, core_before), (all_after, core_after) = fitted.costs[:, 0].T, fitted.costs[:, 1].T
    of_cell, n_segments = segments.of_cell, len(segments.start) - 1
    n_core = np.bincount(of_cell, segments.is_core, n_segments)
    near_share = np.bincount(of_cell, is_near & segments.is_core, n_segments) / n_core
    min_share = np.where(all_after < all_before, MIN_NEAR_SHARE_OF_BETTER_PLANE, options.min_near_share)
    is_accepted = fitted.is_plain & (core_after < options.max_cost) & (near_share > min_share)
    is_accepted &= core_after - core_before < value_of(options, "max_cost_increase")
    slope = np.hypot(fitted.planes[:, 1], fitted.planes[:, 2])
    is_accepted &= slope < options.max_slope_steps * SLOPE_SPAN_CELLS
    return np.asarray(is_accepted)


def share_below(
    segments: PlainSegments, planes: NDArray[np.float64], height: NDArray[np.float32], wanted: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Share of the surroundings of each wanted segment that lies below its plane, (number of wanted segments,).

    planes : see `FittedPlanes`; height : (r, c) height indices of all cells; wanted : (s,). See SURROUNDINGS.
    """
    nearest, farthest = SURROUNDINGS
    inside, outside = (np.ones((2 * distance + 1,) * 2, np.uint8) for distance in (nearest - 1, farthest))
    shares = []
    for number in np.flatnonzero(wanted):
        of_segment = slice(*segments.start[number : number + 2])
        row, col = segments.row[of_segment], segments.col[of_segment]
        top, left = max(row.min() - farthest, 0), max(col.min() - farthest, 0)
        around = height[top : row.max() + farthest + 1, left : col.max() + farthest + 1]
        shape = np.zeros(around.shape, np.uint8)
        shape[row - top, col - left] = 1
        is_beside = (cv2.dilate(shape, outside) > 0) & (cv2.dilate(shape, inside) == 0)
        beside_row, beside_col = np.divmod(np.flatnonzero(is_beside), is_beside.shape[1])
        plane = np.empty(len(beside_row))
        middle = np.array([row.mean() - top, col.mean() - left])
        plane_heights(beside_row, beside_col, middle, planes[number], plane)
        is_below = around[is_beside] < plane - LEAST_STEPS_ABOVE
        shares.append(is_below.mean() if is_below.size else 0.0)
    return np.array(shares)


def plain_segments(is_plain: NDArray[np.bool_], options: PlaneOptions) -> PlainSegments:
    """Connected plain cells in the shape of a roof, with a rim of one cell around each segment. is_plain : (r, c).

    The area of a filled rectangle of any direction is twelve times the root of the determinant of its cells'
    covariance. Networks of roads and the ground around houses fill far less than this, and lie in no single plane.
    """
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(is_plain.astype(np.uint8), connectivity=4)
    area = statistics[:, cv2.CC_STAT_AREA]
    has_size = (area >= options.min_cells) & (area <= options.max_cells)
    has_size[0] = False
    core, count = renumbered(labels, has_size)
    long, short = rectangle_sides(core, count)
    n_cells = np.bincount(core.ravel(), minlength=count + 1)[1:]
    is_compact = (n_cells >= options.min_filled_share * long * short) & (long <= options.max_length_cells)
    core, count = renumbered(core, np.concatenate([[False], is_compact]))
    whole = np.where(core > 0, core, cv2.dilate(core.astype(np.float32), RIM).astype(np.int32)).ravel()
    cells = np.flatnonzero(whole)
    cells = cells[np.argsort(whole[cells], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(whole[cells], minlength=count + 1)[1:])])
    row, col = np.divmod(cells, is_plain.shape[1])
    is_inner = cv2.erode((core > 0).astype(np.uint8), INNER).ravel()[cells] > 0
    return PlainSegments(start.astype(np.int64), row, col, core.ravel()[cells] > 0, is_inner)


def renumbered(labels: NDArray[np.int32], kept: NDArray[np.bool_]) -> LabelledSegments:
    """The segments that are kept, counted from 1. labels : (r, c); kept : (number of labels,)."""
    number = np.zeros(len(kept), np.int32)
    number[kept] = np.arange(1, kept.sum() + 1)
    return LabelledSegments(number[labels], int(kept.sum()))


def rectangle_sides(labels: NDArray[np.int32], count: int) -> RectangleSides:
    """Sides of the rectangle with the covariance of the cells of each label. labels : (r, c), 1 to count."""
    row, col = np.nonzero(labels)
    label = labels[row, col] - 1
    n = np.maximum(np.bincount(label, minlength=count), 1)
    y, x = (v - (np.bincount(label, v, count) / n)[label] for v in (row, col))
    # The extent of a cell itself adds a twelfth.
    yy, xx = (np.bincount(label, v * v, count) / n + 1 / 12 for v in (y, x))
    yx = np.bincount(label, y * x, count) / n
    half, spread = (yy + xx) / 2, np.hypot((yy - xx) / 2, yx)
    return RectangleSides(np.sqrt(12 * (half + spread)), np.sqrt(12 * np.maximum(half - spread, 0)))
