"""One frame in metres for a surface and its reference: shifts and slopes are measured there, whatever the CRS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Proj
from pyproj.exceptions import CRSError, ProjError

from zlocus.errors import InputError
from zlocus.evaluation.heights import HeightRaster
from zlocus.io.crs import is_on_earth, utm_zone
from zlocus.sensors.model import FloatArray
from zlocus.sensors.space import WGS84, between

# Web Mercator is out by a factor of two at 60 degrees; maps made for measuring by less than this.
SCALE_TOLERANCE = 0.01
# Half the distance over which a map is differentiated, m: curvature is not seen, rounding of degrees neither.
HALF_STEP_M = 5.0


@dataclass(frozen=True)
class Points:
    """Ground points in a surface's CRS, which can be moved by metres of the frame.

    xy : (n, 2) float64. per_metre : (n, 2, 2) float64, change of (x, y) by a metre to the east ([..., 0]) and to the
    north ([..., 1]); None where the CRS is the frame.
    """

    xy: FloatArray
    per_metre: FloatArray | None = None

    def moved(self, shift: Sequence[float] | FloatArray) -> FloatArray:
        """The points (n, 2), shifted by (east, north) m of the frame."""
        step = np.asarray(shift, float)
        return np.asarray(self.xy + (step if self.per_metre is None else self.per_metre @ step))

    def where(self, chosen: NDArray[np.bool_]) -> Points:
        """Some of the points. chosen : (n,)."""
        return Points(self.xy[chosen], None if self.per_metre is None else self.per_metre[chosen])


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


def points_on(surface: HeightRaster, reference: HeightRaster, frame: CRS | None, xy: FloatArray) -> Points:
    """Points of the reference (n, 2), in its CRS, as the surface has them."""
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
