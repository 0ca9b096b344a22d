"""The maps of a cloud's images, read back: where on the ground each pixel lies, by window."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.windows import Window

from zlocus.core.grid import CellWindow
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, bare
from zlocus.io.open_raster import cached_raster
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.quality import Quality
from zlocus.sensors.frame import FrameModel

# Share of a depth, and height in metres, by which a second point of a ray is nearer to its camera.
NEARER_SHARE, HIGHER_M = 1e-3, 1.0


@dataclass(frozen=True)
class RayPoints:
    """What the pixels of a window show.

    points : (r, c, 3) m, NaN where a pixel has no measured height; towards : (r, c, 3) unit vectors to the camera.
    """

    points: FloatArray
    towards: FloatArray


@dataclass(frozen=True)
class ImageMap:
    """The map of a reference image in the folder of a cloud.

    view : with the camera of the run; path : of its heights, or of its depths where `is_depth`; quality_path : of its
    quality; vertical_datum : of the heights; crs : of the scene.
    """

    view: View
    path: Path
    quality_path: Path
    is_depth: bool
    vertical_datum: VerticalDatum
    crs: CRS

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.view.image.shape

    def read(self, window: CellWindow, stride: int = 1) -> RayPoints:
        """What every `stride`-th pixel of every `stride`-th row of a window shows. Filled pixels count as empty.

        Raises
        ------
        InputError
            A file can no longer be read.
        """
        part = Window(window.col, window.row, window.cols, window.rows)
        values, quality = (self._read_band(path, part)[::stride, ::stride] for path in (self.path, self.quality_path))
        known = np.isfinite(values) & ((quality & np.uint16(Quality.FILLED)) == 0)
        rows, cols = np.nonzero(known)
        xy = np.column_stack([cols * stride + window.col, rows * stride + window.row]).astype(float)
        near, nearer = self._ground(xy, values[known].astype(float))
        points, towards = np.full((*values.shape, 3), np.nan), np.full((*values.shape, 3), np.nan)
        points[known] = near
        ray = nearer - near
        towards[known] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return RayPoints(points, towards)

    def nearness(self, ground: FloatArray) -> FloatArray:
        """Values (n,) m of ground points (n, 3) m that increase towards the camera along a ray: minus the depth of
        frame cameras, else the height."""
        sensor = bare(self.view.sensor)
        return -sensor.depth(ground) if isinstance(sensor, FrameModel) else ground[:, 2]

    def _ground(self, xy: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ground points (n, 3) m of pixels (n, 2) with their depths or heights, and points nearer to the camera."""
        sensor = self.view.sensor
        if self.is_depth:
            assert isinstance(sensor, FrameModel), "only frame cameras have depths"
            return sensor.ground_at_depth(xy, values), sensor.ground_at_depth(xy, values * (1.0 - NEARER_SHARE))
        if self.vertical_datum.geoid is not None:
            # The undulation is that of the place at the height above the geoid taken as ellipsoidal: some metres beside
            # it, where it differs by a few millimetres at most.
            place = sensor.ground_from_image(xy, values)
            values = values + self.vertical_datum.undulation(place[:, :2], self.crs)
        return sensor.ground_from_image(xy, values), sensor.ground_from_image(xy, values + HIGHER_M)

    @staticmethod
    def _read_band(path: Path, part: Window) -> NDArray[Any]:
        with cached_raster(path) as source:
            return np.asarray(source.read(1, window=part))


def pixels_per_metre(view: View, points: FloatArray) -> FloatArray:
    """Pixels per metre (n,) of a view at ground points (n, 3) m, for lengths perpendicular to the ray: the geometric
    mean of two directions."""
    steps = np.concatenate([np.eye(3), -np.eye(3)]) / 2
    at = [view.sensor.image_from_ground(points + step) for step in steps]
    along_x, along_y = (np.stack([at[k][:, i] - at[k + 3][:, i] for k in range(3)], axis=-1) for i in range(2))
    return np.asarray(np.sqrt(np.linalg.norm(np.cross(along_x, along_y), axis=1)))
