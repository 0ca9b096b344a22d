"""Profile: heights along a line."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import DatasetReader
from rasterio.windows import Window

from zlocus.core.sensor_model import FloatArray
from zlocus.inspector.folder import SurfaceFolder, on_grid
from zlocus.inspector.reference import Reference
from zlocus.io.open_raster import cached_raster

MAX_PLACES = 2000
# Rasters are read in pieces of this many cells a side.
PIECE_CELLS = 512


def profile(
    folder: SurfaceFolder, reference: Reference | None, start: tuple[float, float], end: tuple[float, float]
) -> dict[str, Any]:
    """Heights of the cells along a line, at least a cell apart and at `MAX_PLACES` places at most.

    start, end : m. Keys of the record: distance_m (n,), height_m, sigma_m, reference_m (None without a reference), each
    None where unknown; terrain_m, the DTM, None where the surface has none; spacing_m; length_m.
    """
    length = math.dist(start, end)
    n = int(np.clip(math.ceil(length / folder.cell_m) + 1, 2, MAX_PLACES))
    share = np.linspace(0.0, 1.0, n)[:, None]
    xy = (1 - share) * start + share * end
    cells = cells_of(folder, xy)
    height, sigma = (values_at(folder, name, cells) for name in ("dsm", "sigma"))
    true = None if reference is None else reference_at(folder, reference, cells)
    terrain = values_at(folder, "dtm", cells) if folder.has("dtm") else None
    return {
        "distance_m": (share[:, 0] * length).round(3).tolist(), "height_m": listed(height), "sigma_m": listed(sigma),
        "reference_m": None if true is None else listed(true),
        "terrain_m": None if terrain is None else listed(terrain), "spacing_m": length / (n - 1),
        "length_m": length,
    }  # fmt: skip


def cells_of(folder: SurfaceFolder, xy: FloatArray) -> NDArray[np.int64]:
    """Row and column (n, 2) of the cells that contain ground points (n, 2) m; they may lie outside the grid."""
    a, b, c, d, e, f = (~folder.transform)[:6]
    col, row = a * xy[:, 0] + b * xy[:, 1] + c, d * xy[:, 0] + e * xy[:, 1] + f
    cells: NDArray[np.int64] = np.floor(np.column_stack([row, col])).astype(np.int64)
    return cells


def values_at(folder: SurfaceFolder, name: str, cells: NDArray[np.int64]) -> FloatArray:
    """Values of a raster at cells (n, 2), NaN outside the grid."""
    with cached_raster(folder.path(name)) as file:
        return picked(file, cells)


def reference_at(folder: SurfaceFolder, reference: Reference, cells: NDArray[np.int64]) -> FloatArray:
    """Heights of the reference at cells (n, 2), NaN where it has none."""
    with cached_raster(reference.path) as file, on_grid(file, folder) as view:
        return picked(view, cells)


def picked(file: DatasetReader, cells: NDArray[np.int64]) -> FloatArray:
    """Values of an open raster at cells (n, 2), read piece by piece; NaN outside the grid."""
    result = np.full(len(cells), np.nan)
    inside = ((cells >= 0) & (cells < (file.height, file.width))).all(axis=1)
    pieces, which = np.unique(cells[inside] // PIECE_CELLS, axis=0, return_inverse=True)
    members = np.flatnonzero(inside)
    for k in range(len(pieces)):
        chosen = members[which.ravel() == k]
        (row, col), (last_row, last_col) = cells[chosen].min(axis=0), cells[chosen].max(axis=0)
        values = file.read(1, window=Window(col, row, last_col - col + 1, last_row - row + 1))
        result[chosen] = values[cells[chosen, 0] - row, cells[chosen, 1] - col]
    return result


def listed(values: FloatArray) -> list[float | None]:
    """Rounded numbers for JSON, None in place of NaN."""
    return [round(float(value), 4) if math.isfinite(value) else None for value in values]
