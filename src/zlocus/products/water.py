"""Water surfaces of a surface that is being written: levels from its heights, and water.tif.

All levels are found before the first of them is written, each from its whole surface, whatever the tiles are. Memory
holds some rows of a water surface at a time, and the heights at its shore.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.options import WaterOptions
from zlocus.io.grid_inputs import cells_of_each, outline_of
from zlocus.io.water_polygons import WaterPolygons
from zlocus.matching.possible_water import WaterBlocks, possible_water
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.water_level import WaterHeights, WaterLevel, is_confident, shore_cells, water_level
from zlocus.products.rasters import SurfaceRasters, Water

# Rows that are worked on at a time.
STRIP_ROWS = 128
# Possible water is looked for on at most this many blocks, of about this side.
MAX_BLOCKS, BLOCK_M = 20_000_000, 1.0
# The outline of possible water is this far from its shore at most, in cells: about half of a correlation window.
OUTLINE_CELLS = 8.0
NOT_LEVELLED = np.uint16(Quality.OUTSIDE | Quality.FAILED)


@dataclass(frozen=True)
class LevelledWater:
    """A water surface that was levelled. name : as messages call it; kind : of its cells; n_cells : their number."""

    name: str
    kind: Water
    level: WaterLevel
    n_cells: int

    def as_dict(self) -> dict[str, Any]:
        """The surface as run.json holds it."""
        return {
            "name": self.name, "kind": self.kind.name.lower(), "level_m": self.level.height_m,
            "sigma_m": self.level.sigma_m, "source": self.level.source, "n_cells": self.n_cells,
            "n_used": self.level.n_used,
        }  # fmt: skip


@dataclass
class WaterFound:
    """Water surfaces of a surface.

    levelled : those that have a level now; left : names of those that keep their heights, because too few tell a level;
    n_possible : number of areas of possible water. n_seen, n_matched : number of levelled cells that two images see,
    and of those whose height was matched.
    """

    levelled: list[LevelledWater] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    n_possible: int = 0
    n_seen: int = 0
    n_matched: int = 0

    def as_dict(self) -> dict[str, Any]:
        """The surfaces as run.json holds them."""
        return {
            "levelled": [each.as_dict() for each in self.levelled], "left": self.left, "possible": self.n_possible,
        }  # fmt: skip


@dataclass(frozen=True)
class _Part:
    """Some rows of a water surface on the grid.

    row, col : the first cell; is_surface, is_any : (r, c) bool, cells of the surface and of all surfaces; own : the
    rows that are not read along.
    """

    row: int
    col: int
    is_surface: NDArray[np.bool_]
    is_any: NDArray[np.bool_]
    own: slice


class WaterCells:
    """The cells of water surfaces on a grid, found row by row. A cell belongs to a surface whose outline holds its
    centre; of several, to the last."""

    def __init__(self, polygons: NDArray[Any], geobox: GeoBox) -> None:
        self._polygons, self._geobox, self._tree = polygons, geobox, shapely.STRtree(polygons)

    def numbers(self, row: int, col: int, shape: tuple[int, int]) -> NDArray[np.int32]:
        """Number of the surface of each cell, from 1, 0 for none, (r, c) int32. row, col : the first cell."""
        box = self._geobox[row : row + shape[0], col : col + shape[1]]
        near = np.sort(self._tree.query(shapely.box(*box.boundingbox.bbox)))
        return cells_of_each(self._polygons[near], near + 1, box)

    def parts(self, number: int, margin: int = 0) -> Iterator[_Part]:
        """The cells of a surface, strip after strip. number : of the surface, from 0; margin : cells read along."""
        rows, cols = self._geobox.shape
        west, south, east, north = shapely.bounds(self._polygons[number])
        (first_col, first_row), (last_col, last_row) = (
            ~self._geobox.transform * (west, north),
            (~self._geobox.transform * (east, south)),
        )
        col, after_col = (int(np.clip(n, 0, cols)) for n in (math.floor(first_col) - margin, last_col + margin + 1))
        row, after_row = (int(np.clip(n, 0, rows)) for n in (math.floor(first_row) - margin, last_row + margin + 1))
        for first in range(row, after_row, STRIP_ROWS) if after_col > col else ():
            last = min(first + STRIP_ROWS, after_row)
            above, below = max(first - margin, 0), min(last + margin, rows)
            numbers = self.numbers(above, col, (below - above, after_col - col))
            yield _Part(above, col, numbers == number + 1, numbers > 0, slice(first - above, last - above))

    def has_any(self, number: int) -> bool:
        """Whether a surface has a cell on the grid."""
        return any(part.is_surface.any() for part in self.parts(number))


def level_water(
    rasters: SurfaceRasters, geobox: GeoBox, water: WaterPolygons | None, level_possible: bool, options: WaterOptions
) -> WaterFound:
    """Level the water surfaces of rasters to which all tiles are written, and mark water in water.tif.

    geobox : of the rasters; water : polygons on the grid, None for none; level_possible : whether possible water is
    levelled too.
    """
    found = WaterFound()
    known = np.zeros(0, object) if water is None else water.polygons
    possible = _possible_polygons(rasters, geobox, WaterCells(known, geobox), options)
    found.n_possible = len(possible)
    cells = WaterCells(np.concatenate([known, possible]), geobox)
    levels: list[WaterLevel | None] = []
    for k in range(len(known) + len(possible)):
        is_known = k < len(known)
        if not (is_known or level_possible):
            levels.append(None)
        elif water is not None and is_known and math.isfinite(water.levels_m[k]):
            levels.append(WaterLevel(float(water.levels_m[k]), math.nan, "attribute", 0))
        else:
            width = options.shore_cells if is_known else OUTLINE_CELLS
            levels.append(water_level(_heights_of(rasters, cells, k, width), options))
    names = [*(water.names if water is not None else ()), *(f"possible water {k + 1}" for k in range(len(possible)))]
    for k, (name, level) in enumerate(zip(names, levels, strict=True)):
        is_known = k < len(known)
        if level is None:
            if is_known or level_possible:
                found.left.append(name)
            if not is_known:
                _mark(rasters, cells, k)
        else:
            _write_level(
                rasters,
                cells,
                k,
                LevelledWater(name, Water.LEVELLED if is_known else Water.POSSIBLE_LEVELLED, level, 0),
                found,
            )
    return found


def _possible_polygons(
    rasters: SurfaceRasters, geobox: GeoBox, known: WaterCells, options: WaterOptions
) -> NDArray[Any]:  # fmt: skip
    """Outlines (n,) of areas of possible water, in the CRS of the grid. known : water surfaces of polygons."""
    (rows, cols), cell_m = geobox.shape, float(geobox.transform.a)
    side = max(1, round(BLOCK_M / cell_m), math.ceil(math.sqrt(rows * cols / MAX_BLOCKS)))
    blocks, strip = WaterBlocks.empty((rows, cols), side), max(1, STRIP_ROWS // side) * side
    for row in range(0, rows, strip):
        shape = min(strip, rows - row), cols
        cells = rasters.heights(row, 0, shape)
        blocks.add(row, cells.height, cells.quality, known.numbers(row, 0, shape) > 0)
    outlines = []
    for area in possible_water(blocks, cell_m, options):
        corner = geobox[area.row * side :, area.col * side :]
        step = corner.transform @ type(corner.transform).scale(side)
        outlines.append(outline_of(area.is_water, GeoBox(area.is_water.shape, step, geobox.crs)))
    return np.array(outlines, object)


def _heights_of(rasters: SurfaceRasters, cells: WaterCells, number: int, width_cells: float) -> WaterHeights:
    """Confident heights of a water surface. width_cells : distance from the shore within which cells are beside it."""
    n_cells, n_inside = 0, 0
    held: dict[str, list[NDArray[np.float32]]] = {
        name: [] for name in ("inside", "shore", "shore_sigma", "beyond", "beyond_sigma")
    }
    for part in cells.parts(number, math.ceil(width_cells) + 1):
        written = rasters.heights(part.row, part.col, part.is_surface.shape)
        shore = shore_cells(part.is_surface, part.is_any, width_cells)
        is_sure = is_confident(written.height, written.quality)
        is_own = np.zeros(is_sure.shape, np.bool_)
        is_own[part.own] = True
        is_away = part.is_surface & ~shore.water & is_own
        n_cells, n_inside = n_cells + int((part.is_surface & is_own).sum()), n_inside + int(is_away.sum())
        held["inside"].append(written.height[is_away & is_sure])
        for name, where in (("shore", shore.water), ("beyond", shore.land)):
            counted = where & is_sure & is_own
            held[name].append(written.height[counted])
            held[f"{name}_sigma"].append(written.sigma[counted])
    joined = {name: np.concatenate(values) if values else np.zeros(0, np.float32) for name, values in held.items()}
    return WaterHeights(n_cells, n_inside, **joined)


def _write_level(
    rasters: SurfaceRasters, cells: WaterCells, number: int, levelled: LevelledWater, found: WaterFound
) -> None:
    """Level the cells of a water surface, and add it to what was found."""
    n_cells = 0
    for part in cells.parts(number):
        quality = rasters.heights(part.row, part.col, part.is_surface.shape).quality
        is_levelled = part.is_surface & ((quality & NOT_LEVELLED) == 0)
        is_seen = is_levelled & ((quality & np.uint16(Quality.UNSEEN)) == 0)
        found.n_seen += int(is_seen.sum())
        is_matched = ~is_empty(quality) & ((quality & np.uint16(Quality.FILLED)) == 0)
        found.n_matched += int((is_levelled & is_matched).sum())
        n_cells += int(is_levelled.sum())
        rasters.level(part.row, part.col, is_levelled, levelled.level.height_m, levelled.level.sigma_m)
        rasters.mark_water(part.row, part.col, is_levelled, levelled.kind)
    found.levelled.append(LevelledWater(levelled.name, levelled.kind, levelled.level, n_cells))


def _mark(rasters: SurfaceRasters, cells: WaterCells, number: int) -> None:
    """Mark the cells of an area as possible water."""
    for part in cells.parts(number):
        rasters.mark_water(part.row, part.col, part.is_surface, Water.POSSIBLE)


def without_cells(water: WaterPolygons, geobox: GeoBox) -> Sequence[str]:
    """Names of the polygons that hold the centre of no cell of a grid."""
    cells = WaterCells(water.polygons, geobox)
    return [name for k, name in enumerate(water.names) if not cells.has_any(k)]
