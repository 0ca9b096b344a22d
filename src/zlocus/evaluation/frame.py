"""The common frame of a surface and its reference, in metres, and the places where the surface is sampled.

Shifts and slopes are measured in the frame, whatever the CRS of the two rasters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Proj
from pyproj.exceptions import CRSError, ProjError

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.heights import HeightRaster
from zlocus.io.crs import is_on_earth, utm_zone
from zlocus.sensors.earth_frame import WGS84, between

# A map that is made for measuring is true to scale within this. Web Mercator is wrong by a factor of two at 60 degrees.
MAX_SCALE_ERROR = 0.01
# Half the distance over which a map is differentiated: neither its curvature nor the rounding of degrees matters.
HALF_STEP_M = 5.0
# A cell of the reference this many times as large as the surface's, along a side, is compared with the mean of the
# surface in it. A ratio this close to a whole number counts as whole.
MIN_COARSER_RATIO, RATIO_TOLERANCE = 2.0, 0.01
# Maximum number of places along a side of a larger cell; in cells of 90 m they are 3 m apart.
MAX_PLACES_PER_SIDE = 32
# So many that their heights stay in the cache of a core; ten times as many take twice as long.
PLACES_AT_A_TIME = 65_536
# Allowance for rounding where points are sought that touch a surface, cells of it.
REACH_SLACK_CELLS = 1.0
# Looks heights (n,) up at places (n, 2) of a raster.
LookUp = Callable[[HeightRaster, FloatArray], FloatArray]


@dataclass(frozen=True)
class Areas:
    """Blocks around points, each of which is sampled at several places.

    steps : (2, 2) or (n, 2, 2) float64, change of (x, y) along a block's columns ([..., 0]) and rows ([..., 1]); 0 for
    blocks that are sampled at their point only. shape : number of places along rows and columns.
    """

    steps: FloatArray
    shape: tuple[int, int]

    @property
    def places(self) -> FloatArray:
        """Offsets (k, 2) of the places from the point, in columns and rows, as fractions of the block."""
        down, across = ((np.arange(n) + 0.5) / n - 0.5 for n in self.shape)
        return np.column_stack([np.tile(across, len(down)), np.repeat(down, len(across))])

    def offsets(self, part: NDArray[np.int64]) -> FloatArray:
        """Offsets (n, k, 2) of the places from some of the points, in x and y; (k, 2) where all areas are alike."""
        steps, (across, down) = self.steps if self.steps.ndim == 2 else self.steps[part], self.places.T[..., None]
        return np.asarray(steps[..., None, :, 0] * across + steps[..., None, :, 1] * down)


@dataclass(frozen=True)
class Points:
    """Ground points in the surface's CRS, which can be moved by metres of the frame.

    xy : (n, 2) float64. per_metre : (n, 2, 2) float64, change of (x, y) by a metre to the east ([..., 0]) and to the
    north ([..., 1]); None where the CRS is the frame. areas : None where heights are sampled at the points only.
    """

    xy: FloatArray
    per_metre: FloatArray | None = None
    areas: Areas | None = None

    def heights(
        self, surface: HeightRaster, look_up: LookUp, shift: Sequence[float] | FloatArray | None = None
    ) -> FloatArray:
        """Heights (n,) m of a surface at the points, shifted by (east, north) m, or their means over the areas.

        look_up : method of `HeightRaster` that returns heights at places (n, 2), NaN where there is none. A mean is
        taken over the places that have a height; it is NaN where fewer than half of them have one.
        """
        xy = self.xy if shift is None else self.moved(shift)
        if self.areas is None:
            return look_up(surface, xy)
        means = np.full(len(xy), np.nan)
        # Elsewhere no place has a height. A surface often fills few of the cells of a reference.
        reaching = np.flatnonzero(self.reaching(surface, shift=shift))
        areas, places = self.areas, self.areas.places
        n_at_a_time = max(1, PLACES_AT_A_TIME // len(places))
        for first in range(0, len(reaching), n_at_a_time):
            part = reaching[first : first + n_at_a_time]
            z = look_up(surface, (xy[part, None] + areas.offsets(part)).reshape(-1, 2)).reshape(-1, len(places))
            n_known = np.isfinite(z).sum(axis=1)
            enough = 2 * n_known >= len(places)
            means[part[enough]] = np.nansum(z[enough], axis=1) / n_known[enough]
        return means

    def reaching(
        self, surface: HeightRaster, by_m: float = 0.0, shift: Sequence[float] | FloatArray | None = None
    ) -> NDArray[np.bool_]:
        """Whether points (n,), or their areas, may touch a height of a surface after a shift or one farther by `by_m`.

        It is True too where they touch the rectangle of the surface's cells that have heights, or nearly so.
        """
        if surface.filled_cells is None:
            return np.zeros(len(self.xy), bool)
        inverse = ~surface.transform
        cells = np.array([[inverse.d, inverse.e], [inverse.a, inverse.b]])
        metre = np.eye(2) if self.per_metre is None else self.per_metre
        reach = REACH_SLACK_CELLS + by_m * np.abs(cells @ metre).sum(axis=-1)
        if self.areas is not None:
            reach = reach + np.abs(cells @ self.areas.steps).sum(axis=-1) / 2
        first, last = np.array(surface.filled_cells).T
        cell = surface.cells(self.xy if shift is None else self.moved(shift))
        return np.asarray(((cell >= first - reach) & (cell <= last + 1 + reach)).all(axis=1))

    def moved(self, shift: Sequence[float] | FloatArray) -> FloatArray:
        """Coordinates (n, 2) of the points, shifted by (east, north) m of the frame."""
        step = np.asarray(shift, float)
        return np.asarray(self.xy + (step if self.per_metre is None else self.per_metre @ step))

    def where(self, chosen: NDArray[np.bool_]) -> Points:
        """The points that a mask selects. chosen : (n,) bool."""
        areas = self.areas
        if areas is not None and areas.steps.ndim == 3:
            areas = replace(areas, steps=areas.steps[chosen])
        return Points(self.xy[chosen], None if self.per_metre is None else self.per_metre[chosen], areas)


def frame_of(surface: HeightRaster, reference: HeightRaster) -> CRS | None:
    """The map on which shifts and slopes are measured; None where a file has no CRS, and coordinates are used as given.

    It is the surface's CRS, or else the reference's, if that is projected, in metres and true to scale within 1 %.
    Otherwise it is the WGS84 UTM zone of the reference's centre.

    Raises
    ------
    InputError
        PROJ cannot convert a CRS, or one file is in degrees and the other has no CRS.
    """
    mine, theirs = surface.horizontal, reference.horizontal
    if mine is None or theirs is None:
        for raster, other in ((surface, reference), (reference, surface)):
            if raster.horizontal is not None and raster.horizontal.is_geographic:
                raise InputError(f"{raster.path} is in degrees and {other.path} has no CRS. Assign it one (gdal_edit).")
        return None
    if mine == theirs and not is_on_earth(mine):
        return mine
    for raster, crs in ((surface, mine), (reference, theirs)):
        if not is_on_earth(crs):
            raise InputError(f"{raster.path} has the CRS {crs.name}, which cannot be converted to that of the other.")
    x, y = reference.centre
    lon, lat = between(theirs, WGS84).transform(x, y)
    if not np.isfinite([lon, lat]).all():
        if mine == theirs and in_metres(mine):
            return mine
        raise InputError(f"{reference.path} lies outside of its CRS {theirs.name}. Check its CRS and transform.")
    measuring = (crs for crs in (mine, theirs) if in_metres(crs) and _true_to_scale(crs, lon, lat))
    return next(measuring, utm_zone(lon, lat))


def in_metres(crs: CRS | None) -> bool:
    """Whether coordinates are metres of a map; without a CRS they are assumed to be."""
    if crs is None:
        return True
    return not crs.is_geographic and all(abs(axis.unit_conversion_factor - 1.0) < 1e-9 for axis in crs.axis_info)


def points_on(
    surface: HeightRaster,
    reference: HeightRaster,
    frame: CRS | None,
    xy: FloatArray,
    block: int = 1,
    single: NDArray[np.bool_] | None = None,
) -> Points:
    """Points in the surface's CRS; with areas where the reference's cells are much larger than the surface's.

    xy : (n, 2), in the reference's CRS. block : cells of the reference along a side of a block. single : (n,) bool, the
    points that are sampled at the point only. Much larger: at least `MIN_COARSER_RATIO` times.
    """
    points = _points_without_areas(surface, reference, frame, xy)
    across, down = cells_across(surface, reference)
    if not math.sqrt(across * down) >= MIN_COARSER_RATIO - RATIO_TOLERANCE:
        return points
    n_down, n_across = (
        int(np.clip(np.ceil(block * n - RATIO_TOLERANCE), 1, MAX_PLACES_PER_SIDE)) for n in (down, across)
    )
    steps = grid_steps(reference, block, surface.horizontal, xy)
    if single is not None and single.any():
        steps = np.where(single[:, None, None], 0.0, steps)
    return replace(points, areas=Areas(steps, (n_down, n_across)))


def cells_across(surface: HeightRaster, reference: HeightRaster) -> tuple[float, float]:
    """Cells of the surface along the columns and rows of a reference cell, at the centre; NaN outside a map."""
    x, y = reference.centre
    step = grid_steps(reference, 1, surface.horizontal, np.array([[x, y]])).reshape(2, 2)
    cell = np.array([[surface.transform.a, surface.transform.b], [surface.transform.d, surface.transform.e]])
    if not np.isfinite(step).all():
        return math.nan, math.nan
    along_cols, along_rows = np.linalg.solve(cell, step).T
    return float(np.hypot(*along_cols)), float(np.hypot(*along_rows))


def grid_steps(reference: HeightRaster, size: int, target: CRS | None, xy: FloatArray) -> FloatArray:
    """Change of (x, y) on a map by `size` cells of a reference along its columns ([..., 0]) and rows ([..., 1]).

    xy : (n, 2), places in the reference's CRS at which it is computed. The result is (2, 2) where both have one CRS or
    one has none, else (n, 2, 2).
    """
    t, theirs = reference.transform, reference.horizontal
    step = np.array([[t.a, t.b], [t.d, t.e]]) * size
    if target is None or theirs is None or theirs == target:
        return step
    ends = [(converted(theirs, target, xy + half), converted(theirs, target, xy - half)) for half in step.T / 2]
    return np.stack([after - before for after, before in ends], axis=-1)


def _points_without_areas(surface: HeightRaster, reference: HeightRaster, frame: CRS | None, xy: FloatArray) -> Points:
    mine, theirs = surface.horizontal, reference.horizontal
    if frame is None or mine is None or theirs is None:
        return Points(xy)
    there = converted(theirs, mine, xy)
    if mine == frame:
        return Points(there)
    at = converted(theirs, frame, xy)
    columns = []
    for step in ((HALF_STEP_M, 0.0), (0.0, HALF_STEP_M)):
        columns.append((converted(frame, mine, at + step) - converted(frame, mine, at - step)) / (2 * HALF_STEP_M))
    return Points(there, np.stack(columns, axis=-1))


def converted(given: CRS, wanted: CRS, xy: FloatArray) -> FloatArray:
    """Coordinates (n, 2) of a given CRS in another, wanted one."""
    return xy if given == wanted else np.column_stack(between(given, wanted).transform(xy[:, 0], xy[:, 1]))


def unit_m(reference: HeightRaster, frame: CRS | None) -> tuple[float, float]:
    """Metres of the frame per unit of the reference's x and y, at its centre; (1, 1) for a map made for measuring."""
    theirs = reference.horizontal
    if frame is None or theirs is None or theirs == frame:
        return 1.0, 1.0
    x, y = reference.centre
    half = abs(reference.transform.a) / 2
    ends = converted(theirs, frame, np.array([[x - half, y], [x + half, y], [x, y - half], [x, y + half]]))
    width, height = np.hypot(*(ends[1::2] - ends[::2]).T) / (2 * half)
    if in_metres(theirs) and max(abs(width - 1.0), abs(height - 1.0)) < MAX_SCALE_ERROR:
        return 1.0, 1.0
    return float(width), float(height)


def _true_to_scale(crs: CRS, lon: float, lat: float) -> bool:
    try:
        factors = Proj(crs).get_factors(lon, lat)
    except (ProjError, CRSError):
        return False
    return all(abs(scale - 1.0) < MAX_SCALE_ERROR for scale in (factors.meridional_scale, factors.parallel_scale))
