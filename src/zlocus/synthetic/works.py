"""Works on the ground of a scene: from a day on, a pit is dug in the middle of the area, and a heap lies beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from zlocus.synthetic.objects import Footprint
from zlocus.synthetic.painting import Painter
from zlocus.synthetic.scenes import SceneSpec
from zlocus.synthetic.terrain import GROUND, PATTERN_NATURAL, SyntheticGround, plain_material

# Of the pit: direction of its length, length, width and depth below the lower of the ground there.
ANGLE, PIT_M, DEPTH_M, LOW_PERCENTILE = 0.35, (34.0, 22.0), 6.0, 20.0
# Of the heap: distance of its middle from that of the pit, m east and north, radius and height.
HEAP_AWAY_M, HEAP_RADIUS_M, HEAP_M = (30.0, 18.0), 10.0, 7.0
SOIL_ALBEDO, SOIL_CONTRAST = 0.33, 0.17
# Of the polygons, which lie around both with a margin; sides of that of the heap.
MARGIN_M, CORNERS = 3.0, ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))


def with_works(ground: SyntheticGround, spec: SceneSpec) -> SyntheticGround:
    """The ground of a scene with the pit and the heap, from which all objects were taken."""
    painter = Painter.on(ground)
    pit, heap = _places(ground, spec)
    dug = painter.rectangle(pit)
    raised = painter.disc(heap.x, heap.y, HEAP_RADIUS_M)
    painter.clear(dug | raised)
    painter.level(dug, float(np.percentile(painter.ground.heights[dug], LOW_PERCENTILE)) - DEPTH_M)
    dx, dy = painter.x() - heap.x, painter.y() - heap.y
    distance = np.hypot(dx, dy)
    painter.ground.heights[raised] += (HEAP_M * (1.0 - distance / HEAP_RADIUS_M))[raised].astype(np.float32)
    away = np.stack(np.broadcast_arrays(dx, dy), axis=-1) / np.maximum(distance, ground.step)[..., None]
    painter.ground.slopes[raised] -= (HEAP_M / HEAP_RADIUS_M * ground.step * away)[raised]
    painter.cover(dug | raised, plain_material(GROUND, PATTERN_NATURAL, SOIL_ALBEDO, SOIL_CONTRAST))
    return painter.painted()


def write_works(ground: SyntheticGround, spec: SceneSpec, path: Path) -> None:
    """Write a polygon around the pit and one around the heap as GeoJSON, with their names."""
    features = []
    for name, place in zip(("pit", "heap"), _places(ground, spec), strict=True):
        half = np.array([place.length, place.width]) / 2 + MARGIN_M
        along = np.array([[np.cos(place.angle), np.sin(place.angle)], [-np.sin(place.angle), np.cos(place.angle)]])
        xy = (np.array(CORNERS) * half) @ along + (place.x, place.y)
        ring = [[ground.x0 + float(x), ground.y0 - float(y)] for x, y in xy]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {"name": name}, "geometry": geometry})
    crs = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{spec.epsg}"}}
    document = {"type": "FeatureCollection", "crs": crs, "features": features}
    path.write_text(json.dumps(document) + "\n", encoding="utf-8")


def _places(ground: SyntheticGround, spec: SceneSpec) -> tuple[Footprint, Footprint]:
    """The footprints of the pit, and around the heap."""
    half = spec.size * spec.gsd_m / 2
    x, y = spec.west_m - ground.x0 + half, ground.y0 - spec.north_m + half
    heap = (x + HEAP_AWAY_M[0], y - HEAP_AWAY_M[1])
    return Footprint(x, y, ANGLE, *PIT_M), Footprint(*heap, 0.0, 2 * HEAP_RADIUS_M, 2 * HEAP_RADIUS_M)
