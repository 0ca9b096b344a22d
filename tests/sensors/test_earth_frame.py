"""The curved Earth: against PROJ's own geocentric conversion, and what a map's axes are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Proj, Transformer

from zlocus.sensors.earth_frame import EarthSpace

SAME_M = 2e-8
# PROJ's own inverse of the polar stereographic projection is no better.
THERE_AND_BACK_M = 5e-7
# Above the ellipsoid a conformal map is not quite: its scale falls with height by the two radii of curvature.
CONFORMAL_RAD = 2e-7
CASES = (
    (32631, (420_000.0, 4_790_000.0, 1500.0)),
    (32733, (690_000.0, 6_240_000.0, 300.0)),
    (2154, (700_000.0, 6_600_000.0, 12_000.0)),
    (3413, (150_000.0, -1_200_000.0, 2000.0)),
)
each = pytest.mark.parametrize(("epsg", "at"), CASES, ids=[str(c[0]) for c in CASES])


def proj_geocentric(epsg, xyz):
    """PROJ's pipeline: the map's inverse, then `cart`."""
    crs = CRS.from_epsg(epsg)
    lon, lat = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    a, b = crs.ellipsoid.semi_major_metre, crs.ellipsoid.semi_minor_metre
    cart = Transformer.from_pipeline(f"+proj=cart +a={a!r} +b={b!r}")
    return np.column_stack(cart.transform(np.asarray(lon), np.asarray(lat), xyz[:, 2], radians=False))


def spread(at, n=50, m=20_000.0):
    rng = np.random.default_rng(0)
    return np.array(at) + rng.uniform(-1, 1, (n, 3)) * [m, m, 1000.0]


@each
def test_agrees_with_proj(epsg, at):
    xyz = spread(at)
    here = EarthSpace(CRS.from_epsg(epsg)).cartesian_from_ground(xyz)
    np.testing.assert_allclose(here, proj_geocentric(epsg, xyz), rtol=0, atol=SAME_M)


@each
def test_there_and_back(epsg, at):
    earth, xyz = EarthSpace(CRS.from_epsg(epsg)), spread(at)
    np.testing.assert_allclose(
        earth.ground_from_cartesian(earth.cartesian_from_ground(xyz)), xyz, rtol=0, atol=THERE_AND_BACK_M
    )


@each
def test_axes_of_the_map(epsg, at):
    """Right-handed; up is the normal, and east and north are where the map's coordinates grow, at its own scale."""
    earth = EarthSpace(CRS.from_epsg(epsg))
    centre, axes = earth.pose(earth.crs, np.array(at))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-14)
    moved = earth.cartesian_from_ground(np.array(at) + 100.0 * np.vstack([np.eye(3), -np.eye(3)]))
    towards = (moved[:3] - moved[3:]) / 200.0
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    np.testing.assert_allclose(towards, axes, atol=CONFORMAL_RAD)
    np.testing.assert_allclose(centre, earth.cartesian_from_ground(np.array([at]))[0])


def test_grid_north_turns_with_the_convergence():
    crs, at = CRS.from_epsg(32631), np.array([700_000.0, 5_500_000.0, 0.0])
    earth = EarthSpace(crs)
    _, axes = earth.pose(crs, at)
    lon, lat = Transformer.from_crs(crs, 4326, always_xy=True).transform(*at[:2])
    s, c = np.sin(np.deg2rad([lon, lat])), np.cos(np.deg2rad([lon, lat]))
    east, north = np.array([-s[0], c[0], 0.0]), np.array([-s[1] * c[0], -s[1] * s[0], c[1]])
    convergence = np.rad2deg(np.arctan2(axes[0] @ north, axes[0] @ east))
    assert convergence == pytest.approx(-Proj(crs).get_factors(lon, lat).meridian_convergence, abs=1e-7)


def test_a_pose_given_in_another_map():
    utm, lambert = CRS.from_epsg(32631), CRS.from_epsg(2154)
    at = np.array([420_000.0, 5_000_000.0, 800.0])
    x, y = Transformer.from_crs(utm, lambert, always_xy=True).transform(*at[:2])
    there, axes = EarthSpace(lambert).pose(utm, at)
    here, same = EarthSpace(utm).pose(utm, at)
    np.testing.assert_allclose(there, here, atol=1e-3)  # WGS84 and GRS80 differ by a tenth of a millimetre
    np.testing.assert_allclose(axes, same, atol=1e-9)
    np.testing.assert_allclose(EarthSpace(lambert).ground_from_cartesian(there[None]), [[x, y, 800.0]], atol=1e-6)


@given(st.floats(-75.0, 75.0), st.floats(0.0, 360.0), st.floats(10.0, 9000.0), st.floats(-100.0, 3000.0))
def test_rays_come_to_their_height(tilt, heading, above, z):
    earth = EarthSpace(CRS.from_epsg(32631))
    centre, axes = earth.pose(earth.crs, np.array([420_000.0, 4_790_000.0, z + above]))
    t, h = np.deg2rad([tilt, heading])
    ray = np.array([[np.sin(t) * np.cos(h), np.sin(t) * np.sin(h), -np.cos(t)]]) @ axes
    depth = earth.depth_at_height(centre, ray, np.array([z]))
    ground = earth.ground_from_cartesian(centre + depth[:, None] * ray)
    assert ground[0, 2] == pytest.approx(z, abs=1e-6)
    assert depth[0] == pytest.approx(above / np.cos(t), rel=0.05)


def test_rays_that_miss_the_height():
    earth = EarthSpace(CRS.from_epsg(32631))
    centre, (east, _, up) = earth.pose(earth.crs, np.array([420_000.0, 4_790_000.0, 1000.0]))
    ray = np.array([up, -up, east, -up, up, up * np.nan])
    depth = earth.depth_at_height(centre, ray, np.array([500.0, 500.0, 500.0, 1500.0, 1500.0, 500.0]))
    np.testing.assert_allclose(depth, [np.nan, 500.0, np.nan, np.nan, 500.0, np.nan], atol=1e-6)


def test_points_no_map_has_are_nothing():
    earth = EarthSpace(CRS.from_epsg(32631))
    assert np.isnan(earth.cartesian_from_ground(np.array([[1e9, 1e9, 0.0], [np.nan, 0.0, 0.0]]))).all()
    assert np.isnan(earth.ground_from_cartesian(np.array([[np.nan, 0.0, 0.0]]))).all()
