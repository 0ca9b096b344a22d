"""Rectified pairs for matchers that search along rows: both images resampled onto a plane at a constant height.

On the plane the parallax of a pair lies along rows, so a disparity is a height. Matched points are projected back
through the camera of the first view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import distance_transform_edt

from zlocus.core.scene import View
from zlocus.sensors.frame import FrameModel

STEP_M = 0.5
MARGIN_M = 25.0
# The parallax is that of a point which lies this far above the plane.
RISE_M = 10.0


class Area(Protocol):
    """Area of the surface. bounds : west, south, east, north, m."""

    @property
    def crs(self) -> str: ...

    @property
    def bounds(self) -> tuple[float, float, float, float]: ...


@dataclass(frozen=True)
class Rectified:
    """Grid on the plane: `shape` cells of STEP_M, with rows along the parallax.

    origin : (x, y) m of the first cell's centre; along, across : unit vectors in (x, y).
    """

    origin: np.ndarray
    along: np.ndarray
    across: np.ndarray
    shape: tuple[int, int]

    def ground(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Positions (n, 2) m of cells."""
        at = STEP_M * np.stack([cols, rows], axis=-1).reshape(-1, 2)
        return self.origin + at @ np.stack([self.along, self.across])


def to_image(view: View, shift: np.ndarray, xy: np.ndarray, z: float) -> np.ndarray:
    """Image positions (n, 2) px of ground points (n, 2) m at one height."""
    return np.asarray(view.sensor.image_from_ground(np.column_stack([xy, np.full(len(xy), z)])) + shift)


def parallax(area: Area, views: Sequence[View], shifts: Sequence[np.ndarray], z: float) -> np.ndarray:
    """Parallax (x, y) on the plane, metres per metre of height: position by the first view less that by the second."""
    west, south, east, north = area.bounds
    point = np.array([[(west + east) / 2, (south + north) / 2]])
    on_plane = []
    for view, shift in zip(views, shifts, strict=True):
        seen = to_image(view, shift, point, z + RISE_M)
        on_plane.append(view.sensor.ground_from_image(seen - shift, np.array([z]))[0, :2])
    return np.asarray((on_plane[0] - on_plane[1]) / RISE_M)


def rectified(area: Area, moved: np.ndarray) -> Rectified:
    """Grid around the area, with rows along the parallax. moved : parallax per metre, see `parallax`."""
    west, south, east, north = area.bounds
    along = moved / np.hypot(*moved)
    across = np.array([along[1], -along[0]])
    corners = np.array([(x, y) for x in (west, east) for y in (south, north)])
    places = corners @ np.stack([along, across], axis=1)
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    cols, rows = (int(n) + 1 for n in (high - low) / STEP_M)
    return Rectified(low @ np.stack([along, across]), along, across, (rows, cols))


def shown(views: Sequence[View], shifts: Sequence[np.ndarray], plane: Rectified, z: float) -> np.ndarray:
    """Which cells (r, c) of the plane lie inside all views."""
    row, col = np.mgrid[: plane.shape[0], : plane.shape[1]]
    xy, found = plane.ground(row.ravel(), col.ravel()), np.ones(row.size, bool)
    for view, shift in zip(views, shifts, strict=True):
        seen = to_image(view, shift, xy, z)
        # Far outside, lenses have no image positions: these are NaN, and not inside.
        found &= ((seen >= 0) & (seen <= np.array(view.image.shape[::-1]) - 1)).all(axis=1)
    return found.reshape(plane.shape)


def cameras_above(views: Sequence[View], z: float) -> float:
    """Mean height of frame cameras above a plane, m; infinity for satellites, whose parallax is linear in height."""
    stations = [view.sensor.station_height() for view in views if isinstance(view.sensor, FrameModel)]
    return float(np.mean(stations)) - z if stations else np.inf


def on_plane(view: View, shift: np.ndarray, plane: Rectified, z: float) -> np.ndarray:
    """A view resampled onto the plane, (r, c), in its own dtype; beyond the image its border is repeated."""
    rows, cols = view.image.shape
    grey = view.image.read(0, 0, rows, cols).pixels
    row, col = np.mgrid[: plane.shape[0], : plane.shape[1]]
    seen = to_image(view, shift, plane.ground(row.ravel(), col.ravel()), z).reshape(*plane.shape, 2)
    return np.asarray(
        cv2.remap(
            grey, seen[..., 0].astype(np.float32), seen[..., 1].astype(np.float32), cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )  # fmt: skip


def disparity_range(area_heights: tuple[float, float], moved: np.ndarray, margin_m: float) -> tuple[int, int]:
    """First disparity and number of disparities (a multiple of 16) that cover a range of heights with a margin."""
    low, high = area_heights
    reach = float(np.hypot(*moved)) / STEP_M * ((high - low) / 2 + margin_m)
    return -int(np.ceil(reach)), 16 * int(np.ceil(2 * reach / 16) + 1)


def ground_points(
    disparity: np.ndarray,
    view: View,
    shift: np.ndarray,
    plane: Rectified,
    moved: np.ndarray,
    middle: float,
    above_m: float = np.inf,
) -> np.ndarray:
    """Ground points (n, 3) m of all pixels with a disparity.

    disparity : (r, c) px, NaN where there is none; middle : height of the plane, m; above_m : see `cameras_above`.
    """
    rows, cols = np.nonzero(np.isfinite(disparity))
    z = disparity[rows, cols] * STEP_M / float(np.hypot(*moved))
    if np.isfinite(above_m):
        # A point rises by z where its parallax grows as z / (above_m - z); `moved` is that of RISE_M.
        z = z * above_m / (above_m - RISE_M + z)
    z = middle + z
    seen = to_image(view, shift, plane.ground(rows, cols), middle)
    return np.asarray(view.sensor.ground_from_image(seen - shift, z))


def gridded(area: Area, xyz: np.ndarray) -> np.ndarray:
    """Surface (r, c) m with the highest of the points (n, 3) m in each cell of STEP_M, NaN in empty cells."""
    west, south, east, north = area.bounds
    rows, cols = round((north - south) / STEP_M), round((east - west) / STEP_M)
    row = np.floor((north - xyz[:, 1]) / STEP_M).astype(int)
    col = np.floor((xyz[:, 0] - west) / STEP_M).astype(int)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    surface = np.full((rows, cols), -np.inf)
    np.maximum.at(surface, (row[inside], col[inside]), xyz[inside, 2])
    return np.where(np.isfinite(surface), surface, np.nan)


def write_surface(area: Area, surface: np.ndarray, path: Path) -> Path:
    """Write heights (r, c) m as a raster; empty cells take the height of the nearest cell."""
    nearest = distance_transform_edt(np.isnan(surface), return_distances=False, return_indices=True)
    west, _, _, north = area.bounds
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(
        path, "w", driver="GTiff", height=surface.shape[0], width=surface.shape[1], count=1, dtype="float32",
        crs=area.crs, transform=from_origin(west, north, STEP_M, STEP_M),
    ) as file:  # fmt: skip
        file.write(surface[tuple(nearest)].astype(np.float32), 1)
    return path
