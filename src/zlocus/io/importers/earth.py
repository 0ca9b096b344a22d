"""Convert poses in geocentric axes, as some programs store them, to poses in a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.quoting import quoted
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import checked_crs, utm_zone
from zlocus.sensors.earth_frame import EarthSpace, between


@dataclass(frozen=True)
class MapPoses:
    """Exact conversion of poses from geocentric axes of one datum to a map.

    earth : of the geographic CRS to which the axes belong; target : CRS of the map, projected in metres.
    """

    earth: EarthSpace
    target: CRS

    def pose(self, centre: FloatArray, rotation: FloatArray, path: Path, where: str) -> tuple[FloatArray, FloatArray]:
        """The projection centre (3,) in the map, and the camera's axes (3, 3) relative to those of the map there.

        centre, rotation : geocentric; path, where : for messages.

        Raises
        ------
        InputError
            The map has no such place.
        """
        lon, lat, height = self.earth.ground_from_cartesian(centre[None])[0]
        position = np.array([*between(self.earth.crs, self.target).transform(lon, lat), height])
        if not np.isfinite(position).all():
            raise InputError(
                f"{path}: {quoted(where)} is at longitude {lon:.6g}, latitude {lat:.6g}, which is no place in "
                f"{self.target.to_string()}. Give another --crs."
            )
        _, axes = self.earth.pose(self.target, position)
        return position, np.asarray(rotation @ axes.T)


def map_poses(geographic: CRS, crs: str | None, centre: FloatArray) -> MapPoses:
    """The conversion to a map. crs : of the map; None: the UTM zone of `centre`.

    centre : (3,), geocentric in the datum of `geographic`.

    Raises
    ------
    ConfigError
        `crs` is no CRS, or is not projected in metres.
    """
    earth = EarthSpace(geographic.to_2d())
    if crs is None:
        lon, lat, _ = earth.ground_from_cartesian(centre[None])[0]
        return MapPoses(earth, utm_zone(float(lon), float(lat)))
    return MapPoses(earth, parsed_crs(crs))


def parsed_crs(crs: str) -> CRS:
    """The CRS that --crs names.

    Raises
    ------
    ConfigError
        It is no CRS, or is not projected in metres.
    """
    try:
        return checked_crs(CRS.from_user_input(crs))
    except CRSError as error:
        raise ConfigError(f"--crs {crs} is no CRS. Write it as EPSG:n.") from error


def scene_file_crs(crs: CRS) -> str:
    """The name of a CRS in a scene file: authority and number, or its WKT."""
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else crs.to_wkt()
