"""Poses in geocentric axes, as other programs hold them, as poses in a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import checked_crs, utm_zone
from zlocus.io.safe_text import quoted
from zlocus.sensors.earth_frame import EarthSpace, between


@dataclass(frozen=True)
class MapPoses:
    """From geocentric axes of one datum to a map, exactly.

    earth : of the geographic CRS that the axes belong to; target : the map, projected in metres.
    """

    earth: EarthSpace
    target: CRS

    def pose(self, centre: FloatArray, rotation: FloatArray, path: Path, where: str) -> tuple[FloatArray, FloatArray]:
        """The centre in the map, (3,), and the camera's axes relative to the map's there, (3, 3).

        Raises
        ------
        InputError
            For a place that the map does not have.
        """
        lon, lat, height = self.earth.ground_from_cartesian(centre[None])[0]
        found = np.array([*between(self.earth.crs, self.target).transform(lon, lat), height])
        if not np.isfinite(found).all():
            raise InputError(
                f"{path}: {quoted(where)} is at longitude {lon:.6g}, latitude {lat:.6g}, which is no place in "
                f"{self.target.to_string()}. Give another --crs."
            )
        _, axes = self.earth.pose(self.target, found)
        return found, np.asarray(rotation @ axes.T)


def map_poses(geographic: CRS, crs: str | None, centre: FloatArray) -> MapPoses:
    """The map asked for, else the UTM zone of `centre` (3,), geocentric in the datum of `geographic`.

    Raises
    ------
    ConfigError
        For a CRS that is none, or is not projected in metres.
    """
    earth = EarthSpace(geographic.to_2d())
    if crs is None:
        lon, lat, _ = earth.ground_from_cartesian(centre[None])[0]
        return MapPoses(earth, utm_zone(float(lon), float(lat)))
    return MapPoses(earth, parsed_crs(crs))


def parsed_crs(crs: str) -> CRS:
    """The map that --crs names."""
    try:
        return checked_crs(CRS.from_user_input(crs))
    except CRSError as error:
        raise ConfigError(f"--crs {crs} is no CRS. Write it as EPSG:n.") from error


def scene_file_crs(crs: CRS) -> str:
    """How a scene file names a CRS: by authority and number, else in full."""
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else crs.to_wkt()
