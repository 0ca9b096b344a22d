"""One frame in metres for a surface and its reference: shifts and slopes are measured there, whatever the CRS; and the
places where the surface is looked up.
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

# Web Mercator is out by a factor of two at 60 degrees; maps made for measuring by less than this.
SCALE_TOLERANCE = 0.01
# Half the distance over which a map is differentiated, m: curvature is not seen, rounding of degrees neither.
HALF_STEP_M = 5.0
# From so many cells of the surface on, along a side, a cell of the reference is compared with their mean. So near to a
# whole number, cells of two maps count as fitting.
COARSER, FITTING = 2.0, 0.01
# Places along a side of a larger cell at most: of cells of 90 m, 3 m apart.
MOST_PLACES = 32
PLACES_AT_A_TIME = 1_000_000


@dataclass(frozen=True)
class Areas:
    """The blocks around points, where they are looked up at many places.

    steps : (2, 2) or (n, 2, 2) float64, change of (x, y) along a block's columns ([..., 0]) and rows ([..., 1]), 0 of
    blocks that are looked up at their point alone. shape : places along rows and columns.
    """

    steps: FloatArray
    shape: tuple[int, int]

    @property
    def places(self) -> FloatArray:
        """Where they are in a block, (k, 2) columns and rows, in blocks from its point."""
        down, across = ((np.arange(n) + 0.5) / n - 0.5 for n in self.shape)
        return np.column_stack([np.tile(across, len(down)), np.repeat(down, len(across))])


@dataclass(frozen=True)
class Points:
    """Ground points in a surface's CRS, which can be moved by metres of the frame.

    xy : (n, 2) float64. per_metre : (n, 2, 2) float64, change of (x, y) by a metre to the east ([..., 0]) and to the
    north ([..., 1]); None where the CRS is the frame. areas : None where heights are those at the points.
    """

    xy: FloatArray
    per_metre: FloatArray | None = None
    areas: Areas | None = None

    def heights(
        self, look: Callable[[FloatArray], FloatArray], shift: Sequence[float] | FloatArray | None = None
    ) -> FloatArray:
        """Heights (n,) m at the points, shifted by (east, north) m, or the means of their areas.

        look : heights at places (n, 2), NaN where there is none. A mean is of the places that have a height, NaN where
        fewer than half of them do.
        """
        at = self.xy if shift is None else self.moved(shift)
        if self.areas is None:
            return look(at)
        places, steps = self.areas.places, np.broadcast_to(self.areas.steps, (len(at), 2, 2))
        means = np.full(len(at), np.nan)
        n_at_a_time = max(1, PLACES_AT_A_TIME // len(places))
        for first in range(0, len(at), n_at_a_time):
            part = slice(first, first + n_at_a_time)
            aside = np.einsum("nij,kj->nki", steps[part], places)
            z = look((at[part, None] + aside).reshape(-1, 2)).reshape(-1, len(places))
            n_known = np.isfinite(z).sum(axis=1)
            enough = 2 * n_known >= len(places)
            means[part][enough] = np.nansum(z[enough], axis=1) / n_known[enough]
        return means

    def moved(self, shift: Sequence[float] | FloatArray) -> FloatArray:
        """The points (n, 2), shifted by (east, north) m of the frame."""
        step = np.asarray(shift, float)
        return np.asarray(self.xy + (step if self.per_metre is None else self.per_metre @ step))

    def where(self, chosen: NDArray[np.bool_]) -> Points:
        """Some of the points. chosen : (n,)."""
        areas = self.areas
        if areas is not None and areas.steps.ndim == 3:
            areas = replace(areas, steps=areas.steps[chosen])
        return Points(self.xy[chosen], None if self.per_metre is None else self.per_metre[chosen], areas)


def frame_of(surface: HeightRaster, reference: HeightRaster) -> CRS | None:
    """The map that east, north and slopes are measured on; None where a file has no CRS and coordinates are as given.

    The surface's CRS, else the reference's, if it is projected in metres and true to scale within 1 %; else the WGS84
    UTM zone of the reference's centre.

    Raises
    ------
    InputError
        A CRS that PROJ cannot convert, or degrees beside a file without CRS.
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
    """Whether coordinates are metres of a map; taken to be so where there is no CRS."""
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
    """Points of the reference (n, 2), in its CRS, as the surface has them; with the areas of their blocks where its
    cells are at least `COARSER` times as large as the surface's.

    block : cells of the reference along a side. single : (n,) those that are looked up at the point alone.
    """
    points = _points_alone(surface, reference, frame, xy)
    across, down = cells_across(surface, reference)
    if not math.sqrt(across * down) >= COARSER - FITTING:
        return points
    n_down, n_across = (int(np.clip(np.ceil(block * n - FITTING), 1, MOST_PLACES)) for n in (down, across))
    steps = grid_steps(reference, block, surface.horizontal, xy)
    if single is not None and single.any():
        steps = np.where(single[:, None, None], 0.0, steps)
    return replace(points, areas=Areas(steps, (n_down, n_across)))


