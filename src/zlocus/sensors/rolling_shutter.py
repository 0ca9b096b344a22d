"""Rolling shutter: the motion of a frame camera while the rows of its image are read out one after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from zlocus.core.sensor_model import FloatArray

# Rows farther than this from the middle of the image, by the number of rows, count as read out at this limit. Positions
# so far beyond the image are never used, and the motion would place their camera anywhere.
MAX_ROW_SHARE = 1.0
# A row is found when it changes by less from one iteration to the next. An iteration divides the error by the rows that
# are read while the image moves by one row, which are hundreds for a drone.
ROW_TOLERANCE_PX = 1e-7
MAX_ITERATIONS = 50


@dataclass(frozen=True)
class RollingShutter:
    """Linear motion of a projection centre during the read-out of an image.

    readout_s : time in which all rows are read, from the first to the last; negative where the last row is read first;
    velocity : (3,) m/s of the projection centre, in the axes of the camera's space; rows : of the image. The pose of
    the camera is that of the middle of the image. The attitude does not change.

    Source: the linear model of Vautherin et al. 2016, Photogrammetric accuracy and modeling of rolling shutter cameras,
    ISPRS Annals III-3, 139-146, without its rotation, which a gimbal keeps small.
    """

    readout_s: float
    velocity: tuple[float, float, float]
    rows: int

    def displacement(self, row: FloatArray) -> FloatArray:
        """Motion (n, 3) m of the projection centre from the middle of the image to rows (n,) px."""
        share = np.clip((row - (self.rows - 1) / 2) / self.rows, -MAX_ROW_SHARE, MAX_ROW_SHARE)
        return np.asarray(share[:, None] * (self.readout_s * np.array(self.velocity)))

    def turned(self, rotation: FloatArray) -> RollingShutter:
        """The motion in rotated axes. rotation : (3, 3), new from old axes."""
        x, y, z = (float(v) for v in rotation @ np.array(self.velocity))
        return replace(self, velocity=(x, y, z))

    def image_in_motion(
        self, project: Callable[[FloatArray], FloatArray], ray: FloatArray, nearness: FloatArray | float
    ) -> FloatArray:
        """Image positions (n, 2) px of rays (n, 3) from the projection centre at the middle of the image.

        project : image positions of rays of a camera at rest; nearness : (n,) or one number, by how much a ray changes
        per metre of motion: 1 for rays that end at the ground point, 0 for points infinitely far. The row decides from
        where a point is seen, and from there the point must appear in that row: a fixed point, found by iteration. NaN
        where none is found, because the image moves as fast as the read-out.
        """
        weight = np.broadcast_to(np.asarray(nearness, float), (len(ray),))[:, None]
        xy = project(ray)
        gap = np.full(len(ray), np.inf)
        for _ in range(MAX_ITERATIONS):
            row = xy[:, 1]
            xy = project(ray - weight * self.displacement(row))
            gap = np.abs(xy[:, 1] - row)
            if not (gap > ROW_TOLERANCE_PX).any():
                break
        xy[~(gap <= ROW_TOLERANCE_PX)] = np.nan
        return xy
