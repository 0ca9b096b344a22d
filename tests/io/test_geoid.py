"""Undulations compared with values computed by hand and with those of PROJ."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from rasterio.transform import from_origin

from geoids import around_the_earth, write_geoid, write_proj_grid
from rpc_fixtures import write_image
from zlocus.core.errors import InputError
from zlocus.io.geoid import GeoidRaster

WGS84, UTM31 = CRS.from_epsg(4326), CRS.from_epsg(32631)
# PROJ interpolates float32 posts; a tenth of a millimetre is far below what geoids are known to.
AS_PROJ_M = 1e-4
EXACT_M = 1e-9
POSTS = np.array([[50.0, 51.0, 53.0], [52.0, 54.0, 57.0]], np.float32)


def small(folder, posts=POSTS, **profile):
    """Posts at 5, 5.25 and 5.5 degrees east, 44 and 43.75 north."""
    return GeoidRaster.open(write_geoid(folder / "g.tif", posts, from_origin(4.875, 44.125, 0.25, 0.25), **profile))


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    return GeoidRaster.open(write_proj_grid(tmp_path_factory.mktemp("world") / "world.tif"))


def by_proj(path, lon, lat):
    """Undulations by PROJ's own interpolation."""
    shift = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=vgridshift +grids={path} +multiplier=1"
    )
    return shift.transform(lon, lat, np.zeros(len(lon)))[2]


def test_bilinear_between_posts(tmp_path):
    geoid = small(tmp_path)
    xy = np.array([[5.0, 44.0], [5.5, 43.75], [5.125, 43.875], [5.3125, 43.9375]])
    # At posts; in the middle of the first four; a quarter into the second four, from the north-west.
    right = 0.75 * (0.75 * 51 + 0.25 * 53) + 0.25 * (0.75 * 54 + 0.25 * 57)
    np.testing.assert_allclose(geoid.undulation(xy, WGS84), [50, 57, 51.75, right], rtol=0, atol=EXACT_M)
    assert geoid.undulation(np.empty((0, 2)), WGS84).shape == (0,)


def test_a_map_of_undulations(tmp_path):
    """A plane of a map is given back there, and at places named in another CRS."""
    x, y = 690_000 + 100 * (np.arange(30) + 0.5), 4_800_000 - 100 * (np.arange(20) + 0.5)
    posts = 40.0 + (x - 690_000) * 1e-3 + (y[:, None] - 4_800_000) * 2e-3
    path = write_geoid(tmp_path / "g.tif", posts, from_origin(690_000, 4_800_000, 100, 100), "EPSG:32631")
    xy = np.array([[690_050.0, 4_799_950.0], [691_234.5, 4_798_765.4]])
    expected = 40.0 + (xy[:, 0] - 690_000) * 1e-3 + (xy[:, 1] - 4_800_000) * 2e-3
    geoid = GeoidRaster.open(path)
    np.testing.assert_allclose(geoid.undulation(xy, UTM31), expected, rtol=0, atol=1e-6)
    degrees = np.column_stack(Transformer.from_crs(UTM31, WGS84, always_xy=True).transform(*xy.T))
    np.testing.assert_allclose(geoid.undulation(degrees, WGS84)[1:], expected[1:], rtol=0, atol=1e-6)


@given(lon=st.floats(-180, 180), lat=st.floats(-90, 90))
def test_as_proj_reads_its_grids_everywhere(world, lon, lat):
    (found,) = world.undulation(np.array([[lon, lat]]), WGS84)
    assert found == pytest.approx(by_proj(world.path, np.array([lon]), np.array([lat]))[0], abs=AS_PROJ_M)


def test_as_proj_around_the_seam_and_the_poles(world):
    lon = np.array([179.8, 179.99, -180.0, 180.0, -179.9, 12.3, -77.0, 0.0])
    lat = np.array([10.1, -20.2, 30.0, 30.0, 40.0, 90.0, -90.0, 89.99])
    found = world.undulation(np.column_stack([lon, lat]), WGS84)
    np.testing.assert_allclose(found, by_proj(world.path, lon, lat), rtol=0, atol=AS_PROJ_M)


def test_longitudes_from_0_to_360(tmp_path, world):
    east = from_origin(-0.125, 90.125, 0.25, 0.25)
    geoid = GeoidRaster.open(write_geoid(tmp_path / "g.tif", around_the_earth(0.0), east))
    lon = np.array([-0.1, -0.01, 5.1, -77.3, 179.95, 359.9])
    xy = np.column_stack([lon, np.linspace(-60, 60, len(lon))])
    np.testing.assert_allclose(geoid.undulation(xy, WGS84), world.undulation(xy, WGS84), rtol=0, atol=AS_PROJ_M)


def test_a_point_has_the_same_undulation_in_any_company(world):
    xy = np.random.default_rng(4).uniform([3.0, 40.0], [9.0, 47.0], (500, 2))
    alone = np.concatenate([world.undulation(xy[i : i + 1], WGS84) for i in range(len(xy))])
    assert world.undulation(xy, WGS84).tobytes() == alone.tobytes()


def test_scaled_numbers(tmp_path):
    path = write_geoid(tmp_path / "g.tif", np.array([[100, 200], [300, 400]], np.int16), from_origin(5, 44, 1, 1))
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.01,), (50.0,)
    found = GeoidRaster.open(path).undulation(np.array([[6.0, 43.0]]), WGS84)
    np.testing.assert_allclose(found, [52.5], rtol=0, atol=EXACT_M)


def test_places_without_undulations(tmp_path):
    geoid = small(tmp_path)
    for xy in ([4.99, 43.9], [5.51, 43.9], [5.2, 44.01], [5.2, 43.74], [185.2, 43.9], [np.nan, 43.9]):
        with pytest.raises(InputError, match=r"g\.tif does not cover .*posts lie between 5 and 5\.5, 43\.75 and 44 "):
            geoid.undulation(np.array([[5.2, 43.9], xy]), WGS84)
    hole = POSTS.copy()
    hole[1, 2] = -999
    holed = small(tmp_path, hole, nodata=-999)
    assert holed.undulation(np.array([[5.1, 43.9]]), WGS84) == pytest.approx(0.6 * 50.4 + 0.4 * 52.8, abs=EXACT_M)
    with pytest.raises(InputError, match=r"no value \(nodata\) around 5\.3, 43\.9 \(EPSG:4326\)"):
        holed.undulation(np.array([[5.1, 43.9], [5.3, 43.9]]), WGS84)
    points = np.array([[5.1, 43.9], [5.3, 43.9], [4.99, 43.9], [np.nan, 43.9]])
    np.testing.assert_allclose(
        holed.known_undulation(points, WGS84), [0.6 * 50.4 + 0.4 * 52.8, np.nan, np.nan, np.nan], rtol=0, atol=EXACT_M
    )
    assert holed.known_undulation(np.zeros((0, 2)), WGS84).shape == (0,)


def test_rasters_that_are_no_geoid(tmp_path):
    with pytest.raises(InputError, match="There is no geoid"):
        GeoidRaster.open(tmp_path / "none.tif")
    with pytest.raises(InputError, match="has no CRS"):
        GeoidRaster.open(write_image(tmp_path / "image.tif", POSTS))
    with pytest.raises(InputError, match="in us survey foot"):
        small(tmp_path, units="US survey foot")
    with pytest.raises(InputError, match="1 x 3 posts, too few"):
        small(tmp_path, POSTS[:1])
    with pytest.raises(InputError, match=r"is no geoid: it holds 464\.7 m"):
        small(tmp_path, np.full((2, 2), 464.7)).undulation(np.array([[5.1, 43.9]]), WGS84)
