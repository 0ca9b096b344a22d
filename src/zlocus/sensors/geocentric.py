"""The curved Earth: ground points of a map as geocentric Cartesian ones, in which light runs straight."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from pyproj import CRS, Transformer

from zlocus.sensors.model import FloatArray

NORTH_STEP_M = 10.0
LATITUDE_ITERATIONS = 3
MAX_ITERATIONS = 20
# Before the last step, which squares what is missing.
HEIGHT_TOLERANCE_M = 1e-6


@lru_cache(maxsize=32)
def between(given: CRS, wanted: CRS) -> Transformer:
    """Coordinates of one CRS as those of another, x or longitude first. Made once: it takes longer than many points."""
    return Transformer.from_crs(given, wanted, always_xy=True)


@dataclass(frozen=True)
class Geocentric:
    """Geocentric axes of the ellipsoid of a CRS, whose coordinates (with ellipsoidal heights) are converted exactly.

    crs : horizontal, projected in metres or geographic (longitude, latitude in degrees); axes : x towards longitude 0
    at the equator, z towards the north pole, in metres, as EPSG:4978 has them.
    """

    crs: CRS
    _to_geographic: Transformer = field(init=False, repr=False, compare=False)
    _axes: tuple[float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        flat = self.crs.to_2d()
        geographic, ellipsoid = flat.geodetic_crs, flat.ellipsoid
        assert geographic is not None, "callers make sure that the CRS has a datum"
        assert ellipsoid is not None, "callers make sure that the CRS has a datum"
        object.__setattr__(self, "_to_geographic", between(flat, geographic.to_2d()))
        object.__setattr__(self, "_axes", (ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre))

    def geocentric_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Geocentric points of ground points. (n, 3) -> (n, 3) m; NaN outside of what the CRS can express."""
        xyz = np.asarray(xyz, float)
        lon, lat = self._to_geographic.transform(xyz[:, 0], xyz[:, 1])
        with np.errstate(invalid="ignore"):
            out = self._geocentric(np.deg2rad(lon), np.deg2rad(lat), xyz[:, 2])
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def ground_from_geocentric(self, xyz: FloatArray) -> FloatArray:
        """Ground points of geocentric points. (n, 3) m -> (n, 3); NaN outside of what the CRS can express."""
        lon, lat, height = self._geodetic(np.asarray(xyz, float))
        x, y = self._to_geographic.transform(np.rad2deg(lon), np.rad2deg(lat), direction="INVERSE")
        out = np.column_stack([x, y, height])
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def depth_at_height(self, centre: FloatArray, ray: FloatArray, z: FloatArray) -> FloatArray:
        """How many times `ray` it is from `centre` to the first point at ellipsoidal height z, (n,).

        centre : (3,) m, ray : (n, 3), geocentric; z : (n,) m. NaN where a ray does not come to that height before the
        horizon. From where it meets the ellipsoid that is larger by z all around, by Newton.
        """
        a, b = self._axes
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            squeeze = 1.0 / np.column_stack([a + z, a + z, b + z])
            c, r = centre * squeeze, ray * squeeze
            rr, rc, cc = (r * r).sum(axis=1), (r * c).sum(axis=1), (c * c).sum(axis=1) - 1.0
            root = np.sqrt(rc * rc - rr * cc)
            # From above the first of both crossings, in the form that loses no digits; from below, the way up.
            depth = np.where(cc > 0, cc / (root - rc), np.where(rc > 0, -cc / (root + rc), np.nan))
            depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
            for _ in range(MAX_ITERATIONS):
                lon, lat, height = self._geodetic(centre + depth[:, None] * ray)
                step = (z - height) / (ray * _up(lon, lat)).sum(axis=1)
                depth = depth + step
                if not (np.abs(z - height) > HEIGHT_TOLERANCE_M).any():
                    break
            depth[~((np.abs(z - height) < HEIGHT_TOLERANCE_M) & (depth > 0))] = np.nan
        return np.asarray(depth)

    def pose(self, given: CRS, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A point of a map as a geocentric one, (3,) m, and the map's axes there, rows (3, 3).

        given : the map's CRS, of which xyz (3,) are coordinates; the axes point to grid east, to grid north and up
        along the normal of the ellipsoid, so that they turn with the meridian convergence.
        """
        to_own = between(given.to_2d(), self.crs.to_2d())
        y = xyz[1] + NORTH_STEP_M * np.array([0.0, 1.0, -1.0])
        # North is that of the map, which lies on the ellipsoid.
        points = np.column_stack([*to_own.transform(np.full(3, xyz[0]), y), [xyz[2], 0.0, 0.0]])
        centre, north, south = self.geocentric_from_ground(points)
        lon, lat, _ = self._geodetic(centre[None])
        up = _up(lon, lat)[0]
        towards = north - south - ((north - south) @ up) * up
        towards /= np.linalg.norm(towards)
        return centre, np.stack([np.cross(towards, up), towards, up])

    def _geocentric(self, lon: FloatArray, lat: FloatArray, height: FloatArray) -> FloatArray:
        """(n, 3) m of longitude and latitude (radians) and height, (n,) each."""
        a, b = self._axes
        normal = a / np.sqrt(1.0 - (1.0 - (b / a) ** 2) * np.sin(lat) ** 2)
        across = (normal + height) * np.cos(lat)
        along = ((b / a) ** 2 * normal + height) * np.sin(lat)
        return np.column_stack([across * np.cos(lon), across * np.sin(lon), along])

    def _geodetic(self, xyz: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Longitude and latitude (radians) and height (m), (n,) each, of geocentric points (n, 3).

        Source: Bowring 1976, Survey Review 23 (181), 323-327; repeated, so that it holds at any height.
        """
        a, b = self._axes
        flat, second = 1.0 - (b / a) ** 2, (a / b) ** 2 - 1.0
        across, along = np.hypot(xyz[:, 0], xyz[:, 1]), xyz[:, 2]
        reduced = np.arctan2(a * along, b * across)
        for _ in range(LATITUDE_ITERATIONS):
            lat = np.arctan2(along + second * b * np.sin(reduced) ** 3, across - flat * a * np.cos(reduced) ** 3)
            reduced = np.arctan2(b * np.sin(lat), a * np.cos(lat))
        height = across * np.cos(lat) + along * np.sin(lat) - a * np.sqrt(1.0 - flat * np.sin(lat) ** 2)
        return np.arctan2(xyz[:, 1], xyz[:, 0]), lat, height


def _up(lon: FloatArray, lat: FloatArray) -> FloatArray:
    """(n, 3) unit normals of the ellipsoid at longitudes and latitudes (radians)."""
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
