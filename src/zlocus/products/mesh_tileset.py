"""The index of a mesh in tiles: `tileset.json` of 3D Tiles 1.1, whose content are the .glb files.

Source: Open Geospatial Consortium, 3D Tiles 1.1 (22-025r4), chapters 6 and 7.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from zlocus import __version__
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.earth_frame import EarthSpace

TILESET = "tileset.json"
# Distance over which the scale of a map is measured, m.
STEP_M = 10.0
# Sides of boxes are at least so long, also of a level tile, m.
MIN_SIDE_M = 0.01


@dataclass(frozen=True)
class MeshTile:
    """A tile that was written. file : its name; low, high : (3,) m, corners of its box in the frame of all tiles (east,
    north, up from the origin of the mesh); n_triangles : of the tile; n_walls : walls of a surface's
    mesh, or faces of a cloud's mesh that are as steep as walls; n_unseen : faces that no image shows."""

    file: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    n_triangles: int
    n_walls: int
    n_unseen: int

    @property
    def middle(self) -> FloatArray:
        """Middle (3,) m of its box."""
        return np.asarray((np.array(self.low) + np.array(self.high)) / 2)

    def as_dict(self) -> dict[str, Any]:
        """The tile for a record."""
        counts = {"triangles": self.n_triangles, "walls": self.n_walls, "faces_not_seen": self.n_unseen}
        return {"file": self.file, "low": list(self.low), "high": list(self.high), **counts}


def write_tileset(path: Path, tiles: Sequence[MeshTile], origin: FloatArray, crs: CRS, error_m: float) -> None:
    """Write the index. origin : (3,) of the mesh in the map `crs`; error_m : what a viewer loses without the mesh.

    Coordinates of the tiles are those of the map, so each tile has a transform of its own to geocentric axes, which is
    exact at its middle. In a local frame there is none.
    """
    children = []
    for tile in tiles:
        child: dict[str, Any] = {
            "boundingVolume": {"box": _box(np.array(tile.low), np.array(tile.high))}, "geometricError": 0.0,
            "content": {"uri": tile.file},
        }  # fmt: skip
        if not is_local(crs):
            child["transform"] = geocentric_from_local(crs, origin, tile.middle).T.ravel().tolist()
        children.append(child)
    low = np.min([tile.low for tile in tiles], axis=0)
    high = np.max([tile.high for tile in tiles], axis=0)
    box = _box(low, high) if is_local(crs) else _geocentric_box(crs, origin, low, high)
    root = {"boundingVolume": {"box": box}, "geometricError": error_m, "refine": "ADD", "children": children}
    document = {
        "asset": {"version": "1.1", "generator": f"zlocus {__version__}"}, "geometricError": 2 * error_m, "root": root,
    }  # fmt: skip
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def geocentric_from_local(crs: CRS, origin: FloatArray, at: FloatArray) -> FloatArray:
    """The affine map (4, 4) from local coordinates, m from `origin` (3,) along the axes of a map, to geocentric ones.

    It is exact at the local point `at` (3,).
    """
    earth = EarthSpace(crs)
    ends = origin + at + STEP_M * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    points = earth.cartesian_from_ground(ends)
    matrix = np.eye(4)
    matrix[:3, :3] = ((points[1:4] - points[4:]) / (2 * STEP_M)).T
    matrix[:3, 3] = points[0] - matrix[:3, :3] @ at
    return matrix


def _box(low: FloatArray, high: FloatArray) -> list[float]:
    """A box as its middle and half of its axes, none of which is 0."""
    return [*((low + high) / 2).tolist(), *np.diag(np.maximum(high - low, MIN_SIDE_M) / 2).ravel().tolist()]


def _geocentric_box(crs: CRS, origin: FloatArray, low: FloatArray, high: FloatArray) -> list[float]:
    """A box along geocentric axes around a box of local coordinates."""
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 3).T, indexing="ij"), axis=-1).reshape(-1, 3)
    points = EarthSpace(crs).cartesian_from_ground(origin + grid)
    return _box(points.min(axis=0), points.max(axis=0))
