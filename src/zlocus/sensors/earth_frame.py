"""Spaces in which rays are straight: the scene's own frame, or geocentric axes where the scene is a map of the
Earth."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np
from pyproj import CRS, Transformer

from zlocus.core.sensor_model import FloatArray

WGS84 = CRS.from_epsg(4326)
NORTH_STEP_M = 10.0
LATITUDE_ITERATIONS = 3
MAX_ITERATIONS = 20
# Error before the last step; Newton's method squares it.
HEIGHT_TOLERANCE_M = 1e-6


class Space(Protocol):
    """Cartesian axes in which rays are straight, and the conversion to and from the scene's frame."""

    def cartesian_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Points of the scene's frame (n, 3) -> (n, 3) m; NaN where the frame has no coordinates."""
        ...

    def ground_from_cartesian(self, xyz: FloatArray) -> FloatArray:
        """Points (n, 3) m -> (n, 3) in the scene's frame; NaN where the frame has no coordinates."""
        ...

    def meet(self, centre: FloatArray, ray: FloatArray, z: FloatArray) -> FloatArray:
        """Points (n, 3) of the scene's frame where rays first meet heights; NaN where they do not.

        centre : (3,) or (n, 3) m, projection centres; ray : (n, 3), directions of any length; z : (n,) m.
        """
        ...


