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
from zlocus.matching.quality import Quality
from zlocus.matching.water_level import (
    POSSIBLE_QUANTILE,
    WaterHeights,
    WaterLevel,
    is_confident,
    shore_cells,
    tells_level,
    water_level,
)
from zlocus.products.rasters import SurfaceRasters, WaterKind

# Rows that are worked on at a time.
STRIP_ROWS = 128
# Possible water is looked for on at most this many blocks, of about this side; each takes some 40 bytes of memory.
MAX_BLOCKS, BLOCK_M = 5_000_000, 1.0
# The outline of possible water is this far from its shore at most, in cells: about half of a correlation window.
OUTLINE_CELLS = 8.0
NOT_LEVELLED = np.uint16(Quality.OUTSIDE | Quality.FAILED)


@dataclass(frozen=True)
class LevelledSurface:
    """A water surface that was levelled. name : as messages call it; water_kind : of its cells; n_cells : of them."""

    name: str
    water_kind: WaterKind
    level: WaterLevel
    n_cells: int

    def as_dict(self) -> dict[str, Any]:
        """The surface as run.json holds it."""
        return {
            "name": self.name, "kind": self.water_kind.name.lower(), "level_m": self.level.height_m,
            "sigma_m": self.level.sigma_m, "source": self.level.source, "n_cells": self.n_cells,
            "n_used": self.level.n_used,
        }  # fmt: skip


