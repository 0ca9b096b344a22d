"""What occludes a ground point from a sensor: the place of the surface that an image shows in its stead."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from zlocus.core.sensor_model import FloatArray, SensorModel

# Points of a ray that are computed; others lie on straight lines between them.
NODES = 9
# Cells between the places at which a ray is compared with the surface, and at how many places at most.
STEP_CELLS, MAX_PLACES = 0.5, 20_000
# Heights (n,) m of the surface at ground points (n, 2) m, NaN where it has none.
HeightsAt = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Occluder:
    """The surface between a ground point and a sensor.

    xyz : (3,) m, the place that the image shows in the stead of the point; distance_m : how far away it is, on the map;
    lowest_visible_m : the lowest height, above the same place, that the sensor sees past the surface.
    """

    xyz: FloatArray
    distance_m: float
    lowest_visible_m: float


def occluder_of(
    sensor: SensorModel, xyz: FloatArray, heights_at: HeightsAt, top_m: float, cell_m: float, margin_m: float = 0.0
) -> Occluder | None:
    """What occludes a ground point from a sensor; None where no surface stands above its ray by more than a margin.

    xyz : (3,) m; heights_at : see `HeightsAt`; top_m : no surface is higher; cell_m : side of the surface's cells;
    margin_m : see `cost.occlusion_margin_steps`. The lowest visible height is that of `occlusion.mark_occlusions`: the
    largest height of the surface along the ray, less what the ray has risen by there.
    """
    if not top_m > xyz[2]:
        return None
    xy, at_nodes = sensor.image_from_ground(xyz[None]), np.linspace(0.0, 1.0, NODES)
    nodes = sensor.ground_from_image(np.broadcast_to(xy, (NODES, 2)), xyz[2] + (top_m - xyz[2]) * at_nodes)
    length = float(np.hypot(*(nodes[-1] - xyz)[:2]))
    if not math.isfinite(length) or length == 0:
        return None
    n = min(math.ceil(length / (STEP_CELLS * cell_m)), MAX_PLACES)
    ray = np.column_stack([np.interp(np.arange(1, n + 1) / n, at_nodes, values) for values in nodes.T])
    # The cell itself does not occlude its middle.
    ray = ray[np.abs(ray[:, :2] - xyz[:2]).max(axis=1) > cell_m / 2]
    excess = heights_at(ray[:, :2]) - ray[:, 2]
    above = np.flatnonzero(excess > margin_m)
    if not len(above):
        return None
    shown = ray[above[-1]].copy()
    shown[2] += excess[above[-1]]
    distance_m = float(np.hypot(*(shown - xyz)[:2]))
    return Occluder(shown, distance_m, float(xyz[2] + excess[above].max()))
