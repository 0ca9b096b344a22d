"""How images lie on the ground: footprints, overlap, the area of interest, ground pixels and parallax rates.

Every question of overlap and of the area to match is answered here. Heights are ellipsoidal metres in the frame of the
scene; footprints move with the height, so each function says at which heights it asks.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError, ZlocusWarning
from zlocus.core.grid import CellWindow, Grid
from zlocus.core.scene import Scene, View, held_window, is_local
from zlocus.core.sensor_model import FloatArray

Bounds = tuple[float, float, float, float]  # xmin, ymin, xmax, ymax, m

# Rays are compared over this height difference above and below a point.
RAY_HALF_HEIGHT_M = 0.5
# Points along each side of an image at which `view_geometry` tests its camera.
CAMERA_TEST_POINTS = 5
# Points along each side of an image for the box around its footprint, and the share by which the box is widened,
# because the sides of a footprint are curved between the points.
BOX_POINTS, BOX_MARGIN = 8, 0.02
# In a local frame the area to match is that of the tie points between these percentiles, extended on all sides by this
# share of their extent, where there are at least this many tie points.
AREA_PERCENT, AREA_MARGIN, MIN_TIES_FOR_AREA = (0.5, 99.5), 0.05, 20
# Coordinates up to this may be degrees.
LARGEST_DEGREES = 360.0


def footprint(view: View, z: float, per_side: int = 8, margin_px: float = 0.0) -> FloatArray:
    """Outline of an image on the ground at height z (m), (4 * per_side, 2) m, clockwise or counter-clockwise, not
    closed.

    Of an image in a sparse file: the outline of the part that the file holds. The outline runs along the outer edges of
    the border pixels, or `margin_px` outside of them. It has `per_side` points on each side, because the sides of a
    line scanner's image are curves. Points that the sensor cannot map are left out.
    """
    top, left, rows, cols = held_window(view.image)
    t = np.arange(per_side) / per_side
    zero, one = np.zeros(per_side), np.ones(per_side)
    column = np.concatenate([t, one, 1 - t, zero]) * (cols + 2 * margin_px) - 0.5 - margin_px + left
    row = np.concatenate([zero, t, one, 1 - t]) * (rows + 2 * margin_px) - 0.5 - margin_px + top
    xyz = view.sensor.ground_from_image(np.column_stack([column, row]), np.full(len(column), float(z)))
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1), :2])


def ground_box(view: View, z_range: tuple[float, float], margin_px: float = 0.0) -> FloatArray:
    """Smallest and largest easting and northing, (2, 2) m, that an image may see between two heights (m).

    margin_px : by how much the image may lie away from where its sensor model puts it. Infinite where some ray at the
    image's border meets no ground. Rays are straight: at heights in between they stay in the box of both ends.
    """
    outlines = [footprint(view, z, BOX_POINTS, margin_px) for z in z_range]
    if any(len(outline) < 4 * BOX_POINTS for outline in outlines):
        return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    xy = np.concatenate(outlines)
    margin = BOX_MARGIN * np.ptp(xy, axis=0)
    return np.stack([xy.min(axis=0) - margin, xy.max(axis=0) + margin])


def views_near(views: Sequence[View], area: Bounds, z_range: tuple[float, float]) -> tuple[View, ...]:
    """The views that may show ground of an area (m) between two heights (m). Boxes around footprints are compared."""
    (west, south, east, north), near = area, []
    for view in views:
        low, high = ground_box(view, z_range)
        if low[0] <= east and west <= high[0] and low[1] <= north and south <= high[1]:
            near.append(view)
    return tuple(near)


def is_shared(scene: Scene, z: float) -> bool:
    """Whether two views or more see the same ground at a height (m)."""
    from shapely import MultiPoint

    hulls = [MultiPoint(footprint(view, z)).convex_hull for view in scene.views]
    return any(hulls[i].intersection(hulls[j]).area > 0 for i, j in overlapping_pairs(hulls).tolist())


def ground_sample_distance(view: View, z: float) -> float:
    """Size of a pixel on the ground at height z (m), m, at the image's centre: geometric mean of both directions.

    NaN where the sensor cannot map the centre.
    """
    top, left, rows, cols = held_window(view.image)
    column, row = left + (cols - 1) / 2, top + (rows - 1) / 2
    xy = np.array([[column - 0.5, row], [column + 0.5, row], [column, row - 0.5], [column, row + 0.5]])
    left, right, up, down = view.sensor.ground_from_image(xy, np.full(4, float(z)))[:, :2]
    (ax, ay), (bx, by) = right - left, down - up
    return float(np.sqrt(abs(ax * by - ay * bx)))


def check_overlap(scene: Scene, heights: float | Sequence[float]) -> None:
    """Refuse a scene in which no two views see the same ground; warn about views that overlap no other.

    heights : m; views overlap where their footprints do at any of them. Give several where the height of the ground is
    not known.

    Raises
    ------
    GeometryError
        No two footprints overlap; the message says where each view lies.
    """
    # shapely costs 0.1 s to import, and only this check needs it.
    from shapely import MultiPoint

    levels = np.atleast_1d(np.asarray(heights, float))
    n_views = len(scene.views)
    overlap = np.zeros(n_views, bool)
    for z in levels:
        hulls = [MultiPoint(footprint(view, z)).convex_hull for view in scene.views]
        for i, j in overlapping_pairs(hulls).tolist():
            if not overlap[[i, j]].all() and hulls[i].intersection(hulls[j]).area > 0:
                overlap[[i, j]] = True
    at = f"at heights of {levels.min():g} to {levels.max():g} m" if len(levels) > 1 else f"at {levels[0]:g} m"
    if not overlap.any():
        where = "; ".join(f"{view.name} {_extent(hull.bounds)}" for view, hull in zip(scene.views, hulls, strict=True))
        advice = (
            "Check that they show the same place and that each camera belongs to its image."
            if scene.heights is None
            else "Give --heights that contain the ground, or leave it out."
        )
        raise GeometryError(f"No two images see the same ground {at} ({scene.crs.to_string()}): {where}. {advice}")
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


def overlapping_pairs(outlines: Sequence[Any] | NDArray[Any]) -> NDArray[np.int64]:
    """Numbers (n, 2) of the polygons that touch each other, each pair once and in ascending order."""
    from shapely import STRtree

    first, second = STRtree(outlines).query(outlines, predicate="intersects")
    pairs = np.column_stack([first, second])[first < second]
    return np.asarray(pairs[np.lexsort(pairs.T[::-1])])


def shared_ground(scene: Scene, z_range: tuple[float, float]) -> Bounds:
    """Bounds (xmin, ymin, xmax, ymax), m, of the ground that two views or more may see between two heights (m).

    Raises
    ------
    GeometryError
        No two footprints overlap.
    """
    from shapely import MultiPoint, area, bounds, intersection

    points = [np.concatenate([footprint(view, z) for z in z_range]) for view in scene.views]
    hulls = np.array([MultiPoint(each).convex_hull for each in points])
    first, second = overlapping_pairs(hulls).T
    shared = intersection(hulls[first], hulls[second])
    extents = bounds(shared[area(shared) > 0])
    if not len(extents):
        raise GeometryError(
            f"No two images see the same ground at heights of {z_range[0]:.0f} to {z_range[1]:.0f} m. Check the RPCs, "
            "or give other heights with --heights."
        )
    low, high = extents[:, :2].min(axis=0), extents[:, 2:].max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def shared_area(scene: Scene, z: float) -> Any:
    """The ground that two views or more see at height z (m), as a shapely geometry, which may be empty.

    Footprints are taken as convex.
    """
    from shapely import MultiPoint, intersection, union_all

    hulls = np.array([MultiPoint(footprint(view, z)).convex_hull for view in scene.views])
    first, second = overlapping_pairs(hulls).T
    return union_all(intersection(hulls[first], hulls[second]))


def area_to_match(scene: Scene, z_range: tuple[float, float], ties: FloatArray) -> Bounds:
    """Bounds (xmin, ymin, xmax, ymax), m, of the area to match.

    The area that the scene file gives, or else the ground that two views see between two heights (m). In a local frame
    that ground is cut to the surroundings of the tie points, because cameras there may look at a wall from the side:
    what two footprints share far behind the wall is many times the area of the wall.

    ties : (n, 3) m, tie points that their neighbours support.
    """
    if scene.bounds is not None:
        return scene.bounds
    shared = shared_ground(scene, z_range)
    if not is_local(scene.crs) or len(ties) < MIN_TIES_FOR_AREA:
        return shared
    low, high = np.percentile(ties[:, :2], AREA_PERCENT, axis=0)
    margin = AREA_MARGIN * (high - low)
    low, high = np.maximum(low - margin, shared[:2]), np.minimum(high + margin, shared[2:])
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1])) if (low < high).all() else shared


def matched_area(grid: Grid, overlap_window: CellWindow) -> Bounds:
    """Bounds (xmin, ymin, xmax, ymax), m, of the part of the requested area that two images see.

    overlap_window : cells of the grid's lattice that two views may see.

    Raises
    ------
    GeometryError
        Two images see none of it.
    """
    shared = grid.window.within(overlap_window)
    if shared.rows and shared.cols:
        return grid.bounds(shared)
    raise area_not_seen(grid.geobox.extent.boundingbox.bbox, grid.bounds(overlap_window), "--bounds, --like")


def check_bounds_seen(bounds: Bounds, seen: Bounds) -> None:
    """Refuse bounds of an area that share nothing with the ground that two images see. Both : m, of the scene's frame.

    Raises
    ------
    GeometryError
        They share nothing.
    """
    if bounds[0] >= seen[2] or bounds[2] <= seen[0] or bounds[1] >= seen[3] or bounds[3] <= seen[1]:
        raise area_not_seen(bounds, seen, "--bounds")


def overlap_of(one: Bounds, other: Bounds) -> Bounds:
    """Bounds of what two areas share; its sides are of no or negative length where they share nothing."""
    return max(one[0], other[0]), max(one[1], other[1]), min(one[2], other[2]), min(one[3], other[3])


def area_not_seen(bounds: Bounds, seen: Bounds, options: str) -> GeometryError:
    """The error of an area that two images see nothing of. seen : bounds of what they see; options : that gave it."""
    looks_like_degrees = max(map(abs, bounds)) <= LARGEST_DEGREES < max(map(abs, seen))
    hint = " Bounds are in metres of the result's CRS, and these look like degrees." if looks_like_degrees else ""
    return GeometryError(
        f"The area asked for ({_extent(bounds)}) lies outside the ground that two images see ({_extent(seen)}).{hint} "
        f"Check {options} and the CRS."
    )


@dataclass(frozen=True)
class ViewGeometry:
    """How one image lies on the ground.

    outline : polygon of the footprint in the scene's frame, empty where the rays meet no ground; ground_px_m : ground
    pixel at its middle, m; closing_px : largest distance by which a pixel that is projected to the ground and back
    misses itself, NaN where the camera maps none; lost : share of pixels that the camera cannot map.
    """

    outline: Any
    ground_px_m: float
    closing_px: float
    lost: float


@dataclass(frozen=True)
class PairGeometry:
    """How two images overlap.

    views : their numbers; overlap : area of the shared ground over that of the smaller footprint; base_to_height : by
    how much their rays diverge for each metre of height, at the middle of the shared ground; shared : polygon of that
    ground.
    """

    views: tuple[int, int]
    overlap: float
    base_to_height: float
    shared: Any


def view_geometry(view: View, z: float) -> ViewGeometry:
    """How an image lies on the ground at height z (m)."""
    from shapely import MultiPoint  # a tenth of a second

    top, left, rows, cols = held_window(view.image)
    n = CAMERA_TEST_POINTS
    column, row = np.meshgrid(left + np.linspace(0, cols - 1, n), top + np.linspace(0, rows - 1, n))
    xy = np.column_stack([column.ravel(), row.ravel()])
    back = view.sensor.image_from_ground(view.sensor.ground_from_image(xy, np.full(len(xy), z)))
    error_px = np.hypot(*(back - xy).T)
    known = np.isfinite(error_px)
    return ViewGeometry(
        outline=MultiPoint(footprint(view, z)).convex_hull,
        ground_px_m=ground_sample_distance(view, z),
        closing_px=float(error_px[known].max()) if known.any() else math.nan,
        lost=float(1.0 - known.mean()),
    )


def pair_geometries(views: Sequence[View], outlines: Sequence[Any], z: float) -> list[PairGeometry]:
    """All pairs of views that share ground at height z (m). outlines : polygon of each view's footprint."""
    pairs = []
    for i, j in overlapping_pairs(outlines).tolist():
        shared = outlines[i].intersection(outlines[j])
        if not shared.area > 0:
            continue
        middle = np.array([shared.centroid.x, shared.centroid.y, z])
        ratio = float(np.hypot(*(parallax_rate_at(views[i], middle) - parallax_rate_at(views[j], middle))))
        pairs.append(PairGeometry((i, j), shared.area / min(outlines[i].area, outlines[j].area), ratio, shared))
    return pairs


def parallax_rate_at(view: View, xyz: FloatArray) -> FloatArray:
    """Parallax rate (dE, dN): metres that the ray through a ground point (3,) m moves for each metre of height."""
    xy = view.sensor.image_from_ground(np.array([xyz, xyz]))
    low, high = view.sensor.ground_from_image(xy, xyz[2] + np.array([-RAY_HALF_HEIGHT_M, RAY_HALF_HEIGHT_M]))
    return np.asarray((high - low)[:2] / (2 * RAY_HALF_HEIGHT_M))