@dataclass
class WaterFound:
    """Water surfaces of a surface.

    levelled_surfaces : those that have a level now; left : names of those that keep their heights, because too few tell
    a level; n_possible : number of areas of possible water; doubts : sentences about levels that may be wrong. n_seen,
    n_matched : number of levelled cells that two images see, and of those whose height was matched.
    """

    levelled_surfaces: list[LevelledSurface] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    n_possible: int = 0
    doubts: list[str] = field(default_factory=list)
    n_seen: int = 0
    n_matched: int = 0

    def as_dict(self) -> dict[str, Any]:
        """The surfaces as run.json holds them."""
        return {
            "levelled": [each.as_dict() for each in self.levelled_surfaces], "left": self.left,
            "possible": self.n_possible, "doubts": self.doubts,
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
        self.cell_m = float(geobox.transform.a)

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


@dataclass(frozen=True)
class _Surface:
    """A water surface that may be levelled. water_kind : LEVELLED or POSSIBLE; level_m : NaN where it is not given."""

    name: str
    polygon: Any
    water_kind: WaterKind
    level_m: float = math.nan


def level_water(
    rasters: SurfaceRasters,
    geobox: GeoBox,
    water_polygons: WaterPolygons | None,
    level_possible: bool,
    options: WaterOptions,
) -> WaterFound:
    """Level the water surfaces of rasters to which all tiles are written, and mark water in water.tif.

    geobox : of the rasters; water_polygons : those on the grid, None for none; level_possible : whether possible water
    is levelled too.
    """
    surfaces = _known_surfaces(water_polygons)
    known_cells = WaterCells(_polygons_of(surfaces), geobox)
    possible = [
        _Surface(f"possible water {k}", polygon, WaterKind.POSSIBLE)
        for k, polygon in enumerate(_possible_polygons(rasters, geobox, known_cells, options), 1)
    ]
    surfaces += possible
    cells, water_found = WaterCells(_polygons_of(surfaces), geobox), WaterFound(n_possible=len(possible))
    wanted = [level_possible or surface.water_kind is not WaterKind.POSSIBLE for surface in surfaces]
    levels = [
        _level_of(rasters, cells, k, surface, options) if wanted[k] else None for k, surface in enumerate(surfaces)
    ]
    for k, (surface, level) in enumerate(zip(surfaces, levels, strict=True)):
        if level is not None:
            _write_level(rasters, cells, k, surface, level, water_found)
            continue
        if wanted[k]:
            water_found.left.append(surface.name)
        for part in cells.parts(k):
            rasters.mark_water(part.row, part.col, part.is_surface, WaterKind.POSSIBLE)
    return water_found


def _known_surfaces(water_polygons: WaterPolygons | None) -> list[_Surface]:
    """The water surfaces of polygons."""
    if water_polygons is None:
        return []
    return [
        _Surface(name, polygon, WaterKind.LEVELLED, float(level_m))
        for name, polygon, level_m in zip(
            water_polygons.names, water_polygons.polygons, water_polygons.levels_m, strict=True
        )
    ]


def _polygons_of(surfaces: Sequence[_Surface]) -> NDArray[Any]:
    """Polygons (n,) of water surfaces."""
    return np.array([surface.polygon for surface in surfaces], object)


def _level_of(
    rasters: SurfaceRasters, cells: WaterCells, number: int, surface: _Surface, options: WaterOptions
) -> WaterLevel | None:
    """The level of a water surface; None where too few heights tell it. number : of the surface, from 0."""
    if math.isfinite(surface.level_m):
        return WaterLevel(surface.level_m, math.nan, "attribute", 0)
    if surface.water_kind is WaterKind.POSSIBLE:
        return water_level(_heights_of(rasters, cells, number, OUTLINE_CELLS), options, POSSIBLE_QUANTILE)
    return water_level(_heights_of(rasters, cells, number, options.shore_cells), options)


def _possible_polygons(
    rasters: SurfaceRasters, geobox: GeoBox, known_cells: WaterCells, options: WaterOptions
) -> NDArray[Any]:  # fmt: skip
    """Outlines (n,) of areas of possible water, in the CRS of the grid. known_cells : water surfaces of polygons."""
    (rows, cols), cell_m = geobox.shape, float(geobox.transform.a)
    side = max(1, round(BLOCK_M / cell_m), math.ceil(math.sqrt(rows * cols / MAX_BLOCKS)))
    blocks, strip = WaterBlocks.empty((rows, cols), side), max(1, STRIP_ROWS // side) * side
    for row in range(0, rows, strip):
        shape = min(strip, rows - row), cols
        cells = rasters.heights(row, 0, shape)
        is_known = known_cells.numbers(row, 0, shape) > 0
        blocks.add(row, cells.height, cells.quality, rasters.grey(row, 0, shape), is_known)
    outlines = []
    for area in possible_water(blocks, cell_m, options):
        corner = geobox[area.row * side :, area.col * side :]
        step = corner.transform @ type(corner.transform).scale(side)
        outlines.append(outline_of(area.is_water, GeoBox(area.is_water.shape, step, geobox.crs)))
    return np.array(outlines, object)


def _heights_of(rasters: SurfaceRasters, cells: WaterCells, number: int, width_cells: float) -> WaterHeights:
    """Confident heights of a water surface. width_cells : distance from the shore within which cells are beside it."""
    n_inside, none = 0, np.zeros(0, np.float32)
    inside, shore, sigma, beyond = [none], [none], [none], [none]
    for part in cells.parts(number, math.ceil(width_cells) + 1):
        written = rasters.heights(part.row, part.col, part.is_surface.shape)
        at_shore = shore_cells(part.is_surface, part.is_any, width_cells)
        is_own = np.zeros(part.is_surface.shape, np.bool_)
        is_own[part.own] = True
        is_sure = is_confident(written.height, written.quality) & is_own
        is_exact = tells_level(is_sure, written.sigma, written.views, cells.cell_m)
        is_away = part.is_surface & ~at_shore.water & is_own
        n_inside += int(is_away.sum())
        inside.append(written.height[is_away & is_sure])
        is_beside = (at_shore.water | at_shore.land) & is_exact
        shore.append(written.height[is_beside])
        sigma.append(written.sigma[is_beside])
        beyond.append(written.height[at_shore.land & is_exact])
    return WaterHeights(n_inside, *(np.concatenate(each) for each in (inside, shore, sigma, beyond)))


def _write_level(
    rasters: SurfaceRasters,
    cells: WaterCells,
    number: int,
    surface: _Surface,
    level: WaterLevel,
    water_found: WaterFound,
) -> None:
    """Level the cells of a water surface, and add it to what was found. number : of the surface, from 0."""
    kind = WaterKind.POSSIBLE_LEVELLED if surface.water_kind is WaterKind.POSSIBLE else surface.water_kind
    n_cells = 0
    for part in cells.parts(number):
        written = rasters.heights(part.row, part.col, part.is_surface.shape)
        is_levelled = part.is_surface & ((written.quality & NOT_LEVELLED) == 0)
        is_seen = (written.quality & np.uint16(Quality.UNSEEN)) == 0
        is_matched = np.isfinite(written.height) & ((written.quality & np.uint16(Quality.FILLED)) == 0)
        n_cells += int(is_levelled.sum())
        water_found.n_seen += int((is_levelled & is_seen).sum())
        water_found.n_matched += int((is_levelled & is_matched).sum())
        rasters.level(part.row, part.col, is_levelled, level.height_m, level.sigma_m)
        rasters.mark_water(part.row, part.col, is_levelled, kind)
    water_found.levelled_surfaces.append(LevelledSurface(surface.name, kind, level, n_cells))


def without_cells(water_polygons: WaterPolygons, geobox: GeoBox) -> Sequence[str]:
    """Names of the polygons that hold the centre of no cell of a grid."""
    cells = WaterCells(water_polygons.polygons, geobox)
    return [name for k, name in enumerate(water_polygons.names) if not cells.has_any(k)]
