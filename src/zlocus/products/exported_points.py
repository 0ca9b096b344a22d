"""Tie points in the local frame of an export, with the positions at which the images that are written show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.triangulate import Observations
from zlocus.products.exported_images import ExportedView, colours_of_points
from zlocus.sensors.local_frame import LocalFrame

# A point is in a model where so many images show it.
MIN_IMAGES = 2


@dataclass(frozen=True)
class ExportedPoints:
    """Tie points for other programs.

    xyz : (n, 3) m, local; rgb : (n, 3) uint8; error_px : (n,) mean distance of the observations from where the cameras
    that are written see the point; observations : in the images that are written, whose views are numbered as these.
    """

    xyz: FloatArray
    rgb: NDArray[np.uint8]
    error_px: FloatArray
    observations: Observations

    def __len__(self) -> int:
        return len(self.xyz)


def exported_points(
    orientation: Orientation, exported_views: Sequence[ExportedView], names: Sequence[str], frame: LocalFrame
) -> ExportedPoints:
    """The tie points that two exported images or more show. names : of the scene's views, in the order of its ties."""
    seen, xyz = orientation.observations, frame.local_from_ground(orientation.xyz)
    number = np.full(len(names), -1)
    for k, exported in enumerate(exported_views):
        number[list(names).index(exported.view.name)] = k
    view, xy = number[seen.view], np.full(seen.xy.shape, np.nan)
    inside, away = np.zeros(len(view), bool), np.full(len(view), np.nan)
    for k, exported in enumerate(exported_views):
        mine = np.flatnonzero(view == k)
        xy[mine] = exported.written_from_source(seen.xy[mine])
        with np.errstate(invalid="ignore"):
            limits = np.array(exported.shape[::-1]) - 0.5
            inside[mine] = ((xy[mine] >= -0.5) & (xy[mine] <= limits)).all(axis=1)
        away[mine] = np.hypot(*(exported.sensor.image_from_ground(xyz[seen.point[mine]]) - xy[mine]).T)
    kept = inside & np.isfinite(away)
    kept &= np.bincount(seen.point[kept], minlength=len(xyz))[seen.point] >= MIN_IMAGES
    points, point = np.unique(seen.point[kept], return_inverse=True)
    observations = Observations(view[kept], point, xy[kept])
    first = np.unique(point, return_index=True)[1]
    rgb = colours_of_points([each.view for each in exported_views], view[kept][first], seen.xy[kept][first])
    counts = np.maximum(np.bincount(point, minlength=len(points)), 1)
    error_px = np.bincount(point, away[kept], minlength=len(points)) / counts
    return ExportedPoints(xyz[points], rgb, error_px, observations)
