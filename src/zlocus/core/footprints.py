"""How images lie on the ground: footprints, the ground that two of them share, and base-to-height."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from zlocus.core.errors import GeometryError, ZlocusWarning
from zlocus.core.scene import Scene, View, held_window
from zlocus.core.sensor_model import FloatArray

LEAN_M = 0.5
PER_SIDE = 5


@dataclass(frozen=True)
class ViewGeometry:
    """One image on the ground. outline : polygon in the scene's frame, empty where its rays meet no ground;
    ground_px_m : ground pixel at its middle; closing_px : greatest distance by which a pixel sent to the ground and
    back misses itself; lost : share of pixels that the camera cannot map."""

    outline: Any
    ground_px_m: float
    closing_px: float
    lost: float


@dataclass(frozen=True)
class PairGeometry:
    """Two images, by number. overlap : shared ground over the smaller footprint; base_to_height : by how much their
    rays part per metre of height at the middle of `shared`, that ground."""

    views: tuple[int, int]
    overlap: float
    base_to_height: float
    shared: Any


def view_geometry(view: View, z: float) -> ViewGeometry:
    """An image's place on the ground at height z (m)."""
    from shapely import MultiPoint  # a tenth of a second

    top, left, rows, cols = held_window(view.image)
    column, row = np.meshgrid(left + np.linspace(0, cols - 1, PER_SIDE), top + np.linspace(0, rows - 1, PER_SIDE))
    xy = np.column_stack([column.ravel(), row.ravel()])
    back = view.sensor.image_from_ground(view.sensor.ground_from_image(xy, np.full(len(xy), z)))
    off = np.hypot(*(back - xy).T)
    known = np.isfinite(off)
    return ViewGeometry(
        outline=MultiPoint(footprint(view, z)).convex_hull,
        ground_px_m=ground_sample_distance(view, z),
        closing_px=float(off[known].max()) if known.any() else math.nan,
        lost=float(1.0 - known.mean()),
    )


def pair_geometries(views: Sequence[View], outlines: Sequence[Any], z: float) -> list[PairGeometry]:
    """All pairs that share ground at height z (m)."""
    from shapely import STRtree

    first, second = STRtree(list(outlines)).query(list(outlines), predicate="intersects")
    touching = {(int(i), int(j)) for i, j in zip(first, second, strict=True)}
    pairs = []
    for i, j in combinations(range(len(views)), 2):
        shared = outlines[i].intersection(outlines[j]) if (i, j) in touching else None
        if shared is None or not shared.area > 0:
            continue
        middle = np.array([shared.centroid.x, shared.centroid.y, z])
        apart = float(np.hypot(*(lean(views[i], middle) - lean(views[j], middle))))
        pairs.append(PairGeometry((i, j), shared.area / min(outlines[i].area, outlines[j].area), apart, shared))
    return pairs


def lean(view: View, xyz: FloatArray) -> FloatArray:
    """(dE, dN) per metre of height along the ray through a ground point (3,) m."""
    xy = view.sensor.image_from_ground(np.array([xyz, xyz]))
    low, high = view.sensor.ground_from_image(xy, xyz[2] + np.array([-LEAN_M, LEAN_M]))
    return np.asarray((high - low)[:2] / (2 * LEAN_M))

# Along each side of an image, for the box around its footprint; and by how much of it that is widened, for sides are
# curved in between.
BOX_POINTS, BOX_ASIDE = 8, 0.02


def footprint(view: View, z: float, per_side: int = 8, margin_px: float = 0.0) -> FloatArray:
    """The image's outline on the ground at height z (m, ellipsoidal), counter-clockwise or clockwise, not closed; of an
    image in a sparse file, the outline of the part that the file holds.

    Runs along the outer edges of the border pixels, or `margin_px` outside of them, `per_side` points a side, because
    the sides of a line scanner's image are curves. Returns (4 * per_side, 2) m; points the sensor cannot map are left
    out.
    """
    top, left, rows, cols = held_window(view.image)
    t = np.arange(per_side) / per_side
    zero, one = np.zeros(per_side), np.ones(per_side)
    column = np.concatenate([t, one, 1 - t, zero]) * (cols + 2 * margin_px) - 0.5 - margin_px + left
    row = np.concatenate([zero, t, one, 1 - t]) * (rows + 2 * margin_px) - 0.5 - margin_px + top
    xyz = view.sensor.ground_from_image(np.column_stack([column, row]), np.full(len(column), float(z)))
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1), :2])


