"""Planes through plain segments: roofs and other even ground whose cells alone have nothing to be matched by.

The semi-global constraint fills them with whatever costs least, level rather than sloped and off by a metre or two;
their outline, and what little texture there is, pooled over the whole segment, knows better (method section 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import PlaneOptions
from zlocus.matching.kernels.plane_fitting import SPAN, fit_segments
from zlocus.matching.local_contrast import ALL, Part, deviation, texture_unit
from zlocus.matching.occlusion import sees
from zlocus.matching.tile_views import TileViews

TEXTURE, RIM, INNER = (3, 3), np.ones((3, 3), np.uint8), np.ones((3, 3), np.uint8)
# By how much less the views may agree on a plane than on the heights before, as a share of what a plain core may have.
MOST_WORSE = 0.25


@dataclass(frozen=True)
class PlanarHeights:
    """height : (r, c) float32 height indices, planes where `is_planar`, (r, c) bool."""

    height: NDArray[np.float32]
    is_planar: NDArray[np.bool_]


@dataclass(frozen=True)
class Segments:
    """Cells of plain segments, one segment after the other.

    start : (s + 1,) where each begins; row, col : (n,); is_core : (n,) whether a cell is plain itself, not beside one;
    is_inner : (n,) whether those around it are too.
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


def with_planes(
    views: TileViews,
    ortho: NDArray[np.float32],
    known: PlanarHeights,
    seen: NDArray[np.int32],
    options: PlaneOptions,
    core: Part = ALL,
) -> PlanarHeights:
    """Heights with planes in place of those of plain segments, where the views agree on a plane.

    ortho : (r, c) grey values at the known heights, which are (r, c) height indices; cells that are planar stay; seen :
    (3, i, r, c), see `coverage`; core : the cells whose texture is the unit. A plane is taken where most cells were
    matched near it, or the views agree better on it, and where they agree on its core to the noise, not much less than
    on the heights before: outlines may not.
    """
    height, shown = known.height, np.isfinite(ortho)
    grey = np.where(shown, ortho, np.float32(0.0))
    unit = texture_unit(ortho, core)
    noise, is_plain = options.noise * unit, deviation(grey, TEXTURE) < options.texture * unit
    found = plain_segments(is_plain & shown & ~known.is_planar, options)
    n_segments, cells = len(found.start) - 1, (found.row, found.col)
    if not (n_segments and noise > 0):
        return known
    before = height[cells].astype(np.float64)
    after, visible = before.copy(), sees(seen[(slice(None), slice(None), *cells)], height[cells])
    is_plain, planes, costs = np.zeros(n_segments, np.bool_), np.zeros((n_segments, 3)), np.zeros((n_segments, 2, 2))
    fit_segments(
        found.start, visible, found.is_core, *cells, before, views.pixels, views.layout, views.nodes, views.heights,
        views.block, noise, options.most_cost, is_plain, planes, costs, after,
    )  # fmt: skip
    of_cell, is_near = found.of_cell, np.abs(after - before) < options.near_steps
    near = np.bincount(of_cell, is_near & found.is_core, n_segments) / np.bincount(of_cell, found.is_core, n_segments)
    better = costs[:, 1, 0] < costs[:, 0, 0]
    taken = is_plain & (costs[:, 1, 1] < options.most_cost) & (near > np.where(better, 0.5, options.least_near))
    taken &= costs[:, 1, 1] - costs[:, 0, 1] < MOST_WORSE * options.most_cost
    taken &= np.hypot(planes[:, 1], planes[:, 2]) < options.most_slope_steps * SPAN
    kept = taken[of_cell] & (found.is_inner | is_near) & (visible.sum(axis=0) >= 2)
    result = PlanarHeights(height.copy(), known.is_planar.copy())
    result.height[found.row[kept], found.col[kept]] = after[kept]
    result.is_planar[found.row[kept], found.col[kept]] = True
    return result


def plain_segments(is_plain: NDArray[np.bool_], options: PlaneOptions) -> Segments:
    """Connected plain cells in the shape of a roof, and a rim of one cell around each.

    A filled rectangle of any direction has twelve times the root of the determinant of its cells' covariance for an
    area; nets of roads and what surrounds houses have far less, and no single plane.
    """
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(is_plain.astype(np.uint8), connectivity=4)
    area = statistics[:, cv2.CC_STAT_AREA]
    fits = (area >= options.least_cells) & (area <= options.most_cells)
    fits[0] = False
    core, n_fitting = renumbered(labels, fits)
    long, across = sides(core, n_fitting)
    compact = (np.bincount(core.ravel(), minlength=n_fitting + 1)[1:] >= options.least_filled * long * across) & (
        long <= options.longest_cells
    )
    core, n = renumbered(core, np.concatenate([[False], compact]))
    whole = np.where(core > 0, core, cv2.dilate(core.astype(np.float32), RIM).astype(np.int32)).ravel()
    cells = np.flatnonzero(whole)
    cells = cells[np.argsort(whole[cells], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(whole[cells], minlength=n + 1)[1:])])
    row, col = np.divmod(cells, is_plain.shape[1])
    inner = cv2.erode((core > 0).astype(np.uint8), INNER).ravel()[cells] > 0
    return Segments(start.astype(np.int64), row, col, core.ravel()[cells] > 0, inner)


def renumbered(labels: NDArray[np.int32], kept: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Labels (r, c) of the kept ones alone, counted from 1, 0 elsewhere; and how many they are. kept : (labels,)."""
    number = np.zeros(len(kept), np.int32)
    number[kept] = np.arange(1, kept.sum() + 1)
    return number[labels], int(kept.sum())


def sides(labels: NDArray[np.int32], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Longer and shorter side, cells, of the rectangle with the covariance of each label's cells, (count,) each."""
    row, col = np.nonzero(labels)
    label = labels[row, col] - 1
    n = np.maximum(np.bincount(label, minlength=count), 1)
    y, x = (v - (np.bincount(label, v, count) / n)[label] for v in (row, col))
    # The cells' own extent adds a twelfth.
    yy, xx = (np.bincount(label, v * v, count) / n + 1 / 12 for v in (y, x))
    yx = np.bincount(label, y * x, count) / n
    half, spread = (yy + xx) / 2, np.hypot((yy - xx) / 2, yx)
    return np.sqrt(12 * (half + spread)), np.sqrt(12 * np.maximum(half - spread, 0))
