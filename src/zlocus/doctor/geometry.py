"""Footprints, overlaps and base-to-height, and whether a camera agrees with itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from shapely import MultiPoint, STRtree

from zlocus.doctor.findings import POOR, Finding, poor
from zlocus.scene import View, footprint, ground_sample_distance
from zlocus.sensors.model import FloatArray

LEAN_M = 0.5
PER_SIDE = 5
# Limits of what is told.
CLOSING_PX = 0.05
NARROW, WIDE = 0.1, 1.2
PIXEL_SHARE = 0.2  # by which an ordinary match is off
FINER = 3.0


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
    rows, cols = view.image.shape
    column, row = np.meshgrid(np.linspace(0, cols - 1, PER_SIDE), np.linspace(0, rows - 1, PER_SIDE))
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


def geometry_findings(
    names: Sequence[str], views: Sequence[ViewGeometry], pairs: Sequence[PairGeometry]
) -> list[Finding]:
    """What cameras and bases let expect, in sentences."""
    told = []
    for name, view in zip(names, views, strict=True):
        if view.lost > 0:
            lost = f"its camera cannot map {100 * view.lost:.0f} % of its pixels to the ground."
            told.append(poor(name, f"{lost} Check the camera and the heights."))
        if view.closing_px > CLOSING_PX:
            off = f"pixels sent to the ground and back miss themselves by up to {view.closing_px:.2f} px"
            told.append(poor(name, f"{off}, so its camera does not agree with itself. Check its file."))
    pixels = np.array([view.ground_px_m for view in views])
    if np.nanmax(pixels) > FINER * np.nanmin(pixels):
        coarse, fine = names[int(np.nanargmax(pixels))], names[int(np.nanargmin(pixels))]
        told.append(
            Finding(
                POOR,
                f"{coarse} has pixels of {np.nanmax(pixels):.2g} m on the ground and {fine} of {np.nanmin(pixels):.2g} "
                "m: images so different are hard to match. Leave the coarser ones out, or resample the finer ones.",
                (coarse, fine),
            )
        )
    return told + base_findings(names, views, pairs)


def base_findings(names: Sequence[str], views: Sequence[ViewGeometry], pairs: Sequence[PairGeometry]) -> list[Finding]:
    """What the directions of view let expect of the heights."""
    known = [pair for pair in pairs if math.isfinite(pair.base_to_height)]
    if not known:
        return []
    widest, narrowest = (f(known, key=lambda pair: pair.base_to_height) for f in (max, min))
    if widest.base_to_height < NARROW:
        a, b = (names[i] for i in widest.views)
        pixel = max(views[i].ground_px_m for i in widest.views)
        height = PIXEL_SHARE * pixel / max(widest.base_to_height, 1e-9)
        return [
            Finding(
                POOR,
                f"All images look along nearly the same line: the widest pair, {a} and {b}, has a base-to-height of "
                f"{widest.base_to_height:.2g}. A match off by {PIXEL_SHARE:g} px makes a height off by {height:.2g} m. "
                "Add an image from another direction.",
                (a, b),
            )
        ]
    if narrowest.base_to_height > WIDE:
        a, b = (names[i] for i in narrowest.views)
        return [
            Finding(
                POOR,
                f"Even the narrowest pair, {a} and {b}, has a base-to-height of {narrowest.base_to_height:.2g}: seen "
                "from so far apart, things look too different to match well. Add images from between.",
                (a, b),
            )
        ]
    return []
