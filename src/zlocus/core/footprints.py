"""How images lie on the ground: footprints, the ground that two of them share, and base-to-height."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from zlocus.core.scene import View, footprint, ground_sample_distance, held_window
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
