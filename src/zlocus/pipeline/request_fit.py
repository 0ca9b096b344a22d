"""Refuses requests that do not fit the images, and says which of their values is wrong."""

from __future__ import annotations

import math

from pyproj import Transformer
from pyproj.exceptions import ProjError

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.footprints import Bounds, views_near
from zlocus.core.scene import Scene, is_local
from zlocus.core.sensor_model import Tabulated, bare
from zlocus.pipeline.height_range import possible_heights

LARGEST_LONGITUDE, LARGEST_LATITUDE = 360.0, 90.0


def check_bounds_in_metres(bounds: Bounds | None, scene: Scene) -> None:
    """Refuse bounds in degrees, and say what they are in the frame of the scene.

    Raises
    ------
    ConfigError
        The bounds can be degrees, and as such they lie on the ground that the images show.
    """
    if bounds is None or is_local(scene.crs):
        return
    west, south, east, north = bounds
    if max(abs(west), abs(east)) > LARGEST_LONGITUDE or max(abs(south), abs(north)) > LARGEST_LATITUDE:
        return
    try:
        heights = possible_heights(scene, scene.heights)
        in_frame = Transformer.from_crs("EPSG:4326", scene.crs, always_xy=True).transform_bounds(*bounds)
    except (GeometryError, ProjError):
        return
    if not all(map(math.isfinite, in_frame)) or not views_near(scene.views, in_frame, (heights[0], heights[-1])):
        return
    given, needed = (" ".join(f"{value:.12g}" for value in each) for each in (bounds, map(round, in_frame)))
    raise ConfigError(
        f"--bounds {given} are degrees, and bounds are in metres of the result's CRS ({scene.crs.name}). Give --bounds "
        f"{needed}."
    )


def check_heights_of_cameras(heights: tuple[float, float] | None, scene: Scene) -> None:
    """Refuse heights (m, ellipsoidal) at which the cameras of all images mean nothing, or one of them maps nothing.

    Raises
    ------
    GeometryError
        They lie outside the heights of all cameras that have such limits, or reach beyond a table.
    """
    if heights is None:
        return
    limits = [found for view in scene.views if (found := view.sensor.height_bounds()) is not None]
    asked = f"The heights asked for, {heights[0]:.6g} to {heights[1]:.6g} m,"
    if len(limits) == len(scene.views):
        low, high = min(limit[0] for limit in limits), max(limit[1] for limit in limits)
        if heights[0] > high or heights[1] < low:
            raise GeometryError(
                f"{asked} lie outside those of the images' cameras, {low:.6g} to {high:.6g} m. Give --heights that "
                "contain the ground, or leave it out."
            )
    for view in scene.views:
        sensor = bare(view.sensor)
        if isinstance(sensor, Tabulated):
            low, high = sensor.height_limits()
            if heights[0] < low or heights[1] > high:
                raise GeometryError(
                    f"{asked} reach beyond the location grid of {view.name}, which maps {low:.6g} to {high:.6g} m. "
                    "Give --heights inside of these, or a grid of more heights."
                )
