"""Cartesian axes near the ground for other programs, which know neither maps nor the curved Earth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pyproj import CRS

from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.earth_frame import FRAME_SPACE, EarthSpace, Space, east_north_up
from zlocus.sensors.frame import FrameModel, as_row, as_rows
from zlocus.sensors.rolling_shutter import RollingShutter


@dataclass(frozen=True)
class LocalFrame:
    """Cartesian axes in metres with their origin near the ground, in which rays are straight.

    crs : of the scene; space : the axes in which `origin` (3,) m and the rows of `axes` (3, 3) are given; ground :
    (3,) the origin in the scene's frame.
    """

    crs: CRS
    space: Space
    origin: tuple[float, float, float]
    axes: tuple[tuple[float, float, float], ...]
    ground: tuple[float, float, float]

    @classmethod
    def tangent(cls, crs: CRS, ground: FloatArray) -> LocalFrame:
        """East, north and up at a ground point (3,) of a map. Rays of sensors over the curved Earth stay straight."""
        earth = EarthSpace(crs)
        origin = earth.cartesian_from_ground(ground[None])
        lon, lat, _ = np.deg2rad(earth.geographic_from_cartesian(origin)[0])
        axes = east_north_up(np.array([lon]), np.array([lat]))[0].T
        return cls(crs, earth, as_row(origin[0]), as_rows(axes), as_row(ground))

    @classmethod
    def shifted(cls, crs: CRS, ground: FloatArray) -> LocalFrame:
        """The scene's own axes with their origin at a ground point (3,), for frames that are Cartesian themselves."""
        return cls(crs, FRAME_SPACE, as_row(ground), as_rows(np.eye(3)), as_row(ground))

    def local_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Local coordinates (n, 3) m of ground points (n, 3) m."""
        return np.asarray((self.space.cartesian_from_ground(xyz) - np.array(self.origin)) @ np.array(self.axes).T)

    def ground_from_local(self, xyz: FloatArray) -> FloatArray:
        """Ground points (n, 3) m of local coordinates (n, 3) m."""
        return self.space.ground_from_cartesian(np.array(self.origin) + np.asarray(xyz, float) @ np.array(self.axes))

    def camera(self, sensor: FrameModel) -> FrameModel | None:
        """A frame camera in local axes, exactly; None where its rays are straight in other axes than these."""
        if sensor.space != self.space:
            return None
        axes = np.array(self.axes)
        centre = (np.array(sensor.centre) - np.array(self.origin)) @ axes.T
        shutter: RollingShutter | None = sensor.rolling_shutter
        return replace(
            sensor, centre=as_row(centre), camera_from_ground=as_rows(sensor.rotation @ axes.T), space=FRAME_SPACE,
            rolling_shutter=None if shutter is None else shutter.turned(axes),
        )  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """The axes for a record, with the affine map that leads back from them."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.array(self.axes).T, self.origin
        on_earth = isinstance(self.space, EarthSpace)
        kind = "east, north, up" if on_earth else "axes of the scene's frame, shifted"
        record: dict[str, Any] = {"axes": kind, "crs": None if is_local(self.crs) else self.crs.to_string()}
        record["origin_in_crs"] = list(self.ground)
        if isinstance(self.space, EarthSpace):
            lon, lat, height = self.space.geographic_from_cartesian(np.array([self.origin]))[0]
            record["origin"] = {"longitude_deg": lon, "latitude_deg": lat, "ellipsoidal_height_m": height}
        record["geocentric_from_local" if on_earth else "crs_from_local"] = matrix.tolist()
        return record