def cells_across(surface: HeightRaster, reference: HeightRaster) -> tuple[float, float]:
    """Cells of the surface along the columns and rows of one of the reference, at its centre; NaN outside of a map."""
    x, y = reference.centre
    step = grid_steps(reference, 1, surface.horizontal, np.array([[x, y]])).reshape(2, 2)
    cell = np.array([[surface.transform.a, surface.transform.b], [surface.transform.d, surface.transform.e]])
    if not np.isfinite(step).all():
        return math.nan, math.nan
    along_cols, along_rows = np.linalg.solve(cell, step).T
    return float(np.hypot(*along_cols)), float(np.hypot(*along_rows))


def grid_steps(reference: HeightRaster, size: int, target: CRS | None, xy: FloatArray) -> FloatArray:
    """Change of (x, y) of a map by so many cells of a reference along its columns ([..., 0]) and rows ([..., 1]).

    xy : (n, 2), of its own CRS, around which it is. (2, 2) where both have one CRS, or one has none; else (n, 2, 2).
    """
    t, theirs = reference.transform, reference.horizontal
    step = np.array([[t.a, t.b], [t.d, t.e]]) * size
    if target is None or theirs is None or theirs == target:
        return step
    ends = [(converted(theirs, target, xy + half), converted(theirs, target, xy - half)) for half in step.T / 2]
    return np.stack([after - before for after, before in ends], axis=-1)


def _points_alone(surface: HeightRaster, reference: HeightRaster, frame: CRS | None, xy: FloatArray) -> Points:
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
    """Coordinates (n, 2) of one CRS in another."""
    return xy if given == wanted else np.column_stack(between(given, wanted).transform(xy[:, 0], xy[:, 1]))


def unit_m(reference: HeightRaster, frame: CRS | None) -> tuple[float, float]:
    """Metres of the frame in a unit of the reference's x and y, at its centre; (1, 1) for a map made for measuring."""
    theirs = reference.horizontal
    if frame is None or theirs is None or theirs == frame:
        return 1.0, 1.0
    x, y = reference.centre
    half = abs(reference.transform.a) / 2
    ends = converted(theirs, frame, np.array([[x - half, y], [x + half, y], [x, y - half], [x, y + half]]))
    width, height = np.hypot(*(ends[1::2] - ends[::2]).T) / (2 * half)
    if in_metres(theirs) and max(abs(width - 1.0), abs(height - 1.0)) < SCALE_TOLERANCE:
        return 1.0, 1.0
    return float(width), float(height)


def _true_to_scale(crs: CRS, lon: float, lat: float) -> bool:
    try:
        factors = Proj(crs).get_factors(lon, lat)
    except (ProjError, CRSError):
        return False
    return all(abs(scale - 1.0) < SCALE_TOLERANCE for scale in (factors.meridional_scale, factors.parallel_scale))
