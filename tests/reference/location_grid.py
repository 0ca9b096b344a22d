"""A location grid with SciPy's splines, one point at a time."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline, KroghInterpolator


def along(values, at):
    """Value and slope at a place, in nodes, of the curve through values (n, ...)."""
    nodes = np.arange(len(values))
    if len(values) < 4:
        curve = KroghInterpolator(nodes, values)
        return curve(at), curve.derivative(at)
    curve = CubicSpline(nodes, values)
    return curve(at), curve(at, 1)


def ground_position(location_grid, column, row, z):
    """Ground position (2,) at a place in the image, px, of a location grid in the CRS of the scene."""
    at = (np.array([column, row]) - location_grid.first_node) / location_grid.step
    inside = np.clip(at, 0.0, np.array(location_grid.xy.shape[2:0:-1]) - 1.0)
    across, by_row = along(np.moveaxis(location_grid.xy, 1, 0), inside[1])
    place, by_column = along(np.moveaxis(across, 1, 0), inside[0])
    slope, _ = along(np.moveaxis(by_row, 1, 0), inside[0])
    per_height = place + (at - inside)[0] * by_column + (at - inside)[1] * slope
    heights = location_grid.heights
    n = min(4, len(heights))
    first = min(max(int(np.searchsorted(heights, z)) - n // 2, 0), len(heights) - n)
    return KroghInterpolator(heights[first : first + n], per_height[first : first + n])(z)
