"""Heights of tie points: which of them can be trusted, and the range of heights that they suggest for the search."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.height_range import HeightRange
from zlocus.core.nearest_points import nearest_points
from zlocus.core.options import OrientationOptions
from zlocus.core.sensor_model import FloatArray, limited_margin

# Trusted ties that a range of heights needs, and the percentiles of their heights that it is taken from.
MIN_TIES_FOR_RANGE = 20
RANGE_PERCENT = (0.5, 99.5)
# A tie is trusted where so many of its nearest neighbours have a height that agrees with its own: up to this slope
# between the two, and this many standard deviations of both.
NEIGHBOURS = 8
MIN_AGREEING_NEIGHBOURS = 3
MAX_SLOPE = 1.5
MAX_HEIGHT_SIGMAS = 4.0


def height_range_of_ties(
    xyz: FloatArray,
    sigma_z_m: FloatArray,
    names: Sequence[str],
    options: OrientationOptions,
    station: float | None = None,
) -> HeightRange:
    """Heights (m) at which the surface is expected, and those to search, from the heights of the ties.

    xyz : (n, 3) m, ground points of the ties; sigma_z_m : (n,) precision of their heights; names : of the views, for
    the message; station : height of the lowest camera (m), where it is known.

    The expected range is that of the 0.5 to 99.5 percentiles of the trusted ties, widened at both ends by
    `range_margin` times itself (peaks and valleys between ties), then by `range_up_m` above (roofs and trees carry few
    ties) and `range_down_m` below. What is searched goes on beyond it by `search_up_m` and `search_down_m`, for towers
    and pits. Both margins in metres are limited where the station is near, see `limited_margin`.

    Raises
    ------
    GeometryError
        Fewer than `MIN_TIES_FOR_RANGE` ties can be trusted.
    """
    trusted = supported(xyz, sigma_z_m)
    if trusted.sum() < MIN_TIES_FOR_RANGE:
        raise GeometryError(
            f"Only {int(trusted.sum())} reliable tie points were found between {', '.join(names)}, too few to tell the "
            f"height range of the ground ({MIN_TIES_FOR_RANGE} are needed). Give --heights ZMIN ZMAX or --dem, or "
            "check that the images overlap."
        )
    low, high = (float(z) for z in np.percentile(xyz[trusted, 2], RANGE_PERCENT))
    margin = options.range_margin * (high - low)
    expected = _widened((low - margin, high + margin), options.range_down_m, options.range_up_m, station)
    return HeightRange(expected, _widened(expected, options.search_down_m, options.search_up_m, station))


def _widened(heights: tuple[float, float], down_m: float, up_m: float, station: float | None) -> tuple[float, float]:
    """A height range with margins (m) below and above, no more than a share of the depth below the station."""
    low, high = heights
    return low - limited_margin(down_m, low, station), high + limited_margin(up_m, high, station)


def supported(xyz: FloatArray, sigma_z_m: FloatArray) -> NDArray[np.bool_]:
    """Ties (n,) whose height agrees with that of three or more of their eight nearest neighbours.

    xyz : (n, 3) m, NaN for ties without a ground point; sigma_z_m : (n,). Two heights agree where a slope of 1.5
    between the ties, together with four standard deviations of both heights, explains their difference.
    """
    good = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    trusted = np.zeros(len(xyz), bool)
    if len(good) <= MIN_AGREEING_NEIGHBOURS:
        return trusted
    distance, near = nearest_points(xyz[good, :2], min(NEIGHBOURS + 1, len(good)))
    sigma = np.hypot(sigma_z_m[good][:, None], sigma_z_m[good][near[:, 1:]])
    difference = np.abs(xyz[good, 2][:, None] - xyz[good, 2][near[:, 1:]])
    agrees = difference <= MAX_SLOPE * distance[:, 1:] + MAX_HEIGHT_SIGMAS * sigma
    trusted[good] = agrees.sum(axis=1) >= MIN_AGREEING_NEIGHBOURS
    return trusted
