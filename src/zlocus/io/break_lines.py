"""Read break lines from vector files: lines with heights hold a surface, lines without heights let it jump."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from zlocus.core.errors import InputError
from zlocus.io.crs import file_crs
from zlocus.io.vector_files import check_degrees, read_lines

# Points along a line with heights are this far apart at most, cells: two in every cell that it crosses by more than a
# corner.
POINT_CELLS = 0.25


@dataclass(frozen=True, eq=False)
class GivenLines:
    """Break lines of a file in the CRS of a grid.

    path : of the file; jumps : (n, 2, 2) m, ends (x, y) of the segments of lines without heights; held : (k, 3) m,
    points close together along the lines with heights, in the vertical datum of the file.
    """

    path: Path
    jumps: NDArray[np.float64]
    held: NDArray[np.float64]


def read_break_lines(path: Path, crs: CRS, cell_m: float) -> GivenLines:
    """Read break lines. crs, cell_m : of the grid; heights are taken as they are.

    Raises
    ------
    InputError
        See `read_lines`; the file has no CRS, or a coordinate is not finite or cannot be converted.
    """
    found = read_lines(path)
    if found.crs is None:
        raise InputError(f"{path} has no CRS. Add it (a .prj file for a Shapefile).")
    own_crs = file_crs(found.crs, path)
    check_degrees(found.lines, own_crs, path)
    to_grid = Transformer.from_crs(own_crs.to_2d(), crs.to_2d(), always_xy=True)
    jumps, held = [np.empty((0, 2, 2))], [np.empty((0, 3))]
    parts, of_feature = shapely.get_parts(found.lines, return_index=True)
    for line, number in zip(parts, found.numbers[of_feature], strict=True):
        nodes = _nodes(line, to_grid, path, int(number))
        if np.isnan(nodes[:, 2]).all():
            jumps.append(np.stack([nodes[:-1, :2], nodes[1:, :2]], axis=1))
        else:
            held.append(points_along(nodes, POINT_CELLS * cell_m))
    return GivenLines(path, np.concatenate(jumps), np.concatenate(held))


def points_along(nodes: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Points (k, 3) along a line, its nodes (n, 3) among them, that are `distance` apart at most."""
    points = [nodes[:1]]
    for start, end in pairwise(nodes):
        n = max(int(np.ceil(np.hypot(*(end - start)[:2]) / distance)), 1)
        points.append(start + np.linspace(0.0, 1.0, n + 1)[1:, None] * (end - start))
    return np.concatenate(points)


def _nodes(line: Any, to_grid: Transformer, path: Path, number: int) -> NDArray[np.float64]:
    """Nodes (n, 3) of a line in the CRS of the grid, with its heights as they are; NaN without heights."""
    xyz = shapely.get_coordinates(line, include_z=True)
    if not np.isfinite(xyz[:, :2]).all() or np.isnan(xyz[:, 2]).any() != np.isnan(xyz[:, 2]).all():
        raise InputError(f"Line {number} of {path} has coordinates or heights that are missing. Correct the line.")
    x, y = to_grid.transform(xyz[:, 0], xyz[:, 1])
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"Line {number} of {path} cannot be converted to the CRS of the grid. Check its CRS.")
    return np.column_stack([x, y, xyz[:, 2]])
