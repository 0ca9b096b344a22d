"""Cells of a surface that it hides from a sensor by itself: what a true ortho-image leaves out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.footprints import Bounds
from zlocus.core.grid import cell_centres
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.matching.kernels.sight import mark_hidden

# Directions of rays are computed at nodes so many cells apart at most, and interpolated between them.
NODE_CELLS = 64
# Cells by which a ray rises for the difference that gives its direction.
RISE_CELLS = 10.0
# Cells of the surface by which it must stand above a ray to hide what is behind it (less is its own roughness), and
# cells of it between the places where a ray is looked at.
MARGIN_CELLS, STEP_CELLS = 0.5, 0.5

ReadHeights = Callable[[GeoBox], NDArray[np.float32]]
# The greatest height within bounds, m.
HighestIn = Callable[[Bounds], float]
EVERYWHERE = (-np.inf, -np.inf, np.inf, np.inf)


def hidden_cells(
    sensor: SensorModel,
    read: ReadHeights,
    highest: HighestIn,
    geobox: GeoBox,
    z: NDArray[np.float32],
    surface_cell_m: float,
) -> NDArray[np.bool_]:
    """Which cells of a block the surface hides from a sensor, (r, c) bool.

    read : heights (r, c) m on a grid, NaN where there are none; highest : see `HighestIn`; geobox : of the block; z :
    (r, c) m, its heights, which are not NaN everywhere; surface_cell_m : side (m) of the cells that the surface has.
    """
    by_height = ray_directions(sensor, geobox, z)
    out = np.zeros(z.shape, np.bool_)
    if not by_height.any():
        return out
    cell_m, low = float(geobox.transform.a), float(np.nanmin(z))
    # What stands highest within reach may be far lower than what stands highest of all, and then the reach is shorter.
    top = highest(_within_reach(geobox, by_height, highest(EVERYWHERE) - low))
    reach = _within_reach(geobox, by_height, top - low)
    (west, south, east, north) = geobox.boundingbox.bbox
    above, left = (int(np.ceil(each / cell_m)) for each in (reach[3] - north, west - reach[0]))
    below, right = (int(np.ceil(each / cell_m)) for each in (south - reach[1], reach[2] - east))
    whole = geobox.translate_pix(-left, -above)
    whole = GeoBox((z.shape[0] + above + below, z.shape[1] + left + right), whole.transform, geobox.crs)
    surface = np.ascontiguousarray(read(whole), np.float32)
    surface[above : above + z.shape[0], left : left + z.shape[1]] = z
    margin, stride = MARGIN_CELLS * max(surface_cell_m, cell_m), max(STEP_CELLS * surface_cell_m / cell_m, 1.0)
    mark_hidden(
        surface, np.array([above, left]), by_height, np.float32(top), np.float32(margin), np.float32(stride), out
    )
    return out


def _within_reach(geobox: GeoBox, by_height: NDArray[np.float32], rise_m: float) -> Bounds:
    """Bounds of the ground over which the rays of a block pass while they rise by so much. by_height : (r, c, 2)."""
    cell_m = float(geobox.transform.a)
    reach = max(rise_m, 0.0) * cell_m
    (west, south, east, north) = geobox.boundingbox.bbox
    cols, rows = by_height[..., 0], by_height[..., 1]
    return (
        west + min(float(cols.min()), 0.0) * reach - cell_m, south - max(float(rows.max()), 0.0) * reach - cell_m,
        east + max(float(cols.max()), 0.0) * reach + cell_m, north - min(float(rows.min()), 0.0) * reach + cell_m,
    )  # fmt: skip


def ray_directions(sensor: SensorModel, geobox: GeoBox, z: NDArray[np.float32]) -> NDArray[np.float32]:
    """Columns and rows that the ray through each cell moves per metre that it rises, (r, c, 2) float32.

    0 where the sensor does not see a place, or not from above.
    """
    rows, cols = z.shape
    at_rows, at_cols = (np.rint(np.linspace(0, n - 1, max(-(-n // NODE_CELLS) + 1, 2))) for n in (rows, cols))
    picked = np.ix_(at_rows.astype(int), at_cols.astype(int))
    heights = z[picked].astype(float).ravel()
    heights = np.where(np.isfinite(heights), heights, float(np.nanmedian(z)))
    cell_m = float(geobox.transform.a)
    xyz, rise = np.column_stack([cell_centres(geobox)[picked].reshape(-1, 2), heights]), RISE_CELLS * cell_m
    above: FloatArray = sensor.ground_from_image(sensor.image_from_ground(xyz), heights + rise)
    moved = (above - xyz)[:, :2] / (rise * cell_m) * np.array([1.0, -1.0])
    moved = np.where(np.isfinite(moved).all(axis=1, keepdims=True), moved, 0.0).reshape(len(at_rows), len(at_cols), 2)
    down, across = _weights(at_rows, rows), _weights(at_cols, cols)
    on_cells = [down @ part @ across.T for part in moved.transpose(2, 0, 1)]
    return np.ascontiguousarray(np.stack(on_cells, axis=-1), np.float32)


def _weights(nodes: FloatArray, n: int) -> FloatArray:
    """Weights (n, k) of nodes (k,) for linear interpolation at 0, 1 ... n - 1."""
    return np.column_stack([np.interp(np.arange(n), nodes, one) for one in np.eye(len(nodes))])
