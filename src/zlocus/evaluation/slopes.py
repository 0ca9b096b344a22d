"""Slopes of the reference's blocks, and bands of slope."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import ConfigError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.frame import grid_steps
from zlocus.evaluation.heights import HeightRaster

SLOPE_EDGES_DEG = (5.0, 15.0, 30.0, 45.0)
UNKNOWN = "unknown"


def slope_deg(gradient: FloatArray) -> FloatArray:
    """Steepest slope, degrees (n,), of gradients (n, 2), metres per metre to the east and north."""
    return np.asarray(np.degrees(np.arctan(np.hypot(gradient[:, 0], gradient[:, 1]))))


def check_slope_edges(edges: Sequence[float]) -> None:
    """Refuse limits between bands of slope that cannot be used.

    Raises
    ------
    ConfigError
        The limits do not rise, or are not between 0 and 90 degrees.
    """
    if not all(0 < edge < 90 for edge in edges) or any(low >= high for low, high in pairwise(edges)):
        listed = ",".join(f"{edge:g}" for edge in edges)
        raise ConfigError(f"--slopes {listed} must rise from above 0 to below 90 degrees, for example 5,15,30,45.")


def slope_bands(slopes: FloatArray, edges: Sequence[float]) -> dict[str, NDArray[np.bool_]]:
    """Masks (n,) of the blocks in each band of slope, by name ("5-15": from 5 up to but not including 15 degrees).

    slopes : (n,) degrees. edges : limits between the bands, degrees; none: no bands. Blocks of unknown slope (NaN) are
    in the band `UNKNOWN`, which exists only where there are any.
    """
    if not edges:
        return {}
    bands = {
        f"{low:g}-{high:g}": (slopes >= low) & (slopes < high) for low, high in pairwise((0.0, *edges, 90.0))
    }  # fmt: skip
    unknown = np.isnan(slopes)
    return bands | ({UNKNOWN: unknown} if unknown.any() else {})


def block_gradient(reference: HeightRaster, size: int, frame: CRS | None, chosen: NDArray[np.bool_]) -> FloatArray:
    """Gradient of the blocks' mean heights, metres per metre to the east and to the north of the frame, (n, 2) float64.

    size : cells along a side of a block. chosen : (r, c) bool, the n blocks whose gradient is wanted. Computed from the
    eight neighbouring blocks (Horn 1981, Proc. IEEE 69). NaN where any cell of them has no height.
    """
    rows, cols = chosen.shape
    cells = reference.z[: rows * size, : cols * size].reshape(rows, size, cols, size)
    z = np.pad(cells.mean(axis=(1, 3)), 1, constant_values=np.nan)
    across = z[:, 2:] - z[:, :-2]
    down = z[2:] - z[:-2]
    per_col = (across[:-2] + 2 * across[1:-1] + across[2:])[chosen] / 8
    per_row = (down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:])[chosen] / 8
    # The gradient along the grid is the transpose of the grid's step matrix times the gradient along the frame.
    t = reference.transform
    col_row = np.column_stack(np.nonzero(chosen)[::-1]) + 0.5
    centres = col_row @ (size * np.array([[t.a, t.b], [t.d, t.e]])).T + (t.c, t.f)
    step = grid_steps(reference, size, frame, centres)
    along_grid = np.column_stack([per_col, per_row])
    return np.asarray(np.linalg.solve(np.swapaxes(step, -1, -2), along_grid[..., None])[..., 0])
