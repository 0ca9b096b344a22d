"""A perspective camera with skew fitted to any sensor model over a window of its image and a range of heights.

A satellite image is no perspective view: its rows are taken one after the other. Over a few kilometres the view of a
camera far above is so near to it that programs for photographs can use the image (Zhang, Snavely and Sun 2019,
"Leveraging vision reconstruction pipelines for satellite imagery", ICCV workshops, section 3). They fit all eleven
numbers of a projection matrix. Here the optical axis lies along the line of sight, which leaves nine: rays that are
nearly parallel let it turn far away, where it gains a few hundredths of a pixel at most (0.12 px in place of 0.12 px
for 500 px of Pleiades, 0.06 px in place of 0.10 px for 800 px of WorldView-3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.sensors.earth_frame import FRAME_SPACE
from zlocus.sensors.frame import FrameModel, as_row, as_rows
from zlocus.sensors.local_frame import LocalFrame

# Points along each side of the window, and heights, of the fit. It is judged at twice as many.
GRID_POINTS, GRID_HEIGHTS = 13, 5
# The projection centre is at most so far from the ground, m: no camera that looks at the Earth is much farther. Nearer
# than this many times the extent of the ground it would see no parallel rays.
MAX_DISTANCE_M, MIN_DISTANCE_EXTENTS = 1e6, 4.0


@dataclass(frozen=True)
class FitError:
    """Distance between the image positions of a camera that is written and those of the sensor, px."""

    max_px: float
    rms_px: float

    @classmethod
    def of(cls, difference: FloatArray) -> FitError:
        """Of differences (n, 2) px; infinite where one is NaN."""
        away = np.hypot(*difference.T)
        if not len(away) or np.isnan(away).any():
            return cls(np.inf, np.inf)
        return cls(float(away.max()), float(np.sqrt((away**2).mean())))

    def as_dict(self) -> dict[str, float]:
        """Both numbers for a record."""
        return {"max_px": round(self.max_px, 4), "rms_px": round(self.rms_px, 4)}


@dataclass(frozen=True)
class PerspectiveFit:
    """A perspective camera in a local frame. sensor : of the whole image, without its window's offset; fit_error : over
    the pixels of the window at all heights."""

    sensor: FrameModel
    fit_error: FitError


@dataclass(frozen=True)
class PixelPart:
    """A part of an image. The first column and row, and how many there are."""

    col: int
    row: int
    cols: int
    rows: int

    def grid(self, per_side: int) -> FloatArray:
        """Image positions (n, 2) px of a grid over all of its pixels, edges included."""
        cols = np.linspace(self.col - 0.5, self.col + self.cols - 0.5, per_side)
        rows = np.linspace(self.row - 0.5, self.row + self.rows - 0.5, per_side)
        return np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)


def fit_perspective(
    sensor: SensorModel, frame: LocalFrame, part: PixelPart, heights: tuple[float, float]
) -> PerspectiveFit:
    """Fit a perspective camera with skew to a sensor over a part of its image and a range of heights (m).

    Raises
    ------
    GeometryError
        The sensor does not map all of the part, or the image is a mirror image of the ground.
    """
    xy, local = correspondences(sensor, frame, part, heights, GRID_POINTS, GRID_HEIGHTS)
    if not np.isfinite(local).all():
        raise GeometryError("The sensor model does not map all of the area at all heights. Give a smaller --bounds.")
    matrix = _projection(xy, local)
    fitted = _camera(matrix)
    xy, local = correspondences(sensor, frame, part, heights, 2 * GRID_POINTS, GRID_HEIGHTS + 1)
    return PerspectiveFit(fitted, FitError.of(fitted.image_from_ground(local) - xy))


def correspondences(
    sensor: SensorModel, frame: LocalFrame, part: PixelPart, heights: tuple[float, float], per_side: int, n_heights: int
) -> tuple[FloatArray, FloatArray]:
    """Image positions (n, 2) px over a part of an image and, in local axes, the points (n, 3) m that they show at some
    heights (m)."""
    at = part.grid(per_side)
    xy = np.tile(at, (n_heights, 1))
    ground = sensor.ground_from_image(xy, np.repeat(np.linspace(*heights, n_heights), len(at)))
    return xy, frame.local_from_ground(ground)


def without_skew(sensor: FrameModel, part: PixelPart) -> tuple[FrameModel, tuple[int, int]]:
    """A camera without skew that shows the pixels of a part of an image, and the rows and columns of its image.

    Rows of its image are those of the part, each shifted so that skew is gone.
    """
    plain = replace(sensor, skew=0.0)
    corners = plain.image_from_ray(sensor.ray_from_image(part.grid(2)))
    low, high = np.floor(corners.min(axis=0) + 0.5), np.ceil(corners.max(axis=0) - 0.5)
    low[1], high[1] = part.row, part.row + part.rows - 1
    return plain.moved(-float(low[0]), -float(low[1])), (int(high[1] - low[1]) + 1, int(high[0] - low[0]) + 1)


def _projection(xy: FloatArray, local: FloatArray) -> FloatArray:
    """Projection matrix (3, 4) from local points to pixels; its last row is the depth over that of the middle point."""
    middle = local.mean(axis=0)
    away = local - middle
    extent = float(np.abs(away).max())
    # The affine view tells the line of sight: the direction that it does not see.
    affine = np.linalg.lstsq(np.column_stack([away, np.ones(len(away))]), xy, rcond=None)[0]
    forwards = np.cross(affine[:3, 0], affine[:3, 1])
    forwards /= np.linalg.norm(forwards)
    if forwards[2] > 0:
        raise GeometryError("The image is a mirror image of the ground, which no camera takes. Check its RPC.")

    def solved(log_distance: float) -> tuple[FloatArray, FloatArray, float]:
        """Row of depths, the other two rows, and the sum of squares, for a distance of the projection centre."""
        depth_row = forwards / np.exp(log_distance)
        depth = 1.0 + away @ depth_row
        design = np.column_stack([away / extent, np.ones(len(away))]) / depth[:, None]
        rows = np.linalg.lstsq(design, xy, rcond=None)[0]
        return depth_row, rows, float(((design @ rows - xy) ** 2).sum())

    nearest = MIN_DISTANCE_EXTENTS * extent
    limits = np.log([nearest, max(MAX_DISTANCE_M, 2.0 * nearest)])
    found = minimize_scalar(lambda given: solved(given)[2], bounds=tuple(limits), method="bounded")
    depth_row, rows, _ = solved(float(found.x))
    matrix = np.empty((3, 4))
    matrix[:2, :3], matrix[:2, 3], matrix[2, :3], matrix[2, 3] = rows[:3].T / extent, rows[3], depth_row, 1.0
    matrix[:, 3] -= matrix[:, :3] @ middle
    return matrix


def _camera(matrix: FloatArray) -> FrameModel:
    """The frame camera of a projection matrix (3, 4) whose third row grows away from the camera."""
    first, second, third = matrix[:, :3] / np.linalg.norm(matrix[2, :3])
    row, column = float(second @ third), float(first @ third)
    down = np.asarray(second - row * third, float)
    focal_down = float(np.linalg.norm(down))
    down /= focal_down
    right = np.cross(down, third)
    centre = np.asarray(-np.linalg.solve(matrix[:, :3], matrix[:, 3]), float)
    focal = float(first @ right)
    return FrameModel(
        as_row(centre), as_rows(np.stack([right, down, third])), focal, (column, row), focal_down / focal,
        float(first @ down), space=FRAME_SPACE,
    )  # fmt: skip