def ground_box(view: View, z_range: tuple[float, float], margin_px: float = 0.0) -> FloatArray:
    """Least and greatest east and north (2, 2) m that an image may see between two heights (m), if it may lie
    `margin_px` away from where its sensor model puts it; infinite where some ray at its border meets no ground.

    Rays are straight: at heights in between they stay in the box of both ends.
    """
    outlines = [footprint(view, z, BOX_POINTS, margin_px) for z in z_range]
    if any(len(outline) < 4 * BOX_POINTS for outline in outlines):
        return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    xy = np.concatenate(outlines)
    aside = BOX_ASIDE * np.ptp(xy, axis=0)
    return np.stack([xy.min(axis=0) - aside, xy.max(axis=0) + aside])


def is_shared(scene: Scene, z: float) -> bool:
    """Whether two views or more see the same ground at a height (m, ellipsoidal)."""
    from shapely import MultiPoint, STRtree

    hulls = [MultiPoint(footprint(view, z)).convex_hull for view in scene.views]
    tree = STRtree(hulls)
    first, second = tree.query(hulls, predicate="intersects")
    return any(hulls[i].intersection(hulls[j]).area > 0 for i, j in zip(first, second, strict=True) if i < j)


def ground_sample_distance(view: View, z: float) -> float:
    """Metres on the ground at height z per pixel at the image's centre: geometric mean of both directions.

    NaN where the sensor cannot map the centre.
    """
    top, left, rows, cols = held_window(view.image)
    column, row = left + (cols - 1) / 2, top + (rows - 1) / 2
    xy = np.array([[column - 0.5, row], [column + 0.5, row], [column, row - 0.5], [column, row + 0.5]])
    left, right, up, down = view.sensor.ground_from_image(xy, np.full(4, float(z)))[:, :2]
    (ax, ay), (bx, by) = right - left, down - up
    return float(np.sqrt(abs(ax * by - ay * bx)))


def check_overlap(scene: Scene, heights: float | Sequence[float]) -> None:
    """Refuse a scene without two views of the same ground; warn of views that share none.

    heights : m, ellipsoidal; views overlap when their footprints do at any of them (a footprint moves with the height,
    so give several where the height of the ground is not known).

    Raises
    ------
    GeometryError
        When no two footprints overlap; names the views and where they lie.
    """
    # shapely costs 0.1 s to import, and only this check needs it.
    from shapely import MultiPoint, STRtree

    levels = np.atleast_1d(np.asarray(heights, float))
    n_views = len(scene.views)
    overlap = np.zeros(n_views, bool)
    for z in levels:
        hulls = [MultiPoint(footprint(view, z)).convex_hull for view in scene.views]
        for i, j in zip(*STRtree(hulls).query(hulls, predicate="intersects"), strict=True):
            if i < j and hulls[i].intersection(hulls[j]).area > 0:
                overlap[[i, j]] = True
    at = f"at heights of {levels.min():g} to {levels.max():g} m" if len(levels) > 1 else f"at {levels[0]:g} m"
    if not overlap.any():
        where = "; ".join(f"{view.name} {_extent(hull.bounds)}" for view, hull in zip(scene.views, hulls, strict=True))
        raise GeometryError(
            f"No two images see the same ground {at} ({scene.crs.to_string()}): {where}. "
            "Check that they show the same place and that each RPC belongs to its image."
        )
    for view, overlaps in zip(scene.views, overlap, strict=True):
        if not overlaps:
            warnings.warn(
                f"{view.name} ({view.path}) overlaps no other image {at}. Leave it out, or check its RPC.",
                ZlocusWarning,
                stacklevel=2,
            )


def _extent(bounds: tuple[float, ...]) -> str:
    """Bounds for a message."""
    if not bounds or not np.isfinite(bounds).all():
        return "nowhere"
    xmin, ymin, xmax, ymax = bounds
    return f"E {xmin:.0f} to {xmax:.0f} m, N {ymin:.0f} to {ymax:.0f} m"



def shared_ground(scene: Scene, z_range: tuple[float, float]) -> tuple[float, float, float, float]:
    """Bounds (xmin, ymin, xmax, ymax) of the ground that two views may see between two heights.

    Raises
    ------
    GeometryError
        When no two footprints overlap.
    """
    from shapely import MultiPoint

    hulls = []
    for view in scene.views:
        points = np.concatenate([footprint(view, z) for z in z_range])
        hulls.append(MultiPoint(points).convex_hull)
    shared = [a.intersection(b) for a, b in combinations(hulls, 2)]
    bounds = np.array([part.bounds for part in shared if part.area > 0])
    if not len(bounds):
        raise GeometryError(
            f"No two images see the same ground at heights of {z_range[0]:.0f} to {z_range[1]:.0f} m. Check the RPCs, "
            "or give other heights with --heights."
        )
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