@dataclass(frozen=True)
class FrameSpace:
    """The scene's own coordinates as Cartesian axes: for local frames, flat maps and rendered scenes."""

    def cartesian_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `Space`."""
        return np.asarray(xyz, float)

    def ground_from_cartesian(self, xyz: FloatArray) -> FloatArray:
        """See `Space`."""
        return np.asarray(xyz, float)

    def meet(self, centre: FloatArray, ray: FloatArray, z: FloatArray) -> FloatArray:
        """See `Space`."""
        with np.errstate(all="ignore"):
            depth = (z - centre[..., 2]) / ray[:, 2]
            xyz = centre + depth[:, None] * ray
        xyz[:, 2] = z
        xyz[~((depth > 0) & np.isfinite(xyz).all(axis=1))] = np.nan
        return np.asarray(xyz)


FRAME_SPACE = FrameSpace()


@lru_cache(maxsize=32)
def between(given: CRS, wanted: CRS) -> Transformer:
    """Transformer from one CRS to another, x or longitude first. It is kept, because building it takes long."""
    return Transformer.from_crs(given, wanted, always_xy=True)


@dataclass(frozen=True)
class EarthSpace:
    """Geocentric axes under a CRS, whose coordinates (with ellipsoidal heights) are converted exactly.

    crs : horizontal, projected in metres or geographic (longitude, latitude in degrees); datum : geographic CRS of the
    axes and of their ellipsoid, None is that of `crs`; axes_m : semi-major and semi-minor axis of the ellipsoid. The x
    axis points to longitude 0 at the equator, z to the north pole, in metres, as EPSG:4978 has them.
    """

    crs: CRS
    datum: CRS | None = None
    _to_geographic: Transformer = field(init=False, repr=False, compare=False)
    axes_m: tuple[float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        flat = self.crs.to_2d()
        geographic = flat.geodetic_crs if self.datum is None else self.datum
        assert geographic is not None, "callers make sure that the CRS has a datum"
        ellipsoid = geographic.ellipsoid
        assert ellipsoid is not None, "callers make sure that the CRS has a datum"
        object.__setattr__(self, "_to_geographic", between(flat, geographic.to_2d()))
        object.__setattr__(self, "axes_m", (ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre))

    def cartesian_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `Space`."""
        xyz = np.asarray(xyz, float)
        lon, lat = self._to_geographic.transform(xyz[:, 0], xyz[:, 1])
        with np.errstate(invalid="ignore"):
            out = self._geocentric(np.deg2rad(lon), np.deg2rad(lat), xyz[:, 2])
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def ground_from_cartesian(self, xyz: FloatArray) -> FloatArray:
        """See `Space`."""
        lon, lat, height = self._geodetic(np.asarray(xyz, float))
        x, y = self._to_geographic.transform(np.rad2deg(lon), np.rad2deg(lat), direction="INVERSE")
        out = np.column_stack([x, y, height])
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def meet(self, centre: FloatArray, ray: FloatArray, z: FloatArray) -> FloatArray:
        """See `Space`; NaN beyond the horizon too."""
        depth = self.depth_at_height(centre, ray, z)
        xyz = self.ground_from_cartesian(centre + depth[:, None] * ray)
        xyz[:, 2] = np.where(np.isnan(xyz[:, 2]), np.nan, z)
        return xyz

    def depth_at_height(self, centre: FloatArray, ray: FloatArray, z: FloatArray) -> FloatArray:
        """Distance from `centre` to the first point of a ray at ellipsoidal height z, in lengths of the ray, (n,).

        centre : (3,) or (n, 3) m, ray : (n, 3), geocentric; z : (n,) m. NaN where a ray does not reach that height
        before the horizon. Newton's method starts where the ray meets an ellipsoid whose axes are longer by z.
        """
        a, b = self.axes_m
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
                step = (z - height) / (ray * vertical(lon, lat)).sum(axis=1)
                depth = depth + step
                if not (np.abs(z - height) > HEIGHT_TOLERANCE_M).any():
                    break
            depth[~((np.abs(z - height) < HEIGHT_TOLERANCE_M) & (depth > 0))] = np.nan
        return np.asarray(depth)

    def geographic_from_cartesian(self, xyz: FloatArray) -> FloatArray:
        """Longitude, latitude (degrees) and ellipsoidal height (m) of geocentric points. (n, 3) m -> (n, 3)."""
        lon, lat, height = self._geodetic(np.asarray(xyz, float))
        return np.column_stack([np.rad2deg(lon), np.rad2deg(lat), height])

    def pose(self, given: CRS, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Geocentric coordinates (3,) m of a point of a map, and the map's axes there, rows (3, 3); see `poses`."""
        centre, axes = self.poses(given, xyz[None])
        return centre[0], axes[0]

    def poses(self, given: CRS, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Geocentric coordinates (n, 3) m of points of a map, and the map's axes there, rows (n, 3, 3).

        given : the map's CRS, projected, of which xyz (n, 3) are coordinates; the axes point to grid east, to grid
        north and up along the normal of the ellipsoid, so that they turn with the meridian convergence.
        """
        to_own = between(given.to_2d(), self.crs.to_2d())
        # Grid north is a direction on the ellipsoid, so it is computed at height 0.
        centre, north, south = (
            self.cartesian_from_ground(np.column_stack([*to_own.transform(xyz[:, 0], xyz[:, 1] + step), height]))
            for step, height in ((0.0, xyz[:, 2]), (NORTH_STEP_M, 0.0 * xyz[:, 2]), (-NORTH_STEP_M, 0.0 * xyz[:, 2]))
        )
        lon, lat, _ = self._geodetic(centre)
        up = vertical(lon, lat)
        towards = north - south
        towards = towards - (towards * up).sum(axis=1, keepdims=True) * up
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        return centre, np.stack([np.cross(towards, up), towards, up], axis=1)

    def _geocentric(self, lon: FloatArray, lat: FloatArray, height: FloatArray) -> FloatArray:
        """Geocentric coordinates (n, 3) m of longitudes and latitudes (radians) and heights (m), (n,) each."""
        a, b = self.axes_m
        normal = a / np.sqrt(1.0 - (1.0 - (b / a) ** 2) * np.sin(lat) ** 2)
        across = (normal + height) * np.cos(lat)
        along = ((b / a) ** 2 * normal + height) * np.sin(lat)
        return np.column_stack([across * np.cos(lon), across * np.sin(lon), along])

    def _geodetic(self, xyz: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Longitude and latitude (radians) and height (m), (n,) each, of geocentric points (n, 3).

        Source: Bowring 1976, Survey Review 23 (181), 323-327; repeated, so that it holds at any height.
        """
        a, b = self.axes_m
        flat, second = 1.0 - (b / a) ** 2, (a / b) ** 2 - 1.0
        across, along = np.hypot(xyz[:, 0], xyz[:, 1]), xyz[:, 2]
        reduced = np.arctan2(a * along, b * across)
        for _ in range(LATITUDE_ITERATIONS):
            lat = np.arctan2(along + second * b * np.sin(reduced) ** 3, across - flat * a * np.cos(reduced) ** 3)
            reduced = np.arctan2(b * np.sin(lat), a * np.cos(lat))
        height = across * np.cos(lat) + along * np.sin(lat) - a * np.sqrt(1.0 - flat * np.sin(lat) ** 2)
        return np.arctan2(xyz[:, 1], xyz[:, 0]), lat, height


# The space of longitudes, latitudes and heights of WGS84: it converts cameras before the scene has a map.
WGS84_EARTH = EarthSpace(WGS84)
MAJOR_M, MINOR_M = WGS84_EARTH.axes_m


def vertical(lon: FloatArray, lat: FloatArray) -> FloatArray:
    """Unit normals of the ellipsoid (n, 3) at longitudes and latitudes (n,) radians."""
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def east_north_up(lon: FloatArray, lat: FloatArray) -> FloatArray:
    """Geocentric from local axes (n, 3, 3) at longitudes and latitudes (n,) radians: columns east, north, up."""
    up = vertical(lon, lat)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    return np.stack([east, np.cross(up, east), up], axis=-1)
