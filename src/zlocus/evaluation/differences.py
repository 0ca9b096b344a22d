"""Differences of two surfaces, neither of which is taken as true, on the grid of the first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import converted, frame_of, points_on
from zlocus.evaluation.heights import HeightRaster, read_heights
from zlocus.evaluation.statistics import ErrorStatistics, error_statistics
from zlocus.evaluation.truth import places
from zlocus.evaluation.vertical import same_heights

# Shares of differences below these are given, m; the first is the main one.
THRESHOLDS_M = (1.0, 0.1, 0.25, 0.5, 2.0, 5.0)
# Cells whose places are in memory at a time.
CELLS_AT_A_TIME = 1_000_000
# Grids are the same where their cells lie within this share of a cell.
SAME_GRID = 1e-3


@dataclass(frozen=True)
class SurfaceDifferences:
    """Two surfaces on the grid of the first.

    geobox : that grid. first, second : (r, c) float32, heights, m, NaN where there is none. n_elsewhere : number of
    cells of the second surface, on its own grid, that have a height outside of the grid of the first. statistics : of
    the differences, second less first, m, over the cells that have a height in both; `shares` are shares of these.
    lowest_m, highest_m : of the differences. same_cells : whether the cells of both lie on each other.
    places_per_cell : places over which the second surface was averaged in each cell; 1 where one cell was looked up.
    datums : vertical datums of both as their files state them, None where one does not. assumed : what had to be
    assumed, as sentences.
    """

    geobox: GeoBox
    first: NDArray[np.float32]
    second: NDArray[np.float32]
    n_elsewhere: int
    statistics: ErrorStatistics
    lowest_m: float
    highest_m: float
    same_cells: bool
    places_per_cell: int
    datums: tuple[str | None, str | None]
    assumed: tuple[str, ...] = ()

    @property
    def difference(self) -> NDArray[np.float32]:
        """Second less first (r, c), m; NaN where either has no height."""
        return self.second - self.first

    @property
    def n_both(self) -> int:
        """Number of cells with a height in both."""
        return self.statistics.n

    @property
    def only_first(self) -> NDArray[np.bool_]:
        """Cells (r, c) with a height in the first surface only."""
        return np.asarray(np.isfinite(self.first) & ~np.isfinite(self.second))

    @property
    def only_second(self) -> NDArray[np.bool_]:
        """Cells (r, c) with a height in the second surface only."""
        return np.asarray(np.isfinite(self.second) & ~np.isfinite(self.first))


def surface_differences(first: Path, second: Path, geoid: Path | None = None) -> SurfaceDifferences:
    """Bring the second surface onto the grid of the first, and subtract.

    The second surface is looked up at the centre of each cell of the first, or averaged over the cell where the first
    has cells at least twice as large, as `zlocus.evaluation.evaluate` does. geoid : see `same_heights`.

    Raises
    ------
    InputError
        A file is missing or is no raster of heights, vertical datums differ, or the two have no cell in common.
    ConfigError
        A geoid is given that is not needed.
    """
    compared = same_heights(read_heights(second), read_heights(first), geoid)
    surface, reference = compared.surface, compared.reference
    on_grid = _on_grid(surface, reference)
    here, there = reference.z.astype(np.float32), on_grid.astype(np.float32)
    known = (on_grid - reference.z)[np.isfinite(on_grid) & np.isfinite(reference.z)]
    if not known.size:
        raise InputError(
            f"{first} and {second} overlap, but no cell has a height in both, so there is nothing to compare. Give two "
            "surfaces of the same ground."
        )
    crs = reference.horizontal
    sentences = [] if compared.assumed is None else [compared.assumed]
    if compared.converted is not None:
        sentences.append(f"the geoid's heights were added to those of {compared.converted}")
    without_crs = [str(raster.path) for raster in (reference, surface) if raster.horizontal is None]
    if without_crs:
        sentences.append(f"no CRS is known of {' and '.join(without_crs)}: coordinates were compared as they are")
    return SurfaceDifferences(
        geobox=GeoBox(reference.z.shape, reference.transform, None if crs is None else crs.to_wkt()),
        first=here, second=there, n_elsewhere=_n_elsewhere(surface, reference),
        statistics=error_statistics(known, THRESHOLDS_M[0], THRESHOLDS_M[1:]),
        lowest_m=float(known.min()), highest_m=float(known.max()), same_cells=_has_same_cells(surface, reference),
        places_per_cell=_n_places(surface, reference), datums=(compared.datums[1], compared.datums[0]),
        assumed=tuple(sentences),
    )  # fmt: skip


def _on_grid(surface: HeightRaster, reference: HeightRaster) -> FloatArray:
    """Heights of a surface on the grid of another, (r, c) m.

    Raises
    ------
    InputError
        The two do not overlap.
    """
    frame, (rows, cols) = frame_of(surface, reference), reference.z.shape
    out, is_shared = np.full((rows, cols), np.nan), False
    step = max(1, CELLS_AT_A_TIME // cols)
    for top in range(0, rows, step):
        row, col = (index.ravel() for index in np.mgrid[top : min(top + step, rows), :cols])
        points = points_on(surface, reference, frame, places(reference.transform, row + 0.5, col + 0.5))
        cell = surface.cells(points.xy)
        is_shared = is_shared or bool(((cell >= 0) & (cell < surface.z.shape)).all(axis=1).any())
        out[row, col] = points.heights(surface, HeightRaster.nearest)
    if not is_shared:
        names = [f"{raster.path} ({_crs_name(raster)})" for raster in (reference, surface)]
        raise InputError(
            f"{' and '.join(names)} do not overlap. Give two surfaces of the same ground, or check the CRS of both."
        )
    return out


def _crs_name(raster: HeightRaster) -> str:
    return raster.crs.to_string()[:60] if raster.crs else "no CRS"


def _n_places(surface: HeightRaster, reference: HeightRaster) -> int:
    """Number of places at which a surface is looked up in each cell of another."""
    points = points_on(surface, reference, frame_of(surface, reference), np.array([reference.centre]))
    return 1 if points.areas is None else int(np.prod(points.areas.shape))


def _n_elsewhere(surface: HeightRaster, reference: HeightRaster) -> int:
    """Number of cells of a surface with a height that lie outside of the grid of another."""
    mine, theirs = surface.horizontal, reference.horizontal
    row, col = (index.astype(np.float64) for index in np.nonzero(np.isfinite(surface.z)))
    n_elsewhere = 0
    for start in range(0, len(row), CELLS_AT_A_TIME):
        part = slice(start, start + CELLS_AT_A_TIME)
        xy = places(surface.transform, row[part] + 0.5, col[part] + 0.5)
        cell = reference.cells(xy if mine is None or theirs is None else converted(mine, theirs, xy))
        n_elsewhere += int((~((cell >= 0) & (cell < reference.z.shape)).all(axis=1)).sum())
    return n_elsewhere


def _has_same_cells(surface: HeightRaster, reference: HeightRaster) -> bool:
    """Whether the cells of two rasters lie on each other, as far as both reach."""
    if surface.horizontal != reference.horizontal:
        return False
    offset = ~reference.transform * surface.transform
    rows, cols = reference.z.shape
    moved = np.array([np.subtract(offset * corner, corner) for corner in ((0, 0), (cols, 0), (0, rows))])
    return bool(np.abs(moved - np.rint(moved[0])).max() < SAME_GRID)
