"""The end of every export of a mesh: the index of its tiles, its record, and the answer for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from zlocus.core.export_request import EXPORT_RECORD, ExportRequest
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.run_record import request_as_dict, versions_record
from zlocus.io.staged_export import write_export_record
from zlocus.products.glb import TexturedMesh, glb_bytes
from zlocus.products.mesh_tileset import TILESET, MeshTile, write_tileset
from zlocus.sensors.frame import as_row

ORIGIN_STEP_M = 1.0


@dataclass(frozen=True)
class MeshFrame:
    """Where a mesh lies. crs : of its axes; origin : (3,) m, from which its coordinates are counted."""

    crs: CRS
    origin: FloatArray

    @classmethod
    def around(cls, crs: CRS, middle: FloatArray) -> MeshFrame:
        """The frame with its origin at a point (3,) m, in whole metres."""
        return cls(crs, np.rint(middle / ORIGIN_STEP_M) * ORIGIN_STEP_M)

    def as_dict(self) -> dict[str, Any]:
        """CRS, kind of heights, and origin, for files."""
        local = is_local(self.crs)
        return {
            "crs": None if local else self.crs.to_string(),
            "heights": "of the local frame" if local else "ellipsoidal, m",
            "origin": self.origin.tolist(),
            "axes": "x east, y up, z south, m from the origin",
        }


def write_mesh_tile(
    stage: Path, name: str, mesh_frame: MeshFrame, textured_mesh: TexturedMesh, n_walls: int, n_unseen: int
) -> MeshTile:
    """Write a tile as NAME.glb. n_walls, n_unseen : see `MeshTile`."""
    (stage / f"{name}.glb").write_bytes(glb_bytes(name, textured_mesh, mesh_frame.as_dict()))
    placed = textured_mesh.xyz + np.array(textured_mesh.origin)
    low, high = as_row(placed.min(axis=0)), as_row(placed.max(axis=0))
    return MeshTile(f"{name}.glb", low, high, len(textured_mesh.triangles), n_walls, n_unseen)


def write_mesh_record(
    stage: Path, request: ExportRequest, mesh_frame: MeshFrame, tiles: Sequence[MeshTile], of_kind: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Write the index and the record of a mesh, and return what was written, for people and as a record.

    of_kind : what only a mesh of its kind has to say.
    """
    write_tileset(stage / TILESET, tiles, mesh_frame.origin, mesh_frame.crs, _size(tiles))
    record = {
        "format": request.kind, "request": request_as_dict(request), "versions": versions_record(),
        **mesh_frame.as_dict(), **of_kind, "tiles": [tile.as_dict() for tile in tiles],
    }  # fmt: skip
    write_export_record(stage, record)
    n_triangles, n_walls = sum(tile.n_triangles for tile in tiles), sum(tile.n_walls for tile in tiles)
    n_unseen = sum(tile.n_unseen for tile in tiles)
    text = (
        f"{request.out / TILESET}: {len(tiles)} tiles, {n_triangles} triangles, {n_walls} walls; {n_unseen} "
        f"faces that no image shows are grey. Origin: see {request.out / EXPORT_RECORD}."
    )
    return text, record


def _size(tiles: Sequence[MeshTile]) -> float:
    """Size of the whole mesh, m."""
    low = np.min([tile.low for tile in tiles], axis=0)
    return float(np.linalg.norm(np.max([tile.high for tile in tiles], axis=0) - low))
